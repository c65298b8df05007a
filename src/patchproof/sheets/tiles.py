"""Divide a piece larger than the page into tiles, which are printed on pages of their own and glued together.

In: a template with a [tiles] table, a piece and its design. Out: pages and a manifest. Page 1 shows the chart, the
rulers and a map of the tiles; each tile follows on a page of its own. A tile shows its part of the piece; to the right
and below, where another tile adjoins, it has a flap of 10 mm: one more millimeter of the piece's picture, so that
imprecise cutting leaves no gap, then white paper with a marker that the next tile will cover. Each tile has five
markers of its own, in flaps and trimmed margins, which identify a scan or photograph of it; on the glued piece only the
piece's own markers are visible. Seams are as even as they can be without cutting through a marker of the piece. The
design's page is that of the first tile; `design.rect_mm` and `cut_mm` are in its millimeters and extend beyond its
edges, and `tiles` maps them to every other page.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

from patchproof.base.errors import Refused
from patchproof.sheets import layout
from patchproof.sheets.content import SheetContent, piece_words
from patchproof.sheets.layout import Box, Line, PageLayout, PageParts, PieceWindow
from patchproof.sheets.manifest import Manifest, Marker, Tile
from patchproof.sheets.markers import MARKER_MODULES
from patchproof.sheets.page import CUT_LINE_MM, MAX_TILES, lay_out_parts, piece_zone_mm
from patchproof.sheets.pdf import PdfPage
from patchproof.sheets.piece import Piece, manifest_marker, marker_ids, marker_rect, move_marker, square_marker
from patchproof.sheets.rects import PointMm, RectMm, grow_rect, rect_contains, rects_overlap, shift_rect, size_text
from patchproof.sheets.template import Template, TextLine, TileGrid, template_names

BLEED_MM = 1.0  # of the piece's picture on a flap
MARKERS_PER_TILE = 5  # whichever corner is covered, the other four surround most of the tile
FIRST_TILE_PAGE = 2


@dataclass(frozen=True)
class TilePlan:
    """A tile: its name (row letter, column number), its part of the piece, and the place of that on its page."""

    name: str
    part_mm: RectMm  # in piece millimeters
    corner_mm: PointMm  # of the part, on the page
    right: str | None  # the name of the tile that is glued on the right flap
    below: str | None

    @property
    def page_from_piece_mm(self) -> PointMm:
        """The shift from piece millimeters to page millimeters."""
        return self.corner_mm[0] - self.part_mm[0], self.corner_mm[1] - self.part_mm[1]

    @property
    def page_rect_mm(self) -> RectMm:
        """The rectangle of the part on its page."""
        return (*self.corner_mm, *self.part_mm[2:])

    def rect_with_flaps(self, by_mm: float) -> RectMm:
        """The rectangle of the part on its page, extended by `by_mm` where there are flaps."""
        x, y, w, h = self.page_rect_mm
        return x, y, w + (by_mm if self.right else 0), h + (by_mm if self.below else 0)


def plan_tiles(template: Template, piece: Piece) -> list[TilePlan]:
    """The tiles row by row, none for a template without [tiles]; refused if there are more tiles than marker ids."""
    grid = template.tiles
    if grid is None:
        return []
    xs, ys = (_seams(piece, axis, max_mm) for axis, max_mm in enumerate(grid.zone_mm[2:]))
    columns, rows = len(xs) - 1, len(ys) - 1
    if columns * rows > MAX_TILES:
        expected = f"a piece of at most {MAX_TILES} tiles, limited by the number of marker ids"
        got = f"{size_text(piece.size_mm)} mm on {columns} × {rows} = {columns * rows} tiles"
        raise Refused(expected, got, f"make the patch smaller or {_larger_tiles()}")
    names = [[f"{chr(ord('A') + row)}{column + 1}" for column in range(columns)] for row in range(rows)]
    return [
        TilePlan(
            name=names[row][column],
            part_mm=(xs[column], ys[row], round(xs[column + 1] - xs[column], 6), round(ys[row + 1] - ys[row], 6)),
            corner_mm=grid.zone_mm[:2],
            right=names[row][column + 1] if column + 1 < columns else None,
            below=names[row + 1][column] if row + 1 < rows else None,
        )
        for row in range(rows)
        for column in range(columns)
    ]


def tile_pages(template: Template, grid: TileGrid, content: SheetContent) -> tuple[list[PdfPage], Manifest]:
    """Lay out page 1 and the tiles' pages, and make the manifest; `grid` is the template's [tiles] table."""
    piece, sheet_id = content.piece, content.sheet_id
    tiles, page_ids = plan_tiles(template, piece), len(piece.markers)
    tile_ids = page_ids + len(template.marker.corners_mm)
    ids = marker_ids(sheet_id, content.kind, tile_ids + MARKERS_PER_TILE * len(tiles))
    tile_map, map_rect = _tile_map(piece, tiles, piece_zone_mm(template))
    words = content.words | {"tiles": str(len(tiles))}
    first = lay_out_parts(template, [], ids[page_ids:tile_ids], content.code, words, [tile_map])
    tiles_ids = (ids[start : start + MARKERS_PER_TILE] for start in range(tile_ids, len(ids), MARKERS_PER_TILE))
    layouts = [_tile_page(template, grid, content, *pair) for pair in zip(tiles, tiles_ids, strict=True)]
    # the map is pale, so that names can be read on it and nobody cuts it out
    pages = [PdfPage(first, tuple((rect, 255 - (255 - design) // 3) for rect, design in content.pictures(map_rect)))]
    markers, entries, piece_rect = [], [], (0.0, 0.0, *piece.size_mm)
    for number, (tile, page) in enumerate(zip(tiles, layouts, strict=True), FIRST_TILE_PAGE):
        dx, dy = tile.page_from_piece_mm
        pages.append(PdfPage(page, window_pictures=content.pictures(shift_rect(piece_rect, (dx, dy)))))
        markers += _markers_on(tile, piece, number)
        shift = (1.0, 0.0, round(dx, 6)), (0.0, 1.0, round(dy, 6))
        entries.append(Tile(page=number, page_from_design_mm=shift, cut_mm=tile.page_rect_mm))
    for number, page in enumerate((first, *layouts), FIRST_TILE_PAGE - 1):
        markers += [manifest_marker(marker, number) for marker in page.markers]
    manifest = content.manifest(first, template, shift_rect(piece_rect, tiles[0].page_from_piece_mm), FIRST_TILE_PAGE)
    return pages, manifest.changed(markers=tuple(markers), tiles=tuple(entries))


def _tile_page(template: Template, grid: TileGrid, content: SheetContent, tile: TilePlan, ids: list[int]) -> PageLayout:
    """Lay out and check one tile's page; its own markers are the layout's, the piece's markers lie in the window."""
    shift, part, page_mm, margin_mm = tile.page_from_piece_mm, tile.page_rect_mm, template.page_mm, template.margin_mm
    window, cut = tile.rect_with_flaps(BLEED_MM), tile.rect_with_flaps(grid.overlap_mm)
    side, corners = grid.marker_mm, _marker_corners(grid, part)
    tile_markers = [square_marker(i, corner, side) for i, corner in zip(ids, corners, strict=True)]
    quiet = [layout.quiet_zone_rect(marker_rect(m), side / MARKER_MODULES, page_mm, margin_mm) for m in tile_markers]
    texts, labels = _tile_texts(template, grid, tile, content.sheet_id), _within(window, piece_words(content, shift))
    boxes = [*(Box(f"tile marker {i}", rect) for i, rect in enumerate(quiet, 1)), *map(layout.text_box, texts)]
    piece_markers = [move_marker(marker, shift) for marker in content.piece.markers]
    window_markers = (m for m in piece_markers if rects_overlap(grow_rect(window, 1e-6), marker_rect(m)))
    boxes = (
        Box("tile", grow_rect(cut, CUT_LINE_MM)),
        Box("its picture", window, "tile"),
        *(Box(box.name, box.rect_mm, "tile" if rects_overlap(cut, box.rect_mm) else None) for box in boxes),
    )
    layout.check_layout(boxes, page_mm, margin_mm)
    return PageLayout(
        page_mm=page_mm,
        cuts_mm=(cut,),
        markers=tuple(tile_markers),
        ticks=labels.lines,
        texts=(*texts, *labels.texts),
        boxes=boxes,
        window=PieceWindow(window, tuple(window_markers)),
    )


def _within(window: RectMm, labels: PageParts) -> PageParts:
    """The piece's texts within the window. Seams cut no text, since texts lie in markers' white, which seams avoid."""
    lines = (line for line in labels.lines if rect_contains(window, (*line.ends_mm[:2], 0.0, 0.0)))
    texts = (text for text, box in zip(labels.texts, labels.boxes, strict=True) if rect_contains(window, box.rect_mm))
    return PageParts(tuple(lines), tuple(texts))


def _tile_map(piece: Piece, tiles: Sequence[TilePlan], zone_mm: RectMm) -> tuple[PageParts, RectMm]:
    """A small map of the assembled piece (outline, seams and names), and the rectangle for its picture."""
    x, y, w, h = grow_rect(zone_mm, -6.0)
    scale = min(w / piece.size_mm[0], h / piece.size_mm[1])
    x, y = x + (w - scale * piece.size_mm[0]) / 2, y + (h - scale * piece.size_mm[1]) / 2

    def to_map(rect: RectMm) -> RectMm:
        left, top, wide, high = (scale * side for side in rect)
        return round(x + left, 3), round(y + top, 3), round(wide, 3), round(high, 3)

    lines, texts = [], []
    for tile in tiles:
        left, top, width, height = to_map(tile.part_mm)
        right, bottom = left + width, top + height
        lines += [Line((left, top, right, top), 0.25), Line((left, top, left, bottom), 0.25)]
        lines += [Line((right, top, right, bottom), 0.25), Line((left, bottom, right, bottom), 0.25)]
        size = min(6.0, height / 3, width / 3)
        corner = (left + (width - layout.text_width_mm(tile.name, size, True)) / 2, top + height / 2 + size / 3)
        texts.append(TextLine(at_mm=corner, size_mm=size, text=tile.name, bold=True))
    map_rect = to_map((0, 0, *piece.size_mm))
    return PageParts(tuple(lines), tuple(texts), (Box("plan of the tiles", map_rect),)), map_rect


def _markers_on(tile: TilePlan, piece: Piece, page: int) -> Iterator[Marker]:
    """The piece's markers whose middle lies on the tile, as entries of its page in the manifest."""
    x, y, w, h = tile.page_rect_mm
    for marker in (move_marker(m, tile.page_from_piece_mm) for m in piece.markers):
        left, top, wide, high = marker_rect(marker)
        if x <= left + wide / 2 < x + w and y <= top + high / 2 < y + h:
            yield manifest_marker(marker, page)


def _seams(piece: Piece, axis: int, max_mm: float) -> list[float]:
    """Positions along an axis: 0, the seams, and the piece's end."""
    length = round(piece.size_mm[axis], 6)
    blocked = [(rect[axis], rect[axis] + rect[axis + 2]) for rect in piece.reserved_mm]
    min_tiles = max(math.ceil(length / max_mm - 1e-9), 1)
    if min_tiles > MAX_TILES:
        got = f"{size_text(piece.size_mm)} mm on tiles of {max_mm:g} mm"
        raise Refused(f"a piece of at most {MAX_TILES} tiles", got, _larger_tiles())
    for count in range(min_tiles, min_tiles + 3):
        seams = [0.0, *(_nearest_free(length * i / count, blocked) for i in range(1, count)), length]
        if all(0 < b - a <= max_mm + 1e-6 for a, b in pairwise(seams)):
            return seams
    got = f"markers of {piece.marker_mm:.0f} mm on tiles of {max_mm:.0f} mm"
    raise Refused("a piece that can be divided into tiles without cutting a marker", got, _larger_tiles())


def _larger_tiles() -> str:
    return f"choose a template with larger tiles (of {', '.join(template_names('tiles'))})"


def _nearest_free(position: float, blocked: list[tuple[float, float]]) -> float:
    """The position nearest to the given one that lies in no blocked interval, to 0.01 mm."""
    candidates = [position, *(end for interval in blocked for end in interval)]
    free = [p for p in candidates if not any(low + 1e-6 < p < high - 1e-6 for low, high in blocked)]
    return round(min(free, key=lambda p: abs(p - position)), 2)


def _marker_corners(grid: TileGrid, part: RectMm) -> list[PointMm]:
    """Top-left corners of a tile's own markers: two to its left, two to its right, and one below at the right."""
    size, (x, y, w, h) = grid.marker_mm, part
    module = size / MARKER_MODULES
    distance = BLEED_MM + module  # from the part's edge: the picture's bleed and a quiet zone
    left, right, low = x - CUT_LINE_MM - module - size, x + w + distance, y + h - size
    below = x + w - size - module, y + h + distance
    return [(left, y), (left, low), (right, y + module), (right, low - module), below]


def _tile_texts(template: Template, grid: TileGrid, tile: TilePlan, sheet_id: str) -> list[TextLine]:
    """The tile's name above it, and on each flap the name of the tile to glue on it."""
    x, y, w, h = tile.page_rect_mm
    top, flaps = template.margin_mm + 3.4, [name for name in (tile.right, tile.below) if name]
    under = f"; the white {'flaps go' if len(flaps) > 1 else 'flap goes'} under {' and '.join(flaps)}" if flaps else ""
    lines = [
        TextLine(at_mm=(x, top), size_mm=3.6, text=tile.name, bold=True),
        TextLine(at_mm=(x + 9, top), size_mm=2.2, text=f"patchproof {sheet_id}", gray=0.35),
        TextLine(at_mm=(x, top + 3.4), size_mm=2.0, text=f"Cut along the dashed line{under}.", gray=0.35),
    ]
    if w < 60:  # a narrow tile has room for its name only
        lines = lines[:2] if w > 45 else lines[:1]
    if tile.right:
        middle = x + w + grid.overlap_mm / 2 + BLEED_MM / 2
        for i, word in enumerate(("glue", tile.right, "here")):
            start = (middle - layout.text_width_mm(word, 2.2, False) / 2, y + h / 2 + 3.2 * (i - 1))
            lines.append(TextLine(at_mm=start, size_mm=2.2, text=word, gray=0.35))
    if tile.below:
        start = (x + 4.0, y + h + grid.overlap_mm / 2 + 1.2)
        lines.append(TextLine(at_mm=start, size_mm=2.2, text=f"glue {tile.below} here", gray=0.35))
    return lines
