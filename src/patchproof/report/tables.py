"""Tables and figures of comparisons, studies and charts, written to files or as lines for a terminal.

In: rows of plain values and `Estimate`s, drawings for matplotlib, failures, and the settings to repeat it. Out:
NAME.json, a CSV per table with numbers in full, a PNG per figure, whose comment holds the digest of that JSON's values,
and one self-contained HTML page, each written whole; or lines. The same input gives the same bytes.
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

from patchproof.base.csv_file import csv_lines
from patchproof.base.fingerprint import value_sha256
from patchproof.base.intervals import Estimate
from patchproof.base.output import data_uri, write_atomically, write_json
from patchproof.report.page import draw_figure, render_page, versions_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PHONE_IN, _PHONE_LETTERS = 4.0, 58  # 9 points are 11 pixels of a screen 390 wide; of a line
_LIBRARIES = ("patchproof", "torch", "numpy")
Value = str | int | float | bool | None | Estimate


@dataclass(frozen=True)
class Table:
    """Rows under a head; `name` becomes part of the file's, `about` says what was measured and on what."""

    name: str
    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[Value, ...], ...]
    about: str = ""


@dataclass(frozen=True)
class Drawing:
    """A figure: `draw` fills an empty matplotlib figure of `size_in` (width, height in inches)."""

    name: str
    title: str
    draw: "Callable[[Figure], None]"
    size_in: tuple[float, float] = (7.0, 4.0)
    about: str = ""

    def for_phone(self) -> "Drawing":
        """The drawing for a narrow screen, with text as large as on a wide one: panels side by side are stacked."""

        def draw(figure: "Figure") -> None:
            subplots: Any = figure.subplots

            def stacked(rows: int = 1, columns: int = 1, **options: Any) -> Any:
                if rows == 1 < columns and options.get("squeeze", True):
                    figure.set_figheight(0.8 * columns * self.size_in[1])
                    rows, columns, _ = columns, 1, options.pop("width_ratios", None)
                return subplots(rows, columns, **options)

            vars(figure)["subplots"] = stacked
            self.draw(figure)
            titles: Any = [title for axes in figure.axes for title in (axes.title, vars(axes)["_left_title"])]
            for title in titles:
                title.set_text("\n".join(fill(line, _PHONE_LETTERS) for line in title.get_text().split("\n")))

        return replace(self, draw=draw, size_in=(min(_PHONE_IN, self.size_in[0]), self.size_in[1]))


@dataclass(frozen=True)
class Results:
    """A page's content. `program` and `kind` (such as "patchlab", "study") are its title, `extent` says how much was
    computed, `failed` has a sentence for each cell that failed; `more` is written to the JSON alone.
    """

    kind: str
    name: str
    about: str
    extent: str
    settings: Mapping[str, Any]
    tables: Sequence[Table]
    figures: Sequence[Drawing]
    failed: Mapping[str, str]
    more: Mapping[str, Any] = field(default_factory=dict)
    program: str = "patchproof"


def write_results(folder: Path, results: Results) -> None:
    """Write the page, its JSON, tables as CSV and figures as PNG into the folder."""
    versions = versions_of(_LIBRARIES)
    data = {
        results.kind: results.name,
        "settings": results.settings,
        "versions": versions,
        "tables": {table.name: asdict(table) for table in results.tables},
        **results.more,
        "failed": results.failed,
    }
    mark = {"Software": None, "Comment": value_sha256(data)}  # without date or version of the library
    pictures, narrow = (
        [draw_figure(figure.draw, figure.size_in, "png", dpi=130, metadata=mark) for figure in figures]
        for figures in (results.figures, [figure.for_phone() for figure in results.figures])
    )
    for table in results.tables:
        write_atomically(folder / f"{results.name}_{table.name}.csv", csv_text(table))
    for figure, content in zip(results.figures, pictures, strict=True):
        write_atomically(folder / f"{results.name}_{figure.name}.png", content)
    text = render_page(
        "results.html.j2",
        results=results,
        pictures=list(zip(results.figures, map(data_uri, pictures), map(data_uri, narrow), strict=True)),
        settings=json.dumps(results.settings, indent=1, ensure_ascii=False),
        versions=versions,
        cell_text=cell_text,
    )
    write_atomically(folder / f"{results.name}.html", text)
    write_json(folder / f"{results.name}.json", data)


def csv_text(table: Table) -> str:
    """Convert a table to CSV, numbers in full; a column of `Estimate`s becomes four (value, _low, _high, _n)."""
    columns = []
    for name, *values in zip(table.head, *table.rows, strict=True):
        if any(isinstance(value, Estimate) for value in values):
            columns.append([name, *(value.value if isinstance(value, Estimate) else value for value in values)])
            for part in ("low", "high", "n"):
                columns.append([f"{name}_{part}", *(getattr(value, part, None) for value in values)])
        else:
            columns.append([name, *values])
    return csv_lines(zip(*columns, strict=True))


def cell_text(value: Value) -> str:
    """Format a value for people: three digits, an interval in brackets, a dash for None."""
    if value is None:
        return "–"
    if isinstance(value, Estimate):
        return f"{cell_text(value.value)} [{cell_text(value.low)}, {cell_text(value.high)}]"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        if not math.isfinite(value):
            return str(value)
        return f"{value:.3f}" if 0.01 <= abs(value) < 1000 or value == 0 else f"{value:.3g}"
    return str(value)


def text_lines(table: Table) -> list[str]:
    """Format a table for a terminal: text to the left, numbers to the right."""
    rows = [table.head, *(tuple(map(cell_text, row)) for row in table.rows)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    are_text = (all(isinstance(row[i], str) for row in table.rows) for i in range(len(table.head)))
    pads = [str.ljust if is_text else str.rjust for is_text in are_text]
    return ["  ".join(pad(cell, n) for pad, cell, n in zip(pads, row, widths, strict=True)).rstrip() for row in rows]
