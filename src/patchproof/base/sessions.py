"""Sessions: photographs that share a print, a lamp, a camera and a place are alike, and count for less than their
number.

In: how many photographs of each of some sessions were recognized. Out: a `RatePosterior`, everything that these counts say of
the rate and of how much sessions differ (the correlation of two photographs of one session); from it the rate's
interval, the counts that photographs of new sessions will show, and what rates such counts allow.

A session's own rate is Beta-distributed about the rate of all, so that its count is beta-binomial (Williams, Biometrics
31 (1975) 949-952, with the intraclass correlation ρ = 1 / (α + β + 1)). Both are uncertain: predictions are means over
a grid of the posterior, with Jeffreys' prior of the rate and a flat one of √ρ. Sessions of one photograph each say
nothing of ρ, which then is 0, as if every photograph were taken on its own.
Left out on purpose: a rate that depends on the pose, which all sessions share.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from patchproof.base.intervals import CONFIDENCE, paired_difference, student_mean

TAIL = (1 - CONFIDENCE) / 2
_RATES, _CORRELATIONS = 240, 36
_MOST_CORRELATION = 0.95
_NEGLIGIBLE = 1e-6  # of the heaviest point of the posterior
_INDEPENDENT = 1e-7  # a correlation that is none


@dataclass(frozen=True, eq=False)
class RatePosterior:
    """A posterior over points of a grid: P rates, P correlations within a session, P weights that sum to 1."""

    rates: np.ndarray
    correlations: np.ndarray
    weights: np.ndarray

    @property
    def rate(self) -> tuple[float, float]:
        """The rate's 95 % interval, over sessions; it reaches 0 or 1 where the grid ends."""
        low, high = (_quantile(self.rates, self.weights, share) for share in (TAIL, 1 - TAIL))
        first, last = _grid()[0][[0, -1]]
        return (low if low > first else 0.0), (high if high < last else 1.0)

    @property
    def correlation(self) -> tuple[float, tuple[float, float]]:
        """The median correlation within a session, and its 95 % interval."""
        low, middle, high = (_quantile(self.correlations, self.weights, q) for q in (TAIL, 0.5, 1 - TAIL))
        return middle, (low, high)

    def chances(self, photos: Sequence[int]) -> np.ndarray:
        """The chance of every count from 0 to all, recognized of so many photographs in each of some new sessions."""
        return _chances_of(self, tuple(photos))

    def counts(self, photos: Sequence[int]) -> tuple[int, int]:
        """The 95 % interval of those counts."""
        below = np.cumsum(self.chances(photos))
        return int(np.searchsorted(below, TAIL)), int(np.searchsorted(below, 1 - TAIL))

    def least_rate(self, recognized: int, photos: Sequence[int], tail: float) -> float:
        """The smallest rate at which so many are recognized, or more, with a chance of `tail`; of what was seen itself
        half counts (mid-p). Sessions differ as much as the posterior says.
        """
        return _least_rates(*self._marginal(), tuple(sorted(photos)), tail)[recognized]

    def most_rate(self, recognized: int, photos: Sequence[int], tail: float) -> float:
        """The largest rate at which so many are recognized, or fewer, with a chance of `tail`."""
        return 1 - self.least_rate(sum(photos) - recognized, photos, tail)

    def _marginal(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """The correlations without the rates: values and weights."""
        values, which = np.unique(self.correlations, return_inverse=True)
        return tuple(values), tuple(np.bincount(which, self.weights))


def rate_posterior(recognized: Sequence[int], photos: Sequence[int]) -> RatePosterior:
    """What the counts of some sessions say; of none, what was believed before."""
    return _spread_of(tuple(map(int, recognized)), tuple(map(int, photos)))


@lru_cache(maxsize=32)
def _spread_of(recognized: tuple[int, ...], photos: tuple[int, ...]) -> RatePosterior:
    from scipy.special import betaln

    rates, correlations = _grid() if max(photos, default=0) > 1 else (_grid()[0], np.array([_INDEPENDENT]))
    rate, correlation = (part.ravel() for part in np.meshgrid(rates, correlations, indexing="ij"))
    alpha, beta = _shapes(rate, correlation)
    log, before = np.zeros(len(rate)), betaln(alpha, beta)
    for (k, n), often in Counter(zip(recognized, photos, strict=True)).items():
        log += often * (betaln(alpha + k, beta + n - k) - before)
    weights = np.exp(log - log.max())
    kept = weights > _NEGLIGIBLE
    return RatePosterior(rate[kept], correlation[kept], weights[kept] / weights[kept].sum())


@lru_cache(maxsize=32)
def _chances_of(spread: RatePosterior, photos: tuple[int, ...]) -> np.ndarray:
    """`Spread.chances`, once for all counts that are judged by it."""
    chances = spread.weights @ _chances(spread.rates, spread.correlations, photos)
    chances.flags.writeable = False
    return chances


def count_by_session(
    hits: Sequence[bool] | np.ndarray, each: int, places: Sequence[int] = ()
) -> tuple[list[int], list[int]]:
    """(recognized, photographs) of sessions of `each` photographs in a row; the last may have fewer. Sessions whose
    `places`, if given, are the same count as one, since the place is most of what sessions differ by.
    """
    parts = _parts(hits, each)
    together: dict[int, list[bool]] = {}
    for place, part in zip(places or range(len(parts)), parts, strict=True):
        together.setdefault(place, []).extend(map(bool, part))
    return list(map(sum, together.values())), list(map(len, together.values()))


def _parts(values: Sequence[bool] | np.ndarray, each: int) -> list[Sequence[bool] | np.ndarray]:
    return [values[first : first + each] for first in range(0, len(values), each)]


def session_difference(
    a: Sequence[bool] | np.ndarray, b: Sequence[bool] | np.ndarray, each: int
) -> tuple[float, tuple[float, float]]:
    """Rate of `a` minus rate of `b` on the same conditions, sessions of `each` in a row; the wider of Newcombe's paired
    interval over conditions and Student's over sessions, which is none where all sessions agree.
    """
    difference, (low, high) = paired_difference(list(map(bool, a)), list(map(bool, b)))
    parts = zip(_parts(a, each), _parts(b, each), strict=True)
    of_sessions = [float(np.mean(ours) - np.mean(theirs)) for ours, theirs in parts]
    if each > 1 and len(of_sessions) > 1:
        over = student_mean(of_sessions)
        half = over.high - over.value
        low, high = max(-1.0, min(low, difference - half)), min(1.0, max(high, difference + half))
    return difference, (low, high)


def split_evenly(photos: int, sessions: int) -> tuple[int, ...]:
    """So many photographs spread over so many sessions, as evenly as they go."""
    return tuple(photos // sessions + (i < photos % sessions) for i in range(sessions))


def _grid() -> tuple[np.ndarray, np.ndarray]:
    """Rates evenly in the angle in which Jeffreys' prior is flat; correlations evenly in their root."""
    angles = (np.arange(_RATES) + 0.5) / _RATES * np.pi / 2
    roots = (np.arange(_CORRELATIONS) + 0.5) / _CORRELATIONS
    return np.sin(angles) ** 2, _MOST_CORRELATION * roots**2


def _shapes(rate: np.ndarray, correlation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    strength = 1 / correlation - 1
    return rate * strength, (1 - rate) * strength


def _chances(rates: np.ndarray, correlations: np.ndarray, photos: Sequence[int]) -> np.ndarray:
    """P×(n + 1): the chance of every count at P points. Sessions multiply as Fourier transforms."""
    from scipy.fft import next_fast_len

    alpha, beta = _shapes(rates, correlations)
    counts, transform = sum(photos) + 1, np.ones(1)
    length = next_fast_len(counts, real=True)  # of 151, a prime, a transform takes five times as long as of 160
    for n, often in Counter(photos).items():
        transform = transform * np.fft.rfft(_beta_binomial(n, alpha, beta), length) ** often
    return np.clip(np.fft.irfft(transform, length)[:, :counts], 0, 1)


def _beta_binomial(n: int, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """P×(n + 1): the chances of 0 to n, from the ratio of each to the one before; SciPy's take 17 times as long at
    n = 100.
    """
    k, log = np.arange(n), np.zeros((len(alpha), n + 1))
    ratios = (n - k) / (k + 1) * (alpha[:, None] + k) / (beta[:, None] + n - 1 - k)
    np.cumsum(np.log(ratios), axis=1, out=log[:, 1:])
    chances = np.exp(log - log.max(1, keepdims=True))
    return chances / chances.sum(1, keepdims=True)


@lru_cache(maxsize=64)
def _least_rates(
    correlations: tuple[float, ...], weights: tuple[float, ...], photos: tuple[int, ...], tail: float
) -> tuple[float, ...]:
    """`Spread.least_rate` of every count."""
    rates = _grid()[0]
    rate, correlation = (part.ravel() for part in np.meshgrid(rates, correlations, indexing="ij"))
    chances = _chances(rate, correlation, photos).reshape(len(rates), len(correlations), -1)
    chances = np.einsum("rcn,c->rn", chances, np.array(weights))
    as_many = chances[:, ::-1].cumsum(1)[:, ::-1] - chances / 2
    return tuple(float(np.interp(tail, more, rates, left=0.0, right=1.0)) for more in as_many.T)


def _quantile(values: np.ndarray, weights: np.ndarray, share: float) -> float:
    order = np.argsort(values, kind="stable")
    return float(np.interp(share, np.cumsum(weights[order]) - weights[order] / 2, values[order]))
