"""All pages of a piece in tiles, and what the manifest says of them.

In: a template with a [tiles] table, a piece and its design. Out: pages and a manifest. Page 1 carries the chart, the
rulers and a plan of the tiles; each tile follows on a page of its own. The design's page is that of the first tile, and
`design.rect_mm` and `cut_mm` lie in its millimeters, reaching beyond its edges; `tiles` carries every other page there.
"""

from __future__ import annotations

import numpy as np

from patchproof.sheets.content import PrintedPiece
from patchproof.sheets.manifest import Manifest, Tile
from patchproof.sheets.page import lay_out_parts, piece_zone_mm
from patchproof.sheets.pdf import Printed
from patchproof.sheets.piece import marker_ids, printed
from patchproof.sheets.rects import moved
from patchproof.sheets.template import Template, TileGrid
from patchproof.sheets.tiles import MARKERS, TilePlan, lay_out_tile, own_markers, plan_tiles, tile_map

FIRST_TILE_PAGE = 2


def tile_pages(template: Template, grid: TileGrid, content: PrintedPiece) -> tuple[list[Printed], Manifest]:
    """Page 1 and the tiles' pages, proved apart each; `grid` is the template's own."""
    piece, sheet_id = content.piece, content.sheet_id
    tiles, fixed = plan_tiles(grid, piece), len(piece.markers)
    own = fixed + len(template.marker.corners_mm)
    ids = marker_ids(sheet_id, content.kind, own + MARKERS * len(tiles))
    more, small = tile_map(piece, tiles, piece_zone_mm(template))
    words = content.words | {"tiles": str(len(tiles))}
    first = lay_out_parts(template, [], ids[fixed:own], content.code, words, more)
    layouts = [
        lay_out_tile(template, grid, content, tile, ids[own + MARKERS * i : own + MARKERS * (i + 1)])
        for i, tile in enumerate(tiles)
    ]
    pages = [Printed(first, tuple((rect, _pale(design)) for rect, design in content.pictures(small)))]
    whole = [moved((0.0, 0.0, *piece.size_mm), tile.page_from_piece_mm) for tile in tiles]
    pages += [Printed(page, windowed=content.pictures(rect)) for page, rect in zip(layouts, whole, strict=True)]
    numbered = list(enumerate(tiles, FIRST_TILE_PAGE))
    markers = [printed(marker, number) for number, tile in numbered for marker in own_markers(tile, piece)]
    markers += [printed(marker) for marker in first.markers]
    markers += [
        printed(marker, number) for number, page in enumerate(layouts, FIRST_TILE_PAGE) for marker in page.markers
    ]
    manifest = content.manifest(first, template, whole[0], FIRST_TILE_PAGE).changed(
        markers=tuple(markers), tiles=tuple(_tile(tile, number) for number, tile in numbered)
    )
    return pages, manifest


def _pale(design: np.ndarray) -> np.ndarray:
    """So light that names can be read on it, and that nobody cuts it out."""
    return (255 - (255 - design.astype(int)) // 3).astype(np.uint8)


def _tile(tile: TilePlan, page: int) -> Tile:
    dx, dy = (round(by, 6) for by in tile.page_from_piece_mm)
    return Tile(page=page, page_from_design_mm=((1.0, 0.0, dx), (0.0, 1.0, dy)), cut_mm=tile.page_rect_mm)
