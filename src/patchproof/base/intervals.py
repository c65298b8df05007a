"""Confidence intervals of rates, of means, and of differences between rates.

In: counts and figures. Out: intervals and `Estimate`s for tables, at 95 %. A rate from n images gets Wilson's interval;
`sessions` predicts what photographs of new sessions will show. Differences on the same conditions are paired (Newcombe
1998b, method 10), others follow Newcombe 1998a, method 10. Left out on purpose: corrections for repeated looks at the
data, which `optimizer.promise` does not need.

Sources: Wilson, JASA 22 (1927); Newcombe, Statistics in Medicine 17 (1998) 873-890 (independent) and 2635-2650
(paired).
"""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

CONFIDENCE = 0.95
MIN_CLUSTERS = 5
TAIL = (1 - CONFIDENCE) / 2
_Z = statistics.NormalDist().inv_cdf(0.5 + CONFIDENCE / 2)


@dataclass(frozen=True)
class Estimate:
    """A figure, its 95 % interval and the number of trials it is based on: four columns of a CSV file."""

    value: float
    low: float
    high: float
    n: int


def rate(hits: Sequence[bool]) -> Estimate | None:
    """Return the share of `hits` that are true, with Wilson's interval; None if `hits` is empty."""
    return Estimate(sum(hits) / len(hits), *wilson(sum(hits), len(hits)), len(hits)) if hits else None


def estimate_difference(a: list[bool], b: list[bool]) -> Estimate | None:
    """Return rate(a) - rate(b) on the same conditions, with Newcombe's paired interval; None if `a` is empty."""
    if not a:
        return None
    value, (low, high) = paired_difference(a, b)
    return Estimate(value, low, high, len(a))


def student_mean(values: "Sequence[float] | np.ndarray") -> Estimate:
    """Return the mean of at least two values, with Student's interval."""
    from scipy.special import stdtrit  # what scipy.stats.t.ppf calls, without a second of imports

    n, value = len(values), statistics.fmean(values)
    half = float(stdtrit(n - 1, 1 - TAIL)) * (statistics.stdev(map(float, values)) / math.sqrt(n))
    return Estimate(value, value - half, value + half, n)


def wilson(successes: int, n: int) -> tuple[float, float]:
    """Return Wilson's interval (low, high) of a rate; (0, 1) if n is 0."""
    if n == 0:
        return 0.0, 1.0
    z, rate = _Z, successes / n
    center = (rate + z * z / (2 * n)) / (1 + z * z / n)
    half = z * math.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    # at 0 and n successes the formula gives 0 and 1 up to rounding
    return (0.0 if successes == 0 else center - half), (1.0 if successes == n else center + half)


def paired_difference(a: list[bool], b: list[bool]) -> tuple[float, tuple[float, float]]:
    """Return rate(a) - rate(b) on the same n ≥ 1 conditions, and Newcombe's paired interval (method 10)."""
    n = len(a)
    if n == 0 or n != len(b):
        raise ValueError(f"expected two equally long lists, got {n} and {len(b)} results")
    both = sum(x and y for x, y in zip(a, b, strict=True))
    only_a, only_b = sum(a) - both, sum(b) - both
    neither = n - both - only_a - only_b
    (low_a, high_a), (low_b, high_b) = wilson(sum(a), n), wilson(sum(b), n)
    rate_a, rate_b = sum(a) / n, sum(b) / n
    margins = (both + only_a) * (only_b + neither) * (both + only_b) * (only_a + neither)
    # φ corrected for continuity, only where it is positive (Newcombe's rule)
    covariance = both * neither - only_a * only_b
    phi = 0.0 if margins == 0 else (max(covariance - n / 2, 0) if covariance > 0 else covariance) / math.sqrt(margins)
    down_a, up_a, down_b, up_b = rate_a - low_a, high_a - rate_a, rate_b - low_b, high_b - rate_b
    difference = rate_a - rate_b
    low = difference - math.sqrt(max(0.0, down_a**2 - 2 * phi * down_a * up_b + up_b**2))
    high = difference + math.sqrt(max(0.0, up_a**2 - 2 * phi * up_a * down_b + down_b**2))
    return difference, (low, high)


def independent_difference(successes_a: int, n_a: int, successes_b: int, n_b: int) -> tuple[float, tuple[float, float]]:
    """Return rate a - rate b on different images, and Newcombe's interval from two Wilson scores."""
    rates = successes_a / max(n_a, 1), successes_b / max(n_b, 1)
    return rates_difference(rates[0], wilson(successes_a, n_a), rates[1], wilson(successes_b, n_b))


def rates_difference(
    rate_a: float, interval_a: tuple[float, float], rate_b: float, interval_b: tuple[float, float]
) -> tuple[float, tuple[float, float]]:
    """Return rate_a - rate_b on different images, and its interval from the two rates' own (Newcombe's method 10)."""
    (low_a, high_a), (low_b, high_b) = interval_a, interval_b
    difference = rate_a - rate_b
    low = difference - math.hypot(rate_a - low_a, high_b - rate_b)
    return difference, (low, difference + math.hypot(high_a - rate_a, rate_b - low_b))


def resampled_means(values: "np.ndarray", draws: int) -> "np.ndarray":
    """Return the means (`draws` × ...) of bootstrap resamples of n × ... values, drawn with a fixed seed."""
    import numpy as np

    return values[np.random.default_rng(0).integers(0, len(values), (draws, len(values)))].mean(1)
