"""The code on the page: it names sheet and design, and a page that is another's is refused."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from synthetic_photos import some_design

from patchproof.channel.printer import identity_printer
from patchproof.evidence.locate import pinhole_photo
from patchproof.evidence.measure import measure
from patchproof.evidence.surface import promised_of, surface_of
from patchproof.evidence.task import promised_ranges
from patchproof.photo import page_code
from patchproof.photo.page_code import read_page_code
from patchproof.photo.read import Photo
from patchproof.sheets.blank import blank_sheet
from patchproof.sheets.content import SheetContent
from patchproof.sheets.pdf_raster import rasterize_page
from patchproof.sheets.piece import lay_out_piece
from patchproof.sheets.template import load_template
from patchproof.sheets.write import write_several, write_sheet

DPI = 100


def sheet(path, seed=0, identity="A1B2C3D4E5", kind="design"):
    design = some_design(seed)  # a smooth one: in hard squares the detector looks for markers
    content = SheetContent(lay_out_piece((136, 136), 16.0, identity, kind), identity, kind, design)
    return write_sheet(path, load_template("a4"), content)


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """Manifests and pages: a sheet, the same sheet with another design, and another sheet."""
    folder = tmp_path_factory.mktemp("labels")
    made = {}
    for name, seed, identity in (("ours", 0, "A1B2C3D4E5"), ("design", 1, "A1B2C3D4E5"), ("sheet", 0, "Z9Y8X7W6V5")):
        manifest = sheet(folder / f"{name}.pdf", seed, identity)
        made[name] = manifest, rasterize_page(folder / f"{name}.pdf", 1, DPI)
    return made


def verified(manifest, srgb, scan_dpi=None):
    surface = surface_of(manifest)
    promised = promised_of(manifest, surface, identity_printer())
    return measure(pinhole_photo(Photo(srgb, None), None), "a", surface, promised, promised_ranges(()), scan_dpi)


def oblique(page):
    """The page on a gray table, seen from aside: 3.2 px per mm on its near side, 2.4 on its far one."""
    height, width = page.shape[:2]
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    seen = np.array([[128, 48], [640, 72], [744, 952], [56, 936]], np.float32)
    size = (800, 1000)
    picture = cv2.warpPerspective(
        page, cv2.getPerspectiveTransform(corners, seen), size, flags=cv2.INTER_AREA, borderValue=(120, 120, 120)
    )
    return cv2.GaussianBlur((picture * 0.8).astype(np.uint8), (0, 0), 0.6)


def test_every_page_carries_what_its_manifest_says(pages, tmp_path):
    for manifest, page in pages.values():
        assert read_page_code(page) == manifest.code
    blank = blank_sheet("blank_a4", tmp_path / "blank.pdf")
    assert (
        read_page_code(rasterize_page(tmp_path / "blank.pdf", 1, DPI))
        == blank.code
        == f"patchproof:{blank.sheet_id}:blank"
    )


@pytest.mark.parametrize(
    "text", ["", "patchproof:", "https://example.org", "patchproof:short:00", "x patchproof:A1B2C3D4E5:0"]
)
def test_other_codes_are_none_of_ours(text, monkeypatch):
    for name in ("QRCodeDetectorAruco", "QRCodeDetector"):
        monkeypatch.setattr(page_code.cv2, name, lambda: SimpleNamespace(detectAndDecode=lambda gray: (text,)))
    assert read_page_code(np.zeros((80, 80, 3), np.uint8)) is None


@pytest.mark.parametrize(("look", "scan_dpi"), [(lambda page: (page * 0.8).astype(np.uint8), DPI), (oblique, None)])
def test_a_page_of_another_design_is_the_wrong_sheet_though_its_markers_are_ours(pages, look, scan_dpi):
    ours, page = pages["ours"]
    good = verified(ours, look(page), scan_dpi)
    assert good.entry.status == "measured" and good.entry.code is None
    other, other_page = pages["design"]
    assert {m.id for m in other.markers} == {m.id for m in ours.markers}
    bad = verified(ours, look(other_page), scan_dpi)
    assert (bad.entry.status, bad.entry.code, bad.counted) == ("rejected", "wrong_sheet", False)
    assert other.design.sha256[:16] in bad.entry.remark.advice and ours.design.sha256[:16] in bad.entry.remark.advice
    # and without its code its own pixels tell the design apart
    hidden = other_page.copy()
    hidden[: int(55 / 25.4 * DPI), int(175 / 25.4 * DPI) :] = 255
    assert verified(ours, look(hidden), scan_dpi).entry.code == "other_design"


def test_another_sheet_is_named(pages):
    entry = verified(pages["ours"][0], pages["sheet"][1][: int(65 / 25.4 * DPI)]).entry
    assert (entry.status, entry.code) == ("rejected", "wrong_sheet")
    assert "Z9Y8X7W6V5" in entry.remark.advice


def test_the_code_alone_tells_of_another_sheet_when_no_marker_can_be_read(pages):
    manifest, page = pages["sheet"]
    covered = page.copy()
    for marker in manifest.markers:
        low, high = (np.array(marker.corners_mm)[[0, 2]] * DPI / 25.4).astype(int)
        covered[low[1] : high[1], low[0] : high[0]] = 128
    covered = covered[: int(65 / 25.4 * DPI)]
    assert verified(pages["ours"][0], covered).entry.code == "wrong_sheet"
    assert verified(manifest, covered).entry.code == "too_few_markers"


def test_a_page_of_several_designs_is_each_ones_own_and_nobody_elses(tmp_path):
    template, looks = load_template("a4"), {}

    def page(name, *designs):
        each = [
            SheetContent(lay_out_piece((64, 64), 8, identity, "design"), identity, "design", pixels, None, {})
            for identity, pixels in designs
        ]
        manifests = write_several(tmp_path / f"{name}.pdf", template, each)
        looks[name] = (rasterize_page(tmp_path / f"{name}.pdf", 1, DPI) * 0.8).astype(np.uint8)
        assert {manifest.code for manifest in manifests} == {read_page_code(looks[name])}
        return manifests

    ids, designs = ("A1B2C3D4E5", "B1B2C3D4E5", "C1B2C3D4E5"), [some_design(seed) for seed in range(4)]
    ours = page("ours", *zip(ids, designs[:3], strict=True))
    entry = verified(ours[2], looks["ours"], DPI).entry
    assert (entry.status, entry.code) == ("measured", None)
    page("one changed", *zip(ids, [*designs[:2], designs[3]], strict=True))
    page("without ours", ("Z9Y8X7W6V5", designs[3]), *zip(ids[1:], designs[1:3], strict=True))
    for other, code in (("one changed", "wrong_sheet"), ("without ours", "several_sheets")):
        entry = verified(ours[0], looks[other], DPI).entry
        assert (entry.status, entry.code) == ("rejected", code)
