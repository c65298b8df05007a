"""A piece larger than the page, cut into tiles that are printed on pages of their own and glued together.

In: a template with a [tiles] table, a piece and its design. Out: pages and a manifest. Page 1 carries the chart, the
rulers and a plan of the tiles; each tile follows on a page of its own. A tile shows its part of the piece; to the right
and below, where another tile follows, a flap of 10 mm goes on: the piece's picture for one more millimeter, so that no
gap shows where scissors slip, then white paper with a marker that the next tile will hide. Each tile has five markers
of its own, in flaps and trimmed margins, which tell its scan or photograph from any other's; when all is glued, the
piece's own markers alone are left to be seen. Seams are as even as they can be without cutting through a marker of the
piece. The design's page is that of the first tile, and `design.rect_mm` and `cut_mm` lie in its millimeters, reaching
beyond its edges; `tiles` carries every other page there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from patchproof.base.errors import Refused
from patchproof.sheets.content import SheetContent
from patchproof.sheets.layout import (
    Box,
    Line,
    PageLayout,
    Parts,
    Window,
    prove_apart,
    quiet_box,
    text_box,
    text_width_mm,
)
from patchproof.sheets.manifest import Manifest, Tile
from patchproof.sheets.markers import MARKER_MODULES
from patchproof.sheets.page import CUT_LINE_MM, MOST_TILES, lay_out_parts, piece_zone_mm, place_pieces
from patchproof.sheets.pdf import PdfPage
from patchproof.sheets.piece import (
    Piece,
    PieceMarker,
    manifest_marker,
    marker_ids,
    marker_rect,
    moved_marker,
    square_marker,
)
from patchproof.sheets.piece_words import piece_words
from patchproof.sheets.rects import PointMm, RectMm, grow_rect, rect_contains, rects_overlap, shift_rect, size_text
from patchproof.sheets.template import Template, TextLine, TileGrid, template_names

BLEED_MM = 1.0  # of the piece's picture on a flap
MARKERS = 5  # of a tile's own: whichever corner is hidden, four are left that surround most of it
FIRST_TILE_PAGE = 2


@dataclass(frozen=True)
class TilePlan:
    """A tile: its name (row letter, column number), its part of the piece, and where that lies on its page."""

    name: str
    part_mm: RectMm  # in piece millimeters
    corner_mm: PointMm  # of the part, on the page
    right: str | None  # the name of the tile that is glued on the right flap
    below: str | None

    @property
    def page_from_piece_mm(self) -> PointMm:
        """What to add to piece millimeters."""
        return self.corner_mm[0] - self.part_mm[0], self.corner_mm[1] - self.part_mm[1]

    @property
    def page_rect_mm(self) -> RectMm:
        """The part on its page."""
        return (*self.corner_mm, *self.part_mm[2:])

    def extended(self, by_mm: float) -> RectMm:
        """The part on its page, and that much more of its flaps."""
        x, y, w, h = self.page_rect_mm
        return x, y, w + (by_mm if self.right else 0), h + (by_mm if self.below else 0)


def plan_tiles(template: Template, piece: Piece) -> list[TilePlan]:
    """The tiles row by row, none where the piece stays whole; refused where there are more than marker ids last for."""
    grid = template.tiles
    if grid is None:
        return []
    xs, ys = (_seams(piece, axis, most_mm) for axis, most_mm in enumerate(grid.zone_mm[2:]))
    columns, rows = len(xs) - 1, len(ys) - 1
    if columns * rows > MOST_TILES:
        raise Refused(
            f"a piece of at most {MOST_TILES} tiles, for which there are marker ids",
            f"{size_text(piece.size_mm)} mm on {columns} × {rows} = {columns * rows} tiles",
            f"make the patch smaller or {_larger_tiles()}",
        )
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
    """Page 1 and the tiles' pages, proved apart each; `grid` is the template's own."""
    piece, sheet_id = content.piece, content.sheet_id
    tiles, fixed = plan_tiles(template, piece), len(piece.markers)
    own = fixed + len(template.marker.corners_mm)
    ids = marker_ids(sheet_id, content.kind, own + MARKERS * len(tiles))
    more, small = _tile_map(piece, tiles, piece_zone_mm(template))
    words = content.words | {"tiles": str(len(tiles))}
    first = lay_out_parts(template, [], ids[fixed:own], content.code, words, [more])
    layouts = [
        _lay_out_tile(template, grid, content, tile, ids[own + MARKERS * i : own + MARKERS * (i + 1)])
        for i, tile in enumerate(tiles)
    ]
    # pale: so light that names can be read on it, and that nobody cuts it out
    pages = [PdfPage(first, tuple((rect, 255 - (255 - design) // 3) for rect, design in content.pictures(small)))]
    markers, entries, cut_mm = [], [], (0.0, 0.0, *piece.size_mm)
    for number, (tile, page) in enumerate(zip(tiles, layouts, strict=True), FIRST_TILE_PAGE):
        by = dx, dy = tile.page_from_piece_mm
        pages.append(PdfPage(page, windowed=content.pictures(shift_rect(cut_mm, by))))
        markers += [manifest_marker(marker, number) for marker in _shown_markers(tile, piece)]
        shift = (1.0, 0.0, round(dx, 6)), (0.0, 1.0, round(dy, 6))
        entries.append(Tile(page=number, page_from_design_mm=shift, cut_mm=tile.page_rect_mm))
    for number, page in enumerate((first, *layouts), FIRST_TILE_PAGE - 1):
        markers += [manifest_marker(marker, number) for marker in page.markers]
    whole = shift_rect(cut_mm, tiles[0].page_from_piece_mm)
    manifest = content.manifest(first, template, whole, FIRST_TILE_PAGE)
    return pages, manifest.changed(markers=tuple(markers), tiles=tuple(entries))


def refuse_larger_than_page(template: Template, piece: Piece) -> None:
    """Refuse a piece of which no sheet could be made: too large, or with more markers than there are ids."""
    if template.tiles is None:
        place_pieces(template, [piece])
    own = len(template.marker.corners_mm) + MARKERS * len(plan_tiles(template, piece))
    marker_ids("", "design", len(piece.markers) + own)


def _lay_out_tile(
    template: Template, grid: TileGrid, content: SheetContent, tile: TilePlan, ids: Sequence[int]
) -> PageLayout:
    """One tile's page, proved apart and within the margins; its own markers are the layout's, the piece's lie in
    the window.
    """
    by, part, page_mm, margin_mm = tile.page_from_piece_mm, tile.page_rect_mm, template.page_mm, template.margin_mm
    window, cut = tile.extended(BLEED_MM), tile.extended(grid.overlap_mm)
    own = [square_marker(i, at, grid.marker_mm) for i, at in zip(ids, _places(grid, part), strict=True)]
    quiet = [quiet_box(marker_rect(marker), grid.marker_mm / MARKER_MODULES, page_mm, margin_mm) for marker in own]
    texts, own_words = _words(template, grid, tile, content.sheet_id), _within(window, piece_words(content, by))
    boxes = [Box(f"tile marker {i}", rect) for i, rect in enumerate(quiet, 1)] + [text_box(line) for line in texts]
    markers = [moved_marker(marker, by) for marker in content.piece.markers]
    boxes = (
        Box("tile", grow_rect(cut, CUT_LINE_MM)),
        Box("its picture", window, "tile"),
        *(Box(box.name, box.rect_mm, "tile" if rects_overlap(cut, box.rect_mm) else None) for box in boxes),
    )
    prove_apart(boxes, page_mm, margin_mm)
    return PageLayout(
        page_mm=page_mm,
        cuts_mm=(cut,),
        markers=tuple(own),
        ticks=own_words.lines,
        texts=(*texts, *own_words.texts),
        boxes=boxes,
        window=Window(window, tuple(m for m in markers if rects_overlap(grow_rect(window, 1e-6), marker_rect(m)))),
    )


def _within(window: RectMm, words: Parts) -> Parts:
    """The piece's words that the window shows: whole ones, since a corner's marker and its white are never cut."""
    lines = (line for line in words.lines if rect_contains(window, (*line.ends_mm[:2], 0.0, 0.0)))
    shown = (text for text, box in zip(words.texts, words.boxes, strict=True) if rect_contains(window, box.rect_mm))
    return Parts(tuple(lines), tuple(shown))


def _tile_map(piece: Piece, tiles: Sequence[TilePlan], zone_mm: RectMm) -> tuple[Parts, RectMm]:
    """The assembled piece drawn small in a zone: outline, seams and names, and where its picture goes."""
    x, y, w, h = grow_rect(zone_mm, -6.0)
    scale = min(w / piece.size_mm[0], h / piece.size_mm[1])
    x, y = x + (w - scale * piece.size_mm[0]) / 2, y + (h - scale * piece.size_mm[1]) / 2

    def small(rect: RectMm) -> RectMm:
        left, top, wide, high = (scale * side for side in rect)
        return round(x + left, 3), round(y + top, 3), round(wide, 3), round(high, 3)

    lines, texts = [], []
    for tile in tiles:
        left, top, width, height = small(tile.part_mm)
        right, bottom = left + width, top + height
        lines += [Line((left, top, right, top), 0.25), Line((left, top, left, bottom), 0.25)]
        lines += [Line((right, top, right, bottom), 0.25), Line((left, bottom, right, bottom), 0.25)]
        size = min(6.0, height / 3, width / 3)
        at = (left + (width - text_width_mm(tile.name, size, True)) / 2, top + height / 2 + size / 3)
        texts.append(TextLine(at_mm=at, size_mm=size, text=tile.name, bold=True))
    whole = small((0, 0, *piece.size_mm))
    return Parts(tuple(lines), tuple(texts), (Box("plan of the tiles", whole),)), whole


def _shown_markers(tile: TilePlan, piece: Piece) -> list[PieceMarker]:
    """The piece's markers whose middle the tile shows, in page millimeters."""
    (x, y, w, h), shown = tile.page_rect_mm, []
    for marker in (moved_marker(m, tile.page_from_piece_mm) for m in piece.markers):
        left, top, wide, high = marker_rect(marker)
        if x <= left + wide / 2 < x + w and y <= top + high / 2 < y + h:
            shown.append(marker)
    return shown


def _seams(piece: Piece, axis: int, most_mm: float) -> list[float]:
    """0, the seams along an axis, and the piece's end."""
    length = round(piece.size_mm[axis], 6)
    blocked = [(rect[axis], rect[axis] + rect[axis + 2]) for rect in piece.reserved_mm]
    fewest = max(math.ceil(length / most_mm - 1e-9), 1)
    if fewest > MOST_TILES:
        got = f"{size_text(piece.size_mm)} mm on tiles of {most_mm:g} mm"
        raise Refused(f"a piece of at most {MOST_TILES} tiles", got, _larger_tiles())
    for count in range(fewest, fewest + 3):
        seams = [0.0, *(_free(length * i / count, blocked) for i in range(1, count)), length]
        if all(0 < b - a <= most_mm + 1e-6 for a, b in pairwise(seams)):
            return seams
    raise Refused(
        "a piece that can be cut into tiles without cutting a marker",
        f"markers of {piece.marker_mm:.0f} mm on tiles of {most_mm:.0f} mm",
        _larger_tiles(),
    )


def _larger_tiles() -> str:
    return f"choose a template with larger tiles (of {', '.join(template_names('tiles'))})"


def _free(at: float, blocked: list[tuple[float, float]]) -> float:
    """The place nearest to `at` that lies in no blocked span, to 0.01 mm."""
    places = [at, *(end for span in blocked for end in span)]
    free = [p for p in places if not any(low + 1e-6 < p < high - 1e-6 for low, high in blocked)]
    return round(min(free, key=lambda p: abs(p - at)), 2)


def _places(grid: TileGrid, part: RectMm) -> list[PointMm]:
    """Corners of a tile's own markers: left and right, above and below, and under the part at the right."""
    size, (x, y, w, h) = grid.marker_mm, part
    module = size / MARKER_MODULES
    aside = BLEED_MM + module  # from the part's edge: the picture that runs on, and a quiet zone
    left = x - CUT_LINE_MM - module - size
    return [
        (left, y),
        (left, y + h - size),
        (x + w + aside, y + module),
        (x + w + aside, y + h - size - module),
        (x + w - size - module, y + h + aside),
    ]


def _words(template: Template, grid: TileGrid, tile: TilePlan, sheet_id: str) -> list[TextLine]:
    """The tile's name above it, and on its flaps what is glued there."""
    x, y, w, h = tile.page_rect_mm
    top = template.margin_mm + 3.4
    lines = [
        TextLine(at_mm=(x, top), size_mm=3.6, text=tile.name, bold=True),
        TextLine(at_mm=(x + 9, top), size_mm=2.2, text=f"patchproof {sheet_id}", gray=0.35),
        TextLine(at_mm=(x, top + 3.4), size_mm=2.0, text=f"Cut along the dashed line{_and_flaps(tile)}.", gray=0.35),
    ]
    if w < 60:  # a narrow tile has room for its name alone
        lines = lines[:2] if w > 45 else lines[:1]
    if tile.right:
        middle = x + w + grid.overlap_mm / 2 + BLEED_MM / 2
        for i, word in enumerate(("glue", tile.right, "here")):
            at = (middle - text_width_mm(word, 2.2, False) / 2, y + h / 2 + 3.2 * (i - 1))
            lines.append(TextLine(at_mm=at, size_mm=2.2, text=word, gray=0.35))
    if tile.below:
        at = (x + 4.0, y + h + grid.overlap_mm / 2 + 1.2)
        lines.append(TextLine(at_mm=at, size_mm=2.2, text=f"glue {tile.below} here", gray=0.35))
    return lines


def _and_flaps(tile: TilePlan) -> str:
    flaps = [name for name in (tile.right, tile.below) if name]
    return f"; the white {'flaps go' if len(flaps) > 1 else 'flap goes'} under {' and '.join(flaps)}" if flaps else ""
