"""Fit a falling curve to counts at a few points, and find its breaking point with an interval.

In: hits, conditions × points, and the points' positions in the sweep (0 easy, 1 hard). Out: `Break`. The curve is a
logistic between two levels; its breaking point is where it has lost half of what it loses over the sweep, if that is at
least a quarter of its start. Likelihood is maximized over a grid, which always converges and shows where data leave the
curve open: between two points of rate 1 and 0 the breaking point may lie anywhere, and the interval says so. All points
share their conditions, so the bootstrap resamples whole conditions; else intervals would be too narrow.

The fitted curve always falls. A separate test tells if the data contradict that: the distance from the nearest falling
rates, against the distances of bootstrap samples shifted to falling rates.

Sources: Efron and Tibshirani, An Introduction to the Bootstrap, 1993, 13.3 (percentiles), 16.2 (null made true);
Robertson, Wright and Dykstra, Order Restricted Statistical Inference, 1988, 1.4 (the nearest falling rates).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from patchproof.base.intervals import Estimate, paired_difference, wilson

BOOTSTRAP_SAMPLES = 200
LIKELIHOOD_TOLERANCE = 0.1  # of log-likelihood: curves this near to the best count as equally good
MAX_P_NOT_MONOTONE = 0.01  # 0.01, since each sweep tests two curves
MIN_EASY_RATE = 0.05  # Wilson's lower end of the rate there; below it nothing worked
MIN_LOST_SHARE = 0.25  # of the rate at the easy end; a curve that loses less holds
BEYOND_SWEEP = 2.0  # stands for a breaking point beyond the sweep
CONTROLS = ("bare", "gray")  # of a promise's controls; a noise design would need a draw


@dataclass(frozen=True)
class Break:
    """Positions in the sweep, `BEYOND_SWEEP` where the curve holds; None if nothing worked at the easy end.

    `rates` are the best curve's at both ends; `monotone_p` is None if no curve was fitted.
    """

    value: float | None
    low: float | None
    high: float | None
    monotone_p: float | None
    rates: tuple[float, float]


def find_break(worked: np.ndarray, positions: np.ndarray, seed: int = 0) -> Break:
    """The breaking point of hits n×P at positions P in [0, 1]: the bootstrap's median with its 95 % interval."""
    n = len(worked)
    rng = np.random.default_rng([seed, n])
    weights = rng.multinomial(n, np.full(n, 1 / n), BOOTSTRAP_SAMPLES)
    counts = weights @ worked.astype(float)
    p = monotone_p(worked.mean(0), counts / n)
    best_curve = _fit_curves(worked.sum(0, keepdims=True).astype(float), n, positions)[2][0]
    first, last = curve_at(best_curve, np.array([0.0, 1.0])).tolist()
    if wilson(int(worked[:, 0].sum()), n)[0] < MIN_EASY_RATE:
        return Break(None, None, None, p, (first, last))
    low, high, _ = _fit_curves(counts, n, positions)
    middle = np.where(high < BEYOND_SWEEP, (low + high) / 2, low)
    quantiles = (middle, 0.5), (low, 0.025), (high, 0.975)
    value, low, high = (float(np.quantile(drawn, q, method="inverted_cdf")) for drawn, q in quantiles)
    return Break(value, low, high, p, (first, last))


def curve_at(curve: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Rates at positions of a curve (center, width, level on the easy side, level on the hard side)."""
    from scipy.special import expit

    center, width, top, floor = curve
    return floor + (top - floor) * expit((center - positions) / width)


def monotone_p(rates: np.ndarray, drawn: np.ndarray) -> float:
    """p-value of the hypothesis that rates P fall everywhere; `drawn` B×P are bootstrap samples of them."""
    nearest = nearest_falling(rates)
    observed = ((rates - nearest) ** 2).sum()
    if observed <= 1e-12:
        return 1.0
    moved = drawn - rates + nearest
    distances = np.array([((row - nearest_falling(row)) ** 2).sum() for row in moved])
    return float((1 + (distances >= observed).sum()) / (1 + len(drawn)))


def nearest_falling(rates: np.ndarray) -> np.ndarray:
    """The nearest rates P, by least squares, that never rise."""
    from scipy.optimize import isotonic_regression

    return isotonic_regression(rates, increasing=False).x


@lru_cache(maxsize=1)
def _curve_grid() -> tuple[np.ndarray, np.ndarray]:
    """Curves G×4 and their breaking points, sorted by these."""
    centers, widths = np.linspace(0, 1.2, 61), np.geomspace(0.002, 0.4, 10)
    tops, floors = np.sin(np.linspace(0.05, np.pi / 2 - 0.05, 15)) ** 2, np.array([0, 0.1, 0.25, 0.4, 0.6, 0.8])
    center, width, top, share = (a.ravel() for a in np.meshgrid(centers, widths, tops, floors, indexing="ij"))
    curves = np.stack([center, width, top, share * top], 1)
    first, last = (curve_at(curves.T, np.full(1, end)) for end in (0.0, 1.0))
    level = ((first + last) / 2 - curves[:, 3]) / (top * (1 - share))
    level = level.clip(1e-9, 1 - 1e-9)  # for flat curves it rounds to 1
    lost = center - width * np.log(level / (1 - level))
    lost = np.where(first - last >= MIN_LOST_SHARE * first, lost.clip(0, 1), BEYOND_SWEEP)
    order = np.argsort(lost, kind="stable")
    return curves[order], lost[order]


def _fit_curves(counts: np.ndarray, n: int, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Per row of counts B×P: lowest and highest breaking point of equally good curves, and the best curve B×4."""
    curves, lost = _curve_grid()
    rates = np.stack([curve_at(curves.T, np.full(1, x)) for x in positions]).clip(1e-4, 1 - 1e-4)  # P×G
    odds, none = np.log(rates / (1 - rates)).astype(np.float32), n * np.log(1 - rates).sum(0).astype(np.float32)
    likelihood = counts.astype(np.float32) @ odds + none
    good = likelihood >= likelihood.max(1, keepdims=True) - LIKELIHOOD_TOLERANCE  # curves are sorted by breaking point
    return lost[good.argmax(1)], lost[::-1][good[:, ::-1].argmax(1)], curves[likelihood.argmax(1)]


def gains_over_controls(design: np.ndarray, controls: Mapping[str, np.ndarray]) -> list[Estimate]:
    """Per point the rate of `design` P×N minus that of the best control there, each P×N."""
    gains = []
    for point, hits in enumerate(design):
        best = max((worked[point] for worked in controls.values()), key=np.sum)
        value, (low, high) = paired_difference(hits.tolist(), best.tolist())
        gains.append(Estimate(value, low, high, len(hits)))
    return gains


def has_effect(gain: Estimate) -> bool:
    """True if the gain's interval lies above 0."""
    return gain.low > 0


def gain_break(gains: Sequence[Estimate], positions: np.ndarray) -> Break:
    """The break between the first point without a gain and the one before it, positions P in [0, 1] from easy to hard;
    `rates` are the gains at both ends.
    """
    ends, lost = (gains[0].value, gains[-1].value), [i for i, gain in enumerate(gains) if not has_effect(gain)]
    if not lost:
        return Break(BEYOND_SWEEP, BEYOND_SWEEP, BEYOND_SWEEP, None, ends)
    if lost[0] == 0:
        return Break(None, None, None, None, ends)
    low, high = float(positions[lost[0] - 1]), float(positions[lost[0]])
    return Break((low + high) / 2, low, high, None, ends)
