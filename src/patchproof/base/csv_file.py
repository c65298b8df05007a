"""Read CSV files, with the apostrophes that `text.csv_lines` writes before formulas."""

import csv
import io
from pathlib import Path

from patchproof.base.errors import Refused
from patchproof.base.input import read_text
from patchproof.base.text import FORMULA


def read_csv(path: str | Path, expected: str) -> list[list[str]]:
    """Read rows that are not empty, without the apostrophes of `csv_lines`; refused if another separator is used."""
    text = read_text(path, expected)
    try:
        rows = [row for row in csv.reader(io.StringIO(text, newline=""), skipinitialspace=True) if any(row)]
    except csv.Error as error:
        raise Refused(expected, f"{path} that cannot be read ({error})", "mend it") from error
    for separator, name in ((";", "semicolons"), ("\t", "tabs")):
        if rows and all(separator in row[0] for row in rows):
            raise Refused(f"{expected}, separated by commas", f"{path} with {name}", "save it with commas")
    return [[strip_apostrophe(cell) for cell in row] for row in rows]


def strip_apostrophe(cell: str) -> str:
    """Undo the apostrophe of `csv_lines`."""
    return cell[1:] if cell.startswith("'") and FORMULA.match(cell, 1) else cell
