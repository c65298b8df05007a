"""Progress callbacks of long work.

In: nothing. Out: the type of the `progress` parameter of every long public function, and its default, which reports
nothing. Functions below a public one take an `advance` callback, for the stage that their caller named.
"""

from collections.abc import Callable

Progress = Callable[[str, int, int], None]
"""Called as `progress(stage, done, total)`: a stage's name ("optimize", "promise", ...), items done, items in all."""

Advance = Callable[[int, int], None]
"""Called as `advance(done, total)`: a `Progress` whose stage is fixed, `partial(progress, "promise")`."""


def no_progress(stage: str, done: int, total: int) -> None:
    """Report nothing."""


def no_advance(done: int, total: int) -> None:
    """Report nothing within a stage."""
