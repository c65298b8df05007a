"""Promises that stop when they are known well enough: a full promise's views, fewer of them, and no less right."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from patchproof.optimizer.problem import set_problem
from patchproof.optimizer.promise import PER_SESSION, _looks, make_promise
from patchproof.sessions import spread_of
from patchproof.settings import SceneSettings
from patchproof.strict import Refused, validated
from test_optimize import scene_with


@pytest.fixture
def promised(tmp_path):
    """Promises a blue design's rate on up to 40 views in sessions of four; counts are told to `told`."""
    problem = set_problem(scene_with(tmp_path, target__label="blue"))
    blue = np.zeros((*problem.subject.printed_px[::-1], 3), np.uint8)
    blue[..., 2] = 255
    conditions = problem.scene.draw("promise", 40, per_session=PER_SESSION)

    def make(half_width=None, told=None):
        on_views = (lambda *count: None) if told is None else (lambda *count: told.append(count))
        return make_promise(problem, blue, conditions, ("bare",), on_views, PER_SESSION, half_width)

    return make


def test_it_stops_after_half_or_three_quarters_and_else_is_the_full_promise(promised):
    full, told = promised(), []
    half = promised(0.2, told)
    assert half.n == 20 and half.conditions == full.conditions[:20]
    assert np.ptp(half.interval) <= 0.4
    assert told[-1] == (20, 40)
    narrower = np.ptp(half.interval) / 2 - 1e-6
    longer = promised(narrower)
    assert longer.n > 20 and np.ptp(longer.interval) <= 2 * narrower
    assert promised(0.005) == full, "never narrow enough: all views"


def test_the_key_changes_no_sheet_and_has_a_least_value(tmp_path):
    scene = scene_with(tmp_path, promise__half_width=0.3)
    assert scene.settings.promise.half_width == 0.3
    assert scene.sheet_id == scene_with(tmp_path).sheet_id, "what a promise costs is not printed"
    settings = scene.settings.model_dump() | {"promise": {"half_width": 0.004}}
    with pytest.raises(Refused, match="half_width"):
        validated(SceneSettings, settings, "scene")


def held(runs, rate, correlation, looks, half_width=0.05, seed=3):
    """(share of simulated promises of sessions that differ so much whose interval held, views that they took)."""
    rng, right, views = np.random.default_rng(seed), 0, 0
    for _ in range(runs):
        sessions = rng.beta(rate * (1 / correlation - 1), (1 - rate) * (1 / correlation - 1), 100)
        counts = rng.binomial(PER_SESSION, sessions)
        for last in looks:
            low, high = interval(tuple(np.sort(counts[: last // PER_SESSION])))
            if high - low <= 2 * half_width:
                break
        right, views = right + (low <= rate <= high), views + last
    return right / runs, views / runs


def test_stopping_leaves_the_interval_its_level():
    share, views = held(300, 0.9, 0.3, _looks(400, PER_SESSION)[1:])
    assert share >= 0.92 and views < 360


@cache
def interval(counts):
    return spread_of(counts, (PER_SESSION,) * len(counts)).rate


if __name__ == "__main__":  # the figures in `promise._looks`
    cases = (0.5, 0.1, 0.08), (0.7, 0.3, 0.1), (0.9, 0.3, 0.06), (0.95, 0.1, 0.04), (0.97, 0.3, 0.04), (0.98, 0.1, 0.03)
    for rate, correlation, half_width in cases:
        told = [f"rate {rate}, correlation {correlation}, half_width {half_width}:"]
        for looks in ([400], _looks(400, PER_SESSION)[1:], [100, 200, 300, 400]):
            share, views = held(1000, rate, correlation, looks, half_width)
            told.append(f"looks after {looks}: {share:.1%} held, {views:.0f} views;")
        print(*told, flush=True)
