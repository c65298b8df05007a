"""Sessions: intervals against the beta-binomial's own library, by simulation, and where they stop saying anything."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import betabinom

from patchproof.base import sessions
from patchproof.base.intervals import wilson
from patchproof.base.sessions import (
    TAIL,
    RatePosterior,
    count_by_session,
    rate_posterior,
    session_difference,
    split_evenly,
)


def alone(recognized: int, n: int):
    return rate_posterior([1] * recognized + [0] * (n - recognized), [1] * n)


def drawn(rng, rate: float, correlation: float, photos: int, sessions: int) -> np.ndarray:
    strength = 1 / correlation - 1
    return rng.binomial(photos, rng.beta(rate * strength, (1 - rate) * strength, sessions))


@pytest.mark.parametrize("recognized", [0, 3, 200, 320, 399, 400])
def test_photographs_on_their_own_are_the_beta_binomial_of_jeffreys_prior(recognized):
    expected = betabinom(20, recognized + 0.5, 400 - recognized + 0.5)
    posterior = alone(recognized, 400)
    np.testing.assert_allclose(posterior.chances([1] * 20), expected.pmf(np.arange(21)), atol=2e-4)
    np.testing.assert_allclose(posterior.chances([20]), posterior.chances([1] * 20), atol=1e-6)
    assert posterior.chances([20]) is posterior.chances((20,))  # computed once
    assert not posterior.chances([20]).flags.writeable
    assert posterior.count_interval([20]) == tuple(expected.ppf([TAIL, 1 - TAIL]))
    low, high = posterior.rate_interval
    assert posterior.correlation[0] < 1e-6 and low <= recognized / 400 <= high
    np.testing.assert_allclose(posterior.rate_interval, wilson(recognized, 400), atol=0.01)


@pytest.mark.parametrize("photos", [1, 4, 100, 1000])
@pytest.mark.parametrize(("rate", "correlation"), [(0.8, 0.1), (0.5, 0.95), (1e-5, 0.9), (1 - 1e-5, 1e-3), (0.3, 1e-7)])
def test_chances_of_a_session_are_the_librarys(rate, correlation, photos):
    strength = 1 / correlation - 1
    expected = betabinom.pmf(np.arange(photos + 1), photos, rate * strength, (1 - rate) * strength)
    posterior = RatePosterior(np.array([rate]), np.array([correlation]), np.ones(1))
    np.testing.assert_allclose(posterior.chances([photos]), expected, atol=1e-8)


def test_the_least_rate_is_the_librarys_mean_over_correlations_as_they_weigh():
    shares = {0.02: 0.8, 0.6: 0.2}
    posterior = RatePosterior(np.full(2, 0.5), np.array([*shares]), np.array([*shares.values()]))
    rate, reached = posterior.least_rate(6, (5, 3), TAIL), 0.0
    for correlation, share in shares.items():
        strength = 1 / correlation - 1
        alone = (betabinom.pmf(np.arange(n + 1), n, rate * strength, (1 - rate) * strength) for n in (5, 3))
        chances = np.convolve(*alone)
        reached += share * (chances[6:].sum() - chances[6] / 2)
    assert reached == pytest.approx(TAIL, rel=0.01)  # between rates of a grid


def test_one_session_allows_for_more_than_the_same_photographs_in_many():
    posterior = rate_posterior(drawn(np.random.default_rng(0), 0.8, 0.15, 6, 100), [6] * 100)
    widths = [np.ptp(posterior.count_interval(split_evenly(40, sessions))) for sessions in (1, 2, 4, 8, 40)]
    assert widths == sorted(widths, reverse=True) and widths[0] > 1.5 * widths[-1]
    middle, (low, high) = posterior.correlation
    assert low < 0.15 < high and low < middle < high


@pytest.mark.parametrize("correlation", [0.02, 0.1, 0.3])
def test_intervals_hold_for_new_sessions(correlation):
    """As many sessions as a promise has; of each, one new session and four of ten photographs."""
    rng, inside, within, trials = np.random.default_rng(1), 0, 0, 150
    for rate in rng.beta(2, 1, trials):
        posterior = rate_posterior(drawn(rng, rate, correlation, 6, 100), [6] * 100)
        for photos in ((40,), (10,) * 4):
            low, high = posterior.count_interval(photos)
            inside += low <= sum(drawn(rng, rate, correlation, n, 1)[0] for n in photos) <= high
        within += posterior.rate_interval[0] <= rate <= posterior.rate_interval[1]
    assert 0.93 < inside / (2 * trials) < 0.995 and 0.91 < within / trials < 0.99


def test_the_least_rate_is_wrong_no_more_often_than_it_says():
    rng, posterior = (
        np.random.default_rng(2),
        rate_posterior(drawn(np.random.default_rng(3), 0.85, 0.08, 6, 100), [6] * 100),
    )
    for photos in ((40,), (10,) * 4):
        counts = sum(drawn(rng, 0.65, 0.08, n, 4000) for n in photos)
        wrong = np.mean([posterior.least_rate(int(count), photos, TAIL) > 0.65 for count in counts])
        assert 0.004 < wrong < 0.055
    assert posterior.least_rate(0, (40,), TAIL) < 0.01 and posterior.most_rate(40, (40,), TAIL) > 0.99
    assert posterior.most_rate(10, (40,), TAIL) == pytest.approx(1 - posterior.least_rate(30, (40,), TAIL))


def test_differences_are_wider_where_sessions_differ():
    rng = np.random.default_rng(4)
    good = np.repeat(rng.random(50) < 0.5, 4)  # in half of the sessions the design does it, in the others nothing
    none = np.zeros(200, bool)
    value, (low, high) = session_difference(good, none, 4)
    (_, (near, far)), half = session_difference(good, none, 1), 1.96 * good.std() / 50**0.5
    assert low < near and high > far and value - low == pytest.approx(half, rel=0.1)
    assert session_difference(none, none, 4) == session_difference(none, none, 1)


def test_sessions_are_cut_in_order_and_dealt_evenly():
    assert count_by_session([True, True, False, True, False], 2) == ([2, 1, 0], [2, 2, 1])
    assert split_evenly(11, 4) == (3, 3, 3, 2) and split_evenly(3, 4) == (1, 1, 1, 0)


def test_chances_of_many_photographs_are_computed_in_blocks_that_do_not_grow(monkeypatch):
    few, sizes, transforms = alone(7, 9), [], sessions._transforms
    whole = few.chances((4,) * 30), few.least_rate(70, (4,) * 30, TAIL)
    monkeypatch.setattr(sessions, "_BLOCK_NUMBERS", 1 << 13)
    monkeypatch.setattr(
        sessions, "_transforms", lambda *given: (sizes.append(2 * (t := transforms(*given)).size), t)[1]
    )
    sessions._chances_of.cache_clear()
    sessions._least_rates.cache_clear()
    assert few.chances((4,) * 30) == pytest.approx(whole[0], abs=1e-15)
    assert few.least_rate(70, (4,) * 30, TAIL) == whole[1]
    sessions._least_rates((0.1, 0.2), (0.5, 0.5), (5,) * 100, TAIL)
    assert max(sizes) < 1.1 * (1 << 13)
