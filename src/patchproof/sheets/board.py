"""Board sheets: a page with a ChArUco board, photographs of which calibrate a camera.

In: a template with a [board] table. Out: BOARD.pdf and BOARD.json, made without a run. Black squares alternate with
white ones that hold the markers 0, 1, 2... of the project's dictionary: the pattern that OpenCV's CharucoBoard draws
since 4.6, so that any tool that knows such boards reads this one. The manifest's markers are exact, and
`board_geometry` reads the rest of the pattern back. The sheet id is a hash of the template.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from patchproof.sheets import page as parts
from patchproof.sheets.manifest import Manifest, Marker, Point, dump_manifest, load_manifest
from patchproof.sheets.pdf import page_pdf
from patchproof.sheets.piece import DICTIONARY, MODULES, marker_at, sheet_id
from patchproof.sheets.swatches import RectMm
from patchproof.sheets.template import QrCode, Rulers, TextLine, template_names
from patchproof.sheets.write import qr_text, replace_both
from patchproof.strict import NotNegative, Positive, Refused, Strict, nearest, read_toml, shipped, validated

KIND = "board"


class BoardGrid(Strict):
    """The pattern; its first square, top-left, is black."""

    corner_mm: Point  # its top-left corner
    columns: Annotated[int, Field(ge=4, le=40)]  # squares side by side
    rows: Annotated[int, Field(ge=4, le=40)]  # squares one above the other
    square_mm: Annotated[Positive, Field(ge=8)]  # side of a square
    marker_mm: Annotated[Positive, Field(ge=6)]  # side of a marker, at least a module less than the square


class BoardTemplate(Strict):
    """A whole template file of a board page."""

    page_mm: tuple[Positive, Positive]  # width, height of the paper
    margin_mm: NotNegative  # nothing is printed nearer to the edge
    board: BoardGrid
    ruler: Rulers
    qr: QrCode  # names sheet and board
    text: tuple[TextLine, ...] = ()  # also {columns}, {rows}, {square}, {marker} and {dictionary} are filled in


@dataclass(frozen=True)
class Board:
    """A printed board: what OpenCV's CharucoBoard needs to know, in millimetres as intended."""

    sheet_id: str
    dictionary: str
    ids: tuple[int, ...]
    columns: int
    rows: int
    square_mm: float
    marker_mm: float
    ruler_mm: tuple[float, float]


def is_board(template: str | Path) -> bool:
    """Whether a template (a shipped one's name, or a TOML file) is one of a board."""
    return "board" in read_toml(_path(template))


def board_sheet(template: str | Path, pdf_path: str | Path) -> Manifest:
    """Write the board's page and its manifest beside it."""
    pdf_path = Path(pdf_path)
    if pdf_path.suffix.lower() != ".pdf":
        raise Refused("a file name that ends in .pdf", f'"{pdf_path}"', "name the sheet BOARD.pdf")
    path = _path(template)
    page = validated(BoardTemplate, read_toml(path), str(path))
    identity = sheet_id({"template": page.model_dump(mode="json")}, 0)
    layout = _lay_out(page, identity)
    grid = page.board
    manifest = Manifest(
        sheet_id=identity,
        kind=KIND,
        page_mm=page.page_mm,
        design=None,
        markers=tuple(Marker(dictionary=DICTIONARY, id=m.id, corners_mm=m.corners_mm, page=1) for m in layout.markers),
        chart=(),
        cut_mm=_rect(grid),
        ruler_mm=(page.ruler.length_mm, page.ruler.length_mm),
        promise=None,
        settings={KIND: grid.model_dump(mode="json")},
    )
    text = dump_manifest(manifest)
    pdf = page_pdf(layout, None, f"patchproof sheet {identity} {KIND}", text)
    replace_both({pdf_path: pdf, pdf_path.with_suffix(".json"): text.encode()})
    return manifest


def load_board(name_or_file: str | Path) -> Board:
    """The board of a template's name or file, or of the manifest of a printed one (BOARD.json)."""
    if Path(name_or_file).suffix.lower() == ".json":
        return board_geometry(load_manifest(name_or_file))
    path = _path(name_or_file)
    if not is_board(name_or_file):
        raise Refused("a template with a [board] table", f"{name_or_file}", "use charuco_a4")
    page = validated(BoardTemplate, read_toml(path), str(path))
    length = page.ruler.length_mm
    return _board(page.board, sheet_id({"template": page.model_dump(mode="json")}, 0), (length, length))


def board_geometry(manifest: Manifest) -> Board:
    """The board that a manifest describes."""
    if manifest.kind != KIND:
        raise Refused("the manifest of a board", f'one of kind "{manifest.kind}"', "name the JSON beside BOARD.pdf")
    grid = validated(BoardGrid, manifest.settings.get(KIND), "the board's manifest")
    return _board(grid, manifest.sheet_id, manifest.ruler_mm)


def _board(grid: BoardGrid, identity: str, ruler_mm: tuple[float, float]) -> Board:
    ids = tuple(range(len(_white(grid))))
    return Board(identity, DICTIONARY, ids, grid.columns, grid.rows, grid.square_mm, grid.marker_mm, ruler_mm)


def _lay_out(page: BoardTemplate, identity: str) -> parts.PageLayout:
    """Everything in its place, proved apart and within the margins."""
    grid, ruler = page.board, page.ruler
    inset = (grid.square_mm - grid.marker_mm) / 2
    if inset < grid.marker_mm / MODULES - 1e-6:
        most = grid.square_mm * MODULES / (MODULES + 2)
        raise Refused(
            f"board.marker_mm of at most {most:.3g}, which leaves a module of white round it",
            f"{grid.marker_mm:g} in squares of {grid.square_mm:g} mm",
            "make the markers smaller or the squares larger",
        )
    x, y = grid.corner_mm
    corners = [(x + column * grid.square_mm + inset, y + row * grid.square_mm + inset) for row, column in _white(grid)]
    if len(corners) > 1000:
        raise Refused("at most 1000 markers on a board", f"{len(corners)}", "make the board's squares fewer")
    qr = parts.qr_rects_mm(qr_text(identity, KIND, None), page.qr.corner_mm, page.qr.size_mm)
    words = {
        "sheet_id": identity,
        "dictionary": DICTIONARY,
        "columns": f"{grid.columns}",
        "rows": f"{grid.rows}",
        "square": f"{grid.square_mm:g}",
        "marker": f"{grid.marker_mm:g}",
    }
    starts = ((ruler.x_start_mm, False), (ruler.y_start_mm, True))
    lines = [parts._filled(line, words) for line in page.text]
    layout = parts.PageLayout(
        page_mm=page.page_mm,
        cuts_mm=(),
        designs_mm=(),
        markers=tuple(marker_at(i, corner, grid.marker_mm) for i, corner in enumerate(corners)),
        swatches=(),
        qr_mm=qr,
        ticks=tuple(tick for start, down in starts for tick in parts._ruler_ticks(ruler, start, down)),
        texts=tuple(lines + [digit for start, down in starts for digit in parts._ruler_digits(ruler, start, down)]),
        boxes=(
            parts.Box("board", _rect(grid)),
            parts.Box("QR code", parts._qr_box(page, qr)),
            *(parts._ruler_box(f"{'y' if down else 'x'} ruler", ruler, start, down) for start, down in starts),
            *(parts.text_box(line) for line in lines),
        ),
        squares_mm=_black(grid),
    )
    parts.prove_apart(layout.boxes, page.page_mm, page.margin_mm)
    return layout


def _white(grid: BoardGrid) -> list[tuple[int, int]]:
    """(row, column) of the squares with markers, in the order of their ids."""
    return [(row, column) for row in range(grid.rows) for column in range(grid.columns) if (row + column) % 2]


def _black(grid: BoardGrid) -> tuple[RectMm, ...]:
    side, (x, y) = grid.square_mm, grid.corner_mm
    cells = np.argwhere(np.indices((grid.rows, grid.columns)).sum(0) % 2 == 0).tolist()
    return tuple((x + column * side, y + row * side, side, side) for row, column in cells)


def _rect(grid: BoardGrid) -> RectMm:
    return (*grid.corner_mm, grid.columns * grid.square_mm, grid.rows * grid.square_mm)


def _path(template: str | Path) -> Path:
    path = Path(template)
    if path.suffix == ".toml":
        return path
    names = template_names()
    if str(template) not in names:
        raise Refused("a print template's name or a .toml file", f'"{template}"', nearest(str(template), names))
    return shipped("print_templates", f"{template}.toml")
