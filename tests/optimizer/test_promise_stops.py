"""Promises that stop when they are known well enough: a full promise's views, fewer of them, and no less right."""

from __future__ import annotations

from functools import cache
from itertools import product

import numpy as np
import pytest

from patchproof.base.errors import Refused
from patchproof.base.intervals import student_mean
from patchproof.base.sessions import rate_posterior, session_difference
from patchproof.base.settings import SceneSettings
from patchproof.base.validation import validate_model
from patchproof.evidence.verdict import MOST_PHOTOS, PHOTOS_PER_SESSION, sessions_needed
from patchproof.optimizer import promise, run
from patchproof.optimizer.problem import set_problem
from patchproof.optimizer.promise import (
    CONTROL_VIEWS,
    SETTLED,
    VIEWS_PER_SESSION,
    PromiseOptions,
    _look_positions,
    control_claims,
    make_promise,
)
from patchproof.optimizer.promise_again import promise_run
from patchproof.optimizer.responses import Responses
from test_optimize import scene_with
from test_verify_verdict import promise_of


@pytest.fixture
def promised(tmp_path):
    """Promises a blue design's rate on up to 40 views in sessions of four; counts are told to `told`."""
    problem = set_problem(
        scene_with(tmp_path, target__label="blue", printer__profile="coated", printer__veil=[0, 0], camera__tone=[0, 0])
    )
    blue = np.zeros((*problem.subject.printed_px[::-1], 3), np.uint8)
    blue[..., 2] = 255
    conditions = problem.scene.draw("promise", 40, per_session=VIEWS_PER_SESSION)

    def make(half_width=None, told=None):
        advance = (lambda *count: None) if told is None else (lambda *count: told.append(count))
        return make_promise(problem, blue, conditions, ("bare",), advance, VIEWS_PER_SESSION, half_width)

    return make


def test_it_stops_after_half_or_three_quarters_and_else_is_the_full_promise(promised):
    full, told = promised(), []
    half = promised(0.2, told)
    assert half.n == 20 and half.conditions == full.conditions[:20]
    assert np.ptp(half.interval) <= 0.4
    assert told[-2:] == [(20, 40), (20, 20)]
    narrower = np.ptp(half.interval) / 2 - 1e-6
    longer = promised(narrower)
    assert longer.n > 20 and np.ptp(longer.interval) <= 2 * narrower
    never = promised(0.005)
    assert (never.n, never.conditions, never.interval) == (40, full.conditions, full.interval)


def test_a_control_is_left_out_once_it_is_known_to_differ(promised, monkeypatch):
    full = promised()
    assert full.controls["bare"].n == 20 and full.controls["bare"].difference > 0.5
    early = promised(0.005)
    assert early.controls["bare"].n == 10, "known after half of the views"
    assert early.controls["bare"] == promised(0.3).controls["bare"]
    assert early.headline.startswith("helps: ") and early.best_control == "bare"
    monkeypatch.setattr(promise, "SETTLED", 1e9)
    assert promised(0.005) == full, "never known well enough"
    half = promised(0.2)
    known = np.ptp(half.interval) / 2 + 1e-6
    assert half.n == 20 and np.ptp(half.controls["bare"].difference_interval) / 2 > known
    assert promised(known).n > 20, "the rate is known, but not the control"


def test_a_control_that_was_left_out_is_compared_where_both_were_shown():
    design, control = (np.array([hits], bool) for hits in ([1, 1, 0, 0], [0, 1]))
    answers = {kind: Responses(hits, 1.0 * hits, 0.0 * hits) for kind, hits in (("design", design), ("bare", control))}
    claim = control_claims(answers, 0)["bare"]
    assert (claim.n, claim.rate, claim.difference) == (2, 0.5, 0.5)


def test_a_scene_asks_for_a_half_width_and_a_number_of_views_for_all_of_them(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "PROMISE_VIEWS", 40)
    small = {"optimize__steps": 1, "optimize__views": 1}
    scene = scene_with(tmp_path, promise__half_width=0.3, **small)
    assert SceneSettings.model_fields["promise"].default.half_width == 0.04
    whole = run.optimize(scene, tmp_path / "run", promise=PromiseOptions(controls=("bare",)))
    assert whole.promise.n == 20 and not whole.promise.draft
    assert promise_run(tmp_path / "run", views=40, trust=True).promise.n == 40
    assert promise_run(tmp_path / "run", trust=True).promise == whole.promise


def test_the_key_changes_no_sheet_and_has_a_least_value(tmp_path):
    scene = scene_with(tmp_path, promise__half_width=0.3)
    assert scene.settings.promise.half_width == 0.3
    assert scene.sheet_id == scene_with(tmp_path).sheet_id, "what a promise costs is not printed"
    settings = scene.settings.model_dump() | {"promise": {"half_width": 0.004}}
    with pytest.raises(Refused, match="half_width"):
        validate_model(SceneSettings, settings, "scene")


def held(runs, rate, correlation, looks, half_width=0.05, seed=3):
    """(share of simulated promises of sessions that differ so much whose interval held, views that they took)."""
    rng, right, views = np.random.default_rng(seed), 0, 0
    for _ in range(runs):
        sessions = rng.beta(rate * (1 / correlation - 1), (1 - rate) * (1 / correlation - 1), 100)
        counts = rng.binomial(VIEWS_PER_SESSION, sessions)
        for last in looks:
            low, high = interval(tuple(np.sort(counts[: last // VIEWS_PER_SESSION])))
            if high - low <= 2 * half_width:
                break
        right, views = right + (low <= rate <= high), views + last
    return right / runs, views / runs


def test_stopping_leaves_the_interval_its_level():
    share, views = held(120, 0.9, 0.3, _look_positions(400, VIEWS_PER_SESSION)[1:])
    assert share >= 0.92 and views < 360


def told_apart(runs, gain, correlation, looks, rate=0.8, seed=3):
    """(share of simulated differences whose interval held, share that it told from none, sessions that they took) of
    a control whose rate is `gain` less, where sessions differ so much for both.
    """
    rng, right, other, sessions = np.random.default_rng(seed), 0, 0, 0
    for _ in range(runs):
        own = rng.beta(rate * (1 / correlation - 1), (1 - rate) * (1 / correlation - 1), 100)
        worse = own * (rate - gain) / rate
        design, control = (rng.random((100, CONTROL_VIEWS)) < each[:, None] for each in (own, worse))
        for last in looks:
            so_far = design[:last].ravel(), control[:last].ravel()
            difference, (low, high) = session_difference(*so_far, CONTROL_VIEWS)
            if abs(difference) >= SETTLED * (high - low) / 2:
                break
        right, other, sessions = right + (low <= gain <= high), other + (low > 0 or high < 0), sessions + last
    return right / runs, other / runs, sessions / runs


def places_asked(rate, correlation, control, half_width=0.04, runs=30):
    """(places that photographs need by stopped promises and by full ones of the same sessions) of each run."""
    rng, asked = np.random.default_rng(1), []
    like = promise_of(rate, control)
    for _ in range(runs):
        sessions = rng.beta(rate * (1 / correlation - 1), (1 - rate) * (1 / correlation - 1), 100)
        counts = rng.binomial(VIEWS_PER_SESSION, sessions)
        last = next(n for n in LOOKS if np.ptp(interval(tuple(np.sort(counts[:n])))) <= 2 * half_width or n == 100)
        pair = []
        for some in (counts[:last], counts):
            hits = (np.arange(VIEWS_PER_SESSION) < some[:, None]).ravel()
            rows = [like.conditions[0].changed(recognized=bool(hit)) for hit in hits]
            made = like.changed(n=len(hits), rate=hits.mean(), per_session=VIEWS_PER_SESSION, conditions=rows)
            pair.append(sessions_needed(made) or MOST_PHOTOS // PHOTOS_PER_SESSION + 1)
        asked.append(pair)
    return np.array(asked)


LOOKS = [50, 75, 100]


def test_leaving_controls_out_leaves_their_difference_its_level():
    assert told_apart(200, 0, 0.2, LOOKS)[1] <= 0.08, "no difference is not told for one more often"
    share, _, sessions = told_apart(200, 0.15, 0.2, LOOKS)
    assert share >= 0.92 and sessions < 100
    assert told_apart(40, 0.5, 0.2, LOOKS)[2] == 50


@cache
def interval(counts):
    return rate_posterior(counts, (VIEWS_PER_SESSION,) * len(counts)).rate_interval


if __name__ == "__main__":  # the figures beside `promise._looks`
    cases = (0.85, 0.1), (0.9, 0.3), (0.92, 0.1), (0.95, 0.1), (0.95, 0.3), (0.97, 0.3), (0.98, 0.1), (0.99, 0.05)
    for rate, correlation in cases:
        told = [f"rate {rate}, correlation {correlation}:"]
        for looks in ([400], _look_positions(400, VIEWS_PER_SESSION)[1:], [160, 240, 320, 400]):
            share, views = held(1000, rate, correlation, looks, 0.04)
            told.append(f"looks after {looks}: {share:.1%} held, {views:.0f} views;")
        print(*told, flush=True)
    for rate, gain in product((0.8, 0.95), (0, 0.05, 0.1, 0.15, 0.3)):  # those beside `promise.SETTLED`
        told = [f"rate {rate}, gain {gain}:"]
        for looks in ([100], LOOKS):
            share, other, sessions = told_apart(1000 if gain else 3000, gain, 0.2, looks, rate)
            told.append(f"looks after {looks}: {share:.1%} held, {other:.1%} told, {sessions:.0f} sessions;")
        print(*told, flush=True)
    for rate, control in ((0.98, 0.45), (0.97, 0.87), (0.95, 0.5), (0.92, 0.6)):
        stopped, full = places_asked(rate, 0.1, control).T
        more = student_mean(stopped - full)
        told = f"{stopped.mean():.1f} places in place of {full.mean():.1f}, more in {(stopped > full).sum()} of 30,"
        print(
            f"rate {rate}, control {control}: {told} by {more.value:.1f} [{more.low:.1f}, {more.high:.1f}]", flush=True
        )
