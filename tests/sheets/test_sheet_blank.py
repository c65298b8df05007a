"""Blank sheets: what is on the page, what the manifest says of the piece, and what is refused."""

import numpy as np
import pytest

from patchproof.base.errors import Refused
from patchproof.base.packaged import packaged_path
from patchproof.sheets.blank import blank_piece, blank_sheet
from patchproof.sheets.pdf_raster import attached_manifests, rasterize_piece
from patchproof.sheets.piece import lay_out_piece
from patchproof.sheets.template import load_template
from test_sheet_write import words_px

BLANK = packaged_path("print_templates", "blank_a4.toml")


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


def test_all_but_the_markers_stays_white_paper(blank):
    path, manifest = blank
    assert manifest.design is None and manifest.promise is None and manifest.kind == "blank"
    assert attached_manifests(path)[0] == manifest and manifest.cut_mm[2:] == (162.0, 162.0)
    pixels, scale = rasterize_piece(path, manifest, 200), 200 / 25.4
    dark = (pixels < 30).all(-1).mean()
    for marker in blank_piece(manifest).markers:
        low, high = (np.array(marker.corners_mm)[[0, 2]] * scale).astype(int) + np.array([[-1], [2]])
        pixels[low[1] : high[1], low[0] : high[0]] = 255
    words = words_px(blank_piece(manifest), manifest, pixels.shape)
    assert pixels[words].min() < 100
    pixels[words] = 255
    # PDFium counts coverage of the dashed line, which lies outside, in 1/256: one code value of it may show
    assert pixels.min() >= 254 and dark > 0.02  # and the markers were there


@pytest.mark.parametrize(("piece", "marker"), [("[162.0, 162.0]", "19.0"), ("[61.7, 93.25]", "8.3")])
def test_the_piece_is_read_back_from_cut_line_and_markers(tmp_path, piece, marker):
    text = other(tmp_path, "piece_mm = [162.0, 162.0]\nmarker_mm = 19.0", f"piece_mm = {piece}\nmarker_mm = {marker}")
    manifest = blank_sheet(text, tmp_path / "b.pdf")
    read, asked = blank_piece(manifest), load_template(text).blank
    laid_out = lay_out_piece(asked.piece_mm, asked.marker_mm, manifest.sheet_id, "blank")
    assert read.size_mm == laid_out.size_mm == asked.piece_mm
    assert read.module_mm == pytest.approx(laid_out.module_mm, abs=1e-6)
    assert [m.id for m in read.markers] == [m.id for m in laid_out.markers] and len(read.markers) == 4
    for mine, printed in zip(read.markers, laid_out.markers, strict=True):
        assert np.array(mine.corners_mm) == pytest.approx(np.array(printed.corners_mm), abs=2e-6)
    assert np.array(read.reserved_mm) == pytest.approx(np.array(laid_out.reserved_mm), abs=1e-5)


def test_the_same_template_gives_the_same_bytes_and_another_one_another_id(blank, tmp_path):
    path, manifest = blank
    again = blank_sheet("blank_a4", tmp_path / "again.pdf")
    assert (tmp_path / "again.pdf").read_bytes() == path.read_bytes()
    changed = blank_sheet(other(tmp_path, "marker_mm = 19.0", "marker_mm = 18.0"), tmp_path / "other.pdf")
    assert again.sheet_id == manifest.sheet_id != changed.sheet_id


def test_a_template_for_designs_is_refused(tmp_path):
    with pytest.raises(
        Refused,
        match=r"Expected a template with a \[blank\] table.*got a4 without one: use one of: blank_a4, blank_letter",
    ):
        blank_sheet("a4", tmp_path / "b.pdf")
    with pytest.raises(Refused, match="marker_mm"):
        blank_sheet(other(tmp_path, "marker_mm = 19.0", "marker_mm = 4.0"), tmp_path / "b.pdf")


def test_a_sheet_with_a_design_or_without_markers_is_no_blank(blank):
    with pytest.raises(Refused, match='got a manifest of kind "mean"'):
        blank_piece(blank[1].model_copy(update={"kind": "mean"}))
    with pytest.raises(Refused, match="Expected markers within the blank sheet's cut line, got none: name the JSON"):
        blank_piece(blank[1].model_copy(update={"markers": blank[1].markers[4:]}))
