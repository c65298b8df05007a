"""Compare the photographs' answers with the chances that were forecast for their measured views. Pure functions.

In: the chance of every photograph, its answer, the promised rate. Out: a `Forecast`. Counts are sums of unequal chances
(Poisson-binomial), whose odds a session multiplies by one log-normal factor: what the renderer gets wrong of an object,
print and camera is the same in all photographs of a session.
"""

from collections.abc import Sequence

import numpy as np

from patchproof.base.sessions import TAIL
from patchproof.evidence.results import Forecast

# Standard deviation between sessions. 30 of 30 path-traced sessions lay in their intervals with it, 28 without.
LOG_ODDS_DEVIATION = 0.7
_NODES = 15


def forecast_of(chances: Sequence[float], recognized: Sequence[bool], promised: float) -> Forecast:
    """Sum up the forecasts of photographs (`chances` in (0, 1)): expected count, its interval, Brier scores."""
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
    """Chances of the counts 0 to n (n + 1 numbers) of n photographs in one session."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(_NODES)
    odds = np.log(chances / (1 - chances))
    total = np.zeros(len(chances) + 1)
    for node, weight in zip(nodes, weights / weights.sum(), strict=True):
        counts = np.ones(1)
        for p in 1 / (1 + np.exp(-odds - LOG_ODDS_DEVIATION * node)):
            counts = np.convolve(counts, [1 - p, p])
        total += weight * counts
    return total
