"""Damaged and odd files end in a picture or a code, damaged manifests in a sentence, and none takes long."""

from __future__ import annotations

import json
import time

import numpy as np
import pytest
from fuzz.hostile_bytes import PHOTO_KINDS, changed, mutated, whole_photo
from synthetic_photos import make_manifest

from patchproof.base.errors import Refused
from patchproof.photo.read import read_photo
from patchproof.photo.rejection import REJECTION_CODES, PhotoRejected
from patchproof.sheets.manifest import dump_manifest, load_manifest

PHOTOS, MANIFESTS, SECONDS = 120, 60, 5.0


def test_damaged_photographs_give_a_picture_or_a_code(tmp_path):
    rng, refused = np.random.default_rng(0), 0
    for i in range(PHOTOS):
        kind = PHOTO_KINDS[i % len(PHOTO_KINDS)]
        path = tmp_path / f"{i}.{rng.choice(['jpg', 'png', 'tif'])}"
        path.write_bytes(mutated(rng, whole_photo(rng, kind)))
        begin = time.monotonic()
        try:
            photo = read_photo(path)
            assert photo.srgb.dtype == np.uint8 and photo.srgb.ndim == 3 and photo.srgb.shape[2] == 3
        except PhotoRejected as cannot:
            assert cannot.code in REJECTION_CODES and cannot.advice
            refused += 1
        assert time.monotonic() - begin < SECONDS
    assert refused > PHOTOS / 4  # or the files were not damaged


@pytest.mark.parametrize("kind", PHOTO_KINDS, ids=lambda kind: f"{kind[1]}-{kind[0]}")
def test_whole_photographs_of_every_kind_are_read(tmp_path, kind):
    path = tmp_path / "photo.jpg"
    path.write_bytes(whole_photo(np.random.default_rng(1), kind))
    assert read_photo(path).srgb.shape == (24, 32, 3)


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
