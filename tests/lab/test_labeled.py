"""Labeled renders as a folder: what is written is what `harden` reads."""

from __future__ import annotations

import pytest

from patchlab.harden import labeled_photos
from patchlab.harden.labeled_photos import list_labeled_files
from patchlab.training.labeled import DEFAULT_SEED, render_procedural, render_scenes, write_labeled
from patchlab.training.pictures import HELD_OUT_SEED
from patchproof.base.errors import Refused
from patchproof.classifier.builtin import load_builtin
from patchproof.classifier.labels import find_labels
from patchproof.photo.read import read_photo


def test_every_procedural_object_is_rendered_and_the_network_knows_its_label(tmp_path):
    assert write_labeled(tmp_path / "a", render_procedural(1, 32, DEFAULT_SEED)) == 12
    rows = list_labeled_files(tmp_path / "a", tmp_path / "a/labels.csv")
    labels = load_builtin().labels
    assert [find_labels(labels, label)[0] for _, _, label in rows] == list(range(12))
    assert {read_photo(tmp_path / "a" / file).srgb.shape for file, _, _ in rows} == {(32, 32, 3)}
    assert DEFAULT_SEED > HELD_OUT_SEED  # no network of ours has seen them
    with pytest.raises(Refused, match="new folder"):
        write_labeled(tmp_path / "a", render_procedural(1, 32, DEFAULT_SEED))


def test_a_scenes_bare_object_is_seen_in_its_views_with_its_label(scene_file, tmp_path):
    for folder in ("a", "b"):
        assert write_labeled(tmp_path / folder, render_scenes([scene_file], 2, 48, 5)) == 2
    assert (tmp_path / "a/labels.csv").read_text().split() == ["file,label", "00000.png,carton", "00001.png,carton"]
    first, second, again = (read_photo(tmp_path / name).srgb for name in ("a/00000.png", "a/00001.png", "b/00000.png"))
    assert first.shape == (48, 48, 3) and (first != second).any() and (first == again).all()


def test_lines_of_a_labeled_folder_are_compared_with_few_others(tmp_path, monkeypatch):
    compared = []

    class Name(str):
        __hash__ = str.__hash__

        def __eq__(self, other):
            compared.append(1)
            return str.__eq__(self, other)

    rows = [(Name(f"{i}.png"), "a") for i in range(60)]
    monkeypatch.setattr(labeled_photos, "read_labels", lambda table, folder: rows)
    monkeypatch.setattr(labeled_photos, "is_file", lambda path: True)
    assert [png for _, png, _ in list_labeled_files(tmp_path, tmp_path / "labels.csv")] == [name for name, _ in rows]
    assert len(compared) < 5 * len(rows)
