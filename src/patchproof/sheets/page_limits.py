"""Refuse pieces of which no sheet can be made, before any work is done for them.

In: a template and a piece. Tiles are planned, and their module loaded, only for templates that have them.
"""

from patchproof.sheets.page import place_pieces
from patchproof.sheets.piece import Piece, marker_ids
from patchproof.sheets.template import Template


def refuse_larger_than_page(template: Template, piece: Piece) -> None:
    """Refuse a piece of which no sheet can be made: too large, or with more markers than there are ids."""
    others = len(template.marker.corners_mm)
    if template.tiles is None:
        place_pieces(template, [piece])
    else:
        from patchproof.sheets.tiles import MARKERS_PER_TILE, plan_tiles

        others += MARKERS_PER_TILE * len(plan_tiles(template, piece))
    marker_ids("", "design", len(piece.markers) + others)
