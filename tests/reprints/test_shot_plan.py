"""The shot plan against simulation by the judge's own comparison, and where no number of photographs is enough."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom, binomtest

from patchproof.base.intervals import independent_difference
from patchproof.evidence.verdict import MIN_KEPT_CHANCE, PHOTOS_PER_SESSION, kept_chance
from patchproof.reprints.shot_plan import fewest_photos, paired_power, plan_shots, unpaired_power
from test_verify_verdict import promise_of


@pytest.mark.parametrize(("rates", "n"), [((0.9, 0.4), 20), ((0.7, 0.5), 60)])
def test_power_is_that_of_photographs_that_agree_between_places(rates, n):
    rng, paired, unpaired, trials = np.random.default_rng(0), 0, 0, 900
    for _ in range(trials):
        a, b = (rng.random(n) < rate for rate in rates)
        only_a, only_b = int((a & ~b).sum()), int((b & ~a).sum())
        paired += only_a > only_b and binomtest(only_a, only_a + only_b).pvalue < 0.05
        unpaired += independent_difference(int(a.sum()), n, int(b.sum()), n)[1][0] > 0
    # three standard errors of 900 trials
    assert paired_power(*rates, n) == pytest.approx(paired / trials, abs=0.05)
    assert unpaired_power(*rates, n) == pytest.approx(unpaired / trials, abs=0.05)


@pytest.mark.parametrize(("better", "worse", "n"), [(0.9, 0.4, 5), (0.55, 0.5, 41), (0.7, 0.0, 17), (1.0, 0.97, 150)])
def test_unpaired_power_sums_the_counts_whose_interval_lies_above_zero(better, worse, n):
    counts = range(n + 1)
    a, b = binom.pmf(counts, n, better), binom.pmf(counts, n, worse)
    shown = ((i, j) for i in counts for j in counts if independent_difference(i, n, j, n)[1][0] > 0)
    assert unpaired_power(better, worse, n) == pytest.approx(sum(a[i] * b[j] for i, j in shown), abs=1e-12)


def test_the_plan_s_sessions_are_enough_and_one_less_is_not():
    promise = promise_of(0.85, 0.2, correlation=0.1)
    sessions = plan_shots(promise).sessions
    assert (
        kept_chance(promise, (PHOTOS_PER_SESSION,) * sessions)
        >= MIN_KEPT_CHANCE
        > kept_chance(promise, (PHOTOS_PER_SESSION,) * (sessions - 1))
    )
    assert plan_shots(promise_of(0.3, 0.28, correlation=0.2)).sessions is None
    ways = plan_shots(promise).options
    assert [way.chance for way in ways[:4]] == sorted(way.chance for way in ways[:4])
    assert np.ptp(ways[0].allowed) > np.ptp(ways[3].allowed)


def test_the_hardest_control_decides_and_small_differences_cannot_be_shown():
    plan = plan_shots(promise_of(0.9, 0.3))
    assert plan.control == "bare" and 5 <= plan.unpaired <= plan.paired < 40
    assert plan_shots(promise_of(0.5, 0.5)).paired is None
    assert plan_shots(promise_of(0.1, 0.8, goal="deceive")).control == "bare"
    assert fewest_photos(lambda n: n >= 9) == 9 and fewest_photos(lambda n: False) is None
