"""Recognition rates from photographs taken in sessions, and predictions for new sessions.

Photographs of one session share a print, a lamp, a camera and a place, so they are correlated and carry less evidence
than independent ones. In: how many photographs of each session were recognized. Out: a `RatePosterior` of the rate and
of the correlation of two photographs of a session; from it the rate's interval, the counts that photographs of new
sessions will show, and the rates that are compatible with such counts.

A session's own rate is Beta-distributed about the overall rate, so that its count is beta-binomial (Williams,
Biometrics 31 (1975) 949-952, with the intraclass correlation ρ = 1 / (α + β + 1)). Predictions are means over a grid of
the posterior, with Jeffreys' prior of the rate and a flat prior of √ρ. If all sessions have one photograph, ρ is taken
as 0. Differences between a patch and a control have an interval with the same model in normal form. Left out on
purpose: a rate that depends on the pose, which all sessions share.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from patchproof.base.intervals import TAIL, independent_difference, paired_difference, student_mean

Hits = Sequence[bool] | np.ndarray
HitsBySession = Mapping[int, Sequence[bool]]
LEAST_SESSIONS = 2  # one session cannot tell what a patch does from what its place does
_RATES, _CORRELATIONS = 240, 36
_MAX_CORRELATION = 0.95
_BLOCK_NUMBERS = 1 << 20  # chances that are computed at a time, in 30 MB
_NEGLIGIBLE = 1e-6  # weight, as a share of the posterior's heaviest point
_INDEPENDENT = 1e-7  # the correlation of independent photographs, which must not be 0 exactly


@dataclass(frozen=True, eq=False)
class RatePosterior:
    """A posterior over points of a grid: P rates, P correlations within a session, P weights that sum to 1."""

    rates: np.ndarray
    correlations: np.ndarray
    weights: np.ndarray

    @property
    def rate_interval(self) -> tuple[float, float]:
        """The rate's 95 % interval, over sessions; an end beyond the grid is 0 or 1."""
        low, high = (_quantile(self.rates, self.weights, share) for share in (TAIL, 1 - TAIL))
        first, last = _grid()[0][[0, -1]]
        return (low if low > first else 0.0), (high if high < last else 1.0)

    @property
    def correlation(self) -> tuple[float, tuple[float, float]]:
        """The median correlation within a session, and its 95 % interval."""
        low, middle, high = (_quantile(self.correlations, self.weights, q) for q in (TAIL, 0.5, 1 - TAIL))
        return middle, (low, high)

    def chances(self, photos: Sequence[int]) -> np.ndarray:
        """The chance of each count 0 to n of recognized photographs in new sessions of `photos` photographs each."""
        return _chances_of(self, tuple(photos))

    def count_interval(self, photos: Sequence[int]) -> tuple[int, int]:
        """The 95 % interval of the count of recognized photographs in new sessions of `photos` photographs each."""
        cumulative = np.cumsum(self.chances(photos))
        return int(np.searchsorted(cumulative, TAIL)), int(np.searchsorted(cumulative, 1 - TAIL))

    def least_rate(self, recognized: int, photos: Sequence[int], tail: float) -> float:
        """The smallest rate at which `recognized` photographs or more have a chance of `tail`; the observed count
        itself counts half (mid-p). Sessions differ as much as the posterior says.
        """
        values, inverse = np.unique(self.correlations, return_inverse=True)
        marginal = tuple(values), tuple(np.bincount(inverse, self.weights))
        return _least_rates(*marginal, tuple(sorted(photos)), tail)[recognized]

    def most_rate(self, recognized: int, photos: Sequence[int], tail: float) -> float:
        """The largest rate at which `recognized` photographs or fewer are recognized with a chance of `tail`."""
        return 1 - self.least_rate(sum(photos) - recognized, photos, tail)

    def rate_given(self, recognized: int, photos: Sequence[int]) -> tuple[float, float]:
        """The 95 % interval of a rate by new sessions' photographs, which differ as much as the posterior says."""
        return self.least_rate(recognized, photos, TAIL), self.most_rate(recognized, photos, TAIL)


def rate_posterior(recognized: Sequence[int], photos: Sequence[int]) -> RatePosterior:
    """The posterior given `recognized` of `photos` photographs in each session; the prior for no sessions."""
    return _rate_posterior(tuple(map(int, recognized)), tuple(map(int, photos)))


@lru_cache(maxsize=32)
def _rate_posterior(recognized: tuple[int, ...], photos: tuple[int, ...]) -> RatePosterior:
    from scipy.special import betaln

    rates, correlations = _grid() if max(photos, default=0) > 1 else (_grid()[0], np.array([_INDEPENDENT]))
    rate, correlation = (part.ravel() for part in np.meshgrid(rates, correlations, indexing="ij"))
    alpha, beta = _shapes(rate, correlation)
    log, prior_beta = np.zeros(len(rate)), betaln(alpha, beta)
    for (k, n), sessions in Counter(zip(recognized, photos, strict=True)).items():
        log += sessions * (betaln(alpha + k, beta + n - k) - prior_beta)
    weights = np.exp(log - log.max())
    heavy = weights > _NEGLIGIBLE
    return RatePosterior(rate[heavy], correlation[heavy], weights[heavy] / weights[heavy].sum())


@lru_cache(maxsize=32)
def _chances_of(posterior: RatePosterior, photos: tuple[int, ...]) -> np.ndarray:
    """`RatePosterior.chances`, cached because many counts are judged by the same chances."""
    rates, correlations, weights = posterior.rates, posterior.correlations, posterior.weights
    parts = _blocks(len(rates), sum(photos))
    means = [weights[p] @ _transforms(rates[p], correlations[p], photos) for p in parts]
    chances = _chances(np.sum(means, axis=0), photos)
    chances.flags.writeable = False
    return chances


def count_by_session(hits: Hits, per_session: int, places: Sequence[int] = ()) -> tuple[list[int], list[int]]:
    """Count (recognized, photographs) in sessions of `per_session` successive photographs; the last may have fewer.
    Sessions with the same number in `places` count as one, because sessions differ mostly by their place.
    """
    sessions, by_place = _split(hits, per_session), dict[int, list[bool]]()
    for place, session in zip(places or range(len(sessions)), sessions, strict=True):
        by_place.setdefault(place, []).extend(map(bool, session))
    return list(map(sum, by_place.values())), list(map(len, by_place.values()))


def _split(values: Hits, per_session: int) -> list[Hits]:
    return [values[first : first + per_session] for first in range(0, len(values), per_session)]


def session_difference(a: Hits, b: Hits, per_session: int) -> tuple[float, tuple[float, float]]:
    """Return rate(a) - rate(b) on the same conditions in sessions of `per_session` successive ones, and the wider of
    two intervals: Newcombe's paired one over conditions, and Student's over sessions (of width 0 if all agree).
    """
    difference, (low, high) = paired_difference(list(map(bool, a)), list(map(bool, b)))
    pairs = zip(_split(a, per_session), _split(b, per_session), strict=True)
    differences = [float(np.mean(part_a) - np.mean(part_b)) for part_a, part_b in pairs]
    if per_session > 1 and len(differences) > 1:
        mean = student_mean(differences)
        half = mean.high - mean.value
        low, high = max(-1.0, min(low, difference - half)), min(1.0, max(high, difference + half))
    return difference, (low, high)


def sessions_difference(a: HitsBySession, b: HitsBySession, paired: bool = False) -> tuple[float, tuple[float, float]]:
    """Return rate(a) - rate(b) of photographs by session, and the wider of two 95 % intervals: Newcombe's over
    photographs, and one over sessions; all differences where either has fewer than two sessions. If both have the same
    sessions, they are compared within each; where `paired`, photographs at equal places in their lists are pairs.

    Over sessions, the difference is normal given the correlation ρ within a session, with the prior of `rate_posterior`
    and binomial variances at the mean of both rates. Equal rates at ρ of 0 to 0.3 are told apart in either direction in
    at most 3.5 % of trials with 2 to 12 sessions of 3 to 20 photographs each.
    """
    from scipy.special import ndtr

    (a_hits, a_n), (b_hits, b_n) = (np.array([(sum(hits), len(hits)) for hits in each.values()]).T for each in (a, b))
    pairs = [pair for session in a for pair in zip(a[session], b[session], strict=True)] if paired else []
    totals = [int(each.sum()) for each in (a_hits, a_n, b_hits, b_n)]
    difference, (low, high) = independent_difference(*totals)
    if paired:
        difference, (low, high) = paired_difference([x for x, _ in pairs], [y for _, y in pairs])
    if min(len(a), len(b)) < LEAST_SESSIONS:
        return difference, (-1.0, 1.0)
    mean = ((totals[0] + 0.5) / (totals[1] + 1) + (totals[2] + 0.5) / (totals[3] + 1)) / 2
    variance, correlation = mean * (1 - mean), _grid()[1][:, None]
    if a.keys() == b.keys():
        b_rates, b_sizes = np.array([(np.mean(b[session]), len(b[session])) for session in a]).T
        gains, within = a_hits / a_n - b_rates, variance * (1 / a_n + 1 / b_sizes)
        if paired:  # as pairs of one view differ, and two more with the binomial variance
            squares = sum(x != y for x, y in pairs) - gains**2 @ a_n
            within = (squares + 4 * variance) / (len(pairs) - len(a) + 2) / a_n
        middle, spread, log = _mean_by_variances(gains, within + 2 * correlation * variance)
    else:
        sides = (a_hits, a_n), (b_hits, b_n)
        rows = [(k / n, variance * (correlation + (1 - correlation) / n)) for k, n in sides]
        (a_mean, a_error, a_log), (b_mean, b_error, b_log) = (_mean_by_variances(*row) for row in rows)
        middle, spread, log = a_mean - b_mean, np.hypot(a_error, b_error), a_log + b_log
    ends, weights = np.linspace(-1, 1, 2001), np.exp(log - log.max())
    shares = weights @ ndtr((ends - middle[:, None]) / spread[:, None]) / weights.sum()
    low_end, high_end = np.interp((TAIL, 1 - TAIL), shares, ends)
    return difference, (min(low, float(low_end)), max(high, float(high_end)))


def _mean_by_variances(values: np.ndarray, variances: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The weighted mean of S values, its error, and the log likelihood of each row of variances C×S (flat prior)."""
    weights = 1 / variances
    total = weights.sum(1)
    mean = weights @ values / total
    squares = (weights * (values - mean[:, None]) ** 2).sum(1)
    return mean, total**-0.5, -(np.log(variances).sum(1) + squares + np.log(total)) / 2


def split_evenly(photos: int, sessions: int) -> tuple[int, ...]:
    """Distribute photographs over sessions as evenly as possible: the number in each session."""
    return tuple(photos // sessions + (i < photos % sessions) for i in range(sessions))


def _grid() -> tuple[np.ndarray, np.ndarray]:
    """Rates at even steps of the angle in which Jeffreys' prior is flat, and correlations at even steps of √ρ."""
    angles = (np.arange(_RATES) + 0.5) / _RATES * np.pi / 2
    roots = (np.arange(_CORRELATIONS) + 0.5) / _CORRELATIONS
    return np.sin(angles) ** 2, _MAX_CORRELATION * roots**2


def _shapes(rate: np.ndarray, correlation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    strength = 1 / correlation - 1
    return rate * strength, (1 - rate) * strength


def _transforms(rates: np.ndarray, correlations: np.ndarray, photos: Sequence[int]) -> np.ndarray:
    """The Fourier transforms P×F of the chances of every count at P points; sessions, whose counts add, multiply."""
    from scipy.fft import next_fast_len

    alpha, beta = _shapes(rates, correlations)
    half: Any = next_fast_len(sum(photos) // 2 + 1, real=True)  # no prime, which takes five times as long
    transforms = np.ones(1)
    for n, sessions in Counter(photos).items():
        transforms = transforms * np.fft.rfft(_beta_binomial(n, alpha, beta), 2 * half) ** sessions
    return transforms


def _chances(transforms: np.ndarray, photos: Sequence[int]) -> np.ndarray:
    """The chances ...×(n + 1) of every count by `_transforms`; means of transforms give means of chances."""
    return np.clip(np.fft.irfft(transforms)[..., : sum(photos) + 1], 0, 1)


def _blocks(rows: int, columns: int) -> list[slice]:
    """Split `rows` so that memory does not grow with the number of photographs; one block up to 120 of them."""
    size = max(1, _BLOCK_NUMBERS // max(columns, 1))
    return [slice(first, first + size) for first in range(0, rows, size)]


def _beta_binomial(n: int, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """The chances P×(n + 1) of 0 to n by ratios of successive ones; SciPy takes 17 times as long at n = 100."""
    k, log = np.arange(n), np.zeros((len(alpha), n + 1))
    ratios = (n - k) / (k + 1) * (alpha[:, None] + k) / (beta[:, None] + n - 1 - k)
    np.cumsum(np.log(ratios), axis=1, out=log[:, 1:])
    chances = np.exp(log - log.max(1, keepdims=True))
    return chances / chances.sum(1, keepdims=True)


@lru_cache(maxsize=64)
def _least_rates(
    correlations: tuple[float, ...], weights: tuple[float, ...], photos: tuple[int, ...], tail: float
) -> tuple[float, ...]:
    """`RatePosterior.least_rate` of every count."""
    rates, rows = _grid()[0], []
    for part in _blocks(len(rates), len(correlations) * sum(photos)):
        rate, correlation = (each.ravel() for each in np.meshgrid(rates[part], correlations, indexing="ij"))
        transforms = _transforms(rate, correlation, photos).reshape(len(rates[part]), len(correlations), -1)
        rows.append(np.array(weights) @ transforms)
    chances = _chances(np.concatenate(rows), photos)
    at_least = chances[:, ::-1].cumsum(1)[:, ::-1] - chances / 2
    return tuple(float(np.interp(tail, tails, rates, left=0.0, right=1.0)) for tails in at_least.T)


def _quantile(values: np.ndarray, weights: np.ndarray, share: float) -> float:
    order = np.argsort(values, kind="stable")
    return float(np.interp(share, np.cumsum(weights[order]) - weights[order] / 2, values[order]))
