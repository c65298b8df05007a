"""Draws: within their ranges, repeatable, and five streams that share nothing."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import qmc

from patchproof.base.settings import SceneSettings
from patchproof.base.validation import validate_model
from patchproof.scene.conditions import draw, fields_of, scrambled_sobol

SETTINGS = validate_model(
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
    fields = fields_of(draw(SETTINGS, stream, n, seed, start))
    names = ("azimuth_deg", "distance_mm", "exposure_ev", "jpeg")
    return np.stack([*(fields[name] for name in names), fields["background"][:, 2]], 1)


def test_every_value_lies_in_its_range():
    drawn, view = draw(SETTINGS, "promise", 2000, 0), SETTINGS.view
    for values, (low, high) in (
        (drawn.pose.azimuth_deg, view.azimuth_deg),
        (drawn.pose.elevation_deg, view.elevation_deg),
        (drawn.pose.distance_mm, view.distance_mm),
        (drawn.light.ambient, SETTINGS.light.ambient),
        (drawn.sensor.blur_px, SETTINGS.camera.blur_px),
        (drawn.sensor.jpeg, SETTINGS.camera.jpeg),
    ):
        assert low <= values.min() and values.max() <= high
        assert values.min() < low + 0.02 * (high - low) + 1 and values.max() > high - 0.02 * (high - low) - 1
    assert np.abs(drawn.pose.look_at_offset).max() <= view.look_at_jitter
    assert (drawn.sensor.white_balance[:, 1] == 1).all()


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
            noise = set(draw(SETTINGS, stream, 256, seed).sensor.noise_seed.tolist())
            assert not seeds & noise
            seeds |= noise


def test_sobol_covers_a_range_more_evenly_than_independent_draws():
    def unevenness(stream):
        counts = np.histogram(draw(SETTINGS, stream, 256, 0).pose.azimuth_deg, 32, SETTINGS.view.azimuth_deg)[0]
        return counts.std()

    assert unevenness("train") == 0 and unevenness("promise") > 1.5


EVERYTHING = SETTINGS.model_copy(
    update={
        "camera": SETTINGS.camera.model_copy(update={"motion_px": (0.0, 12.0)}),
        "printer": SETTINGS.printer.model_copy(update={"scale": (0.95, 1), "mottle": (0.0, 0.05)}),
    }
)


def test_motion_and_light_fill_their_ranges():
    drawn, light = fields_of(draw(EVERYTHING, "train", 1024, 0)), EVERYTHING.light
    ranges = {"ambient": light.ambient, "light_azimuth_deg": (-90, 90), "light_elevation_deg": (10, 80)}
    for name, (low, high) in (ranges | {"motion_px": EVERYTHING.camera.motion_px, "motion_deg": (0, 180)}).items():
        share = (drawn[name] - low) / (high - low)
        assert 0 <= share.min() < 0.01 and 0.99 < share.max() <= 1, name
        assert (np.histogram(share, 16, (0, 1))[0] == 64).all(), name  # Sobol points: every bin alike
    assert not draw(SETTINGS, "train", 64, 0).sensor.motion_px.any()


def test_terms_that_are_on_leave_the_other_draws_as_they_were():
    on, off = (fields_of(draw(settings, "promise", 50, 3)) for settings in (EVERYTHING, SETTINGS))
    for name in ("azimuth_deg", "ambient", "background", "dot_gain", "veil", "jpeg", "noise_seed"):
        np.testing.assert_array_equal(on[name], off[name])


def test_print_scale_fills_its_range_and_is_off_by_default():
    drawn, off = (draw(settings, "promise", 2000, 0).pose.printed_scale for settings in (EVERYTHING, SETTINGS))
    assert 0.95 <= drawn.min() < 0.951 and 0.999 < drawn.max() <= 1 and (off == 1).all()


def test_no_two_columns_move_together():
    drawn = fields_of(draw(EVERYTHING, "train", 1024, 0))
    names = ("motion_px", "motion_deg", "azimuth_deg", "distance_mm", "ambient", "light_azimuth_deg", "blur_px")
    columns = np.corrcoef([drawn[name] for name in names])
    assert np.abs(columns - np.eye(len(columns))).max() < 0.1


def test_poses_are_kept_while_the_rest_is_drawn_anew():
    poses, new = draw(EVERYTHING, "train", 12, 0), draw(EVERYTHING, "train", 12, 0, start=12)
    kept = replace(new, pose=poses.pose)
    pose = {"azimuth_deg", "elevation_deg", "distance_mm", "roll_deg", "look_at_offset", "background", "printed_scale"}
    kept, *both = (fields_of(conditions) for conditions in (kept, poses, new))
    for name, values in kept.items():
        source, other = both if name in pose else both[::-1]
        np.testing.assert_array_equal(values, source[name])
        assert not np.array_equal(values, other[name]), name
    with pytest.raises(ValueError, match=r"\[3, 12\] rows"):
        replace(new, pose=poses[:3].pose)


@pytest.mark.parametrize("count", [1, 3, 64])
def test_sobol_s_points_are_scipy_s_without_its_import(count, monkeypatch):
    points = scrambled_sobol(count, np.random.default_rng((3, 0)).spawn(1)[0])
    sampler = qmc.Sobol(points.shape[1], rng=np.random.default_rng((3, 0)))  # which spawns a generator of its own
    assert np.array_equal(points, sampler.random_base2(6)[:count])
    monkeypatch.setitem(sys.modules, "scipy.stats", None)
    draw(SETTINGS, "train", count, 0)
