"""Describe values in a few words, and objects in a line: what a notebook and a refusal show of them."""

from collections.abc import Mapping, Sequence
from operator import attrgetter
from types import MethodType
from typing import Any

from patchproof.base.text import printable

_MAX_CHARACTERS, _MAX_ITEMS = 100, 4  # of what is shown as it is


def describe_value(value: object) -> str:
    """Text and numbers as they are, arrays by type and shape, long text and lists by their length."""
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(shape := getattr(value, "shape", None), tuple):
        return f"{getattr(value, 'dtype', type(value).__name__)} {'×'.join(map(str, shape)) or 'without shape'}"
    if isinstance(value, tuple) and len(value) <= _MAX_ITEMS:
        return f"({', '.join(map(describe_value, value))})"
    is_text = isinstance(value, str | bytes)
    if isinstance(value, Mapping | Sequence) and len(value) > (_MAX_CHARACTERS if is_text else _MAX_ITEMS):
        kind = "a dictionary" if isinstance(value, Mapping) else "text" if is_text else "a list"
        return f"{kind} of {len(value):,} {'characters' if is_text else 'items'}"
    text = printable(repr(value))
    return text if len(text) <= _MAX_CHARACTERS and " at 0x" not in text else type(value).__name__


def describe_object(thing: Any) -> str:
    """The attributes in its class's `SHOWN` (dotted names, methods are called), else its fields."""
    kind, parts = type(thing), []
    for name in getattr(kind, "SHOWN", None) or getattr(kind, "__dataclass_fields__", None) or kind.model_fields:
        value = attrgetter(name)(thing)
        text = describe_value(value() if isinstance(value, MethodType) else value)
        parts.append(f"{name.rpartition('.')[2]}={text}")
    return f"{kind.__name__}({', '.join(parts)})"
