"""Tables and figures of studies and benchmarks: what is handed over to be written, and how a figure reads.

In: rows of plain values and `Estimate`s, drawings for matplotlib. Out: CSV text with numbers in full, cells of a page
as people read them, PNG bytes. The same input gives the same bytes.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from patchproof.base.claims import Estimate
from patchproof.report.drawing import drawn

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Value = str | int | float | bool | None | Estimate


@dataclass(frozen=True)
class Table:
    """Rows under a head; `name` becomes the file's, `about` says what was measured and on what."""

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
    draw: Callable[[Figure], None]
    size_in: tuple[float, float] = (7.0, 4.0)
    about: str = ""


def csv_text(table: Table) -> str:
    """The table with numbers in full; an `Estimate`'s column becomes four (value, _low, _high, _n)."""
    wide = [any(isinstance(row[i], Estimate) for row in table.rows) for i in range(len(table.head))]
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    parts = ("", "_low", "_high", "_n")
    writer.writerow(
        name + part for name, is_wide in zip(table.head, wide, strict=True) for part in (parts if is_wide else ("",))
    )
    for row in table.rows:
        writer.writerow(
            part for value, is_wide in zip(row, wide, strict=True) for part in (_four(value) if is_wide else (value,))
        )
    return buffer.getvalue()


def shown(value: Value) -> str:
    """A value as people read it: three digits, an interval in brackets, a dash for nothing."""
    if value is None:
        return "–"
    if isinstance(value, Estimate):
        return f"{shown(value.value)} [{shown(value.low)}, {shown(value.high)}]"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        if not math.isfinite(value):
            return str(value)
        return f"{value:.3f}" if 0.01 <= abs(value) < 1000 or value == 0 else f"{value:.3g}"
    return str(value)


def text_lines(table: Table) -> list[str]:
    """The table for a terminal: columns aligned, numbers to the right."""
    rows = [table.head, *(tuple(map(shown, row)) for row in table.rows)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    left = [all(isinstance(row[i], str) for row in table.rows) for i in range(len(table.head))]
    return [
        "  ".join(
            cell.ljust(width) if is_left else cell.rjust(width)
            for cell, width, is_left in zip(row, widths, left, strict=True)
        ).rstrip()
        for row in rows
    ]


def png(drawing: Drawing) -> bytes:
    """The drawing as a PNG file's bytes, without date or version."""
    return drawn(drawing.draw, drawing.size_in, "png", dpi=130, metadata={"Software": None})


def _four(value: Value) -> tuple[Value, ...]:
    if isinstance(value, Estimate):
        return value.value, value.low, value.high, value.n
    return value, None, None, None
