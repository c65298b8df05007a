"""Files of networks and their cards: what is loaded, what is refused, and how it is said."""

from __future__ import annotations

import json
import pickle
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from patchproof.base.errors import Refused
from patchproof.classifier import center_square, load_classifier, network_file
from patchproof.classifier.network_file import load_network

pytest.importorskip("onnx", reason='needs onnx, of the extra "test"')

import onnx_files
from onnx.reference import ReferenceEvaluator


@pytest.fixture
def small(tmp_path) -> Path:
    return onnx_files.save(tmp_path, onnx_files.small())


@pytest.mark.parametrize(
    ("card", "sentence"),
    [
        (None, r"Expected a JSON file, got no file at .*small\.json: write"),
        ("{", "that cannot be read"),
        ("[]", "input_px"),
        ('{"input_px": "8", "labels": ["a", "b"]}', "input_px.*'8'"),
        ('{"input_px": 8, "labels": ["a"]}', "labels, a list of two or more names"),
        ('{"input_px": 8, "labels": "names.json"}', r"no file at .*names\.json: put the list of labels there"),
        ('{"input_px": 8, "labels": ""}', "put the list of labels there"),
        ('{"input_px": 8, "labels": "/"}', "put the list of labels there"),
        ('{"input_px": 8, "labels": ["a", "b", "c"]}', "3 logits for each picture.*\\(3, 4\\)"),
        ('{"input_px": 12, "labels": ["a", "b", "c", "d"]}', "takes N×3×S×S pictures"),
    ],
)
def test_a_card_that_is_missing_or_wrong_is_refused(card, sentence, small):
    if card is None:
        small.with_suffix(".json").unlink()
    else:
        small.with_suffix(".json").write_text(card)
    with pytest.raises(Refused, match=sentence) as caught:
        load_classifier(f"file:{small}", small.parent)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 700


def test_labels_may_lie_in_a_list_beside_the_card(small):
    small.with_suffix(".json").write_text('{"input_px": 8, "labels": "list.json"}')
    (small.parent / "list.json").write_text(json.dumps(onnx_files.LABELS))
    assert load_network(small).labels == tuple(onnx_files.LABELS)


def test_a_file_of_absurd_size_is_refused_unread(small, monkeypatch):
    monkeypatch.setattr(network_file, "MAX_BYTES", 100)
    monkeypatch.setattr(Path, "read_bytes", lambda self: pytest.fail("it was read"))
    with pytest.raises(Refused, match="more than 0 KiB"):
        load_network(small)


@pytest.mark.parametrize("suffix", [".pt2", ".pt", ".pth", ".pkl", ".onnx.bin", ""])
def test_other_files_are_refused_unread_with_the_way_to_an_onnx_file(suffix, tmp_path, monkeypatch):
    path = tmp_path / f"net{suffix}"
    path.write_bytes(pickle.dumps(sys.exit))
    monkeypatch.setattr(Path, "read_bytes", lambda self: pytest.fail("it was read"))
    with pytest.raises(Refused, match=r"an ONNX file, file:NAME\.onnx, got .*: export it with torch\.onnx\.export"):
        load_classifier(f"file:{path}", tmp_path)
    if suffix == ".pt2":  # also without the word that would say what it is
        with pytest.raises(Refused, match=r'got "net\.pt2": export it with torch\.onnx\.export'):
            load_classifier("net.pt2", tmp_path)


def test_a_network_of_one_batch_size_takes_any_number(tmp_path):
    path, photos = onnx_files.save(tmp_path, onnx_files.model(onnx_files.SMALL, 13, batch="3")), torch.rand(7, 3, 8, 8)
    of_three, of_any = load_network(path), load_network(onnx_files.save(tmp_path, onnx_files.small(), name="any"))
    assert (of_three.network.size, of_any.network.size) == (3, None)
    torch.testing.assert_close(of_three.logits(photos), of_any.logits(photos))


@pytest.mark.filterwarnings("ignore:.*resize_short_px")
def test_real_networks_recognize_a_photograph(data):
    from PIL import Image

    photo = np.asarray(Image.open(data / "photos" / "skimage_coffee.png").convert("RGB")).copy()
    photo = torch.from_numpy(photo).permute(2, 0, 1)[None].float() / 255
    for name in ("mobilenet_v1_0.25_128", "squeezenet1.1_224"):
        classifier = load_classifier(f"file:${{PATCHPROOF_DATA}}/models/{name}.onnx", Path("."))
        assert classifier.logits(photo).argmax() == 967  # espresso
    square = center_square(photo, 128)
    path = data / "models" / "mobilenet_v1_0.25_128.onnx"
    reference, ours = ReferenceEvaluator(str(path)), load_network(path).network(square)
    (truth,) = reference.run(None, {reference.input_names[0]: square.numpy()})
    torch.testing.assert_close(ours, torch.from_numpy(truth), rtol=1e-5, atol=1e-5 * float(np.abs(truth).max()))
