"""Make pages without a design, before there is a run: a blank piece with markers only, or a color chart only.

In: a template. Out: a PDF and its JSON; the sheet id is a hash of the template, so equal templates give equal pages.
A template with a [blank] table has a piece with markers only: photographs of it on the object show where a design of
the same size will lie and the light on it, which is all that a photographed scene needs. `blank_piece` reads the piece
back from the manifest's cut line and markers. A template without a zone for a piece is a chart, printed to calibrate a
printer; nothing is cut out of it, and its `cut_mm` is the part that photographs must show. `blank_page` also makes the
pages of boards (see `board`).
"""

from pathlib import Path

from patchproof.base.errors import Refused
from patchproof.sheets.board import board_sheet, is_board
from patchproof.sheets.content import SheetContent
from patchproof.sheets.manifest import Manifest
from patchproof.sheets.markers import MARKER_MODULES
from patchproof.sheets.page import lay_out_parts
from patchproof.sheets.piece import Piece, PieceMarker, lay_out_piece, marker_ids, marker_rect, move_marker, page_id
from patchproof.sheets.rects import rect_contains
from patchproof.sheets.template import Template, load_template, template_names
from patchproof.sheets.write import write_page, write_sheet

BLANK, CHART = "blank", "chart"


def blank_page(pdf_path: str | Path, *, template: str | None, control: str | None = None) -> Manifest:
    """Write a page that needs no run: of a template with a [blank] or a [board] table, or of a chart alone."""
    if control is not None:
        raise Refused(f"a run, whose {control} control to print", "none", "name the run")
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
        do = f"use one of: {', '.join(template_names(BLANK))}, or name a run whose design to print"
        raise Refused("a template with a [blank] table for a page without a design", f"{template} without one", do)
    identity = page_id(page)
    piece = lay_out_piece(page.blank.piece_mm, page.blank.marker_mm, identity, BLANK)
    settings = {BLANK: page.blank.model_dump(mode="json")}
    return write_sheet(pdf_path, page, SheetContent(piece, identity, BLANK, None, settings=settings))


def chart_sheet(template: Template, pdf_path: str | Path) -> Manifest:
    """Write the page of a chart and its manifest beside it."""
    identity = page_id(template)
    ids = marker_ids(identity, BLANK, len(template.marker.corners_mm))  # any kind would do: no other sheet has this id
    grid = template.chart
    words = {"sheet_id": identity, "kind": CHART, "swatches": str(grid.columns * grid.rows)}
    page = lay_out_parts(template, [], ids, f"patchproof:{identity}:{CHART}", words)
    pitch = grid.swatch_mm + grid.gap_mm
    width, height = (round(count * pitch - grid.gap_mm, 6) for count in (grid.columns, grid.rows))
    return write_page(pdf_path, page, template, (*grid.corner_mm, width, height), CHART)


def blank_piece(manifest: Manifest) -> Piece:
    """Reconstruct the piece of a blank sheet from its cut line and the markers within it."""
    if manifest.kind != BLANK:
        got = f'a manifest of kind "{manifest.kind}"'
        raise Refused("the manifest of a blank sheet", got, "name the JSON beside BLANK.pdf")
    x, y, width, height = manifest.cut_mm
    markers = [PieceMarker(m.id, m.corners_mm) for m in manifest.markers if m.page == 1]
    inside = [move_marker(m, (-x, -y)) for m in markers if rect_contains(manifest.cut_mm, marker_rect(m))]
    if not inside:
        raise Refused("markers within the blank sheet's cut line", "none", "name the JSON beside BLANK.pdf")
    return Piece((width, height), tuple(inside), round(marker_rect(inside[0])[2] / MARKER_MODULES, 6))
