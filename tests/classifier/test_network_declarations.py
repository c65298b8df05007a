"""Each thing that files of networks can declare, on a tiny network that declares it."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import torch
from safetensors.torch import save
from torch import Tensor, nn

from patchproof.app.keys import declarations
from patchproof.base.declarations import load_declarations
from patchproof.base.errors import Refused
from patchproof.classifier import Classifier, center_square, imagenet, load_classifier, wrapping
from patchproof.classifier.detector import Detector
from patchproof.classifier.zoo import load_weights, read_weights

pytest.importorskip("onnx", reason='needs onnx, of the extra "test"')

import onnx_files
from onnx import ModelProto, TensorProto, helper

import test_imagenet

PHOTOS = torch.rand(3, 3, 8, 8, generator=torch.Generator().manual_seed(7))
W, F = (torch.from_numpy(onnx_files.constants()[name]) for name in "WF")


def answers(folder: Path, made: ModelProto, **card: Any) -> Tensor:
    """The logits of the file's network, with a card of these entries."""
    path = onnx_files.save(folder, made)
    path.with_suffix(".json").write_text(json.dumps({"input_px": 8, "labels": onnx_files.LABELS} | card))
    return load_classifier(f"file:{path}", folder).logits(PHOTOS)


def changed(change: Callable[[ModelProto], object]) -> ModelProto:
    made = onnx_files.small()
    change(made)
    return made


def metadata(**entries: str) -> ModelProto:
    return changed(
        lambda made: [made.metadata_props.add(key=k.replace("__", "."), value=v) for k, v in entries.items()]
    )


def elsewhere(folder: Path, location: str = "w.bin", **entries: str) -> ModelProto:
    """The small network with W in a file of bytes around it."""
    made = onnx_files.small()
    weight = next(tensor for tensor in made.graph.initializer if tensor.name == "W")
    stored = bytes(8) + weight.raw_data + bytes(4)
    (folder / "w.bin").write_bytes(stored)
    (folder / "small.onnx.data").write_bytes(bytes(len(stored)))  # an earlier export, named by nobody
    weight.ClearField("raw_data")
    weight.data_location = TensorProto.EXTERNAL
    where = {"location": location, "offset": "8", "length": str(len(stored) - 12)} | entries
    for key, value in where.items():
        weight.external_data.add(key=key, value=value)
    return made


def truth(photos: Tensor = PHOTOS) -> Tensor:
    return nn.functional.conv2d(photos, W, F, padding=1).relu().mean((2, 3))


def tall() -> ModelProto:
    return onnx_files.model(onnx_files.SMALL.replace("pads=[1,1,1,1]", "pads=[2,0,1,1], strides=[2,1]"), 13)


def with_default(made: ModelProto) -> None:
    made.graph.input.extend([helper.make_tensor_value_info("W", 1, [4, 3, 3, 3])])


def checked(network: Callable[[Tensor], Tensor], make: Callable[..., Classifier] = Classifier, count: int = 3) -> None:
    load_classifier(make("it", None, 8, ("a", "b", "c")[:count], network))


class Linear(nn.Module):
    """Logits of three labels, of both signs."""

    def __init__(self, gain: float = 4.0):
        super().__init__()
        self.weight = nn.Parameter(gain * torch.tensor([[1.0, -1, 0.3], [-0.4, 1, -1], [0.2, -1, 1]]))

    def forward(self, x: Tensor) -> Tensor:
        return x.mean((2, 3)) @ self.weight.T


def candidates(boxes: list[list[float]], network: Callable[[Tensor], Tensor] | None = None) -> Callable:
    """A detector with these boxes in every picture, all with the network's logits."""

    def forward(x: Tensor) -> Tensor:
        logits = (network or Linear())(x)[:, None].expand(-1, len(boxes), -1)
        return torch.cat([torch.tensor(boxes).expand(len(x), -1, -1), logits], -1)

    return forward


def raw_detector(folder: Path, head: Any) -> Tensor:
    """The first box of a set of two, in shares, beside logits that tell a background."""
    body = """m = GlobalAveragePool(x) s = Gather<axis=1>(m, [0, 1, 2, 0, 1]) t = Squeeze(s, [3])
        l = Transpose<perm=[0,2,1]>(t)
        logits = Concat<axis=1>(l, l) n = Shape<end=1>(x) e = Concat<axis=0>(n, [2, 4])
        b = Reshape([0.5, 0.5, 0.5, 0.5, 0.25, 0.5, 0.5, 0.5], [1, 2, 4]) y = Expand(b, e)"""
    made = onnx_files.model(body)
    made.graph.output.add(name="logits")
    path = onnx_files.save(folder, made)
    card = {"input_px": 8, "labels": onnx_files.LABELS, "kind": "detector"} | ({"head": head} if head else {})
    path.with_suffix(".json").write_text(json.dumps(card))
    return load_classifier(f"file:{path}", folder).network(PHOTOS)[0, :1, :4]


GRID = [[2.0 * column, 2.0 * row, 2.0 * column + 2, 2.0 * row + 2] for row in range(4) for column in range(4)]


def weights(folder: Path, declared: dict[str, str] | None = None, **changes: Any) -> None:
    """Load a file's weights into a network of one layer."""
    network = nn.Linear(3, 2)
    (folder / "w.safetensors").write_bytes(save(network.state_dict() | changes, declared))
    load_weights(network, read_weights(folder / "w.safetensors"), "linear", "check the name")


def unlike_imagenet() -> None:
    """Check a network that takes red for blue beside another in the place of `imagenet`."""
    reference = Classifier("imagenet", None, 32, test_imagenet.NAMES, test_imagenet.Colors())
    swapped = Classifier("it", None, 32, test_imagenet.NAMES, lambda x: reference.network(x.flip(1)))
    wrapping._references.cache_clear()
    with mock.patch.multiple(imagenet, has_imagenet=lambda: True, load_imagenet=lambda: reference):
        wrapping.check_wrapping(swapped, "cpu")
    wrapping._references.cache_clear()


SHA1 = hashlib.sha1(bytes(8) + W.numpy().tobytes() + bytes(4)).hexdigest()
NAMES = metadata(names="{0: 'red'}", imgsz="[8, 8]", task="classify", license="MIT")
# by entry of the list: calls, each with the logits that it has to return or the sentence that it ends in
CASES: dict[str, tuple[Any, ...]] = {
    "of known labels, unlike those of a known network": (lambda at: unlike_imagenet(), "red and blue swapped"),
    "opset": (
        *(lambda at: answers(at, onnx_files.model(onnx_files.SMALL, 13)), truth()),
        *(lambda at: answers(at, onnx_files.model(onnx_files.SMALL, 6)), "opset 6, not one from 7"),
    ),
    "attributes of operators": (
        lambda at: answers(at, tall()),
        nn.functional.conv2d(nn.functional.pad(PHOTOS, (0, 1, 2, 1)), W, F, (2, 1)).relu().mean((2, 3)),
    ),
    "attributes that contradict each other or the weights": (
        lambda at: answers(at, onnx_files.model('y = Conv<auto_pad="VALID", pads=[1, 1, 1, 1]>(x, W)')),
        "an auto_pad 'VALID' with the pads",
    ),
    "pictures of N×S×S×3": (
        lambda at: answers(
            at,
            onnx_files.model(
                f"z = Transpose<perm=[0,3,1,2]>(x) {onnx_files.SMALL.replace('(x', '(z')}", 13, sizes="8,8,3"
            ),
        ),
        truth(),
    ),
    "fields and attributes that are not known": (
        lambda at: answers(at, changed(lambda made: made.graph.node[1].attribute.add(name="slope", type=1, f=0.5))),
        "unsupported inputs or attributes .*slope",
    ),
    "operators of other domains, functions, subgraphs": (
        lambda at: answers(at, changed(lambda made: setattr(made.graph.node[1], "domain", "com.microsoft"))),
        "the operator 'com.microsoft.Relu'",
    ),
    "training mode and steps": (
        lambda at: answers(at, onnx_files.model("y = BatchNormalization<training_mode=1>(x, S, P, S, P)")),
        "the attribute training_mode = 1",
    ),
    "sparse or quantized tensors": (
        lambda at: answers(at, changed(lambda made: made.graph.quantization_annotation.add(tensor_name="W"))),
        "quantized tensors, which is not supported",
    ),
    "location, offset, length of weights": (lambda at: answers(at, elsewhere(at)), truth()),
    "location outside of the folder": (
        lambda at: answers(at, elsewhere(at, "../w.bin")),
        r"a file beside the network, got '\.\./w\.bin' named in .*: save it again",
    ),
    "checksum of weights": (
        *(lambda at: answers(at, elsewhere(at, checksum=SHA1)), truth()),
        *(lambda at: answers(at, elsewhere(at, checksum=SHA1[::-1])), "SHA-1 is not the stated checksum"),
    ),
    "default value of an input": (lambda at: answers(at, changed(with_default)), truth()),
    "number of pictures": (lambda at: answers(at, onnx_files.model(onnx_files.SMALL, 13, batch="2")), truth()),
    "type and dimensions of the input": (
        lambda at: answers(at, changed(lambda m: setattr(m.graph.input[0].type.tensor_type, "elem_type", 10))),
        "an input that is not float32",
    ),
    "several outputs": (lambda at: answers(at, changed(lambda m: m.graph.output.add(name="b"))), "2 outputs, not one"),
    "metadata: preparation of pictures": (
        lambda at: answers(at, metadata(Image__BitmapPixelFormat="Bgr8")),
        r"takes sRGB in \[0, 1\], got Image\.BitmapPixelFormat = 'Bgr8' in .*small\.onnx: prepare",
    ),
    "metadata: other entries": (
        lambda at: answers(at, NAMES),
        "is not used: names = .*0: 'red'.*, imgsz = .*, task = ",
    ),
    "input_px": (
        *(
            lambda at: answers(at, onnx_files.model(onnx_files.SMALL, 13, sizes="3,S,S"), input_px=16),
            truth(center_square(PHOTOS, 16)),
        ),
        *(lambda at: answers(at, onnx_files.small(), input_px=16), "fails on 3×3×16×16"),
    ),
    "labels": (
        lambda at: answers(at, onnx_files.small(), labels=["a", "b", "c"]),
        r"3 logits .* got \(3, 4\).*background",
    ),
    "kind": (
        lambda at: answers(at, onnx_files.small(), kind="detector"),
        r"outputs of a detector's head for 4 labels, got N×4 from .*small\.onnx: write \"head\" into its JSON",
    ),
    "head": (
        *(lambda at: raw_detector(at, "detr"), torch.tensor([[2.0, 2, 6, 6]])),
        *(lambda at: raw_detector(at, "dert"), r"the name of a head .*, got 'dert': did you mean \"detr\""),
        *(
            lambda at: raw_detector(at, {"name": "detr", "unit": "inch"}),
            r"a usable \"unit\" in \"head\" in .*, got inch",
        ),
    ),
    "mean, std, channels, range": (
        lambda at: answers(at, onnx_files.small(), mean=[103.9, 116.8, 123.7]),
        r"got mean = \[103\.9, .*\] in .*small\.json: prepare the pictures",
    ),
    "resize, crop, interpolation, activation": (
        lambda at: answers(at, onnx_files.small(), resize_short_px=9, source="here"),
        "resize_short_px = 9$",
    ),
    "names and shapes": (lambda at: weights(at, bias=torch.zeros(3)), r"bias is \(3,\) instead of \(2,\)"),
    "whole numbers as weights": (
        lambda at: weights(at, bias=torch.zeros(2, dtype=torch.int8)),
        r"bias is \(2,\) of whole numbers instead of \(2,\)",
    ),
    "format": (lambda at: weights(at, {"format": "mlx"}), "weights of PyTorch, got format = 'mlx'"),
    "other metadata": (lambda at: weights(at, {"format": "pt", "epoch": "3"}), "is not used: epoch = '3'"),
    "probabilities, percent, 8 bits": (lambda at: checked(lambda x: Linear()(x).sigmoid()), "all from 0 to 1, also"),
    "values from 0 to 1 that may be logits": (
        lambda at: checked(lambda x: 0.3 + 0.1 * Linear(1)(x.clamp(0, 1))),
        "gives only outputs from .* to .*: if they are probabilities",
    ),
    "candidates of another shape": (
        lambda at: checked(lambda x: candidates(GRID)(x).mT, Detector),
        r"got \(3, 7, 16\) for 3 .*: write \"head\" into its JSON",
    ),
    "those of a detector's head that is not told": (
        lambda at: raw_detector(at, None),
        r'small\.onnx gives N×2×4 and N×2×5, read as the head "detr": write "head" into its JSON',
    ),
    "boxes in 0 to 1, (center, size), reversed": (
        lambda at: checked(candidates([[x / 8 for x in box] for box in GRID]), Detector),
        r'none that reaches beyond 1 px .* it \(such as \(0, 0, 0\.25, 0\.25\)\): write .*"unit": "share"',
    ),
    "boxes (top, left, bottom, right)": (
        lambda at: checked(candidates([[y, x, bottom, right] for x, y, right, bottom in GRID]), Detector),
        r"are they \(top, left, bottom, right\)",
    ),
    "boxes of pictures of another size": (
        lambda at: checked(candidates([[10 * side for side in box] for box in GRID]), Detector),
        r"boxes around \(\d+, \d+\) to \(\d+, \d+\) in squares of 8 px: are they of pictures of another size",
    ),
}


@pytest.mark.parametrize("entry", load_declarations("classifier"), ids=lambda entry: entry.declares)
def test_what_a_file_declares_is_used_refused_or_said(entry, tmp_path):
    case = CASES[entry.declares]
    with warnings.catch_warnings(action="error"):
        for act, expected in zip(case[::2], case[1::2], strict=True):
            if isinstance(expected, Tensor):
                assert entry.answer == "used"
                torch.testing.assert_close(act(tmp_path), expected, rtol=1e-4, atol=1e-5)
                continue
            with pytest.raises(UserWarning if entry.answer == "said" else Refused, match=expected):
                act(tmp_path)


def test_the_list_has_no_other_cases_and_is_on_the_page():
    listed = load_declarations("classifier")
    assert CASES.keys() == {entry.declares for entry in listed} and set(listed) <= set(declarations("Networks"))


HARMLESS = {"mean": [0, 0.0, 0], "std": [1, 1, 1], "channels": 3, "color_mode": "RGB", "range": [0, 1], "bgr": False}


@pytest.mark.parametrize(
    ("key", "value"),
    [("std", [0.229, 0.224, 0.225]), ("color_mode", "BGR"), ("input_range", [0, 255]), ("layout", "NHWC"),
     ("bgr", True), ("Image.NominalPixelRange", "NominalRange_0_255"), ("Image.ColorSpaceGamma", "Linear"),
     ("do_normalize", True)],
)  # fmt: skip
def test_preparations_other_than_ours_are_refused_and_ours_are_not(key, value, tmp_path):
    with warnings.catch_warnings(action="error"):
        torch.testing.assert_close(answers(tmp_path, onnx_files.small(), **HARMLESS), truth(), rtol=1e-4, atol=1e-5)
        with pytest.raises(Refused, match=r"takes sRGB in \[0, 1\], got "):
            answers(tmp_path, onnx_files.small(), **HARMLESS | {key: value})


# heads that make logits into something else, and what is seen of it
HEADS: dict[str, tuple[Callable[[Tensor], Tensor], str]] = {
    "a softmax without its first row": (lambda z: z.softmax(1)[:, 1:], "all from 0 to 1, also"),
    "percent": (lambda z: 100 * z.softmax(1), "rows that sum to 100"),
    "percent of each label": (lambda z: 100 * z.sigmoid(), "all from 0 to 100, also"),
    "8 bits": (lambda z: (255 * z.softmax(1)).round(), "whole numbers from .* to .* from the network it"),
    "8 bits before rounding": (lambda z: 255 * z.softmax(1), "rows that sum to 255"),
    "a sigmoid written out": (lambda z: 1 / (1 + (-z).exp()), "all from 0 to 1, also"),
    "a sigmoid of pictures that are clamped": (lambda z: z.clamp(-2, 2).sigmoid(), "all from 0 to 1, also"),
    "a hard sigmoid": (nn.functional.hardsigmoid, "all from 0 to 1, also"),
}


@pytest.mark.parametrize("head", HEADS)
def test_heads_that_squash_logits_are_refused(head):
    squash, sentence = HEADS[head]
    with pytest.raises(Refused, match=sentence):
        checked(lambda x: squash(Linear()(x)), count=2 if "without" in head else 3)
    if "sigmoid" in head or "label" in head:
        with pytest.raises(Refused, match="probabilities from the network it"):  # a detector's scores
            checked(candidates(GRID, lambda x: squash(Linear()(x))), Detector)


@pytest.mark.parametrize(
    "network",
    [
        lambda x: 0.2 * Linear()(x).relu() + 0.1,  # in 0 to 1 for the pictures, and beyond for others
        lambda x: 9 + 4 * Linear()(x),
        lambda x: Linear()(x).log_softmax(1),
        lambda x: 6 * (Linear()(x) + 0.5).clamp(0, 6),
        candidates(GRID, lambda x: 0.2 * Linear()(x).relu() + 0.1),
    ],
)
def test_logits_are_not_taken_for_probabilities(network):
    with warnings.catch_warnings(action="error"):
        try:
            checked(network, Detector if "candidates" in network.__qualname__ else Classifier)
        except UserWarning as doubt:
            assert "probabilities" not in str(doubt)


def test_weights_are_not_read_through_links_whatever_else_is_linked(tmp_path):
    """Nor if all files of the folder lead to the same other one."""
    folder = tmp_path / "received"
    folder.mkdir()
    made = elsewhere(tmp_path, "w")
    for name in ("w", "x"):
        (folder / name).symlink_to(tmp_path / "w.bin")
    with pytest.raises(Refused, match="a file beside the network, got 'w'"):
        answers(folder, made)


def test_rows_that_fill_up_a_table_are_no_boxes():
    def padded(x: Tensor) -> Tensor:
        rows = torch.full((len(x), 40, 7), -torch.inf)
        rows[..., :4] = 0
        rows[:, 30:, 4:] = -10  # a logit without a box
        return torch.cat([candidates(GRID)(x), rows], 1)

    with warnings.catch_warnings(action="error"):
        checked(padded, Detector)
        checked(candidates([[1.0, row, 3.0, row + 2] for row in range(5)]), Detector)  # too few to be a grid


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda b: [b[2], b[3], b[0], b[1]], "100% with right <= left .*: put the upper left corner first"),
        (lambda b: [(b[0] + b[2]) / 2, (b[1] + b[3]) / 2, 2.0, 2.0], "% with right <= left .*ultralytics"),
        (lambda b: [4.0, 4.0, 4.0, 4.0], r"such as \(4, 4, 4, 4\)"),
    ],
)
def test_boxes_that_are_no_corners_are_refused(change, sentence):
    with pytest.raises(Refused, match=sentence):
        checked(candidates([change(box) for box in GRID]), Detector)
    with warnings.catch_warnings(action="error"):
        checked(candidates(GRID), Detector)
        with pytest.raises(UserWarning, match=r"6% with right <= left or bottom <= top: are they \(center, size\)"):
            checked(candidates([*GRID[:-1], change(GRID[-1])]), Detector)
