"""The list that every reader of files keeps: what its format can declare, and what the reader does with it.

In: the lists of the readers, each beside its reader (`declarations.py` of a room). Out: one type of entry, from which
`patchproof keys --files` makes the page of all formats, and for which the tests hold one file each.
"""

from typing import Literal, NamedTuple


class Declaration(NamedTuple):
    """One thing that files of a kind can declare: "used" as declared, "refused", or left aside and "said"."""

    file: str  # the kind of file, such as "TIFF"
    declares: str  # such as "orientation (tag 274)"
    answer: Literal["used", "refused", "said"]
    how: str  # what is done with it, in a few words
