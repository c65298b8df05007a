"""Damaged and odd files end in a picture or a code, damaged manifests in a sentence, and none takes long."""

from __future__ import annotations

import io
import json
import time

import numpy as np
import pytest
from PIL import Image

from patchproof.photo.cannot import CODES, CannotJudge
from patchproof.photo.read import read_photo
from patchproof.sheets.manifest import dump_manifest, load_manifest
from patchproof.strict import Refused
from test_photo_synthetic import make_manifest

PHOTOS, MANIFESTS, SECONDS = 120, 60, 5.0
KINDS = [
    ("RGB", "JPEG", {"quality": 80}),
    ("RGB", "JPEG", {"progressive": True}),
    ("CMYK", "JPEG", {}),
    ("L", "JPEG", {}),
    ("RGB", "PNG", {}),
    ("RGBA", "PNG", {}),
    ("P", "PNG", {}),
    ("I;16", "PNG", {}),
    ("RGB", "TIFF", {"compression": "tiff_lzw"}),
    ("CMYK", "TIFF", {}),
    ("F", "TIFF", {}),
    ("RGB", "WEBP", {}),
    ("RGB", "BMP", {}),
    ("P", "GIF", {}),
    ("P", "GIF", {"animated": True}),
]


def whole_file(rng, kind) -> bytes:
    """A small valid picture of a kind."""
    mode, file_format, options = kind
    pixels = rng.integers(0, 256, (24, 32, 3), np.uint8)
    if mode == "I;16":
        image = Image.fromarray(pixels[..., 0].astype(np.uint16) * 257)
    elif mode == "F":
        image = Image.fromarray(pixels[..., 0].astype(np.float32) / 255)
    else:
        image = Image.fromarray(pixels).convert(mode)
    options, buffer = dict(options), io.BytesIO()
    if options.pop("animated", False):
        options |= {"save_all": True, "append_images": [image.rotate(90), image.rotate(180)]}
    image.save(buffer, file_format, **options)
    return buffer.getvalue()


def mutated(rng, data: bytes) -> bytes:
    """Cut, overwritten, with a piece doubled or dropped, or with huge numbers in its header."""
    data, how = bytearray(data), rng.integers(6)
    at = int(rng.integers(len(data)))
    if how == 0:
        return bytes(data[:at])
    if how == 1:
        for place in rng.integers(0, len(data), rng.integers(1, 20)):
            data[place] = rng.integers(256)
    elif how == 2:
        for place in rng.integers(0, min(len(data), 64), 3):
            data[place] = rng.choice([0, 127, 128, 255])
    elif how == 3:
        data[at:at] = data[: rng.integers(1, 200)]
    elif how == 4:
        del data[at : at + int(rng.integers(1, 50))]
    else:
        start = int(rng.integers(0, min(len(data), 40)))
        data[start : start + 4] = b"\x7f\xff\xff\xff"
    return bytes(data)


def test_damaged_photographs_give_a_picture_or_a_code(tmp_path):
    rng, refused = np.random.default_rng(0), 0
    for i in range(PHOTOS):
        kind = KINDS[i % len(KINDS)]
        path = tmp_path / f"{i}.{rng.choice(['jpg', 'png', 'tif'])}"
        path.write_bytes(mutated(rng, whole_file(rng, kind)))
        begin = time.monotonic()
        try:
            photo = read_photo(path)
            assert photo.srgb.dtype == np.uint8 and photo.srgb.ndim == 3 and photo.srgb.shape[2] == 3
        except CannotJudge as cannot:
            assert cannot.code in CODES and cannot.advice
            refused += 1
        assert time.monotonic() - begin < SECONDS
    assert refused > PHOTOS / 4  # or the files were not damaged


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: f"{kind[1]}-{kind[0]}")
def test_whole_photographs_of_every_kind_are_read(tmp_path, kind):
    path = tmp_path / "photo.jpg"
    path.write_bytes(whole_file(np.random.default_rng(1), kind))
    assert read_photo(path).srgb.shape == (24, 32, 3)


def changed(rng, value):
    """The same JSON value with one thing in it made wrong."""
    if isinstance(value, dict) and value and rng.random() < 0.85:
        key = str(rng.choice(list(value)))
        if rng.random() < 0.15:
            return {k: v for k, v in value.items() if k != key}
        return value | {key: changed(rng, value[key])}
    if isinstance(value, list) and value and rng.random() < 0.85:
        at = int(rng.integers(len(value)))
        return [*value[:at], *([] if rng.random() < 0.15 else [changed(rng, value[at])]), *value[at + 1 :]]
    odd = [None, True, -1, 0, 1e308, "", "x" * 1000, [], {}, [[]], {"a": 1}, float("nan"), float("inf"), -1e-300]
    return odd[rng.integers(len(odd))]


def test_damaged_manifests_are_read_or_refused_in_a_sentence(tmp_path):
    rng, whole, refused = np.random.default_rng(0), dump_manifest(make_manifest()), 0
    path = tmp_path / "sheet.json"
    for i in range(MANIFESTS):
        if i % 2:
            path.write_bytes(mutated(rng, whole.encode()))
        else:
            path.write_text(json.dumps(changed(rng, json.loads(whole))), encoding="utf-8")
        begin = time.monotonic()
        try:
            load_manifest(path)
        except Refused as refusal:
            assert "xpected" in str(refusal)
            refused += 1
        assert time.monotonic() - begin < SECONDS
    assert refused > MANIFESTS / 3
