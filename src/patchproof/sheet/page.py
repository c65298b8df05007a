"""One page: the piece, chart, rulers, card outline, QR code, page markers and words, each in its place.

In: a template and a piece. Out: a `PageLayout`, plain geometry in page millimetres that `pdf` turns into ink and
`write` into the manifest. Every part also leaves a `Box`, the rectangle that is its own, white borders included;
`prove_apart` shows that all boxes lie within the margins and that no two overlap, or refuses. A page that this module
hands out has passed.
Left out on purpose: automatic arranging. The template says where things go; only the piece is centred in its zone.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import combinations

from patchproof.settings import Refused
from patchproof.sheet.chart import chart_swatches
from patchproof.sheet.fonts import CAP_HEIGHT, DESCENT, text_width_mm
from patchproof.sheet.piece import (
    MODULES,
    SMALLEST_MARKER_MM,
    Piece,
    PieceMarker,
    black_runs,
    frame_mm,
    marker_at,
    marker_ids,
)
from patchproof.sheet.swatches import RectMm, SwatchRect
from patchproof.sheet.template import Rulers, Template, TextLine

CUT_LINE_MM = 0.2  # drawn wholly outside the cut, so that no ink of it stays on the piece
TICK_MM = 0.15
QR_QUIET = 4  # modules of white that a QR code asks for on each side (ISO/IEC 18004)


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
class PageLayout:
    """All that is on the page, in page millimetres."""

    page_mm: tuple[float, float]
    piece: Piece | None  # none on a board's page, nor what follows from it
    cut_mm: RectMm | None
    design_mm: RectMm | None
    markers: tuple[PieceMarker, ...]  # the piece's first
    swatches: tuple[SwatchRect, ...]  # the chart's first
    qr_mm: tuple[RectMm, ...]
    ticks: tuple[Line, ...]
    card_mm: RectMm | None
    card_radius_mm: float
    texts: tuple[TextLine, ...]
    boxes: tuple[Box, ...]
    squares_mm: tuple[RectMm, ...] = ()  # a board's black squares


def largest_piece_mm(template: Template) -> tuple[float, float]:
    """Width and height that a piece may have on this page, for `marker_size_mm`."""
    _, _, w, h = template.piece.zone_mm
    return w - 2 * CUT_LINE_MM, h - 2 * CUT_LINE_MM


def lay_out_page(template: Template, piece: Piece, sheet_id: str, kind: str, qr_text: str) -> PageLayout:
    """Everything in its place, proved apart and within the margins; refused where the piece is too large."""
    corner = _place_piece(template, piece)
    cut = _round((*corner, *piece.size_mm))
    design = _moved(piece.design_rect_mm, corner)
    ids = marker_ids(sheet_id, kind, len(piece.markers) + len(template.marker.corners_mm))[len(piece.markers) :]
    own = [marker_at(i, at, template.marker.size_mm) for i, at in zip(ids, template.marker.corners_mm, strict=True)]
    chart = tuple((_round(rect), srgb) for rect, srgb in chart_swatches(template.chart))
    card = (*template.card.corner_mm, *template.card.size_mm)
    qr = qr_rects_mm(qr_text, template.qr.corner_mm, template.qr.size_mm)
    words = {
        "sheet_id": sheet_id,
        "kind": kind,
        "design": _size(piece.design_rect_mm[2:]),
        "piece": _size(piece.size_mm),
    }
    digits = [
        *_ruler_digits(template.ruler, template.ruler.x_start_mm, False),
        *_ruler_digits(template.ruler, template.ruler.y_start_mm, True),
    ]
    lines = [_filled(line, words) for line in template.text]
    layout = PageLayout(
        page_mm=template.page_mm,
        piece=piece,
        cut_mm=cut,
        design_mm=design,
        markers=tuple(_moved_marker(m, corner) for m in piece.markers) + tuple(own),
        swatches=chart + tuple((_moved(rect, corner), srgb) for rect, srgb in piece.swatches),
        qr_mm=qr,
        ticks=(
            *_ruler_ticks(template.ruler, template.ruler.x_start_mm, False),
            *_ruler_ticks(template.ruler, template.ruler.y_start_mm, True),
        ),
        card_mm=card,
        card_radius_mm=template.card.radius_mm,
        texts=tuple(lines + digits),
        boxes=(
            Box("piece", _grown(cut, CUT_LINE_MM)),
            *_piece_boxes(piece, corner),
            *(Box(f"chart swatch {i + 1}", rect) for i, (rect, _) in enumerate(chart)),
            *(Box(f"page marker {i + 1}", _marker_box(marker, template)) for i, marker in enumerate(own)),
            Box("card outline", card),
            Box("QR code", _qr_box(template, qr)),
            _ruler_box("x ruler", template.ruler, template.ruler.x_start_mm, False),
            _ruler_box("y ruler", template.ruler, template.ruler.y_start_mm, True),
            *(_text_box(line, card) for line in lines),
        ),
    )
    prove_apart(layout.boxes, template.page_mm, template.margin_mm)
    return layout


def prove_apart(boxes: tuple[Box, ...], page_mm: tuple[float, float], margin_mm: float) -> None:
    """Refuse a page on which two parts overlap, a part leaves the one that holds it, or anything lies in the margin."""
    within = (margin_mm, margin_mm, page_mm[0] - 2 * margin_mm, page_mm[1] - 2 * margin_mm)
    by_name = {box.name: box.rect_mm for box in boxes}
    for box in boxes:
        if not _holds(by_name[box.inside] if box.inside else within, box.rect_mm):
            place = box.inside or f"the margins of {margin_mm:g} mm"
            raise Refused(f"{box.name} within {place}", _where(box), "move or shrink it in the template")
    for a, b in combinations(boxes, 2):
        related = a.name == b.inside or b.name == a.inside
        if not related and _overlap(a.rect_mm, b.rect_mm):
            raise Refused("parts that lie apart", f"{a.name} over {b.name}", "move one of them in the template")


def qr_rects_mm(text: str, corner_mm: tuple[float, float], size_mm: float) -> tuple[RectMm, ...]:
    """The dark runs, from the top down, of a QR code with error correction M in a square of that size."""
    import numpy as np
    import segno

    dark = np.array([list(row) for row in segno.make_qr(text, error="m").matrix], bool)
    module, (x, y) = size_mm / len(dark), corner_mm
    return tuple(
        (x + start * module, y + row * module, (stop - start) * module, module) for row, start, stop in black_runs(dark)
    )


def _place_piece(template: Template, piece: Piece) -> tuple[float, float]:
    x, y, w, h = template.piece.zone_mm
    widest, highest = largest_piece_mm(template)
    if piece.size_mm[0] > widest + 1e-6 or piece.size_mm[1] > highest + 1e-6:
        marker = piece.module_mm * MODULES
        hints = [
            f"{widest - 2 * frame_mm(size):.0f} × {highest - 2 * frame_mm(size):.0f} mm with {size:.3g} mm markers"
            for size in sorted({SMALLEST_MARKER_MM, marker}, reverse=True)
            if min(widest, highest) > 2 * frame_mm(size)
        ]
        raise Refused(
            f"a piece of at most {_size((widest, highest))} mm on this page",
            f"{_size(piece.size_mm)} mm",
            f"choose a larger template, or a design of at most {' or '.join(hints)}",
        )
    return round(x + (w - piece.size_mm[0]) / 2, 3), round(y + (h - piece.size_mm[1]) / 2, 3)


def _piece_boxes(piece: Piece, corner: tuple[float, float]) -> list[Box]:
    """The piece's parts with half a module of white round each, so that a whole one lies between."""
    half = piece.module_mm / 2
    boxes = [Box("design", _grown(_moved(piece.design_rect_mm, corner), half), "piece")]
    for i, marker in enumerate(piece.markers):
        (x, y), (x1, _) = _moved_marker(marker, corner).corners_mm[:2]
        boxes.append(Box(f"piece marker {i + 1}", _grown((x, y, x1 - x, x1 - x), half), "piece"))
    for i, (rect, _) in enumerate(piece.swatches):
        boxes.append(Box(f"piece swatch {i + 1}", _grown(_moved(rect, corner), half), "piece"))
    return boxes


def _marker_box(marker: PieceMarker, template: Template) -> RectMm:
    (x, y), (x1, _) = marker.corners_mm[:2]
    return _quiet((x, y, x1 - x, x1 - x), (x1 - x) / MODULES, template)


def _qr_box(template: Template, qr: tuple[RectMm, ...]) -> RectMm:
    module = qr[0][3]
    return _quiet((*template.qr.corner_mm, template.qr.size_mm, template.qr.size_mm), QR_QUIET * module, template)


def _quiet(rect: RectMm, width: float, template: Template) -> RectMm:
    """The rectangle with its quiet zone, less what falls into the margin, which is white anyway."""
    margin = template.margin_mm
    sides = []
    for i in (0, 1):
        low, high = rect[i], rect[i] + rect[i + 2]
        sides.append((min(low, max(low - width, margin)), max(high, min(high + width, template.page_mm[i] - margin))))
    (x0, x1), (y0, y1) = sides
    return x0, y0, x1 - x0, y1 - y0


def _ruler_ticks(ruler: Rulers, start: tuple[float, float], down: bool) -> list[Line]:
    lines = [((0.0, 0.0, ruler.length_mm, 0.0), 0.3)]
    for mm in range(int(ruler.length_mm + 1e-6) + 1):
        depth = 4.0 if mm % 10 == 0 else 3.0 if mm % 5 == 0 else 2.0
        lines.append(((float(mm), 0.0, float(mm), depth), TICK_MM))
    ticks = []
    for (a0, b0, a1, b1), width in lines:
        ends = (b0, a0, b1, a1) if down else (a0, b0, a1, b1)
        ticks.append(Line(tuple(v + start[i % 2] for i, v in enumerate(ends)), width))
    return ticks


def _ruler_digits(ruler: Rulers, start: tuple[float, float], down: bool) -> list[TextLine]:
    digits, size = [], 2.1
    for mm in range(0, int(ruler.length_mm + 1e-6) + 1, 10):
        if down:
            at = (start[0] + 5.0, start[1] + mm + size * CAP_HEIGHT / 2)
        else:
            at = (start[0] + mm - text_width_mm(str(mm), size, False) / 2, start[1] + 4.8 + size * CAP_HEIGHT)
        digits.append(TextLine(at_mm=at, size_mm=size, text=str(mm), gray=0.2))
    return digits


def _ruler_box(name: str, ruler: Rulers, start: tuple[float, float], down: bool) -> Box:
    along, across = (-2.5, ruler.length_mm + 5.0), (-0.2, 9.5 if down else 7.2)
    (x, w), (y, h) = (across, along) if down else (along, across)
    return Box(name, (start[0] + x, start[1] + y, w, h))


def _filled(line: TextLine, words: dict[str, str]) -> TextLine:
    def word(match: re.Match) -> str:
        if match[1] not in words:
            raise Refused("only known words in the template's text", match[0], f"use one of: {', '.join(words)}")
        return words[match[1]]

    return line.model_copy(update={"text": re.sub(r"\{(.*?)\}", word, line.text)})


def _text_box(line: TextLine, card: RectMm) -> Box:
    (x, baseline), size = line.at_mm, line.size_mm
    top = baseline - CAP_HEIGHT * size
    rect = (x, top, text_width_mm(line.text, size, line.bold), (CAP_HEIGHT + DESCENT) * size)
    return Box(f'text "{line.text}"', rect, "card outline" if _holds(card, rect) else None)


def _size(size_mm: tuple[float, ...]) -> str:
    return " × ".join(f"{round(side, 1):g}" for side in size_mm)


def _round(rect: RectMm) -> RectMm:
    return tuple(round(v, 6) for v in rect)  # a nanometre: keeps 0.1 + 0.2 out of the manifest


def _moved(rect: RectMm, by: tuple[float, float]) -> RectMm:
    return _round((rect[0] + by[0], rect[1] + by[1], rect[2], rect[3]))


def _moved_marker(marker: PieceMarker, by: tuple[float, float]) -> PieceMarker:
    return PieceMarker(marker.id, tuple((round(x + by[0], 6), round(y + by[1], 6)) for x, y in marker.corners_mm))


def _grown(rect: RectMm, by: float) -> RectMm:
    return rect[0] - by, rect[1] - by, rect[2] + 2 * by, rect[3] + 2 * by


def _holds(outer: RectMm, inner: RectMm) -> bool:
    return all(
        outer[i] <= inner[i] + 1e-3 and inner[i] + inner[i + 2] <= outer[i] + outer[i + 2] + 1e-3 for i in (0, 1)
    )


def _overlap(a: RectMm, b: RectMm) -> bool:
    return all(a[i] + 1e-3 < b[i] + b[i + 2] and b[i] + 1e-3 < a[i] + a[i + 2] for i in (0, 1))


def _where(box: Box) -> str:
    x, y, w, h = box.rect_mm
    return f"x {x:.1f} to {x + w:.1f}, y {y:.1f} to {y + h:.1f} mm"
