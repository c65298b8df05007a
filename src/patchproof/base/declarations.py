"""What files can declare, and what their readers do with each declaration: the lists `declarations.csv` of the rooms.

`patchproof keys --files` prints all of them, and the tests hold a file for each entry.
"""

import csv
from pathlib import Path
from typing import NamedTuple


class Declaration(NamedTuple):
    """One thing that files of a kind can declare: "used" as declared, "refused", or left aside and "said"."""

    file: str  # the kind of file, such as "TIFF"
    declares: str  # such as "orientation (tag 274)"
    answer: str
    how: str  # what is done with it, in a few words


def load_declarations(room: str) -> tuple[Declaration, ...]:
    """Load the list of the readers in a room of this package."""
    lines = (Path(__file__).parents[1] / room / "declarations.csv").read_text(encoding="utf-8").splitlines()
    return tuple(Declaration(*row) for row in csv.reader(lines[1:]))
