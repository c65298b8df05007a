"""A program as numbered steps: what onnx_file.py makes of a file, or traced.py of a module, and graph.py computes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class ValueRef:
    """In an argument: the value with that number."""

    number: int


class InputDevice:
    """In an argument, the class itself: the device that the pictures are on."""


@dataclass(frozen=True)
class Step:
    """One operator, where its results go, and which values nobody needs afterwards."""

    compute: Callable[..., Any]
    arguments: list[Any]
    keywords: dict[str, Any]
    results: list[int]
    several: bool  # the operator returns a sequence
    spent: list[int]


def mark_last_uses(steps: list[Step], kept: set[int]) -> None:
    """Write into each step which values it is the last to need."""
    needed = set(kept)
    for step in reversed(steps):
        used = {*step.results, *value_numbers(step.arguments), *value_numbers(step.keywords.values())}
        step.spent.extend(used - needed)
        needed |= used


def value_numbers(arguments: Iterable[Any]) -> Iterator[int]:
    """Of the values that arguments name."""
    for argument in arguments:
        if type(argument) is ValueRef:
            yield argument.number
        elif type(argument) is list:
            yield from value_numbers(argument)
