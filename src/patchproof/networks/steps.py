"""A program as numbered steps: made by onnx_file.py from a file or by tracing.py from a module, run by graph.py."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class ValueRef:
    """An argument that stands for the value with this number."""

    number: int


class InputDevice:
    """As an argument, the class itself stands for the device that the pictures are on."""


@dataclass(frozen=True)
class Step:
    """One operator, the numbers of its results, and the values that no later step needs."""

    compute: Callable[..., Any]
    arguments: list[Any]
    keywords: dict[str, Any]
    results: list[int]
    returns_sequence: bool  # of several tensors
    last_uses: list[int]


def mark_last_uses(steps: list[Step], outputs: set[int]) -> None:
    """Write into each step's `last_uses` the values that no later step needs."""
    needed = set(outputs)
    for step in reversed(steps):
        used = {*step.results, *value_numbers(step.arguments), *value_numbers(step.keywords.values())}
        step.last_uses.extend(used - needed)
        needed |= used


def value_numbers(arguments: Iterable[Any]) -> Iterator[int]:
    """The numbers of the values that arguments refer to."""
    for argument in arguments:
        if type(argument) is ValueRef:
            yield argument.number
        elif type(argument) is list:
            yield from value_numbers(argument)
