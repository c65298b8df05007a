"""Make pages without a design, before there is a run: a blank piece with markers only, a color chart, a ChArUco board.

In: a template. Out: a PDF and its JSON; the sheet id is a hash of the template, so equal templates give equal pages. A
template with a [blank] table has a piece with markers only: photographs of it on the object show where a design of the
same size will lie and the light on it, which is all that a photographed scene needs. `blank_piece` reads the piece back
from the manifest's cut line and markers. A template without a zone for a piece is a chart, printed to calibrate a
printer; nothing is cut out of it, and its `cut_mm` is the part that has to be in photographs. A template with a [board]
table is for calibrating a camera: black squares alternate with white ones that hold the markers 0, 1, 2... of the
project's dictionary, as in OpenCV's CharucoBoard since 4.6, so that other tools can read it. The manifest holds the
markers exactly, and `load_board` reads the rest of the pattern back.
"""

from dataclasses import dataclass
from pathlib import Path

from patchproof.base.errors import Refused
from patchproof.base.validation import validate_model
from patchproof.sheets.content import SheetContent
from patchproof.sheets.layout import Box, PageLayout
from patchproof.sheets.manifest import Manifest, load_manifest
from patchproof.sheets.markers import DICTIONARY, MARKER_MODULES, board_squares, marker_corner
from patchproof.sheets.page import add_template_parts, lay_out_parts
from patchproof.sheets.piece import Piece, lay_out_piece, marker_ids, marker_rect, move_marker, page_id, square_marker
from patchproof.sheets.rects import RectMm, rect_contains
from patchproof.sheets.template import BoardGrid, BoardTemplate, Template, load_template, template_data, template_names
from patchproof.sheets.write import write_page, write_sheet

BLANK, CHART, BOARD = "blank", "chart", "board"


@dataclass(frozen=True)
class Board:
    """A board in its intended millimeters; its markers are the first ones of DICTIONARY."""

    sheet_id: str
    grid: BoardGrid
    ruler_mm: tuple[float, float]


def blank_page(pdf_path: str | Path, *, template: str | None, control: str | None = None) -> Manifest:
    """Write a page that needs no run: of a template with a [blank] or a [board] table, or of a chart alone."""
    if control is not None:
        raise Refused(f"a run, whose {control} control to print", "none", "name the run")
    if template is None:
        raise Refused("a run, or the template of a blank page", "neither", "name a run, or --template blank_a4")
    if BOARD in template_data(template)[1]:
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
    markers = [marker for marker in manifest.markers if marker.page == 1]
    inside = [move_marker(m, (-x, -y)) for m in markers if rect_contains(manifest.cut_mm, marker_rect(m))]
    if not inside:
        raise Refused("markers within the blank sheet's cut line", "none", "name the JSON beside BLANK.pdf")
    return Piece((width, height), tuple(inside), round(marker_rect(inside[0])[2] / MARKER_MODULES, 6))


def board_sheet(template: str | Path, pdf_path: str | Path) -> Manifest:
    """Write the page of a board and its manifest beside it."""
    page = _board_template(template)
    return write_page(pdf_path, _lay_out_board(page, page_id(page)), page, _board_rect(page.board), BOARD)


def load_board(name_or_file: str | Path) -> Board:
    """Load the board of a template (name or TOML file), or of a printed board's manifest (BOARD.json)."""
    if Path(name_or_file).suffix.lower() != ".json":
        template = _board_template(name_or_file)
        return Board(page_id(template), template.board, (template.ruler.length_mm, template.ruler.length_mm))
    manifest = load_manifest(name_or_file)
    if manifest.kind != BOARD:
        got = f'a manifest of kind "{manifest.kind}"'
        raise Refused("the manifest of a board", got, "name the JSON beside BOARD.pdf")
    grid = validate_model(BoardGrid, manifest.settings.get(BOARD), "the board's manifest")
    return Board(manifest.sheet_id, grid, manifest.ruler_mm)


def _board_template(template: str | Path) -> BoardTemplate:
    path, data = template_data(template)
    if BOARD not in data:
        do = f"use one of: {', '.join(template_names(BOARD))}"
        raise Refused("a template with a [board] table", f"{template} without one", do)
    return validate_model(BoardTemplate, data, str(path))


def _lay_out_board(template: BoardTemplate, identity: str) -> PageLayout:
    grid = template.board
    inset = (grid.square_mm - grid.marker_mm) / 2
    if inset < grid.marker_mm / MARKER_MODULES - 1e-6:
        largest = grid.square_mm * MARKER_MODULES / (MARKER_MODULES + 2)
        expected = f"board.marker_mm of at most {largest:.3g}, which leaves a module of white around it"
        got = f"{grid.marker_mm:g} in squares of {grid.square_mm:g} mm"
        raise Refused(expected, got, "make the markers smaller or the squares larger")
    (x, y), side = grid.corner_mm, grid.square_mm
    black, white = (board_squares(grid.rows, grid.columns, white) for white in (False, True))
    if len(white) > 1000:
        raise Refused("at most 1000 markers on a board", f"{len(white)}", "use fewer rows or columns")
    corners = [marker_corner(square, side, grid.marker_mm, grid.corner_mm) for square in white]
    words = {"sheet_id": identity, "dictionary": DICTIONARY, "columns": f"{grid.columns}", "rows": f"{grid.rows}"}
    words |= {"square": f"{grid.square_mm:g}", "marker": f"{grid.marker_mm:g}"}
    page = PageLayout(
        page_mm=template.page_mm,
        markers=tuple(square_marker(i, corner, grid.marker_mm) for i, corner in enumerate(corners)),
        boxes=(Box("board", _board_rect(grid)),),
        squares_mm=tuple((x + column * side, y + row * side, side, side) for row, column in black),
    )
    return add_template_parts(template, page, f"patchproof:{identity}:{BOARD}", words)


def _board_rect(grid: BoardGrid) -> RectMm:
    return (*grid.corner_mm, grid.columns * grid.square_mm, grid.rows * grid.square_mm)
