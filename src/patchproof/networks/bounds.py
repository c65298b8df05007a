"""Limits on what a network's file may ask for, and the error for what exceeds them."""

from typing import Any

from patchproof.base.errors import PatchproofError

MAX_NUMBERS = 1 << 31  # along one side of a weight
MAX_DIMENSIONS = 12
MAX_LIST = 1 << 10  # numbers in one attribute
MAX_BATCH = 4096  # pictures, for a network that takes a fixed number of them


class UnsupportedNetwork(PatchproofError):
    """The file has something that is not allowed; the text completes "the file with …"."""


def quote(value: Any) -> str:
    """The repr of a value from the file, cut to 80 characters."""
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def checked_integer(value: Any, low: int, high: int) -> int:
    """Return `value` if it is an int from `low` to `high`; booleans and floats are refused."""
    if type(value) is not int or not low <= value <= high:
        raise UnsupportedNetwork(f"{quote(value)} instead of a whole number from {low} to {high}")
    return value
