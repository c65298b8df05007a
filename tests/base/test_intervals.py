"""Claims: published figures, and intervals that cover as often as they say."""

import sys

import numpy as np
import pytest
from scipy.stats import binom, multinomial, t

from patchproof.base.intervals import (
    independent_difference,
    paired_difference,
    student_mean,
    wilson,
)


def pairs(both: int, only_a: int, only_b: int, neither: int) -> tuple[list[bool], list[bool]]:
    a = [True] * (both + only_a) + [False] * (only_b + neither)
    b = [True] * both + [False] * only_a + [True] * only_b + [False] * neither
    return a, b


def test_student_s_interval_is_scipy_s_without_importing_its_distributions(monkeypatch):
    half = t.ppf(0.975, 3) * np.std([1, 2, 4, 9], ddof=1) / 2
    monkeypatch.setitem(sys.modules, "scipy.stats", None)
    assert student_mean([1, 2, 4, 9]).low == pytest.approx(4 - half, rel=1e-12)


def test_wilson_by_hand():
    assert wilson(8, 10) == pytest.approx((0.4902, 0.9433), abs=5e-5)
    assert wilson(0, 10) == pytest.approx((0, 0.2775), abs=5e-5)  # z²/(n + z²)
    assert wilson(0, 0) == (0, 1) and wilson(0, 5)[0] == 0 and wilson(5, 5)[1] == 1


def test_wilson_is_symmetric_and_narrows():
    for k in range(11):
        low, high = wilson(k, 10)
        assert wilson(10 - k, 10) == pytest.approx((1 - high, 1 - low))
        assert low <= k / 10 <= high
    widths = [np.ptp(wilson(n // 2, n)) for n in (10, 100, 1000)]
    assert widths == sorted(widths, reverse=True)


def test_wilson_covers_95_percent_on_average():
    n = 60
    rates = np.linspace(0.02, 0.98, 97)
    intervals = np.array([wilson(k, n) for k in range(n + 1)])
    inside = (intervals[:, :1] <= rates) & (rates <= intervals[:, 1:])
    coverage = (binom.pmf(np.arange(n + 1)[:, None], n, rates) * inside).sum(0)
    assert coverage.mean() == pytest.approx(0.95, abs=0.01) and coverage.min() > 0.88


def test_independent_differences_as_published():
    """Newcombe 1998 (873-890), Table II, method 10."""
    for counts, expected in [
        ((56, 70, 48, 80), (0.0524, 0.3339)),
        ((9, 10, 3, 10), (0.1705, 0.8090)),
        ((5, 56, 0, 29), (-0.0381, 0.1926)),
        ((10, 10, 0, 20), (0.6791, 1.0000)),
    ]:
        difference, interval = independent_difference(*counts)
        assert interval == pytest.approx(expected, abs=1e-4)
        assert difference == pytest.approx(counts[0] / counts[1] - counts[2] / counts[3])


def test_paired_difference_covers_by_exact_enumeration():
    """Every table of 20 pairs, weighted by its chance; the interval is to hold the true difference 95 times in 100."""
    n = 20
    tables = [(a, b, c, n - a - b - c) for a in range(n + 1) for b in range(n + 1 - a) for c in range(n + 1 - a - b)]
    found = np.array([paired_difference(*pairs(*table))[1] for table in tables])
    for chances in ([0.4, 0.3, 0.1, 0.2], [0.6, 0.2, 0.05, 0.15], [0.25, 0.25, 0.25, 0.25], [0.1, 0.05, 0.05, 0.8]):
        weight = multinomial.pmf(tables, n, chances)
        truth = chances[1] - chances[2]
        coverage = weight[(found[:, 0] <= truth) & (truth <= found[:, 1])].sum()
        assert 0.93 < coverage < 0.999, chances


def test_paired_difference_as_published():
    """Newcombe 1998 (2635-2650), method 10: 36, 12, 2, 0 of 50 pairs."""
    difference, interval = paired_difference(*pairs(36, 12, 2, 0))
    assert difference == pytest.approx(0.2) and interval == pytest.approx((0.0569, 0.3404), abs=1e-4)


def test_paired_difference_swaps_sign_and_stays_in_bounds():
    for table in [(5, 9, 1, 5), (0, 20, 0, 0), (10, 0, 0, 10), (0, 0, 0, 20), (0, 10, 10, 0)]:
        a, b = pairs(*table)
        difference, (low, high) = paired_difference(a, b)
        swapped, (swapped_low, swapped_high) = paired_difference(b, a)
        assert (swapped, swapped_low, swapped_high) == pytest.approx((-difference, -high, -low))
        assert -1 <= low <= difference <= high <= 1


def test_pairing_narrows_where_results_agree():
    a, b = pairs(40, 8, 2, 50)
    paired = np.ptp(paired_difference(a, b)[1])
    assert paired < 0.8 * np.ptp(independent_difference(sum(a), 100, sum(b), 100)[1])


def test_paired_difference_wants_pairs():
    for a, b in (([], []), ([True], [True, False])):
        with pytest.raises(ValueError, match="equally long"):
            paired_difference(a, b)
