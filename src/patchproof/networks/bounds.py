"""How much a file of a network may ask for, and the refusal of what goes beyond it."""

from __future__ import annotations

from typing import Any

from patchproof.base.errors import PatchproofError

MAX_NUMBERS = 1 << 31  # along one side of a weight
MAX_DIMENSIONS = 12
MAX_LIST = 1 << 10  # numbers in one attribute
MAX_BATCH = 4096  # pictures, of a network that takes one number of them only


class UnsupportedNetwork(PatchproofError):
    """Something in the file that is not allowed; the text follows "the file with"."""


def quote(value: Any) -> str:
    """Whatever stands in the file, short and on one line."""
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def whole(value: Any, low: int, high: int) -> int:
    """A whole number from `low` to `high`, and not one in disguise."""
    if type(value) is not int or not low <= value <= high:
        raise UnsupportedNetwork(f"{quote(value)} for a whole number from {low} to {high}")
    return value
