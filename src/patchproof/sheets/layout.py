"""A page as plain geometry, and the proof that its parts lie apart.

Every part also leaves a `Box`, the rectangle that is its own, white borders included; `prove_apart` shows that all
boxes lie within the margins and that no two overlap, or refuses. All in page millimeters. The typeface is Bitstream
Vera, which travels with reportlab and may be embedded.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

from patchproof.base.errors import Refused
from patchproof.sheets.piece import PieceMarker
from patchproof.sheets.rects import PointMm, RectMm, SwatchRect, grow_rect, rect_contains, rects_overlap
from patchproof.sheets.template import Rulers, TextLine

TICK_MM = 0.15
SLACK_MM = 1e-3  # that parts may touch by
CAP_HEIGHT = 0.76  # of the size; Vera's ascenders and digits reach this high
DESCENT = 0.24  # of the size; below the baseline


@dataclass(frozen=True)
class Box:
    """A part's own rectangle on the page; `inside` names the part that may and must hold it."""

    name: str
    rect_mm: RectMm
    inside: str | None = None


@dataclass(frozen=True)
class Line:
    """A black line from (x0, y0) to (x1, y1)."""

    ends_mm: tuple[float, float, float, float]
    width_mm: float


@dataclass(frozen=True)
class Parts:
    """Lines and words, and the boxes that they take."""

    lines: tuple[Line, ...] = ()
    texts: tuple[TextLine, ...] = ()
    boxes: tuple[Box, ...] = ()


@dataclass(frozen=True)
class Window:
    """A part of a piece, the only thing on its page that is cut off at an edge: `rect_mm` is what shows of it."""

    rect_mm: RectMm
    markers: tuple[PieceMarker, ...]


@dataclass(frozen=True)
class PageLayout:
    """All that is on a page."""

    page_mm: tuple[float, float]
    cuts_mm: tuple[RectMm, ...] = ()  # dashed lines, one for each piece
    markers: tuple[PieceMarker, ...] = ()  # the pieces' first
    swatches: tuple[SwatchRect, ...] = ()
    qr_mm: tuple[RectMm, ...] = ()
    ticks: tuple[Line, ...] = ()
    texts: tuple[TextLine, ...] = ()
    boxes: tuple[Box, ...] = ()
    squares_mm: tuple[RectMm, ...] = ()  # a board's black squares
    window: Window | None = None


def prove_apart(boxes: tuple[Box, ...], page_mm: tuple[float, float], margin_mm: float) -> None:
    """Refuse a page on which two parts overlap, a part leaves the one that holds it, or anything lies in the margin."""
    within = grow_rect((0.0, 0.0, *page_mm), -margin_mm)
    by_name = {box.name: box.rect_mm for box in boxes}
    for box in boxes:
        if not rect_contains(by_name[box.inside] if box.inside else within, box.rect_mm, SLACK_MM):
            place, (x, y, w, h) = box.inside or f"the margins of {margin_mm:g} mm", box.rect_mm
            where = f"x {x:.1f} to {x + w:.1f}, y {y:.1f} to {y + h:.1f} mm"
            raise Refused(f"{box.name} within {place}", where, "move or shrink it in the template")
    for a, b in combinations(boxes, 2):
        related = a.name == b.inside or b.name == a.inside
        if not related and rects_overlap(a.rect_mm, b.rect_mm, SLACK_MM):
            raise Refused("parts that lie apart", f"{a.name} over {b.name}", "move one of them in the template")


def font_name(bold: bool) -> str:
    """The registered name of Vera or Vera Bold."""
    from reportlab.pdfbase import pdfmetrics
    from reportlab.pdfbase.ttfonts import TTFont

    name = "VeraBd" if bold else "Vera"
    if name not in pdfmetrics.getRegisteredFontNames():
        pdfmetrics.registerFont(TTFont(name, f"{name}.ttf"))
    return name


def text_width_mm(text: str, size_mm: float, bold: bool) -> float:
    """How far a line of text runs."""
    from reportlab.pdfbase import pdfmetrics

    return pdfmetrics.stringWidth(text, font_name(bold), size_mm)


def text_box(line: TextLine) -> Box:
    """The rectangle that a line of text takes."""
    (x, baseline), size = line.at_mm, line.size_mm
    width = text_width_mm(line.text, size, line.bold)
    return Box(f'text "{line.text}"', (x, baseline - CAP_HEIGHT * size, width, (CAP_HEIGHT + DESCENT) * size))


def quiet_box(rect: RectMm, width: float, page_mm: tuple[float, float], margin_mm: float) -> RectMm:
    """The rectangle with its quiet zone, less what falls into the margin, which is white anyway."""
    sides = []
    for i in (0, 1):
        low, high = rect[i], rect[i] + rect[i + 2]
        sides.append((min(low, max(low - width, margin_mm)), max(high, min(high + width, page_mm[i] - margin_mm))))
    (x0, x1), (y0, y1) = sides
    return x0, y0, x1 - x0, y1 - y0


def ruler_parts(rulers: Rulers) -> Parts:
    """The ruler to the right and the one downwards."""
    lines, digits, boxes, length, size = [], [], [], rulers.length_mm, 2.1
    for name, (x, y), down in (("x ruler", rulers.x_start_mm, False), ("y ruler", rulers.y_start_mm, True)):

        def at(along: float, across: float, x=x, y=y, down=down) -> PointMm:
            return (x + across, y + along) if down else (x + along, y + across)

        lines.append(Line((*at(0.0, 0.0), *at(length, 0.0)), 0.3))
        for mm in range(int(length + 1e-6) + 1):
            depth = 4.0 if mm % 10 == 0 else 3.0 if mm % 5 == 0 else 2.0
            lines.append(Line((*at(mm, 0.0), *at(mm, depth)), TICK_MM))
            if mm % 10 == 0:
                wide, high = text_width_mm(str(mm), size, False), size * CAP_HEIGHT
                place = (x + 5.0, y + mm + high / 2) if down else (x + mm - wide / 2, y + 4.8 + high)
                digits.append(TextLine(at_mm=place, size_mm=size, text=str(mm), gray=0.2))
        left, top = at(-2.5, -0.2)
        boxes.append(Box(name, (left, top, 9.5, length + 5.0) if down else (left, top, length + 5.0, 7.2)))
    return Parts(tuple(lines), tuple(digits), tuple(boxes))
