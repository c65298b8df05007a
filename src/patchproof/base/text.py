"""Text that others wrote, such as names and labels, made fit for terminals, pages and spreadsheets.

Out: text without characters that move a cursor or turn the direction of reading; CSV without formulas.
"""

import csv
import io
import re
import shlex
import unicodedata
from collections.abc import Callable, Iterable
from typing import Any

FORMULA = re.compile(r"\s*[=+@＝＋－＠-]|[\t\r\n]")  # what a spreadsheet computes, after an apostrophe does not
_UNSEEN = ("Cc", "Cf", "Cs", "Zl", "Zp")  # control, format, surrogate, line and paragraph separators
_JOINERS = "\u200c\u200d"  # invisible, and needed within words and emoji


def printable(text: str) -> str:
    """Escape control characters, marks of direction, line separators and bytes that are not UTF-8, as in "\\\\x1b"."""
    if text.isprintable():
        return text
    return "".join(_escape(c) if unicodedata.category(c) in _UNSEEN and c not in _JOINERS else c for c in text)


def command_text(verb: str, *words: object) -> str:
    """A command as a shell takes it, words with spaces in quotes."""
    return shlex.join(["patchproof", verb, *map(str, words)])


def drawable(text: str, has_glyph: Callable[[str], bool]) -> str:
    """Make text `printable`, and escape the characters that a font lacks, too."""
    return "".join(c if has_glyph(c) else _escape(c) for c in printable(text))


def brief(value: object) -> str:
    """Describe a value in a few words; see `base.describe`, which is loaded for this only."""
    from patchproof.base.describe import describe_value

    return describe_value(value)


def short_repr(self: Any) -> str:
    """Describe an object in a line, as "Name(key=value, ...)"; see `base.describe`."""
    from patchproof.base.describe import describe_object

    return describe_object(self)


def _escape(character: str) -> str:
    return character.encode("unicode_escape").decode()


def csv_lines(rows: Iterable[Iterable[Any]]) -> str:
    """Write rows as CSV, their text `printable`, and with an apostrophe where a spreadsheet would see a formula."""

    def cell(value: Any) -> Any:
        return "'" * bool(FORMULA.match(value)) + printable(value) if isinstance(value, str) else value

    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(map(cell, row) for row in rows)
    return buffer.getvalue()
