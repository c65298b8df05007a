"""The page: what it holds, the proof that its parts lie apart, and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest

from patchproof.base.errors import Refused
from patchproof.base.packaged import packaged_path
from patchproof.sheets.content import SheetContent
from patchproof.sheets.layout import Box, check_layout
from patchproof.sheets.page import largest_piece_mm, lay_out_page, qr_rects_mm
from patchproof.sheets.piece import SHEET_KINDS, lay_out_piece, marker_rect, marker_size_mm
from patchproof.sheets.rects import rect_contains, rects_overlap
from patchproof.sheets.template import TextLine, load_template

ID = "WWWWWWWWWW"  # the widest id there can be
WHITE = np.full((4, 4, 3), 255, np.uint8)
PAGE, MARGIN = (210.0, 297.0), 7.0


def page_of(template, piece_mm, needed_mm=20.0, kind="design", bends=False):
    piece = lay_out_piece(piece_mm, marker_size_mm(needed_mm, piece_mm), ID, kind, bends)
    return lay_out_page(template, SheetContent(piece, ID, kind, WHITE))


@pytest.mark.parametrize("piece_mm", [(110, 110), (40, 40), (60, 140), (140, 50), (166.6, 179.6), (39, 39)])
@pytest.mark.parametrize("kind", ["design", "blank"])
@pytest.mark.parametrize("bends", [False, True])
def test_a4_holds_small_large_and_oblong_pieces(piece_mm, kind, bends):
    template = load_template("a4")
    page = page_of(template, piece_mm, kind=kind, bends=bends)
    assert page.cuts_mm[0][2:] == piece_mm
    # the piece is in the middle of its zone, and holds its markers
    x, y, w, h = template.piece.zone_mm
    corner = np.array([x + w / 2, y + h / 2]) - np.array(piece_mm) / 2
    assert np.array(page.cuts_mm[0][:2]) == pytest.approx(corner, abs=1e-3)
    assert len({m.id for m in page.markers}) == len(page.markers)
    own, others = page.markers[:-4], page.markers[-4:]
    assert all(rect_contains(page.cuts_mm[0], marker_rect(m)) for m in own)
    assert not any(rects_overlap(page.cuts_mm[0], marker_rect(m)) for m in others)
    assert len(own) >= 4 + 4 * (bends and min(piece_mm) >= 110)


def test_a4_holds_a_piece_of_its_zone_less_the_cut_line():
    assert largest_piece_mm(load_template("a4")) == pytest.approx((166.6, 179.6))


@pytest.mark.parametrize("piece_mm", [(39, 39), (162, 110)])
def test_a_piece_says_its_top_its_sheet_and_its_name_in_the_scissors_millimeter(piece_mm):
    template, sizes = load_template("a4"), {}
    for label, name in (("mug", "DESIGN · MUG"), (None, "DESIGN"), (404, "DESIGN · 404"), ("m" * 99, "DESIGN · MM")):
        piece = lay_out_piece(piece_mm, marker_size_mm(20.0, piece_mm), ID, "design")
        settings = {} if label is None else {"target": {"label": label}}
        page = lay_out_page(template, SheetContent(piece, ID, "design", WHITE, settings=settings))
        x, y, w, h = page.cuts_mm[0]
        own = [line for line in page.texts if x < line.at_mm[0] < x + w and y < line.at_mm[1] < y + h]
        top, sheet, last = own
        assert (top.text, sheet.text) == ("TOP", ID)
        assert last.text == name or (label == "m" * 99 and last.text.startswith(name) and last.text.endswith("…"))
        # capitals of 0.72 mm in the middle of the millimeter along the cut, above the upper markers and below a lower
        assert [line.at_mm[1] - y for line in (top, sheet)] == pytest.approx([0.861, 0.861])
        assert y + h - last.at_mm[1] == pytest.approx(0.139)
        assert top.at_mm[0] - x < 2 and last.at_mm[0] - x < 1 and sheet.at_mm[0] - x > w - 1.3 * piece.marker_mm - 1
        arrow = [line.ends_mm for line in page.ticks if line.ends_mm[0] < x + 1.3 and y < line.ends_mm[3] < y + 1]
        assert len(arrow) == 3 and all(end[3] < end[1] for end in arrow)  # all end at its tip
        sizes[name] = len(page.boxes)
    assert len(set(sizes.values())) == 1


def test_kinds_share_no_marker_even_with_the_page_s_own():
    template = load_template("a4")
    ids = [m.id for kind in SHEET_KINDS for m in page_of(template, (120, 120), kind=kind, bends=True).markers]
    assert len(ids) == len(set(ids)) == len(SHEET_KINDS) * 12


def test_no_two_boxes_share_a_point_of_a_fine_grid():
    """Slow twin of the proof: paint every box that holds no other onto a 0.1 mm grid and look for double paint."""
    page = page_of(load_template("a4"), (110, 110))
    holders = {box.inside for box in page.boxes}
    paint = np.zeros((2970, 2100), np.uint8)
    for box in page.boxes:
        if box.name not in holders:
            x, y, w, h = box.rect_mm
            paint[int(y * 10 + 0.6) : int((y + h) * 10 + 0.4), int(x * 10 + 0.6) : int((x + w) * 10 + 0.4)] += 1
    assert paint.max() == 1
    assert not paint[:70].any() and not paint[-70:].any() and not paint[:, :70].any() and not paint[:, -70:].any()


def test_overlap_is_caught():
    boxes = (Box("one", (20, 20, 30, 30)), Box("two", (49.9, 49.9, 10, 10)))
    with pytest.raises(Refused, match="one over two"):
        check_layout(boxes, PAGE, MARGIN)
    check_layout((boxes[0], Box("two", (50, 20, 10, 10))), PAGE, MARGIN)  # touching is apart
    check_layout((boxes[0], Box("two", (30, 30, 10, 10), "one")), PAGE, MARGIN)  # one may hold the other


def test_two_parts_in_one_holder_must_lie_apart_and_stay_in():
    holder = Box("tile", (20, 20, 80, 50))
    with pytest.raises(Refused, match="a over b"):
        check_layout((holder, Box("a", (30, 30, 9, 9), "tile"), Box("b", (35, 35, 9, 9), "tile")), PAGE, MARGIN)
    with pytest.raises(Refused, match="a within tile"):
        check_layout((holder, Box("a", (95, 30, 9, 9), "tile")), PAGE, MARGIN)


@pytest.mark.parametrize("rect", [(6.9, 50, 5, 5), (50, 6.9, 5, 5), (198.1, 50, 5, 5), (50, 285.1, 5, 5)])
def test_ink_in_the_margin_is_caught(rect):
    with pytest.raises(Refused, match="one within the margins of 7 mm"):
        check_layout((Box("one", rect),), PAGE, MARGIN)


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        ("corner_mm = [95.4, 218.2]", "corner_mm = [95.4, 222.2]", "chart swatch 71 over page marker 3"),
        ("corner_mm = [179.0, 20.0]", "corner_mm = [175.0, 20.0]", "piece over QR code"),
        ("y_start_mm = [179.1, 72.0]", "y_start_mm = [179.1, 60.0]", "y ruler over text"),
        ("[[7.0, 200.0]", "[[24.0, 200.0]", "page marker 1 over x ruler"),
        ("[[7.0, 200.0]", "[[2.0, 200.0]", "page marker 1 within the margins"),
        ("length_mm = 100.0", "length_mm = 107.0", "x ruler over text"),
    ],
)
def test_a_template_whose_parts_collide_is_refused(tmp_path, old, new, what):
    text = packaged_path("print_templates", "a4.toml").read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "mine.toml"
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(Refused) as refusal:
        page_of(load_template(path), (162, 162))
    assert refusal.match("move")
    told = str(refusal.value)
    assert what in told or " over ".join(reversed(what.split(" over "))) in told


@pytest.mark.parametrize(("piece_mm", "got"), [((166.7, 100), "166.7 × 100"), ((100, 179.7), "100 × 179.7")])
def test_a_piece_too_large_is_refused_with_the_largest_that_fits(piece_mm, got):
    with pytest.raises(Refused) as refusal:
        page_of(load_template("a4"), piece_mm)
    told = str(refusal.value)
    assert told.startswith(f"Expected a piece of at most 166.6 × 179.6 mm on this page, got {got} mm: choose")
    assert "one with tiles (a3_tiles, a4_tiles, letter_tiles), or a smaller patch" in told and "\n" not in told


def test_unknown_word_in_a_text_is_refused():
    template = load_template("a4")
    line = TextLine(at_mm=(50, 14), size_mm=2, text="{sheet}")
    with pytest.raises(Refused, match=r"\{sheet\}: use one of: sheet_id"):
        page_of(template.changed(text=(line,)), (110, 110))


def test_qr_code_fills_its_square():
    rects = np.array(qr_rects_mm("patchproof:A1B2C3D4E5:0123456789abcdef", (10, 20), 29))
    assert rects[:, 0].min() == 10 and (rects[:, 0] + rects[:, 2]).max() == pytest.approx(39)
    assert rects[:, 1].min() == 20 and rects[:, 3] == pytest.approx(1)  # version 3: 29 modules


def test_rulers_have_a_tick_at_each_millimeter():
    page = page_of(load_template("a4"), (110, 110))
    vertical = sorted(t.ends_mm[0] for t in page.ticks if t.ends_mm[0] == t.ends_mm[2] and t.width_mm < 0.2)
    assert np.diff(vertical) == pytest.approx(np.ones(100)) and len(vertical) == 101


def test_layout_is_frozen():
    page = page_of(load_template("a4"), (110, 110))
    assert replace(page) == page
