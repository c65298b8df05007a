"""Pages of every template, pieces in tiles, several designs on a page: read back by PDFium, OpenCV and pikepdf."""

from __future__ import annotations

import json
from itertools import pairwise

import cv2
import numpy as np
import pikepdf
import pypdfium2
import pytest

from patchproof.base.errors import Refused
from patchproof.base.geometry import apply_homography, rect_corners
from patchproof.base.packaged import packaged_path
from patchproof.base.validation import read_toml
from patchproof.evidence.locate import pinhole_photo
from patchproof.evidence.measure import measure
from patchproof.evidence.surface import surface_of
from patchproof.evidence.task import promised_ranges
from patchproof.photo.page_code import read_page_code
from patchproof.photo.read import Photo
from patchproof.sheets.blank import BOARD, board_sheet, chart_sheet
from patchproof.sheets.content import SheetContent
from patchproof.sheets.layout import Box, check_layout
from patchproof.sheets.manifest import load_manifest
from patchproof.sheets.page import largest_piece_mm, refuse_larger_than_page
from patchproof.sheets.pdf_raster import attached_manifests, rasterize_page, rasterize_piece
from patchproof.sheets.piece import lay_out_piece, marker_image
from patchproof.sheets.plan_page import PlanPage
from patchproof.sheets.print_advice import sheet_advice
from patchproof.sheets.template import load_template, template_data, template_names
from patchproof.sheets.tiles import plan_tiles
from patchproof.sheets.write import write_several, write_sheet
from test_benefit import promise_of
from test_sheet_write import DPI, ID, PX_PER_MM, detect, sample_design

NAMES = template_names()
DESIGN = cv2.resize(sample_design(12, 12), (120, 120), interpolation=cv2.INTER_CUBIC)


PIECE = lay_out_piece((680, 680), 30, ID, "design", bends=True)  # in tiles


def write(path, name, piece_mm=None, marker_mm=None, design=DESIGN, **more):
    if BOARD in template_data(name)[1]:
        return board_sheet(name, path)
    template = load_template(name)
    if template.piece is None:
        return chart_sheet(template, path)
    piece_mm = piece_mm or ((280, 280) if template.tiles else (90, 90))
    piece = lay_out_piece(piece_mm, marker_mm or (20 if template.tiles else 8), ID, "design", bends=True)
    return write_sheet(path, template, SheetContent(piece, ID, "design", design), **more)


@pytest.mark.parametrize("name", NAMES)
def test_every_page_has_its_markers_within_a_tenth_of_a_millimeter_its_code_and_its_fonts(tmp_path, name):
    path, margin = tmp_path / "s.pdf", read_toml(packaged_path("print_templates", f"{name}.toml"))["margin_mm"]
    manifest = write(path, name)
    with pikepdf.open(path) as pdf:
        count = len(pdf.pages)
        for page in pdf.pages:
            fonts = page.obj.Resources.Font
            assert all("/FontFile2" in font.FontDescriptor for font in fonts.values())
            size = [0, 0, *(side / 25.4 * 72 for side in manifest.page_mm)]
            for box in ("/MediaBox", "/TrimBox", "/BleedBox"):
                assert [float(v) for v in page.obj[box]] == pytest.approx(size, abs=1e-3)
            for image in page.obj.Resources.get("/XObject", {}).values():
                assert image.ColorSpace[0] == "/ICCBased"
    for number in range(1, count + 1):
        pixels = rasterize_page(path, number, DPI)
        found = detect(pixels)
        expected = [marker for marker in manifest.markers if marker.page == number]
        assert set(found) == {marker.id for marker in expected} and expected
        for marker in expected:
            assert np.abs(found[marker.id] / PX_PER_MM - np.array(marker.corners_mm)).max() < 0.1
        assert_nothing_lies_over(pixels, manifest, number, margin)
        if number == 1:
            assert read_page_code(pixels) == manifest.code
    assert attached_manifests(path)[0] == load_manifest(path.with_suffix(".json")) == manifest


def assert_nothing_lies_over(pixels, manifest, number, margin_mm):
    """What another library rendered: white margins, white round every marker, one color all over each swatch."""
    low, high = int(margin_mm * PX_PER_MM), np.ceil((np.array(manifest.page_mm) - margin_mm) * PX_PER_MM).astype(int)
    inside = np.zeros(pixels.shape[:2], bool)
    inside[low : high[1], low : high[0]] = True
    assert (pixels[~inside] == 255).all()
    for marker in (m for m in manifest.markers if m.page == number):
        (x0, y0), (x1, y1) = np.array(marker.corners_mm)[[0, 2]]
        for reach, white in ((0.9 * (x1 - x0) / 7, True), (-0.5 * (x1 - x0) / 7, False)):  # of 7 modules
            left, top = np.ceil(np.array([x0 - reach, y0 - reach]) * PX_PER_MM).astype(int)
            right, bottom = np.floor(np.array([x1 + reach, y1 + reach]) * PX_PER_MM).astype(int)
            ring = [pixels[top, left:right], pixels[bottom - 1, left:right]]
            ring += [pixels[top:bottom, left], pixels[top:bottom, right - 1]]
            assert (np.concatenate(ring) == (255 if white else 0)).all(), marker.id
    for swatch in (s for s in manifest.chart if s.page == number):
        x, y, w, h = (v * PX_PER_MM for v in swatch.rect_mm)
        seen = pixels[int(np.ceil(y)) : int(y + h), int(np.ceil(x)) : int(x + w)]
        assert seen.size and np.abs(seen - np.array(swatch.srgb) * 255).max() < 0.51, swatch


def test_letter_and_a4_differ_in_layout_alone():
    def content(name):
        data = load_template(name).model_dump()
        for line in data["text"]:
            del line["at_mm"]
        for table, key in (
            ("chart", "corner_mm"),
            ("qr", "corner_mm"),
            ("marker", "corners_mm"),
        ):
            del data[table][key]
        for key in ("x_start_mm", "y_start_mm"):
            del data["ruler"][key]
        return {key: value for key, value in data.items() if key not in ("page_mm", "piece")}

    assert content("letter") == content("a4")
    assert content("blank_letter") == content("blank_a4")
    assert load_template("letter").page_mm == (215.9, 279.4)


def test_charts_have_the_colors_that_they_promise(tmp_path):
    for name, count in (("chart_a4", 96), ("chart_letter", 96), ("chart48_a4", 48)):
        manifest = write(tmp_path / f"{name}.pdf", name)
        assert len(manifest.chart) == count and manifest.kind == "chart"
        pixels = rasterize_page(tmp_path / f"{name}.pdf", 1, 50)
        for swatch in manifest.chart:
            x, y, w, h = (v * 50 / 25.4 for v in swatch.rect_mm)
            assert np.array_equal(pixels[int(y + h / 2), int(x + w / 2)], np.rint(np.array(swatch.srgb) * 255))


@pytest.fixture(scope="module")
def tiled(tmp_path_factory):
    path = tmp_path_factory.mktemp("tiles") / "s.pdf"
    return path, write(path, "a4_tiles", PIECE.size_mm, 30)


SCAN_DPI = 100


def scanned(page, seed):
    """A page turned by up to 2° and shifted by up to 3 mm on the scanner, and its homography from page mm to px."""
    rng = np.random.default_rng(seed)
    turn, shift = np.radians(rng.uniform(-2, 2)), rng.uniform(-12, 12, 2)
    c, s = np.cos(turn), np.sin(turn)
    matrix = np.array([[c, -s, shift[0]], [s, c, shift[1]], [0, 0, 1.0]])  # of edges, about the corner
    half = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
    size = page.shape[1] + 80, page.shape[0] + 80
    move = np.array([[1, 0, 40], [0, 1, 40], [0, 0, 1.0]])
    whole = half @ move @ matrix @ np.linalg.inv(half)
    scan = cv2.warpAffine(page, whole[:2], size, flags=cv2.INTER_LINEAR, borderValue=(255, 255, 255))
    return scan, move @ matrix @ np.diag([SCAN_DPI / 25.4, SCAN_DPI / 25.4, 1])


def test_a_600_mm_patch_rebuilds_from_scans_of_its_tiles_within_half_a_millimeter(tiled):
    path, manifest = tiled
    surface, origin, errors = surface_of(manifest), np.array(manifest.design.rect_mm[:2]), []
    assert len(manifest.tiles) >= 12 and len(surface.piece_ids) == 8
    for tile in manifest.tiles[::3]:  # each is scanned and measured by itself
        scan, truth = scanned(rasterize_page(path, tile.page, SCAN_DPI), tile.page)
        measured = measure(pinhole_photo(Photo(scan, None), None), "scan", surface, None, promised_ranges(()), SCAN_DPI)
        entry = measured.entry
        assert entry.status == "measured" and not measured.counted
        assert (entry.scale.scale_x, entry.scale.scale_y) == pytest.approx((1, 1), abs=0.002)
        corners = rect_corners(tile.cut_mm)
        in_design_page = corners - np.array(tile.page_from_design_mm)[:, 2] + origin
        seen = apply_homography(np.array(entry.geometry.homography_px_from_mm), in_design_page)
        errors.append(np.linalg.norm(seen - apply_homography(truth, corners), axis=1).max() / SCAN_DPI * 25.4)
    assert max(errors) < 0.5


def test_assembled_tiles_are_the_design_and_all_its_markers(tiled):
    path, manifest = tiled
    pixels = rasterize_piece(path, manifest, 50)
    scale = pixels.shape[1] / manifest.cut_mm[2]
    found, surface = detect(pixels), surface_of(manifest)
    assert set(found) == surface.piece_ids
    for i in surface.piece_ids:
        assert np.abs(found[i] / scale + manifest.cut_mm[:2] - surface.corners_mm[i]).max() < 0.25
    x, y, w, h = manifest.design.rect_mm
    at = (np.arange(120) + 0.5) / 120
    columns = ((x - manifest.cut_mm[0] + at * w) * scale).astype(int)
    rows = ((y - manifest.cut_mm[1] + at * h) * scale).astype(int)
    free = ~marker_image(PIECE, (120, 120))[1]
    assert np.abs(pixels[np.ix_(rows, columns)].astype(int) - DESIGN)[free].mean() < 4 and free.mean() > 0.8
    measured = measure(pinhole_photo(Photo(pixels, None), None), "p", surface, None, promised_ranges(()))
    assert measured.counted and measured.entry.markers_found == 8  # glued together it is no page check


def test_a_blank_piece_in_tiles_is_put_together_as_one_with_a_design_is(tmp_path):
    pixels = {}
    for name, design in (("blank", None), ("white", np.full((8, 8, 3), 255, np.uint8))):
        path = tmp_path / f"{name}.pdf"
        pixels[name] = rasterize_piece(path, write(path, "a4_tiles", design=design), 50)
    np.testing.assert_array_equal(pixels["blank"], pixels["white"])


def test_a_scan_of_the_first_page_is_a_page_check(tiled):
    path, manifest = tiled
    page = rasterize_page(path, 1, 75)
    measured = measure(pinhole_photo(Photo(page, None), None), "p", surface_of(manifest), None, promised_ranges(()))
    assert measured.entry.code is None and not measured.counted


@pytest.mark.parametrize(
    ("piece_mm", "marker_mm", "bends"),
    [((650, 650), 30, True), ((600, 650), 30, False), ((1500, 200), 15, False), ((330, 1400), 12.5, False)],
)
def test_seams_are_even_and_spare_the_markers_and_their_white(piece_mm, marker_mm, bends):
    template, piece = load_template("a4_tiles"), lay_out_piece(piece_mm, marker_mm, ID, "design", bends)
    tiles = plan_tiles(template, piece)
    area = sum(t.part_mm[2] * t.part_mm[3] for t in tiles)
    assert area == pytest.approx(piece.size_mm[0] * piece.size_mm[1], rel=1e-6)
    for axis in (0, 1):
        seams = sorted({t.part_mm[axis] for t in tiles} - {0.0})
        assert max(b - a for a, b in pairwise([0.0, *seams, piece.size_mm[axis]])) <= template.tiles.zone_mm[2 + axis]
        for rect in piece.reserved_mm:
            # to a hundredth of a millimeter, to which seams are laid
            assert not any(rect[axis] + 0.006 < seam < rect[axis] + rect[axis + 2] - 0.006 for seam in seams)
        even = piece.size_mm[axis] / (len(seams) + 1)
        widest = max(rect[axis + 2] for rect in piece.reserved_mm)
        assert all(abs(seam - even * (i + 1)) <= widest / 2 + 0.01 for i, seam in enumerate(seams))


def test_markers_too_large_for_tiles_are_refused():
    """Corners of 136 × 9/7 + 1 = 175.9 mm go on tiles of 177 mm, those of 137 mm markers are 177.1 mm wide."""
    template = load_template("a4_tiles")
    assert plan_tiles(template, lay_out_piece((700, 700), 136, ID, "design"))
    with pytest.raises(
        Refused, match="can be divided into tiles without cutting a marker, got markers of 137 mm on tiles"
    ):
        plan_tiles(template, lay_out_piece((700, 700), 137, ID, "design"))


def test_a_piece_with_more_markers_than_ids_is_refused_before_it_is_optimized():
    template = load_template("a4_tiles")
    for marker_mm, markers, fits in ((10, 36, True), (8, 44, False)):
        piece = lay_out_piece((1000, 1000), marker_mm, ID, "design")
        assert len(piece.markers) == markers and len(plan_tiles(template, piece)) == 24
        if fits:
            refuse_larger_than_page(template, piece)  # 36 + 4 + 5 × 24 = 160
        else:
            with pytest.raises(Refused, match="at most 166 markers on one sheet, got 168: use larger or fewer tiles"):
                refuse_larger_than_page(template, piece)


def test_copies_are_pages_of_the_same(tmp_path):
    write(tmp_path / "s.pdf", "label_102x152", copies=3)
    pages = [rasterize_page(tmp_path / "s.pdf", n, 50) for n in (1, 2, 3)]
    assert np.array_equal(pages[0], pages[1]) and np.array_equal(pages[0], pages[2])


def designs(*ids, piece_mm=(84, 84)):
    return [
        SheetContent(lay_out_piece(piece_mm, 8, i, "design"), i, "design", np.roll(DESIGN, n), None, {})
        for n, i in enumerate(ids)
    ]


def test_several_designs_share_a_page_each_with_a_manifest_of_its_own(tmp_path):
    manifests = write_several(tmp_path / "s.pdf", load_template("a3"), designs(ID, "B1B2C3D4E5", "C1B2C3D4E5"))
    found = detect(rasterize_page(tmp_path / "s.pdf", 1, DPI))
    for number, manifest in enumerate(manifests, 1):
        assert load_manifest(tmp_path / f"s_{number}.json") == manifest
        assert manifest in attached_manifests(tmp_path / "s.pdf")
        surface = surface_of(manifest)
        assert len(surface.piece_ids) == 4 and len(surface.page_ids) > 4
        assert manifest.design.rect_mm == manifest.cut_mm
        for marker in manifest.markers:
            assert np.abs(found[marker.id] / PX_PER_MM - np.array(marker.corners_mm)).max() < 0.1
        assert len(rasterize_piece(tmp_path / "s.pdf", manifest, 50)) > 100
    cuts = [Box(f"piece {i}", m.cut_mm) for i, m in enumerate(manifests)]
    check_layout(tuple(cuts), manifests[0].page_mm, 7.0)


def test_each_of_several_designs_has_a_plan_that_names_its_sheet(tmp_path):
    plans = [PlanPage(None, (("Here", (word,)),)) for word in ("First.", "Second.")]
    both = designs(ID, "B1B2C3D4E5", piece_mm=(74, 74))
    manifests = write_several(tmp_path / "s.pdf", load_template("a4"), both, plans)
    assert [manifest.plan_page for manifest in manifests] == [2, 3]
    for manifest, word in zip(manifests, ("First.", "Second."), strict=True):
        text = words_on(tmp_path / "s.pdf", manifest.plan_page)
        assert f"plan of sheet {manifest.sheet_id}" in text and word in text
        assert (
            f"Page {manifest.plan_page} is for people, on any paper: where the piece of sheet {manifest.sheet_id}"
            in (" ".join(sheet_advice(manifest)))
        )
    only = write_several(tmp_path / "t.pdf", load_template("a4"), both, [None, plans[1]])
    assert [manifest.plan_page for manifest in only] == [None, 2]
    assert "as its own plan page shows" in words_on(tmp_path / "s.pdf", 1)


def words_on(path, page):
    """A page's words, as PDFium reads them."""
    with pypdfium2.PdfDocument(path) as pdf:
        return " ".join(pdf[page - 1].get_textpage().get_text_bounded().split())


@pytest.mark.parametrize("name", template_names("piece"))
@pytest.mark.parametrize("bent", [False, True])
def test_the_longest_words_fit_every_page(tmp_path, name, bent):
    """A draft whose effect is unknown, on a piece of the most digits, with the widest id and a long label."""
    template = load_template(name)
    promise = promise_of(0.5, {"noise": (0.5, -0.1, 0.1)}).changed(draft=True)
    widest, highest = largest_piece_mm(template)
    size = (777.7, 888.8) if template.tiles else (round(widest - 1.1, 1), round(highest - 1.1, 1))
    piece = lay_out_piece(size, 20 if template.tiles else 12.3, "W" * 10, "design", bends=bent)
    settings = {"target": {"label": "W" * 60}}
    content = SheetContent(piece, "W" * 10, "design", DESIGN, promise, settings, bent)
    write_sheet(tmp_path / "s.pdf", template, content, PlanPage(None, (("Here", ("First.",)),)))
    words = words_on(tmp_path / "s.pdf", 1)
    assert ("Wrap the piece smoothly round" in words) == (bent and template.plan_page and not template.tiles)
    assert "draft design, effect unknown" in words or template.blank is not None


def test_two_times_is_the_same_bytes(tmp_path):
    for folder in ("1", "2"):
        write(tmp_path / folder / "t.pdf", "letter_tiles")
        write_several(tmp_path / folder / "s.pdf", load_template("a4"), designs(ID, "B1B2C3D4E5", piece_mm=(74, 74)))
        chart_sheet(load_template("chart_a4"), tmp_path / folder / "c.pdf")
    for name in ("t.pdf", "t.json", "s.pdf", "s_1.json", "s_2.json", "c.pdf"):
        assert (tmp_path / "1" / name).read_bytes() == (tmp_path / "2" / name).read_bytes()


def test_what_cannot_be_printed_is_refused_in_one_sentence(tmp_path):
    path = tmp_path / "s.pdf"
    with pytest.raises(Refused, match=r"a piece of at most .* one with tiles \(.*a4_tiles"):
        write(path, "letter", (300, 300))
    with pytest.raises(Refused, match="at most 30 tiles, limited by the number of marker ids"):
        write(path, "a4_tiles", (2000, 2000), 30)
    with pytest.raises(Refused, match=r'"lettre".*did you mean "letter"'):
        write(path, "lettre")
    with pytest.raises(Refused, match="a template with a chart only"):
        largest_piece_mm(load_template("chart_a4"))
    with pytest.raises(Refused, match="twice: use --copies"):
        write_several(path, load_template("a3"), designs(ID, ID))
    with pytest.raises(Refused, match="put fewer designs"):
        write_several(path, load_template("a4"), designs(*(f"{i}AAAAAAAAA" for i in range(6))))
    with pytest.raises(Refused, match="one copy of a piece in tiles"):
        write(path, "a4_tiles", copies=2)
    (tmp_path / "file").write_text("x")
    with pytest.raises(Refused, match="a folder that can be written to"):
        chart_sheet(load_template("chart_a4"), tmp_path / "file" / "c.pdf")
    assert json.loads(json.dumps([p.name for p in tmp_path.iterdir()])) == ["file"]


def test_check_says_of_each_kind_of_page_what_is_cut(tmp_path, tiled):
    def told(manifest):
        return " ".join(sheet_advice(manifest))

    chart = told(chart_sheet(load_template("chart_a4"), tmp_path / "c.pdf"))
    assert "Cut nothing" in chart and "piece" not in chart and "7.0 mm from its edge" in chart
    board = told(board_sheet("charuco_a4", tmp_path / "b.pdf"))
    assert "Glue the uncut page" in board and "Cut the" not in board
    tiles = told(tiled[1])
    count = len(tiled[1].tiles)
    assert f"Cut the {count} tiles of pages 2 to {count + 1}" in tiles and "page 1 stays whole" in tiles
    assert "-" not in tiles.split("cut line stay ")[1].split(" mm")[0]
    for manifest in write_several(tmp_path / "s.pdf", load_template("a3"), designs(ID, "B1B2C3D4E5")):
        corner = "{:.0f} mm from the left and {:.0f} mm from the top".format(*manifest.cut_mm)
        assert f"of sheet {manifest.sheet_id}" in told(manifest) and corner in told(manifest)
    plan = PlanPage(None, (("How to photograph it", ("From all sides.",)),))
    one = write(tmp_path / "p.pdf", "a4", plan=plan)
    assert one.plan_page == 2 and "Page 2 is for people" in told(one)
    assert "Cut the piece of 90.0 × 90.0 mm" in told(one)
    assert "Page 2" not in told(write(tmp_path / "q.pdf", "a4"))
