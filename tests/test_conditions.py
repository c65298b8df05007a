"""Draws: within their ranges, repeatable, and five streams that share nothing."""

from __future__ import annotations

import numpy as np
import pytest

from patchproof.scene.conditions import draw
from patchproof.settings import SceneSettings, validated

SETTINGS = validated(
    SceneSettings,
    {
        "object": {"mesh": "primitive:carton", "length_mm": 300},
        "patch": {"width_mm": 50, "height_mm": 50},
        "target": {"label": "carton", "models": ["builtin"]},
    },
    "test",
)
STREAMS = ("train", "select", "promise", "reprint", "evaluate")


def rows(stream, n=256, seed=0, start=0):
    drawn = draw(SETTINGS, stream, n, seed, start)
    return np.stack([drawn.azimuth_deg, drawn.distance_mm, drawn.exposure_ev, drawn.jpeg, drawn.background[:, 2]], 1)


def test_every_value_lies_in_its_range():
    drawn, view = draw(SETTINGS, "promise", 2000, 0), SETTINGS.view
    for values, (low, high) in (
        (drawn.azimuth_deg, view.azimuth_deg),
        (drawn.elevation_deg, view.elevation_deg),
        (drawn.distance_mm, view.distance_mm),
        (drawn.ambient, SETTINGS.light.ambient),
        (drawn.blur_px, SETTINGS.camera.blur_px),
        (drawn.jpeg, SETTINGS.camera.jpeg),
    ):
        assert low <= values.min() and values.max() <= high
        assert values.min() < low + 0.02 * (high - low) + 1 and values.max() > high - 0.02 * (high - low) - 1
    assert np.abs(drawn.look_at_offset).max() <= view.look_at_jitter
    assert (drawn.white_balance[:, 1] == 1).all()


@pytest.mark.parametrize("stream", STREAMS)
def test_a_draw_depends_on_its_index_alone(stream):
    np.testing.assert_array_equal(rows(stream, 40), rows(stream, 100)[:40])
    np.testing.assert_array_equal(rows(stream, 15, start=25), rows(stream, 40)[25:])
    assert not np.array_equal(rows(stream), rows(stream, seed=1))


def test_streams_share_nothing():
    seen: set[tuple] = set()
    seeds = set()
    for stream in STREAMS:
        for seed in range(3):
            new = {tuple(row) for row in rows(stream, seed=seed)}
            assert not seen & new
            seen |= new
            noise = set(draw(SETTINGS, stream, 256, seed).noise_seed.tolist())
            assert not seeds & noise
            seeds |= noise


def test_sobol_covers_a_range_more_evenly_than_independent_draws():
    def unevenness(stream):
        counts = np.histogram(draw(SETTINGS, stream, 256, 0).azimuth_deg, 32, SETTINGS.view.azimuth_deg)[0]
        return counts.std()

    assert unevenness("train") == 0 and unevenness("promise") > 1.5
