"""What files can declare, and what their readers do with each declaration.

`DECLARED` is the list of settings and text files; other readers have theirs in the `declarations.py` of their packages.
`patchproof keys --files` prints all of them, and the tests hold a file for each entry.
"""

from typing import Literal, NamedTuple


class Declaration(NamedTuple):
    """One thing that files of a kind can declare: "used" as declared, "refused", or left aside and "said"."""

    file: str  # the kind of file, such as "TIFF"
    declares: str  # such as "orientation (tag 274)"
    answer: Literal["used", "refused", "said"]
    how: str  # what is done with it, in a few words


_FILES = "TOML, JSON, CSV"
DECLARED: tuple[Declaration, ...] = (
    Declaration(_FILES, "UTF-8, with or without a byte order mark", "used", "the mark is skipped"),
    Declaration(_FILES, "UTF-16, with or without a byte order mark", "refused", "it is named: save it as UTF-8"),
    Declaration(_FILES, "bytes that are not UTF-8, such as Latin-1", "refused", "line and byte are named"),
    Declaration("TOML, JSON", "an unknown key of settings", "refused", "with the nearest known one"),
    Declaration("CSV", "semicolons or tabs as separators", "refused", "they are named: save it with commas"),
    Declaration("CSV", "an apostrophe before a formula", "used", "it is no part of the text"),
)
