"""Blank sheets: what is on the page, what the manifest says of the piece, and what is refused."""

import numpy as np
import pytest

from patchproof.sheets.blank import blank_piece_mm, blank_sheet
from patchproof.sheets.piece import lay_out_piece
from patchproof.sheets.raster import attached_manifest, piece_pixels
from patchproof.sheets.template import load_template
from patchproof.strict import Refused, shipped

BLANK = shipped("print_templates", "blank_a4.toml")


@pytest.fixture(scope="module")
def blank(tmp_path_factory):
    path = tmp_path_factory.mktemp("blank") / "BLANK.pdf"
    return path, blank_sheet("blank_a4", path)


def other(tmp_path, old, new):
    text = BLANK.read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "mine.toml"
    path.write_text(text.replace(old, new), encoding="utf-8")
    return path


def test_the_middle_stays_white_paper(blank):
    path, manifest = blank
    assert manifest.design is None and manifest.promise is None and manifest.kind == "blank"
    assert attached_manifest(path) == manifest
    pixels = piece_pixels(path, manifest, 100)
    design_mm, _ = blank_piece_mm(manifest)
    inset = np.round((np.array(manifest.cut_mm[2:]) - design_mm) / 2 * 100 / 25.4).astype(int) + 1
    assert (pixels[inset[1] : -inset[1], inset[0] : -inset[0]] == 255).all()
    assert (pixels < 30).all(-1).mean() > 0.05  # and the frame is there


@pytest.mark.parametrize(("design", "marker"), [("[110.0, 110.0]", "19.0"), ("[61.7, 93.25]", "8.3")])
def test_the_piece_is_read_back_from_cut_line_and_markers(tmp_path, design, marker):
    text = other(
        tmp_path, "design_mm = [110.0, 110.0]\nmarker_mm = 19.0", f"design_mm = {design}\nmarker_mm = {marker}"
    )
    manifest = blank_sheet(text, tmp_path / "b.pdf")
    design_mm, marker_mm = blank_piece_mm(manifest)
    asked = load_template(text).blank
    assert design_mm == asked.design_mm and marker_mm == asked.marker_mm
    piece = lay_out_piece(design_mm, marker_mm, "A1B2C3D4E5", "design")
    assert piece.size_mm == pytest.approx(manifest.cut_mm[2:], abs=1e-5)
    corner = np.array(manifest.cut_mm[:2])
    for mine, printed in zip(piece.markers, manifest.markers, strict=False):
        assert np.array(mine.corners_mm) + corner == pytest.approx(np.array(printed.corners_mm), abs=1e-5)


def test_the_same_template_gives_the_same_bytes_and_another_one_another_id(blank, tmp_path):
    path, manifest = blank
    again = blank_sheet("blank_a4", tmp_path / "again.pdf")
    assert (tmp_path / "again.pdf").read_bytes() == path.read_bytes()
    changed = blank_sheet(other(tmp_path, "marker_mm = 19.0", "marker_mm = 18.0"), tmp_path / "other.pdf")
    assert again.sheet_id == manifest.sheet_id != changed.sheet_id


def test_a_template_for_designs_is_refused(tmp_path):
    with pytest.raises(
        Refused, match=r"Expected a template with a \[blank\] table.*got a4: use one of: blank_a4, blank_letter"
    ):
        blank_sheet("a4", tmp_path / "b.pdf")
    with pytest.raises(Refused, match="marker_mm"):
        blank_sheet(other(tmp_path, "marker_mm = 19.0", "marker_mm = 4.0"), tmp_path / "b.pdf")


def test_a_sheet_with_a_design_is_no_blank(blank):
    with pytest.raises(Refused, match='got one of kind "mean"'):
        blank_piece_mm(blank[1].model_copy(update={"kind": "mean"}))
