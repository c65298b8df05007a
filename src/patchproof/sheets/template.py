"""Print templates: pages as data, all in millimeters.

In: the name of a shipped template ("a4") or a user's TOML file. Out: a frozen `Template`, or `BoardTemplate`, every key
known and every number checked. A template sets the places and sizes of things; their content (ids, colors, the design)
comes from elsewhere. `page.add_template_parts` checks the page with its piece for overlaps and margins.
Left out on purpose: expressions, inheritance and includes. A page is short enough to be written out.
"""

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from patchproof.base import validation
from patchproof.base.errors import Refused
from patchproof.base.packaged import named_path, packaged_path
from patchproof.base.settings import NO_PAGE
from patchproof.base.validation import Finite, NotNegative, Positive, Share, StrictModel

PagePoint = tuple[Finite, Finite]
PageRect = tuple[Finite, Finite, Positive, Positive]
PaperMm = Annotated[Positive, Field(le=2000)]  # a side of the largest paper, A0 and more


class PieceZone(StrictModel):
    """The zone of the page for the piece."""

    zone_mm: PageRect  # [x, y, width, height]; the piece is centered in it


class ChartGrid(StrictModel):
    """The color chart's grid; a printer model needs at least 48 swatches."""

    corner_mm: PagePoint  # its top-left corner
    columns: Annotated[int, Field(ge=4, le=40)]  # swatches side by side
    rows: Annotated[int, Field(ge=2, le=40)]  # swatches one above the other
    swatch_mm: Annotated[Positive, Field(ge=4)]  # side; below 4 a phone's photograph of the page has too few pixels
    gap_mm: NotNegative  # between swatches


class Rulers(StrictModel):
    """A ruler along x and one along y, by their zero ticks."""

    length_mm: PaperMm  # of both
    x_start_mm: PagePoint  # zero tick of the ruler along x
    y_start_mm: PagePoint  # zero tick of the ruler along y


class QrCode(StrictModel):
    """The QR code's black square; its quiet zone of 4 modules lies outside."""

    corner_mm: PagePoint  # its top-left corner
    size_mm: Positive  # its side, without the quiet zone


class PageMarkers(StrictModel):
    """The page's own markers by the top-left corners of their black squares; one alone would locate the page badly."""

    size_mm: Annotated[Positive, Field(ge=8)]  # side of a black square
    corners_mm: Annotated[tuple[PagePoint, ...], Field(min_length=2)]  # top-left, one per marker


class BlankPiece(StrictModel):
    """The piece of a page that is printed without a design, before there is a scene."""

    piece_mm: tuple[Positive, Positive]  # width and height of the piece, and of the design to come
    marker_mm: Annotated[Positive, Field(ge=8)]  # side of a marker; smaller ones are lost in photographs


class TileGrid(StrictModel):
    """The pages of a piece larger than the page; each tile has markers to the left and right of its part and below."""

    # [x, y, width, height]: the largest part of the piece on a tile; smaller parts start at its corner.
    zone_mm: PageRect
    overlap_mm: Annotated[Positive, Field(ge=8)]  # width of the flap that the next tile is glued on, with a marker
    marker_mm: Annotated[Positive, Field(ge=5)]  # for scans and photographs of single pages


class TextLine(StrictModel):
    """One line of text; {sheet_id}, {kind}, {design}, {piece}, {fix} and {keep} are replaced by their values."""

    at_mm: PagePoint  # left end of its baseline
    size_mm: Positive  # font size
    text: str  # the line, with placeholders
    bold: bool = False  # in the bold font
    gray: Share = 0.0  # 0 is black, 1 white


class Template(StrictModel):
    """A whole template file."""

    page_mm: tuple[PaperMm, PaperMm]  # width, height of the paper
    margin_mm: NotNegative  # nothing is printed nearer to the edge; home printers need 3 to 6
    piece: PieceZone | None = None  # none on a page with a chart only
    chart: ChartGrid  # at least 48 swatches
    ruler: Rulers
    qr: QrCode  # names sheet and design
    marker: PageMarkers  # in addition to those of the piece
    blank: BlankPiece | None = None  # on a page that is made without a run
    tiles: TileGrid | None = None  # on templates for a piece larger than the page
    plan_page: bool = False  # add a last page that shows the place of the piece and how to photograph it
    text: tuple[TextLine, ...] = ()  # all texts


class BoardGrid(StrictModel):
    """A ChArUco board's pattern; its first square, top-left, is black."""

    corner_mm: PagePoint  # its top-left corner
    columns: Annotated[int, Field(ge=4, le=40)]  # squares side by side
    rows: Annotated[int, Field(ge=4, le=40)]  # squares one above the other
    square_mm: Annotated[Positive, Field(ge=8)]  # side of a square
    marker_mm: Annotated[Positive, Field(ge=6)]  # side of a marker; a module of white must remain on each side


class BoardTemplate(StrictModel):
    """A whole template file of a board page."""

    page_mm: tuple[PaperMm, PaperMm]  # width, height of the paper
    margin_mm: NotNegative  # nothing is printed nearer to the edge
    board: BoardGrid
    ruler: Rulers
    qr: QrCode  # names sheet and board
    text: tuple[TextLine, ...] = ()  # placeholders: {sheet_id}, {columns}, {rows}, {square}, {marker}, {dictionary}


AnyTemplate = Template | BoardTemplate


def load_template(name_or_file: str | Path) -> Template:
    """Load a shipped template by name, or a TOML file; an unknown name is refused with the nearest one."""
    path, data = template_data(name_or_file)
    template = validation.validate_model(Template, data, str(path))
    swatches = template.chart.columns * template.chart.rows
    if swatches < 48:
        raise Refused(f"at least 48 swatches in the chart of {path}", f"{swatches}", "add columns or rows")
    return template


def page_template(name_or_file: str | Path) -> Template | None:
    """Load a template; None for a print without a page."""
    return None if name_or_file == NO_PAGE else load_template(name_or_file)


def template_data(name_or_file: str | Path) -> tuple[Path, dict[str, Any]]:
    """A template's path and its unchecked data, whose tables tell the kind of page."""
    path = named_path(name_or_file, None, "a print template", packaged_path("print_templates"), (".toml",))
    return path, validation.read_toml(path)


def template_summaries() -> list[str]:
    """A line for each shipped template: its name and the first sentence of its first comment."""
    names = template_names()
    files = [packaged_path("print_templates", f"{name}.toml") for name in names]
    heads = [file.read_text(encoding="utf-8").partition("\n")[0].lstrip("# ") for file in files]
    width = max(map(len, names))
    return [f"{name:<{width}}  {head.partition('. ')[0].rstrip('.')}" for name, head in zip(names, heads, strict=True)]


def template_names(table: str | None = None) -> list[str]:
    """The names of the shipped templates, with `table` only of those that have this table."""
    paths = packaged_path("print_templates").glob("*.toml")
    return sorted(path.stem for path in paths if table is None or table in validation.read_toml(path))
