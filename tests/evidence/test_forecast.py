"""Counts of unequal chances that a session shifts together, by hand and by chance."""

from itertools import product

import numpy as np
import pytest

from patchlab.validation.forecasts import calibration_slope
from patchproof.evidence import forecast
from patchproof.evidence.forecast import count_chances, forecast_of


def enumerated(chances: np.ndarray) -> np.ndarray:
    """The chance of every count, over all outcomes."""
    total = np.zeros(len(chances) + 1)
    for outcome in product((0, 1), repeat=len(chances)):
        total[sum(outcome)] += np.prod(np.where(outcome, chances, 1 - chances))
    return total


def test_counts_without_a_shift_are_those_of_independent_chances(monkeypatch):
    monkeypatch.setattr(forecast, "LOG_ODDS_DEVIATION", 0.0)
    chances = np.array([0.05, 0.3, 0.5, 0.9, 0.97])
    assert count_chances(chances) == pytest.approx(enumerated(chances), abs=1e-12)


def test_a_shift_widens_counts_as_drawn_sessions_do():
    chances, rng = np.linspace(0.1, 0.9, 20), np.random.default_rng(0)
    odds = np.log(chances / (1 - chances))
    shift = forecast.LOG_ODDS_DEVIATION * rng.standard_normal((20_000, 1))
    counts = (rng.random((20_000, 20)) < 1 / (1 + np.exp(-odds - shift))).sum(1)
    drawn = np.bincount(counts, minlength=21) / len(counts)
    assert count_chances(chances) == pytest.approx(drawn, abs=0.01)
    low, high = forecast_of(chances, [True] * 10 + [False] * 10, 0.5).interval
    assert 0.93 < np.mean((low <= counts) & (counts <= high)) <= 0.99


def test_scores_by_hand():
    told = forecast_of([0.9, 0.2], [True, False], 0.5)
    assert (told.photos, told.expected, told.recognized) == (2, pytest.approx(1.1), 1)
    assert told.brier == pytest.approx((0.01 + 0.04) / 2) and told.brier_promise == pytest.approx(0.25)


@pytest.mark.parametrize("sure", [0.5, 1.0, 2.0])
def test_the_slope_says_how_much_too_sure_chances_are(sure):
    rng = np.random.default_rng(0)
    odds = rng.normal(0, 1.5, 20_000)
    hits = (rng.random(len(odds)) < 1 / (1 + np.exp(-odds))).astype(float)
    assert calibration_slope(1 / (1 + np.exp(-sure * odds)), hits) == pytest.approx(1 / sure, rel=0.08)
    assert calibration_slope(np.array([0.2, 0.4]), np.array([1.0, 1.0])) is None
