"""Read and write CSV files, with apostrophes before what a spreadsheet would take for formulas."""

import csv
import io
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from patchproof.base.errors import Refused
from patchproof.base.input import read_text
from patchproof.base.text import printable

_FORMULA = re.compile(r"\s*[=+@＝＋－＠-]|[\t\r\n]")  # what a spreadsheet computes, after an apostrophe does not


def read_csv(path: str | Path, expected: str) -> list[list[str]]:
    """Read rows that are not empty, without the apostrophes of `csv_lines`; refused if another separator is used."""
    text = read_text(path, expected)
    try:
        rows = [
            row for row in csv.reader(io.StringIO(text, newline=""), skipinitialspace=True, strict=True) if any(row)
        ]
    except csv.Error as error:
        raise Refused(expected, f"{path} that cannot be read ({error})", "correct that file") from error
    for separator, name in ((";", "semicolons"), ("\t", "tabs")):
        is_uneven = len({*map(len, rows)}) > 1  # by commas, which names hold, too
        if rows and all(any(separator in cell for cell in (row if is_uneven else row[:1])) for row in rows):
            raise Refused(f"{expected}, separated by commas", f"{path} with {name}", "save it with commas")
    return [[cell[1:] if cell.startswith("'") and _FORMULA.match(cell, 1) else cell for cell in row] for row in rows]


def csv_lines(rows: Iterable[Iterable[Any]]) -> str:
    """Write rows as CSV, their text `printable`, and with an apostrophe where a spreadsheet would see a formula."""

    def cell(value: Any) -> Any:
        return "'" * bool(_FORMULA.match(value)) + printable(value) if isinstance(value, str) else value

    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(map(cell, row) for row in rows)
    return buffer.getvalue()
