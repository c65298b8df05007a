"""A sheet carries what its verdict needs, and nothing of the folders of the machine that made it; blanks are cut."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from patchproof.base.errors import Refused
from patchproof.base.packaged import packaged_path
from patchproof.channel.printer import carried_printer, load_printer, printer_of_sheet
from patchproof.reprints import page_photos
from patchproof.reprints.reprint import DEFAULT_SETUP
from patchproof.reprints.run_sheet import without_folders
from patchproof.sheets.blank import blank_sheet


def test_a_printer_without_a_name_goes_with_the_sheet(tmp_path):
    for suffix in (".npz", ".json"):
        shutil.copy(packaged_path("calibration", "printers", f"uncoated{suffix}"), tmp_path / f"mine{suffix}")
    mine = load_printer("mine.json", tmp_path)
    carried = json.loads(json.dumps(carried_printer(tmp_path / "mine.npz")))
    shutil.rmtree(tmp_path)
    assert printer_of_sheet(carried, "sheet.json").sha256 == mine.sha256
    for text, sentence in (("é", "base64, got sheet.json with other text"), ("AAAA", "printer's tables, got")):
        with pytest.raises(Refused, match=sentence):
            printer_of_sheet(carried | {"npz": text}, "sheet.json")


def test_settings_of_a_sheet_name_no_folder_of_this_machine(tmp_path):
    settings = {
        "object": {"mesh": f"{tmp_path}/mug.glb"},
        "models": [f"file:{tmp_path}/n.onnx", "builtin"],
        "px": [1, 2],
    }
    portable = without_folders(settings, lambda name: name.replace(str(tmp_path), "../scene"))
    assert portable == {"object": {"mesh": "mug.glb"}, "models": ["file:../scene/n.onnx", "builtin"], "px": [1, 2]}


def test_of_a_blank_sheet_only_the_piece_is_photographed(tmp_path, monkeypatch):
    """Markers of its page would stand beside the print that hangs in its place: "several_sheets"."""
    sizes = []

    def photograph(page: np.ndarray, seed: int) -> tuple[bytes, np.ndarray]:
        sizes.append(page.shape[:2])
        return b"", np.ones(3)

    monkeypatch.setattr(page_photos, "PX_PER_MM", 2)
    monkeypatch.setattr(page_photos, "photograph_page", photograph)
    blank = blank_sheet("blank_a4", tmp_path / "blank.pdf")
    page_photos.reprint_pages(tmp_path / "blank.pdf", 1, tmp_path / "photos", DEFAULT_SETUP)
    assert sizes == [(324, 324)] and blank.cut_mm[2:] == (162, 162)
