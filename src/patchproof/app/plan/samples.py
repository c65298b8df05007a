"""How much the figures that are counted can say: the selection's and the promise's.

In: the draft's rate and what selection can tell apart. Out: for each, how far off it may be with as many samples as it
takes, and with four times as many, which is the next rung: chance shrinks with their root, cost grows with them. The
promise's interval is Wilson's, of views that share no session. What photographs can say depends on how much sessions
differ, which the promise measures: the sheet's plan page has it.
"""

from __future__ import annotations

from patchproof.base.claims import wilson
from patchproof.base.strict import Strict
from patchproof.optimizer.loop import SELECT_VIEWS
from patchproof.optimizer.promise import PROMISE_VIEWS

NEXT = 4


class Sample(Strict):
    """Half the width of a 95 % interval, of a mean confidence or a rate in [0, 1], from `n` and from `next_n`."""

    name: str
    n: int
    half_width: float
    next_n: int
    next_half_width: float


def sample_plan(rate: float, standard_error: float) -> tuple[Sample, ...]:
    """The samples' ladder at a rate; `standard_error` is that of the selection set's mean confidence."""
    selection = [1.96 * standard_error / k**0.5 for k in (1, NEXT)]
    promise = [_half(wilson(round(rate * n), n)) for n in (PROMISE_VIEWS, NEXT * PROMISE_VIEWS)]
    rows = (
        ("selection: mean confidence", SELECT_VIEWS, selection),
        ("promise: rate", PROMISE_VIEWS, promise),
    )
    return tuple(
        Sample(name=name, n=n, half_width=now, next_n=NEXT * n, next_half_width=after) for name, n, (now, after) in rows
    )


def _half(interval: tuple[float, float]) -> float:
    return (interval[1] - interval[0]) / 2


def sample_lines(samples: tuple[Sample, ...]) -> list[str]:
    """The ladder for the terminal."""
    return [
        f"  {s.name:27} {s.n:4d} samples leave ±{s.half_width:.3f}, {s.next_n} would ±{s.next_half_width:.3f}"
        for s in samples
    ]
