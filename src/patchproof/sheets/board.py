"""Make pages with a ChArUco board, for calibrating a camera from photographs of it.

In: a template with a [board] table. Out: BOARD.pdf and BOARD.json, made without a run. Black squares alternate with
white ones that hold the markers 0, 1, 2... of the project's dictionary: the pattern of OpenCV's CharucoBoard since 4.6,
so that other tools can read it. The manifest holds the markers exactly, and `load_board` reads the rest of the pattern
back. The sheet id is a hash of the template.
"""

from dataclasses import dataclass
from pathlib import Path

from patchproof.base.errors import Refused
from patchproof.base.validation import validate_model
from patchproof.sheets.layout import Box, PageLayout
from patchproof.sheets.manifest import Manifest, load_manifest
from patchproof.sheets.markers import DICTIONARY, MARKER_MODULES, board_squares, marker_corner
from patchproof.sheets.page import add_template_parts
from patchproof.sheets.piece import page_id, square_marker
from patchproof.sheets.rects import RectMm
from patchproof.sheets.template import BoardGrid, BoardTemplate, template_data, template_names
from patchproof.sheets.write import write_page

KIND = "board"


@dataclass(frozen=True)
class Board:
    """A board in its intended millimeters; its markers are the first ones of DICTIONARY."""

    sheet_id: str
    grid: BoardGrid
    ruler_mm: tuple[float, float]


def is_board(template: str | Path) -> bool:
    """True if a template (a shipped one's name, or a TOML file) has a [board] table."""
    return KIND in template_data(template)[1]


def board_sheet(template: str | Path, pdf_path: str | Path) -> Manifest:
    """Write the page of a board and its manifest beside it."""
    page = _load(template)
    return write_page(pdf_path, _lay_out(page, page_id(page)), page, _rect(page.board), KIND)


def load_board(name_or_file: str | Path) -> Board:
    """Load the board of a template (name or TOML file), or of a printed board's manifest (BOARD.json)."""
    if Path(name_or_file).suffix.lower() != ".json":
        template = _load(name_or_file)
        return Board(page_id(template), template.board, (template.ruler.length_mm, template.ruler.length_mm))
    manifest = load_manifest(name_or_file)
    if manifest.kind != KIND:
        got = f'a manifest of kind "{manifest.kind}"'
        raise Refused("the manifest of a board", got, "name the JSON beside BOARD.pdf")
    grid = validate_model(BoardGrid, manifest.settings.get(KIND), "the board's manifest")
    return Board(manifest.sheet_id, grid, manifest.ruler_mm)


def _load(template: str | Path) -> BoardTemplate:
    path, data = template_data(template)
    if KIND not in data:
        do = f"use one of: {', '.join(template_names(KIND))}"
        raise Refused("a template with a [board] table", f"{template} without one", do)
    return validate_model(BoardTemplate, data, str(path))


def _lay_out(template: BoardTemplate, identity: str) -> PageLayout:
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
        boxes=(Box("board", _rect(grid)),),
        squares_mm=tuple((x + column * side, y + row * side, side, side) for row, column in black),
    )
    return add_template_parts(template, page, f"patchproof:{identity}:{KIND}", words)


def _rect(grid: BoardGrid) -> RectMm:
    return (*grid.corner_mm, grid.columns * grid.square_mm, grid.rows * grid.square_mm)
