"""Text that others wrote, such as names and labels, made fit for terminals and pages.

Out: text without characters that move a cursor or turn the direction of reading; values and objects in a line, for
notebooks and refusals; a command as a shell takes it.
"""

import shlex
import unicodedata
from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter
from types import MethodType
from typing import Any

_UNSEEN = ("Cc", "Cf", "Cs", "Zl", "Zp")  # control, format, surrogate, line and paragraph separators
_JOINERS = "\u200c\u200d"  # invisible, and needed within words and emoji
_MAX_CHARACTERS, _MAX_ITEMS = 100, 4  # of a value that is shown as it is


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
    """Describe a value: text and numbers as they are, arrays by type and shape, long text and lists by their length."""
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(shape := getattr(value, "shape", None), tuple):
        return f"{getattr(value, 'dtype', type(value).__name__)} {'×'.join(map(str, shape)) or 'without shape'}"
    if isinstance(value, tuple) and len(value) <= _MAX_ITEMS:
        return f"({', '.join(map(brief, value))})"
    is_text = isinstance(value, str | bytes)
    if isinstance(value, Mapping | Sequence) and len(value) > (_MAX_CHARACTERS if is_text else _MAX_ITEMS):
        kind = "a dictionary" if isinstance(value, Mapping) else "text" if is_text else "a list"
        return f"{kind} of {len(value):,} {'characters' if is_text else 'items'}"
    text = printable(repr(value))
    return text if len(text) <= _MAX_CHARACTERS and " at 0x" not in text else type(value).__name__


def short_repr(self: Any) -> str:
    """Describe an object in a line, as "Name(key=value, ...)", by the attributes in its class's `SHOWN` (dotted names,
    methods are called), else by its fields.
    """
    kind, parts = type(self), []
    for name in getattr(kind, "SHOWN", None) or getattr(kind, "__dataclass_fields__", None) or kind.model_fields:
        value = attrgetter(name)(self)
        parts.append(f"{name.rpartition('.')[2]}={brief(value() if isinstance(value, MethodType) else value)}")
    return f"{kind.__name__}({', '.join(parts)})"


def _escape(character: str) -> str:
    return character.encode("unicode_escape").decode()
