"""The difference between photographs of a patch and of a control over sessions: false gains are rare."""

from __future__ import annotations

import numpy as np
import pytest

from patchproof.base.intervals import independent_difference
from patchproof.base.sessions import sessions_difference


def draw(rng, rate, correlation, sessions, first=0):
    strength = 1 / correlation - 1
    rates = rng.beta(rate * strength, (1 - rate) * strength, sessions)
    return {first + i: list(rng.random(10) < each) for i, each in enumerate(rates)}


@pytest.mark.parametrize(("first", "paired"), [(9, False), (0, False), (0, True)])
def test_equal_rates_of_few_sessions_are_rarely_told_apart(first, paired):
    """4 sessions of 10, correlation 0.2: photographs told equal rates apart in 13 % of 1000 trials to either side."""
    rng, found = np.random.default_rng(0), np.zeros(2)
    for _ in range(150):
        a, b = draw(rng, 0.5, 0.2, 4), draw(rng, 0.5, 0.2, 4, first)
        totals = sum(map(sum, a.values())), 40, sum(map(sum, b.values())), 40
        for i, ends in enumerate((sessions_difference(a, b, paired)[1], independent_difference(*totals)[1])):
            found[i] += (ends[0] > 0) + (ends[1] < 0)
    assert found[0] <= 0.07 * 150 < 0.15 * 150 < found[1]  # 3.5 % to either side


def test_more_sessions_tell_what_few_cannot_and_swapping_sides_changes_the_sign():
    gains = []
    for sessions in (2, 4, 12):
        a = {i: [True] * 7 + [False] * 3 for i in range(sessions)}
        b = {100 + i: [True] * 4 + [False] * 6 for i in range(sessions)}
        difference, (low, high) = sessions_difference(a, b)
        swapped, ends = sessions_difference(b, a)
        assert difference == pytest.approx(0.3) == pytest.approx(-swapped)
        assert (low, high) == pytest.approx((-ends[1], -ends[0]), abs=1e-9)
        gains.append(low)
    assert gains == sorted(gains) and gains[0] < 0 < gains[2]


def test_what_sessions_share_cancels_within_them():
    """A dark and a bright place: rates differ by place, the gain does not."""
    a = {0: [True] * 10, 1: [True] * 6 + [False] * 4, 2: [True] * 10, 3: [True] * 6 + [False] * 4}
    b = {0: [True] * 4 + [False] * 6, 1: [False] * 10, 2: [True] * 4 + [False] * 6, 3: [False] * 10}
    other = {9 + key: hits for key, hits in b.items()}
    assert sessions_difference(a, b)[1][0] > sessions_difference(a, other)[1][0]
    assert sessions_difference(a, b)[1][0] > 0
