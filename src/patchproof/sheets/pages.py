"""A piece on its template: whole on one page, or in tiles on several.

In: a template and a piece, or its content. Out: pages and manifest. What lays out tiles is loaded where a template has
them; most have not.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from patchproof.base.strict import Refused
from patchproof.sheets.content import PrintedPiece
from patchproof.sheets.manifest import Manifest
from patchproof.sheets.page import lay_out_page, place_pieces
from patchproof.sheets.pdf import Printed
from patchproof.sheets.piece import Piece, marker_ids
from patchproof.sheets.template import Template

if TYPE_CHECKING:
    from patchproof.sheets.tiles import TilePlan


def pages_of(template: Template, content: PrintedPiece, copies: int = 1) -> tuple[list[Printed], Manifest]:
    """The pages with the piece, `copies` of a whole one, and the manifest."""
    if template.tiles is None:
        page = lay_out_page(template, content)
        pages = [Printed(page, content.pictures(page.cuts_mm[0]))] * copies
        return pages, content.manifest(page, template, page.cuts_mm[0])
    if copies > 1:
        raise Refused("one copy of a piece in tiles", f"{copies}", "print the file more than once")
    return _tiling("tile_pages").tile_pages(template, template.tiles, content)


def tiles_of(template: Template, piece: Piece) -> list[TilePlan]:
    """The tiles that a piece is cut into; none where it stays whole."""
    return [] if template.tiles is None else _tiling("tiles").plan_tiles(template.tiles, piece)


def refuse_larger_than_page(template: Template, piece: Piece) -> None:
    """Refuse a piece of which no sheet could be made: too large, or with more markers than there are ids."""
    if template.tiles is None:
        place_pieces(template, [piece])
    tiles = tiles_of(template, piece)
    own = _tiling("tiles").MARKERS * len(tiles) if tiles else 0
    marker_ids("", "design", len(piece.markers) + len(template.marker.corners_mm) + own)


def _tiling(module: str) -> Any:
    return import_module(f"patchproof.sheets.{module}")
