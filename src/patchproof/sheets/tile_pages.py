"""All pages of a piece in tiles, and what the manifest says of them.

In: a template with a [tiles] table, a piece and its design. Out: `TiledPages`. Page 1 carries the chart, the rulers and
a plan of the tiles; each tile follows on a page of its own. The design's page is that of the first tile, and
`design.rect_mm` and `cut_mm` lie in its millimeters, reaching beyond its edges; `tiles` carries every other page there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from patchproof.sheets.manifest import Marker, Swatch, Tile
from patchproof.sheets.page import lay_out_parts, piece_words, piece_zone_mm
from patchproof.sheets.pdf import Printed
from patchproof.sheets.piece import Piece, PieceMarker, marker_ids, printed
from patchproof.sheets.rects import RectMm, moved
from patchproof.sheets.template import Template, TileGrid
from patchproof.sheets.tiles import MARKERS, TilePlan, lay_out_tile, own_markers, own_swatches, plan_tiles, tile_map

FIRST_TILE_PAGE = 2


@dataclass(frozen=True)
class TiledPages:
    """The pages, and the parts of the manifest that say where everything is on them."""

    pages: tuple[Printed, ...]
    markers: tuple[Marker, ...]  # the piece's first
    chart: tuple[Swatch, ...]
    tiles: tuple[Tile, ...]
    cut_mm: RectMm
    design_mm: RectMm


def tile_pages(
    template: Template, grid: TileGrid, piece: Piece, sheet_id: str, kind: str, qr_text: str, design: np.ndarray | None
) -> TiledPages:
    """Page 1 and the tiles' pages, proved apart each; `grid` is the template's own."""
    tiles, fixed = plan_tiles(grid, piece), len(piece.markers)
    own = fixed + len(template.marker.corners_mm)
    ids = marker_ids(sheet_id, kind, own + MARKERS * len(tiles))
    more, small = tile_map(piece, tiles, piece_zone_mm(template))
    words = piece_words(piece, sheet_id, kind) | {"tiles": str(len(tiles))}
    first = lay_out_parts(template, [], ids[fixed:own], qr_text, words, more)
    layouts = [
        lay_out_tile(template, grid, piece, tile, ids[own + MARKERS * i : own + MARKERS * (i + 1)], sheet_id)
        for i, tile in enumerate(tiles)
    ]
    pages = [Printed(first, () if design is None else ((small, _pale(design)),))]
    pages += [Printed(page, windowed=() if design is None else ((page.designs_mm[0], design),)) for page in layouts]
    by = tiles[0].page_from_piece_mm
    chart = [Swatch(rect_mm=rect, srgb=srgb, page=1) for rect, srgb in first.swatches]
    chart += [
        Swatch(rect_mm=rect, srgb=srgb, page=number)
        for number, tile in enumerate(tiles, FIRST_TILE_PAGE)
        for rect, srgb in own_swatches(tile, piece)
    ]
    return TiledPages(
        pages=tuple(pages),
        markers=tuple(_all_markers(piece, tiles, first.markers, [page.markers for page in layouts])),
        chart=tuple(chart),
        tiles=tuple(_tile(tile, piece, number) for number, tile in enumerate(tiles, FIRST_TILE_PAGE)),
        cut_mm=moved((0.0, 0.0, *piece.size_mm), by),
        design_mm=moved(piece.design_rect_mm, by),
    )


def _pale(design: np.ndarray) -> np.ndarray:
    """So light that names can be read on it, and that nobody cuts it out."""
    return (255 - (255 - design.astype(int)) // 3).astype(np.uint8)


def _tile(tile: TilePlan, piece: Piece, page: int) -> Tile:
    (dx, dy), (x, y, *_) = tile.page_from_piece_mm, piece.design_rect_mm
    return Tile(
        page=page,
        page_from_design_mm=((1.0, 0.0, round(dx + x, 6)), (0.0, 1.0, round(dy + y, 6))),
        cut_mm=tile.page_rect_mm,
    )


def _all_markers(
    piece: Piece, tiles: Sequence[TilePlan], first: Sequence[PieceMarker], own: Sequence[Sequence[PieceMarker]]
) -> list[Marker]:
    of_piece = [(m, n) for n, tile in enumerate(tiles, FIRST_TILE_PAGE) for m in own_markers(tile, piece)]
    checks = [(m, 1) for m in first] + [(m, n) for n, page in enumerate(own, FIRST_TILE_PAGE) for m in page]
    return [printed(m, n) for m, n in of_piece + checks]
