"""The shot plan against simulation by the judge's own comparison, and where no number of photographs is enough."""

from __future__ import annotations

import re

import numpy as np
import pytest

from patchproof.base.goal import LEAST_GAIN
from patchproof.base.sessions import sessions_difference
from patchproof.base.settings import SceneSettings
from patchproof.evidence.verdict import (
    MIN_KEPT_CHANCE,
    PHOTOS_PER_SESSION,
    kept_chance,
    provable_gain,
    sessions_needed,
    sessions_to_show,
)
from patchproof.reprints.run_sheet import shot_sections
from test_verify_verdict import promise_of

SETTINGS = SceneSettings.model_validate(
    {
        "object": {"mesh": "primitive:mug", "length_mm": 100},
        "patch": {"width_mm": 50, "height_mm": 50},
        "target": {"label": "mug", "models": ["builtin"]},
    }
)


@pytest.mark.parametrize(("sessions", "photos", "correlation"), [(12, 4, 0.1), (6, 10, 0.02)])
def test_a_provable_gain_is_found_by_the_judge_s_own_comparison(sessions, photos, correlation):
    promise = promise_of(0.85, 0.2, correlation=correlation)
    gain, strength = provable_gain(promise, sessions, photos), 1 / promise.posterior.correlation[0] - 1
    rng, found, trials = np.random.default_rng(0), 0, 60
    for _ in range(trials):
        a, b = (
            dict(enumerate(rng.random((sessions, photos)) < rng.beta(r * strength, (1 - r) * strength, (sessions, 1))))
            for r in (promise.rate, promise.rate - gain)
        )
        found += sessions_difference(a, b)[1][0] > 0
    assert 0.65 <= found / trials <= 0.98  # 80 % are meant, three standard errors of 60 trials are 15 points


def test_a_page_says_before_it_is_printed_that_its_promise_asks_for_nothing():
    asks_nothing, asks = promise_of(0.15, 0.0), promise_of(0.85, 0.2)
    said = [" ".join(shot_sections(promise, SETTINGS)[0][1]) for promise in (asks_nothing, asks)]
    assert ["asks for nothing: any photographs keep it" in text for text in said] == [True, False]


def test_the_plan_s_sessions_are_enough_and_one_less_is_not():
    promise = promise_of(0.85, 0.2, correlation=0.1)
    sessions = sessions_needed(promise)
    assert (
        kept_chance(promise, (PHOTOS_PER_SESSION,) * sessions)
        >= MIN_KEPT_CHANCE
        > kept_chance(promise, (PHOTOS_PER_SESSION,) * (sessions - 1))
    )
    assert sessions_needed(promise_of(0.3, 0.28, correlation=0.2)) is None
    said = " ".join(shot_sections(promise, SETTINGS)[0][1])
    assert re.search(r"40 in 1 place: \d+ to \d+ \(\d+%; no gain\); .* 80 in 8 places: \d+ to \d+ \(\d+%; \d+%\)", said)
    assert f"10 of the bare object in each of {max(sessions, sessions_to_show(promise))} places" in said


def test_more_places_show_smaller_gains_and_one_place_or_a_small_gain_shows_none():
    promise = promise_of(0.85, 0.2, correlation=0.1)
    assert provable_gain(promise, 1, 40) is None
    gains = [provable_gain(promise, sessions, 10) for sessions in (4, 8, 15)]
    assert gains == sorted(gains, reverse=True) and gains[-1] > LEAST_GAIN  # which is why less is not worth having
    assert sessions_to_show(promise) <= 4 and sessions_to_show(promise_of(0.5, 0.5)) is None
    assert sessions_to_show(promise_of(0.1, 0.8, goal="deceive")) <= 4
    said = shot_sections(promise_of(0.5, 0.5), SETTINGS)[0][1]
    assert (
        said[-2].startswith("Even 150 photographs are unlikely to show that it helps")
        and "Take at least" not in said[-2]
    )
