"""One page: the piece, chart, rulers, QR code, page markers and words, each in its place.

In: a template and a piece. Out: a `PageLayout`, plain geometry in page millimetres that `pdf` turns into ink and
`write` into the manifest. Every part also leaves a `Box`, the rectangle that is its own, white borders included;
`prove_apart` shows that all boxes lie within the margins and that no two overlap, or refuses. A page that this module
hands out has passed.
Left out on purpose: automatic arranging. The template says where things go; only the piece is centred in its zone.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

from patchproof.sheets.chart import chart_swatches
from patchproof.sheets.fonts import CAP_HEIGHT, DESCENT, text_width_mm
from patchproof.sheets.piece import (
    MODULES,
    SMALLEST_MARKER_MM,
    Piece,
    PieceMarker,
    black_runs,
    frame_mm,
    marker_at,
    marker_ids,
)
from patchproof.sheets.swatches import RectMm, SwatchRect
from patchproof.sheets.template import Rulers, Template, TextLine
from patchproof.strict import Refused

CUT_LINE_MM = 0.2  # drawn wholly outside the cut, so that no ink of it stays on the piece
TICK_MM = 0.15
BETWEEN_MM = 4.0  # of white paper from piece to piece, for scissors
MOST_TILES = 30  # 5 markers each, beside the piece's 8 and the page's 4, out of a kind's 166
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
class Parts:
    """What a page carries besides its template: drawn after it, proved with it."""

    lines: tuple[Line, ...] = ()
    texts: tuple[TextLine, ...] = ()
    boxes: tuple[Box, ...] = ()


@dataclass(frozen=True)
class PageLayout:
    """All that is on the page, in page millimetres."""

    page_mm: tuple[float, float]
    cuts_mm: tuple[RectMm, ...]  # dashed lines, one for each piece
    designs_mm: tuple[RectMm, ...]
    markers: tuple[PieceMarker, ...]  # the pieces' first
    swatches: tuple[SwatchRect, ...]  # the chart's first
    qr_mm: tuple[RectMm, ...]
    ticks: tuple[Line, ...]
    texts: tuple[TextLine, ...]
    boxes: tuple[Box, ...]
    squares_mm: tuple[RectMm, ...] = ()  # a board's black squares
    window: Window | None = None


@dataclass(frozen=True)
class Window:
    """A part of a piece, the only thing on its page that is cut off at an edge: `rect_mm` is what shows of it."""

    rect_mm: RectMm
    markers: tuple[PieceMarker, ...]
    swatches: tuple[SwatchRect, ...]


def largest_piece_mm(template: Template) -> tuple[float, float]:
    """Width and height that a piece may have on this template, for `marker_size_mm`."""
    if template.piece is None:
        raise Refused("a template with a place for a piece", "one of a chart alone", "use a4, letter or a3")
    _, _, w, h = template.piece.zone_mm
    if template.tiles is not None:  # as many as marker ids last for, in one row or column; `tiles` counts exactly
        _, _, w, h = (MOST_TILES * side for side in template.tiles.zone_mm)
    return w - 2 * CUT_LINE_MM, h - 2 * CUT_LINE_MM


def lay_out_page(template: Template, piece: Piece, sheet_id: str, kind: str, qr_text: str) -> PageLayout:
    """Everything in its place, proved apart and within the margins; refused where the piece is too large."""
    places = place_pieces(template, [piece])
    ids = marker_ids(sheet_id, kind, len(piece.markers) + len(template.marker.corners_mm))[len(piece.markers) :]
    words = {
        "sheet_id": sheet_id,
        "kind": kind,
        "design": size_text(piece.design_rect_mm[2:]),
        "piece": size_text(piece.size_mm),
    }
    return lay_out_parts(template, [piece], places, ids, qr_text, words)


def lay_out_parts(
    template: Template,
    pieces: Sequence[Piece],
    places: Sequence[tuple[float, float]],
    ids: Sequence[int],
    qr_text: str,
    words: dict[str, str],
    more: Parts | None = None,
) -> PageLayout:
    """A page of a template with any number of pieces at their places; `ids` are for the page's own markers."""
    cuts = [_round((*corner, *piece.size_mm)) for piece, corner in zip(pieces, places, strict=True)]
    own = [marker_at(i, at, template.marker.size_mm) for i, at in zip(ids, template.marker.corners_mm, strict=True)]
    chart = tuple((_round(rect), srgb) for rect, srgb in chart_swatches(template.chart))
    qr = qr_rects_mm(qr_text, template.qr.corner_mm, template.qr.size_mm)
    digits = [
        *_ruler_digits(template.ruler, template.ruler.x_start_mm, False),
        *_ruler_digits(template.ruler, template.ruler.y_start_mm, True),
    ]
    lines = [_filled(line, words) for line in template.text]
    more = more or Parts()
    put = list(zip(pieces, places, strict=True))
    layout = PageLayout(
        page_mm=template.page_mm,
        cuts_mm=tuple(cuts),
        designs_mm=tuple(moved(piece.design_rect_mm, corner) for piece, corner in put),
        markers=tuple(moved_marker(m, corner) for piece, corner in put for m in piece.markers) + tuple(own),
        swatches=chart + tuple((moved(rect, corner), srgb) for piece, corner in put for rect, srgb in piece.swatches),
        qr_mm=qr,
        ticks=(
            *_ruler_ticks(template.ruler, template.ruler.x_start_mm, False),
            *_ruler_ticks(template.ruler, template.ruler.y_start_mm, True),
            *more.lines,
        ),
        texts=(*lines, *digits, *more.texts),
        boxes=(
            *(box for i, (piece, corner) in enumerate(put) for box in _piece_boxes(piece, corner, i)),
            *(Box(f"chart swatch {i + 1}", rect) for i, (rect, _) in enumerate(chart)),
            *(Box(f"page marker {i + 1}", _marker_box(marker, template)) for i, marker in enumerate(own)),
            Box("QR code", _qr_box(template, qr)),
            _ruler_box("x ruler", template.ruler, template.ruler.x_start_mm, False),
            _ruler_box("y ruler", template.ruler, template.ruler.y_start_mm, True),
            *(text_box(line) for line in lines),
            *more.boxes,
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


def place_pieces(template: Template, pieces: Sequence[Piece]) -> list[tuple[float, float]]:
    """Top-left corners of pieces in rows, each row as full as may be, in the middle of the template's zone."""
    for piece in pieces:
        _refuse_larger(template, piece)
    x, y, w, h = template.piece.zone_mm
    rows: list[list[Piece]] = []
    for piece in pieces:
        used = sum(p.size_mm[0] + BETWEEN_MM for p in rows[-1]) if rows else math.inf
        if used + piece.size_mm[0] > w - 2 * CUT_LINE_MM + 1e-6:
            rows.append([])
        rows[-1].append(piece)
    heights = [max(piece.size_mm[1] for piece in row) for row in rows]
    total = sum(heights) + BETWEEN_MM * (len(rows) - 1)
    if total > h - 2 * CUT_LINE_MM + 1e-6:
        raise Refused(
            f"pieces that go on one page, in rows at most {h:g} mm high together",
            f"{len(pieces)} that are {total:.0f} mm high",
            "choose a larger template or put fewer designs on a page",
        )
    places, top = [], y + (h - total) / 2
    for row, height in zip(rows, heights, strict=True):
        left = x + (w - sum(piece.size_mm[0] for piece in row) - BETWEEN_MM * (len(row) - 1)) / 2
        for piece in row:
            places.append((round(left, 3), round(top, 3)))
            left += piece.size_mm[0] + BETWEEN_MM
        top += height + BETWEEN_MM
    return places


def _refuse_larger(template: Template, piece: Piece) -> None:
    widest, highest = largest_piece_mm(template)
    if piece.size_mm[0] > widest + 1e-6 or piece.size_mm[1] > highest + 1e-6:
        marker = piece.module_mm * MODULES
        hints = [
            f"{widest - 2 * frame_mm(size):.0f} × {highest - 2 * frame_mm(size):.0f} mm with {size:.3g} mm markers"
            for size in sorted({SMALLEST_MARKER_MM, marker}, reverse=True)
            if min(widest, highest) > 2 * frame_mm(size)
        ]
        raise Refused(
            f"a piece of at most {size_text((widest, highest))} mm on this page",
            f"{size_text(piece.size_mm)} mm",
            f"choose a larger template, one with tiles such as a4_tiles, or a design of at most {' or '.join(hints)}",
        )


def _piece_boxes(piece: Piece, corner: tuple[float, float], number: int) -> list[Box]:
    """The piece and its parts with half a module of white round each, so that a whole one lies between."""
    half, name = piece.module_mm / 2, f"piece {number + 1}" if number else "piece"
    boxes = [
        Box(name, grown((*corner, *piece.size_mm), CUT_LINE_MM)),
        Box(f"{name}'s design" if number else "design", grown(moved(piece.design_rect_mm, corner), half), name),
    ]
    for i, marker in enumerate(piece.markers):
        boxes.append(Box(f"{name} marker {i + 1}", grown(marker_rect(moved_marker(marker, corner)), half), name))
    for i, (rect, _) in enumerate(piece.swatches):
        boxes.append(Box(f"{name} swatch {i + 1}", grown(moved(rect, corner), half), name))
    return boxes


def marker_rect(marker: PieceMarker) -> RectMm:
    """The marker's black square."""
    (x, y), (x1, _) = marker.corners_mm[:2]
    return x, y, x1 - x, x1 - x


def _marker_box(marker: PieceMarker, template: Template) -> RectMm:
    rect = marker_rect(marker)
    return quiet_box(rect, rect[2] / MODULES, template)


def _qr_box(template: Template, qr: tuple[RectMm, ...]) -> RectMm:
    module = qr[0][3]
    return quiet_box((*template.qr.corner_mm, template.qr.size_mm, template.qr.size_mm), QR_QUIET * module, template)


def quiet_box(rect: RectMm, width: float, template: Template) -> RectMm:
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


def text_box(line: TextLine) -> Box:
    """The rectangle that a line of text takes."""
    (x, baseline), size = line.at_mm, line.size_mm
    top = baseline - CAP_HEIGHT * size
    rect = (x, top, text_width_mm(line.text, size, line.bold), (CAP_HEIGHT + DESCENT) * size)
    return Box(f'text "{line.text}"', rect)


def size_text(size_mm: tuple[float, ...]) -> str:
    """Width × height to a tenth of a millimetre."""
    return " × ".join(f"{round(side, 1):g}" for side in size_mm)


def _round(rect: RectMm) -> RectMm:
    return tuple(round(v, 6) for v in rect)  # a nanometre: keeps 0.1 + 0.2 out of the manifest


def moved(rect: RectMm, by: tuple[float, float]) -> RectMm:
    """The rectangle elsewhere."""
    return _round((rect[0] + by[0], rect[1] + by[1], rect[2], rect[3]))


def moved_marker(marker: PieceMarker, by: tuple[float, float]) -> PieceMarker:
    """The marker elsewhere."""
    return PieceMarker(marker.id, tuple((round(x + by[0], 6), round(y + by[1], 6)) for x, y in marker.corners_mm))


def grown(rect: RectMm, by: float) -> RectMm:
    """The rectangle with that much more on each side."""
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
