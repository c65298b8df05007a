"""Breaking points: against scipy's own maximum, known truths, and data that are not monotone."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from patchlab.validation.envelope.fit import (
    BEYOND_SWEEP,
    MAX_P_NOT_MONOTONE,
    _fit_curves,
    curve_at,
    find_break,
    monotone_p,
    nearest_falling,
)

AT = np.linspace(0, 1, 7)


def conditions(center, n, spread=0.12, seed=0):
    """n×7: each condition works up to a threshold of its own, whose median is `center`."""
    rng = np.random.default_rng(seed)
    return AT < (center + spread * rng.logistic(size=(n, 1)) / 1.8)


def test_the_interval_covers_the_truth_about_as_often_as_it_says():
    held = [
        (b := find_break(conditions(0.55, 48, seed=seed), AT)).low <= 0.55 <= b.high and abs(b.value - 0.55) < 0.12
        for seed in range(12)
    ]
    assert sum(held) >= 9  # of 12; fewer than 9 has a chance of 0.002


def test_the_grid_finds_the_maximum_that_an_optimizer_finds():
    counts = np.array([60.0, 58, 50, 31, 12, 4, 1])

    def loss(p):
        center, log_width, top, share = p
        r = curve_at(np.array([center, np.exp(log_width), top, share * top]), AT).clip(1e-9, 1 - 1e-9)
        return -(counts * np.log(r) + (64 - counts) * np.log(1 - r)).sum()

    bounds = [(0, 1.2), (-6, -0.9), (0.01, 0.999), (0, 0.8)]
    best = minimize(loss, [0.5, -2.0, 0.95, 0.05], method="Nelder-Mead", bounds=bounds)
    fine = np.linspace(0, 1, 2001)
    rates = curve_at(np.array([best.x[0], np.exp(best.x[1]), best.x[2], best.x[3] * best.x[2]]), fine)
    half = fine[np.abs(rates - (rates[0] + rates[-1]) / 2).argmin()]
    low, high, curve = _fit_curves(counts[None], 64, AT)
    assert low[0] - 0.03 <= half <= high[0] + 0.03 and high[0] - low[0] < 0.1
    center, width, top, floor = curve[0]
    assert loss([center, np.log(width), top, floor / top]) < best.fun + 0.5


def test_between_two_sure_points_the_breaking_point_is_open():
    worked = np.repeat([[1, 1, 1, 0, 0, 0, 0]], 16, 0).astype(bool)
    found = find_break(worked, AT)
    assert found.low <= 0.36 and found.high >= 0.47 and 0.36 < found.value < 0.47  # the gap is 1/3 to 1/2


def test_what_never_breaks_holds_and_what_never_worked_has_no_breaking_point():
    assert find_break(np.ones((16, 7), bool), AT).value == BEYOND_SWEEP
    assert find_break(np.zeros((16, 7), bool), AT).value is None
    # last good and first bad: 15 of 16 work at the hard end, then 4 of 16
    kept, lost = np.ones((16, 7), bool), np.ones((16, 7), bool)
    kept[:1, -1] = False
    lost[:12, -1] = False
    assert find_break(kept, AT).value == BEYOND_SWEEP and find_break(lost, AT).value < 1


def test_falling_rates_are_the_nearest_ones():
    rates = np.array([0.9, 0.5, 0.7, 0.2])
    assert nearest_falling(rates) == pytest.approx([0.9, 0.6, 0.6, 0.2])
    drawn = np.random.default_rng(0).random((50, 6))
    nearest = np.array([nearest_falling(row) for row in drawn])
    assert (np.diff(nearest, axis=1) <= 1e-12).all() and nearest.sum(1) == pytest.approx(drawn.sum(1))
    other = np.sort(np.random.default_rng(1).random((50, 6)), 1)[:, ::-1]
    assert (((drawn - nearest) ** 2).sum(1) <= ((drawn - other) ** 2).sum(1)).all()


def p_of(worked):
    """The p-value as `find_break` gets it, without the curve, which takes longer."""
    rng = np.random.default_rng(0)
    drawn = rng.multinomial(len(worked), np.full(len(worked), 1 / len(worked)), 200) @ worked / len(worked)
    return monotone_p(worked.mean(0), drawn)


def test_a_sweep_that_rises_is_called_so_and_one_that_falls_is_not():
    rising = conditions(0.6, 64)
    rising[:, 2] = np.random.default_rng(5).random(64) < 0.5  # a dip in the easy half
    assert find_break(rising, AT).monotone_p < MAX_P_NOT_MONOTONE
    called = sum(p_of(conditions(0.6, 24, seed=seed)) < MAX_P_NOT_MONOTONE for seed in range(30))
    assert called == 0  # every condition falls, and with it the rates
    flat = [np.random.default_rng(seed).random((24, 7)) < 0.8 for seed in range(100)]
    assert (
        sum(p_of(worked) < MAX_P_NOT_MONOTONE for worked in flat) <= 5
    )  # 1 is expected; more than 5 has a chance of 0.001


def test_points_without_any_doubt_that_rise_are_not_monotone():
    assert monotone_p(np.array([1.0, 0.0, 1.0]), np.tile([1.0, 0.0, 1.0], (200, 1))) < MAX_P_NOT_MONOTONE
