"""Estimates of means, medians and clusters, for tables of studies."""

import statistics
from collections.abc import Sequence

import numpy as np
from scipy.stats import binom

from patchproof.base.intervals import CONFIDENCE, MIN_CLUSTERS, Estimate, resampled_means, student_mean

_INTERVAL_QUANTILES = (1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2  # of an interval, as shares of a distribution


def mean(values: Sequence[float]) -> Estimate | None:
    """The mean with Student's interval; None for fewer than two values."""
    return student_mean(values) if len(values) > 1 else None


def median(values: Sequence[float] | np.ndarray) -> Estimate:
    """The median with its distribution-free interval from order statistics; for few values, their range."""
    ordered, n = sorted(map(float, values)), len(values)
    skipped = max(int(binom.ppf(_INTERVAL_QUANTILES[0], n, 0.5)) - 1, 0)
    return Estimate(statistics.median(ordered), ordered[skipped], ordered[n - 1 - skipped], n)


def cluster_mean(values: Sequence[float]) -> Estimate | float | None:
    """The mean of one figure per cluster; a plain number if clusters are too few for an interval, None if none."""
    if len(values) < MIN_CLUSTERS:
        return statistics.fmean(values) if values else None
    value, (low, high) = clustered_mean(values)
    return Estimate(value, low, high, len(values))


def clustered_mean(values: Sequence[float]) -> tuple[float, tuple[float, float]]:
    """Mean of one figure per cluster with a percentile bootstrap over clusters, since values within a cluster (seeds
    and conditions of one object and network) are alike. Repeatable. Needs MIN_CLUSTERS: fewer would give far too narrow
    intervals (one: a point), and with ten it covers about nine times in ten.
    """
    if len(values) < MIN_CLUSTERS:
        raise ValueError(f"expected at least {MIN_CLUSTERS} clusters, got {len(values)}")
    means = resampled_means(np.asarray(values, float), 10_000)
    low, high = np.quantile(means, _INTERVAL_QUANTILES)
    return float(np.mean(values)), (float(low), float(high))
