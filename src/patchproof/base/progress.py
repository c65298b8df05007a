"""How long work says how far it is.

In: nothing. Out: the type of the `progress` parameter that every long public function takes, and its default, which is
silent. Work below a public function is told to `advance` within the stage that its caller named.
"""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, int, int], None]
"""Called as `progress(stage, done, total)`: a stage's name ("optimize", "promise", ...), items done, items in all."""

Advance = Callable[[int, int], None]
"""Called as `advance(done, total)`: a `Progress` whose stage is fixed, `partial(progress, "promise")`."""


def no_progress(stage: str, done: int, total: int) -> None:
    """Report nothing."""


def no_advance(done: int, total: int) -> None:
    """Report nothing within a stage."""
