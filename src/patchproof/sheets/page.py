"""One page: pieces, chart, rulers, QR code, page markers and words, each in its place and proved apart.

In: a template and pieces. Out: a `PageLayout`, which `pdf` turns into ink and `write` into the manifest.
Left out on purpose: automatic arranging. The template says where things go; only pieces are centered in their zone.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace

from patchproof.base.errors import Refused
from patchproof.sheets.chart import chart_swatches
from patchproof.sheets.content import SheetContent
from patchproof.sheets.layout import Box, PageLayout, Parts, prove_apart, quiet_box, ruler_parts, text_box
from patchproof.sheets.markers import MARKER_MODULES
from patchproof.sheets.piece import (
    Piece,
    black_runs,
    marker_ids,
    marker_rect,
    moved_marker,
    square_marker,
)
from patchproof.sheets.piece_words import piece_words
from patchproof.sheets.rects import PointMm, RectMm, grow_rect, rounded, shift_rect, size_text
from patchproof.sheets.template import BoardTemplate, Template, TextLine, template_names

CUT_LINE_MM = 0.2  # drawn wholly outside the cut, so that no ink of it stays on the piece
BETWEEN_MM = 4.0  # of white paper from piece to piece, for scissors
MOST_TILES = 30  # 5 markers each, beside the piece's and the page's, out of a kind's 166
QR_QUIET = 4  # modules of white that a QR code asks for on each side (ISO/IEC 18004)


def piece_zone_mm(template: Template) -> RectMm:
    """Where a piece may lie on the template's page."""
    if template.piece is None:
        got = "one of a chart alone"
        raise Refused("a template with a place for a piece", got, f"use one of: {', '.join(template_names('piece'))}")
    return template.piece.zone_mm


def largest_piece_mm(template: Template) -> tuple[float, float]:
    """Width and height that a piece may have on this template."""
    _, _, w, h = piece_zone_mm(template)
    if template.tiles is not None:  # as many as marker ids last for, in one row or column; `tiles` counts exactly
        _, _, w, h = (MOST_TILES * side for side in template.tiles.zone_mm)
    return w - 2 * CUT_LINE_MM, h - 2 * CUT_LINE_MM


def lay_out_page(template: Template, content: SheetContent) -> PageLayout:
    """The page of one piece; refused where that is too large."""
    placed, fixed = place_pieces(template, [content.piece]), len(content.piece.markers)
    ids = marker_ids(content.sheet_id, content.kind, fixed + len(template.marker.corners_mm))[fixed:]
    own_words = [piece_words(content, placed[0][1], piece_name(0))]
    return lay_out_parts(template, placed, ids, content.code, content.words, own_words)


def lay_out_parts(
    template: Template,
    placed: Sequence[tuple[Piece, PointMm]],
    ids: Sequence[int],
    qr_text: str,
    words: dict[str, str],
    more: Sequence[Parts] = (),
) -> PageLayout:
    """A page with any number of pieces at their top-left corners; `ids` are for the page's own markers."""
    size = template.marker.size_mm
    own = [square_marker(i, at, size) for i, at in zip(ids, template.marker.corners_mm, strict=True)]
    quiet = [quiet_box(marker_rect(m), size / MARKER_MODULES, template.page_mm, template.margin_mm) for m in own]
    chart = [(rounded(rect), srgb) for rect, srgb in chart_swatches(template.chart)]
    page = PageLayout(
        page_mm=template.page_mm,
        cuts_mm=tuple(rounded((*corner, *piece.size_mm)) for piece, corner in placed),
        markers=(*(moved_marker(m, corner) for piece, corner in placed for m in piece.markers), *own),
        swatches=tuple(chart),
        ticks=tuple(line for parts in more for line in parts.lines),
        texts=tuple(text for parts in more for text in parts.texts),
        boxes=(
            *(box for i, (piece, corner) in enumerate(placed) for box in _piece_boxes(piece, corner, i)),
            *(Box(f"chart swatch {i}", rect) for i, (rect, _) in enumerate(chart, 1)),
            *(Box(f"page marker {i}", rect) for i, rect in enumerate(quiet, 1)),
            *(box for parts in more for box in parts.boxes),
        ),
    )
    return furnished(template, page, qr_text, words)


def furnished(template: Template | BoardTemplate, page: PageLayout, qr_text: str, words: dict[str, str]) -> PageLayout:
    """The page with the template's QR code, rulers and words, proved apart and within the margins."""
    side = template.qr.size_mm
    qr = qr_rects_mm(qr_text, template.qr.corner_mm, side)
    square = quiet_box((*template.qr.corner_mm, side, side), QR_QUIET * qr[0][3], template.page_mm, template.margin_mm)
    rulers, lines = ruler_parts(template.ruler), tuple(_filled(line, words) for line in template.text)
    page = replace(
        page,
        qr_mm=qr,
        ticks=(*rulers.lines, *page.ticks),
        texts=(*lines, *rulers.texts, *page.texts),
        boxes=(*page.boxes, Box("QR code", square), *rulers.boxes, *map(text_box, lines)),
    )
    prove_apart(page.boxes, template.page_mm, template.margin_mm)
    return page


def qr_rects_mm(text: str, corner_mm: PointMm, size_mm: float) -> tuple[RectMm, ...]:
    """The dark runs, from the top down, of a QR code with error correction M in a square of that size."""
    import numpy as np
    import segno

    dark = np.array([list(row) for row in segno.make_qr(text, error="m").matrix], bool)
    return tuple(black_runs(dark, corner_mm, size_mm / len(dark)))


def place_pieces(template: Template, pieces: Sequence[Piece]) -> list[tuple[Piece, PointMm]]:
    """Pieces with their top-left corners: in rows as full as may be, in the middle of the template's zone."""
    widest, highest = largest_piece_mm(template)
    for piece in pieces:
        if piece.size_mm[0] > widest + 1e-6 or piece.size_mm[1] > highest + 1e-6:
            most, tiled = size_text((widest, highest)), ", ".join(template_names("tiles"))
            do = f"choose a larger template, one with tiles ({tiled}), or a smaller patch"
            raise Refused(f"a piece of at most {most} mm on this page", f"{size_text(piece.size_mm)} mm", do)
    x, y, w, h = piece_zone_mm(template)
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
    placed, top = [], y + (h - total) / 2
    for row, height in zip(rows, heights, strict=True):
        left = x + (w - sum(piece.size_mm[0] for piece in row) - BETWEEN_MM * (len(row) - 1)) / 2
        for piece in row:
            placed.append((piece, (round(left, 3), round(top, 3))))
            left += piece.size_mm[0] + BETWEEN_MM
        top += height + BETWEEN_MM
    return placed


def piece_name(number: int) -> str:
    """The name of a page's piece, from 0, among the page's parts."""
    return f"piece {number + 1}" if number else "piece"


def _piece_boxes(piece: Piece, corner: PointMm, number: int) -> list[Box]:
    """The piece, and in it its markers with their quiet zones."""
    name = piece_name(number)
    quiet = [grow_rect(shift_rect(marker_rect(marker), corner), piece.module_mm) for marker in piece.markers]
    cut = Box(name, grow_rect((*corner, *piece.size_mm), CUT_LINE_MM))
    return [cut, *(Box(f"{name} marker {i}", rect, name) for i, rect in enumerate(quiet, 1))]


def _filled(line: TextLine, words: dict[str, str]) -> TextLine:
    def word(match: re.Match) -> str:
        if match[1] not in words:
            raise Refused("only known words in the template's text", match[0], f"use one of: {', '.join(words)}")
        return words[match[1]]

    return line.changed(text=re.sub(r"\{(.*?)\}", word, line.text))
