"""The geometry of a page, and the check that its parts do not overlap.

Every part also has a `Box`, the rectangle that it occupies, with its white border; `check_layout` refuses a page unless
all boxes lie within the margins and no two overlap. All is in page millimeters. The typeface is Bitstream Vera, which
comes with reportlab and may be embedded.
"""

from dataclasses import dataclass
from itertools import combinations
from typing import Any

from patchproof.base.errors import Refused
from patchproof.base.text import drawable
from patchproof.sheets.piece import PieceMarker
from patchproof.sheets.rects import PointMm, RectMm, SwatchRect, grow_rect, rect_contains, rects_overlap
from patchproof.sheets.template import Rulers, TextLine

TICK_MM = 0.15
TOLERANCE_MM = 1e-3  # overlap that is not refused
CAP_HEIGHT = 0.76  # of the font size; height of Vera's ascenders and digits
DESCENT = 0.24  # of the font size; depth below the baseline


@dataclass(frozen=True)
class Box:
    """The rectangle that a part occupies on the page; `inside` is the name of the part that must contain it."""

    name: str
    rect_mm: RectMm
    inside: str | None = None


@dataclass(frozen=True)
class Line:
    """A black line from (x0, y0) to (x1, y1)."""

    ends_mm: tuple[float, float, float, float]
    width_mm: float


@dataclass(frozen=True)
class PageParts:
    """Lines and texts of a page, and the boxes that they occupy."""

    lines: tuple[Line, ...] = ()
    texts: tuple[TextLine, ...] = ()
    boxes: tuple[Box, ...] = ()


@dataclass(frozen=True)
class PieceWindow:
    """The part of a piece on a tile's page, whose markers and design are clipped at `rect_mm`."""

    rect_mm: RectMm
    markers: tuple[PieceMarker, ...]


@dataclass(frozen=True)
class PageLayout:
    """Everything on a page, except pictures."""

    page_mm: tuple[float, float]
    cuts_mm: tuple[RectMm, ...] = ()  # dashed lines, one for each piece
    markers: tuple[PieceMarker, ...] = ()  # those of the pieces first
    swatches: tuple[SwatchRect, ...] = ()
    qr_mm: tuple[RectMm, ...] = ()
    ticks: tuple[Line, ...] = ()
    texts: tuple[TextLine, ...] = ()
    boxes: tuple[Box, ...] = ()
    squares_mm: tuple[RectMm, ...] = ()  # a board's black squares
    window: PieceWindow | None = None


def check_layout(boxes: tuple[Box, ...], page_mm: tuple[float, float], margin_mm: float) -> None:
    """Refuse a page on which two parts overlap, a part leaves the one that contains it, or one lies in the margin."""
    printable = grow_rect((0.0, 0.0, *page_mm), -margin_mm)
    by_name = {box.name: box.rect_mm for box in boxes}
    for box in boxes:
        if not rect_contains(by_name[box.inside] if box.inside else printable, box.rect_mm, TOLERANCE_MM):
            outer, (x, y, w, h) = box.inside or f"the margins of {margin_mm:g} mm", box.rect_mm
            got = f"x {x:.1f} to {x + w:.1f}, y {y:.1f} to {y + h:.1f} mm"
            raise Refused(f"{box.name} within {outer}", got, "move or shrink it in the template")
    for a, b in combinations(boxes, 2):
        nested = a.name == b.inside or b.name == a.inside
        if not nested and rects_overlap(a.rect_mm, b.rect_mm, TOLERANCE_MM):
            raise Refused("parts that do not overlap", f"{a.name} over {b.name}", "move one of them in the template")


def font_name(bold: bool) -> str:
    """Register Vera or Vera Bold with reportlab, and return its name."""
    from reportlab.pdfbase import pdfmetrics
    from reportlab.pdfbase.ttfonts import TTFont

    name = "VeraBd" if bold else "Vera"
    if name not in pdfmetrics.getRegisteredFontNames():
        pdfmetrics.registerFont(TTFont(name, f"{name}.ttf"))
    return name


def text_width_mm(text: str, size_mm: float, bold: bool) -> float:
    """The width of a line of text."""
    from reportlab.pdfbase import pdfmetrics

    return pdfmetrics.stringWidth(drawable_text(text, bold), font_name(bold), size_mm)


def drawable_text(text: str, bold: bool) -> str:
    """A line of text as it is drawn, with characters that Vera lacks as "\\u5361"."""
    from reportlab.pdfbase import pdfmetrics

    font: Any = pdfmetrics.getFont(font_name(bold))
    return drawable(text, lambda character: ord(character) in font.face.charToGlyph)


def text_box(line: TextLine) -> Box:
    """The box of a line of text."""
    (x, baseline), size = line.at_mm, line.size_mm
    width = text_width_mm(line.text, size, line.bold)
    return Box(f'text "{line.text}"', (x, baseline - CAP_HEIGHT * size, width, (CAP_HEIGHT + DESCENT) * size))


def quiet_zone_rect(rect: RectMm, width: float, page_mm: tuple[float, float], margin_mm: float) -> RectMm:
    """A rectangle with a quiet zone of `width` around it, without its part in the margin, which is white anyway."""
    sides = []
    for i in (0, 1):
        low, high = rect[i], rect[i] + rect[i + 2]
        sides.append((min(low, max(low - width, margin_mm)), max(high, min(high + width, page_mm[i] - margin_mm))))
    (x0, x1), (y0, y1) = sides
    return x0, y0, x1 - x0, y1 - y0


def ruler_parts(rulers: Rulers) -> PageParts:
    """The lines, digits and boxes of the ruler along x and the one along y."""
    lines, digits, boxes, length, size = [], [], [], rulers.length_mm, 2.1
    for name, (x, y), down in (("x ruler", rulers.x_start_mm, False), ("y ruler", rulers.y_start_mm, True)):

        def to_page(along: float, across: float, x=x, y=y, down=down) -> PointMm:
            return (x + across, y + along) if down else (x + along, y + across)

        lines.append(Line((*to_page(0.0, 0.0), *to_page(length, 0.0)), 0.3))
        for mm in range(int(length + 1e-6) + 1):
            depth = 4.0 if mm % 10 == 0 else 3.0 if mm % 5 == 0 else 2.0
            lines.append(Line((*to_page(mm, 0.0), *to_page(mm, depth)), TICK_MM))
            if mm % 10 == 0:
                wide, high = text_width_mm(str(mm), size, False), size * CAP_HEIGHT
                place = (x + 5.0, y + mm + high / 2) if down else (x + mm - wide / 2, y + 4.8 + high)
                digits.append(TextLine(at_mm=place, size_mm=size, text=str(mm), gray=0.2))
        left, top = to_page(-2.5, -0.2)
        boxes.append(Box(name, (left, top, 9.5, length + 5.0) if down else (left, top, length + 5.0, 7.2)))
    return PageParts(tuple(lines), tuple(digits), tuple(boxes))
