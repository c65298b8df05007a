"""What photographs were to be expected to show, each at its own measured view, and what they did: pure functions.

In: the chance of every photograph, its answer, the promised rate. Out: a `Forecast`. Counts are sums of unequal chances
(Poisson-binomial) that one session shifts together: all their odds by a factor whose logarithm is normal, for what the
renderer has wrong of this object, print and camera alike.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from patchproof.base.sessions import TAIL
from patchproof.evidence.results import Forecast

# Standard deviation of the odds' logarithm between sessions: 30 of 30 path-traced ones held with it, 28 with none.
SHIFT = 0.7
_NODES = 15


def forecast_of(chances: Sequence[float], recognized: Sequence[bool], promised: float) -> Forecast:
    """The forecast of photographs of one session or several, with the score of each chance in (0, 1)."""
    p, hits = np.asarray(chances, float), np.asarray(recognized, float)
    below = np.cumsum(count_chances(p))
    return Forecast(
        photos=len(p),
        expected=float(p.sum()),
        interval=(int(np.searchsorted(below, TAIL)), int(np.searchsorted(below, 1 - TAIL))),
        recognized=int(hits.sum()),
        brier=float(np.mean((p - hits) ** 2)),
        brier_promise=float(np.mean((promised - hits) ** 2)),
    )


def count_chances(chances: np.ndarray) -> np.ndarray:
    """n + 1: the chance of every count of n photographs in one session."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(_NODES)
    odds = np.log(chances / (1 - chances))
    total = np.zeros(len(chances) + 1)
    for node, weight in zip(nodes, weights / weights.sum(), strict=True):
        counts = np.ones(1)
        for p in 1 / (1 + np.exp(-odds - SHIFT * node)):
            counts = np.convolve(counts, [1 - p, p])
        total += weight * counts
    return total
