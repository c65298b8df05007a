"""Lay out one page: pieces, chart, rulers, QR code, page markers and texts, without overlaps.

In: a template and pieces. Out: a `PageLayout`, which `pdf` draws and `write` states in the manifest. The chart's colors
are the 8 corners of the RGB cube, an 8-step gray ramp (6 between black and white), 6 duplicates, whose readings are
averaged, and a low-discrepancy sample of the cube, all multiples of 1/255, so that every printer driver gets the same
numbers. They are shuffled in a fixed order, so that a gradient of light across the page is not mistaken for a color.
Left out on purpose: automatic arrangement. The template places everything; only pieces are centered in their zone.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from patchproof.base.errors import Refused
from patchproof.sheets.content import SheetContent, piece_words
from patchproof.sheets.layout import Box, PageLayout, PageParts, check_layout, quiet_zone_rect, ruler_parts, text_box
from patchproof.sheets.markers import MARKER_MODULES
from patchproof.sheets.piece import Piece, black_runs, hash_order, marker_ids, marker_rect, move_marker, square_marker
from patchproof.sheets.rects import PointMm, RectMm, Srgb, SwatchRect, grow_rect, round_rect, shift_rect, size_text
from patchproof.sheets.template import AnyTemplate, ChartGrid, Template, TextLine, template_names

CORNERS: tuple[Srgb, ...] = tuple((float(r), float(g), float(b)) for r, g, b in product((0, 1), repeat=3))
GRAYS: tuple[Srgb, ...] = tuple((v / 255, v / 255, v / 255) for v in (36, 73, 109, 146, 182, 219))
DUPLICATES: tuple[Srgb, ...] = (CORNERS[0], CORNERS[7], GRAYS[1], GRAYS[4], (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
# (columns, rows): the one of 200 shuffles that keeps duplicates far apart (4 to 7 cells) and correlations of a channel
# with x or y low (below 0.1 on 12 × 6, at most 0.15). Other grids use that of 12 × 6.
SHUFFLE_NUMBERS = {(12, 6): 184, (8, 12): 19, (16, 6): 81, (12, 4): 80, (6, 8): 172}

_BITS = 32  # of the integers in Sobol's sequence
MIN_PRINT_MM, MAX_PRINT_MM = 5.0, 20_000.0  # of prints without a page: a sticker, a wall
CUT_LINE_MM = 0.2  # drawn outside the cut, so that no ink of it stays on the piece
PIECE_GAP_MM = 4.0  # of white paper between pieces, for scissors
MAX_TILES = 30  # with 5 markers each, beside the piece's and the page's, out of a kind's ids
QR_QUIET_MODULES = 4  # white on each side of a QR code (ISO/IEC 18004)


def chart_colors(count: int) -> list[Srgb]:
    """`count` sRGB colors: the fixed ones, then Sobol's sequence (unscrambled, without its first point)."""
    fixed = [*CORNERS, *GRAYS, *DUPLICATES]
    points = np.rint(sobol(max(count - len(fixed), 0) + 1)[1:] * 255) / 255
    return [*fixed, *((r, g, b) for r, g, b in points.tolist())][:count]


def sobol(count: int) -> np.ndarray:
    """The first `count` points (count×3) of Sobol's sequence in the unit cube, exact below 2^32 points (Antonov and
    Saleev, 1979; direction numbers of Joe and Kuo, 2008). scipy.stats.qmc has it, too, but imports all of scipy.stats.
    """
    first, second, third = [1, 1], [1, 3], [1, 3]
    while len(first) < _BITS:
        first.append(1)
        second.append(second[-1] << 1 ^ second[-1])  # polynomial x + 1
        third.append(third[-1] << 1 ^ third[-2] << 2 ^ third[-2])  # polynomial x² + x + 1
    directions = np.array([first, second, third]).T << np.arange(_BITS - 1, -1, -1)[:, None]
    lowest_zeros = [(~number & number + 1).bit_length() - 1 for number in range(count - 1)]
    return np.bitwise_xor.accumulate(np.concatenate([np.zeros((1, 3), int), directions[lowest_zeros]])) / 2**_BITS


def chart_swatches(grid: ChartGrid) -> tuple[SwatchRect, ...]:
    """The chart's swatches (rectangle in page millimeters, sRGB), row by row."""
    colors = chart_colors(grid.columns * grid.rows)
    order = hash_order(f"chart {SHUFFLE_NUMBERS.get((grid.columns, grid.rows), 184)}", len(colors))
    pitch = grid.swatch_mm + grid.gap_mm
    (x, y), side = grid.corner_mm, grid.swatch_mm
    cells = product(range(grid.rows), range(grid.columns))
    rects = ((x + column * pitch, y + row * pitch, side, side) for row, column in cells)
    return tuple(zip(rects, (colors[index] for index in order), strict=True))


def piece_zone_mm(template: Template) -> RectMm:
    """The zone of the template's page for pieces; refused if the template has none."""
    if template.piece is None:
        do = f"use one of: {', '.join(template_names('piece'))}"
        raise Refused("a template with a zone for a piece", "a template with a chart only", do)
    return template.piece.zone_mm


def largest_piece_mm(template: Template) -> tuple[float, float]:
    """The largest width and height of a piece on one page of this template."""
    _, _, w, h = piece_zone_mm(template)
    return w - 2 * CUT_LINE_MM, h - 2 * CUT_LINE_MM


def lay_out_page(template: Template, content: SheetContent) -> PageLayout:
    """Lay out the page of one piece; refused if the piece is too large."""
    pieces, used_ids = place_pieces(template, [content.piece]), len(content.piece.markers)
    page_ids = len(template.marker.corners_mm) if used_ids else 0
    ids = marker_ids(content.sheet_id, content.kind, used_ids + page_ids)[used_ids:]
    labels = [piece_words(content, pieces[0][1], piece_name(0))]
    return lay_out_parts(template, pieces, ids, content.code, content.words, labels)


def lay_out_parts(
    template: Template,
    pieces: Sequence[tuple[Piece, PointMm]],
    ids: Sequence[int],
    qr_text: str,
    words: dict[str, str],
    extra_parts: Sequence[PageParts] = (),
) -> PageLayout:
    """Lay out a page with any number of (piece, top-left corner); `ids` are those of the page's own markers (none for a
    page without markers), `words` the values of the placeholders in the template's text.
    """
    size, corners_mm = template.marker.size_mm, template.marker.corners_mm if ids else ()
    page_markers = [square_marker(i, corner, size) for i, corner in zip(ids, corners_mm, strict=True)]
    page_mm, margin_mm = template.page_mm, template.margin_mm
    quiet = [quiet_zone_rect(marker_rect(m), size / MARKER_MODULES, page_mm, margin_mm) for m in page_markers]
    chart = [(round_rect(rect), srgb) for rect, srgb in chart_swatches(template.chart)]
    page = PageLayout(
        page_mm=page_mm,
        cuts_mm=tuple(round_rect((*corner, *piece.size_mm)) for piece, corner in pieces),
        markers=(*(move_marker(m, corner) for piece, corner in pieces for m in piece.markers), *page_markers),
        swatches=tuple(chart),
        ticks=tuple(line for parts in extra_parts for line in parts.lines),
        texts=tuple(text for parts in extra_parts for text in parts.texts),
        boxes=(
            *(box for i, (piece, corner) in enumerate(pieces) for box in _piece_boxes(piece, corner, i)),
            *(Box(f"chart swatch {i}", rect) for i, (rect, _) in enumerate(chart, 1)),
            *(Box(f"page marker {i}", rect) for i, rect in enumerate(quiet, 1)),
            *(box for parts in extra_parts for box in parts.boxes),
        ),
    )
    return add_template_parts(template, page, qr_text, words)


def add_template_parts(template: AnyTemplate, page: PageLayout, qr_text: str, words: dict[str, str]) -> PageLayout:
    """Add the template's QR code, rulers and texts to a page, and check the whole layout."""
    (x, y), side = template.qr.corner_mm, template.qr.size_mm
    qr = qr_rects_mm(qr_text, (x, y), side)
    square = quiet_zone_rect((x, y, side, side), QR_QUIET_MODULES * qr[0][3], template.page_mm, template.margin_mm)
    rulers, texts = ruler_parts(template.ruler), tuple(_fill_placeholders(line, words) for line in template.text)
    page = replace(
        page,
        qr_mm=qr,
        ticks=(*rulers.lines, *page.ticks),
        texts=(*texts, *rulers.texts, *page.texts),
        boxes=(*page.boxes, Box("QR code", square), *rulers.boxes, *map(text_box, texts)),
    )
    check_layout(page.boxes, template.page_mm, template.margin_mm)
    return page


def qr_rects_mm(text: str, corner_mm: PointMm, size_mm: float) -> tuple[RectMm, ...]:
    """The dark runs, from the top down, of a QR code with error correction M in a square of `size_mm`."""
    import segno

    dark = np.array([list(row) for row in segno.make_qr(text, error="m").matrix], bool)
    return tuple(black_runs(dark, corner_mm, size_mm / len(dark)))


def place_pieces(template: Template, pieces: Sequence[Piece]) -> list[tuple[Piece, PointMm]]:
    """Give pieces their top-left corners: in full rows, centered in the template's zone; refused if they do not fit."""
    max_width, max_height = largest_piece_mm(template)
    for piece in pieces:
        if piece.size_mm[0] > max_width + 1e-6 or piece.size_mm[1] > max_height + 1e-6:
            largest, tiled = size_text((max_width, max_height)), ", ".join(template_names("tiles"))
            do = f"choose a larger template, one with tiles ({tiled}), or a smaller patch"
            raise Refused(f"a piece of at most {largest} mm on this page", f"{size_text(piece.size_mm)} mm", do)
    x, y, w, h = piece_zone_mm(template)
    rows: list[list[Piece]] = []
    for piece in pieces:
        used = sum(p.size_mm[0] + PIECE_GAP_MM for p in rows[-1]) if rows else math.inf
        if used + piece.size_mm[0] > w - 2 * CUT_LINE_MM + 1e-6:
            rows.append([])
        rows[-1].append(piece)
    heights = [max(piece.size_mm[1] for piece in row) for row in rows]
    total = sum(heights) + PIECE_GAP_MM * (len(rows) - 1)
    if total > h - 2 * CUT_LINE_MM + 1e-6:
        expected = f"pieces that fit on one page, in rows with a total height of at most {h:g} mm"
        got = f"{len(pieces)} pieces with a total height of {total:.0f} mm"
        raise Refused(expected, got, "choose a larger template or put fewer designs on a page")
    corners, top = [], y + (h - total) / 2
    for row, height in zip(rows, heights, strict=True):
        left = x + (w - sum(piece.size_mm[0] for piece in row) - PIECE_GAP_MM * (len(row) - 1)) / 2
        for piece in row:
            corners.append((piece, (round(left, 3), round(top, 3))))
            left += piece.size_mm[0] + PIECE_GAP_MM
        top += height + PIECE_GAP_MM
    return corners


def piece_name(number: int) -> str:
    """The name of a page's piece, numbered from 0, among the page's parts."""
    return f"piece {number + 1}" if number else "piece"


def _piece_boxes(piece: Piece, corner: PointMm, number: int) -> list[Box]:
    """The boxes of a piece and of its markers with their quiet zones."""
    name = piece_name(number)
    quiet = [grow_rect(shift_rect(marker_rect(marker), corner), piece.module_mm) for marker in piece.markers]
    cut = Box(name, grow_rect((*corner, *piece.size_mm), CUT_LINE_MM))
    return [cut, *(Box(f"{name} marker {i}", rect, name) for i, rect in enumerate(quiet, 1))]


def _fill_placeholders(line: TextLine, words: dict[str, str]) -> TextLine:
    def value(match: re.Match) -> str:
        if match[1] not in words:
            raise Refused("only known placeholders in a template's text", match[0], f"use one of: {', '.join(words)}")
        return words[match[1]]

    return line.changed(text=re.sub(r"\{(.*?)\}", value, line.text))


def refuse_larger_than_page(template: Template | None, piece: Piece) -> None:
    """Refuse a piece of an impossible size, with more markers than there are ids, or without any in tiles."""
    if template is None:
        if not MIN_PRINT_MM <= min(piece.size_mm) <= max(piece.size_mm) <= MAX_PRINT_MM:
            expected = f"a print of {MIN_PRINT_MM:g} mm to {MAX_PRINT_MM / 1000:g} m along each side"
            raise Refused(expected, f"{size_text(piece.size_mm)} mm", "state its width and height in millimeters")
        return
    if template.tiles is not None and not piece.markers:
        raise Refused("markers on a piece in tiles", "sheet.markers = false", 'name a page of one piece, or "none"')
    others = len(template.marker.corners_mm)
    if template.tiles is None:
        place_pieces(template, [piece])
    else:
        from patchproof.sheets.tiles import MARKERS_PER_TILE, plan_tiles

        others += MARKERS_PER_TILE * len(plan_tiles(template, piece))
    marker_ids("", "design", len(piece.markers) + others)
