"""Pages without a design, printed before there is a run: a blank piece, or a color chart alone.

In: a template. Out: a PDF and its JSON; the sheet id is a hash of the template, so equal templates give equal pages.
A template with a [blank] table has a piece with markers alone: photographs of the object with it show where a design of
the same size would lie and what light falls on it, all that a photographed scene needs. Its cut line and markers say
all about the piece: `blank_piece` reads it back. A template without a place for a piece is a chart, printed to learn
what a printer does to colors; nothing is cut, but its `cut_mm` is what photographs are to show. `blank_page` takes the
templates of boards, too (see `board`).
"""

from __future__ import annotations

from pathlib import Path

from patchproof.base.errors import Refused
from patchproof.sheets.board import board_sheet, is_board
from patchproof.sheets.content import SheetContent
from patchproof.sheets.manifest import Manifest
from patchproof.sheets.markers import MARKER_MODULES
from patchproof.sheets.page import lay_out_parts
from patchproof.sheets.piece import (
    Piece,
    PieceMarker,
    lay_out_piece,
    marker_ids,
    marker_rect,
    moved_marker,
    page_id,
)
from patchproof.sheets.rects import rect_contains
from patchproof.sheets.template import Template, load_template, template_names
from patchproof.sheets.write import write_page, write_sheet

BLANK, CHART = "blank", "chart"


def blank_page(pdf_path: str | Path, *, template: str | None, control: str | None = None) -> Manifest:
    """Write a page that needs no run: of a template with a [blank] or a [board] table, or of a chart alone."""
    if control is not None:
        raise Refused(f"the run whose {control} control belongs on the page", "none", "name the run")
    if template is None:
        raise Refused("a run, or the template of a blank page", "neither", "name a run, or --template blank_a4")
    if is_board(template):
        return board_sheet(template, pdf_path)
    page = load_template(template)
    return chart_sheet(page, pdf_path) if page.piece is None else blank_sheet(template, pdf_path)


def blank_sheet(template: str | Path, pdf_path: str | Path) -> Manifest:
    """Write the blank page of a template (a shipped one's name, or a TOML file) and its manifest beside it."""
    page = load_template(template)
    if page.blank is None:
        do = f"use one of: {', '.join(template_names(BLANK))}, or name the run whose design belongs on the page"
        raise Refused("a template with a [blank] table for a page without a design", f"{template}", do)
    identity = page_id(page)
    piece = lay_out_piece(page.blank.piece_mm, page.blank.marker_mm, identity, BLANK)
    settings = {BLANK: page.blank.model_dump(mode="json")}
    return write_sheet(pdf_path, page, SheetContent(piece, identity, BLANK, None, settings=settings))


def chart_sheet(template: Template, pdf_path: str | Path) -> Manifest:
    """Write the chart's page and its manifest beside it."""
    identity = page_id(template)
    ids = marker_ids(identity, BLANK, len(template.marker.corners_mm))  # a chart has an id of its own, so no kind
    grid = template.chart
    words = {"sheet_id": identity, "kind": CHART, "swatches": str(grid.columns * grid.rows)}
    page = lay_out_parts(template, [], ids, f"patchproof:{identity}:{CHART}", words)
    pitch = grid.swatch_mm + grid.gap_mm
    width, height = (round(count * pitch - grid.gap_mm, 6) for count in (grid.columns, grid.rows))
    return write_page(pdf_path, page, template, (*grid.corner_mm, width, height), CHART, grid)


def blank_piece(manifest: Manifest) -> Piece:
    """The piece of a blank sheet, from its cut line and the markers in it, wherever these lie."""
    if manifest.kind != BLANK:
        got = f'one of kind "{manifest.kind}"'
        raise Refused("the manifest of a blank sheet", got, "name the JSON beside BLANK.pdf")
    x, y, width, height = manifest.cut_mm
    markers = [PieceMarker(m.id, m.corners_mm) for m in manifest.markers if m.page == 1]
    inside = [moved_marker(m, (-x, -y)) for m in markers if rect_contains(manifest.cut_mm, marker_rect(m))]
    if not inside:
        raise Refused("markers within the blank's cut line", "none", "name the JSON beside BLANK.pdf")
    return Piece((width, height), tuple(inside), round(marker_rect(inside[0])[2] / MARKER_MODULES, 6))
