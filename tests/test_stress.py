"""Stress tests and mining: cells, worst cases on a network whose weakness is known, and that mining repeats itself."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from scipy.stats import spearmanr

from patchproof.channel.effects import FIELDS
from patchproof.experiments import mining
from patchproof.experiments.hard_views import (
    CANDIDATES,
    LIGHT,
    POSE,
    expected_losses,
    hardest,
    training_conditions,
)
from patchproof.experiments.stress import OcclusionSettings, SearchSettings, occluded, worst_case
from patchproof.experiments.stress_map import (
    Axis,
    MapSettings,
    axes_of,
    clean,
    in_cell,
    map_of,
    mesh_cells,
    worst_cells,
)
from patchproof.goal import Goal
from patchproof.optimizer import loop, run
from patchproof.optimizer.loop import State, steps
from patchproof.optimizer.pixels import as_pixels
from patchproof.optimizer.problem import set_problem
from patchproof.scene.conditions import fields_of, with_values
from patchproof.scene.scene import build_scene
from patchproof.settings import OptimizeSettings, SceneSettings
from patchproof.strict import Refused, validated
from patchproof.study.grid import GridSettings
from patchproof.study.study import run_study

SCENE = {
    "object": {"mesh": "primitive:carton", "length_mm": 300, "up": "y"},
    "patch": {"side": "+z", "width_mm": 60, "height_mm": 60},
    "target": {"label": "carton", "models": ["builtin"]},
    "view": {"azimuth_deg": [-60, 60], "elevation_deg": [0, 40], "distance_mm": [500, 700]},
    "light": {"ambient": [0.0, 0.6], "directional": [0.1, 0.5]},
    "background": {"color": [0.8, 0.8, 0.8]},
    "camera": {"photo_px": [96, 96]},
    "optimize": {"steps": 6, "views": 2},
}
PRINTED = {"kind": "patch", "width_mm": 90, "height_mm": 90}
BRIGHT = {"label": "bright", "models": ["module:fake_networks.bright"]}


def toml(path, **tables):
    lines = []
    for table, values in (SCENE | {name: SCENE[name] | values for name, values in tables.items()}).items():
        lines += [f"[{table}]", *(f"{name} = {json.dumps(value)}" for name, value in values.items())]
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def problem_with(tmp_path, **tables):
    data = SCENE | {name: SCENE[name] | values for name, values in tables.items()}
    return set_problem(build_scene(validated(SceneSettings, data, "test"), tmp_path))


@pytest.fixture(autouse=True)
def few_views(monkeypatch):
    monkeypatch.setattr(run, "PROMISE_VIEWS", 4)
    monkeypatch.setattr(loop, "SELECT_VIEWS", 4)
    monkeypatch.setattr(loop, "SELECT_AFTER", 4)


def losses_of(problem, conditions):
    return clean(problem, conditions, problem.training_px).loss.mean(0)


def rows_of(conditions, names):
    return np.concatenate([fields_of(conditions)[name].astype(float).reshape(len(conditions), -1) for name in names], 1)


# ---------------------------------------------------------------------------------------------------------- mining


def test_without_mining_the_views_are_those_drawn(tmp_path):
    problem = problem_with(tmp_path, patch=PRINTED)
    given, drawn = (list(steps(problem, conditions=views)) for views in (problem.scene.draw("train", 12), None))
    assert torch.equal(given[-1].state.design, drawn[-1].state.design)


def test_mined_views_take_pose_and_light_of_expectedly_bad_draws_and_nothing_else(tmp_path):
    problem = problem_with(tmp_path)
    mined, drawn = training_conditions(problem, 64), problem.scene.draw("train", 12 + 64 + 6 * CANDIDATES)
    assert len(mined) == 12
    names = POSE + LIGHT
    others = [name for name in FIELDS if name not in names]
    np.testing.assert_array_equal(rows_of(mined, others), rows_of(drawn[:12], others))
    np.testing.assert_array_equal(rows_of(mined, names)[::2], rows_of(drawn[:12], names)[::2])
    fresh, tried = drawn[76:], drawn[12:76]  # the worst of each eight draws that no try has used
    expected = expected_losses(tried, losses_of(problem, tried), fresh).reshape(6, CANDIDATES)
    groups = zip(rows_of(mined, names)[1::2], rows_of(fresh, names).reshape(6, CANDIDATES, -1), expected, strict=True)
    for row, group, losses in groups:
        assert (row == group).all(1).nonzero()[0].tolist() == [losses.argmax()]


def test_the_fit_finds_what_is_hard_and_ignores_what_does_not_vary(tmp_path):
    """Losses that rise with darkness and away from one azimuth, with noise: the expected order, by rank correlation."""
    problem = problem_with(tmp_path, view={"azimuth_deg": [-180, 180]}, light={"ambient": [0.1, 0.9]})
    drawn = problem.scene.draw("train", 400)
    truth = 2 * (1 - drawn.light.ambient) - np.cos(np.radians(drawn.pose.azimuth_deg - 40))
    noisy = truth + np.random.default_rng(0).normal(0, 0.5, 400)
    expected = expected_losses(drawn[:128], noisy[:128], drawn[128:])
    assert spearmanr(expected, truth[128:]).statistic > 0.9
    assert truth[128:][hardest(expected)].mean() > np.quantile(truth[128:], 0.8)
    alike = expected_losses(drawn[:128], np.full(128, 3.0), drawn[128:])
    np.testing.assert_allclose(alike, 3)


def test_views_from_behind_a_patch_are_not_mined(tmp_path):
    """The object fails there, too, but the patch cannot be seen; where too few are not, nothing is mined."""
    around = problem_with(tmp_path, view={"azimuth_deg": [-180, 180]})
    mined, drawn = training_conditions(around, 16), around.scene.draw("train", 12)
    changed = mined.pose.azimuth_deg != drawn.pose.azimuth_deg
    assert changed.any() and (np.abs(around.scene.piece_azimuth_deg(mined))[changed] < 90).all()
    too_few = training_conditions(around, 1)  # to fit anything to
    np.testing.assert_array_equal(too_few.pose.azimuth_deg, drawn.pose.azimuth_deg)


def test_the_worst_of_every_eight_by_hand():
    assert hardest(np.array([0, 1, 9, 3, 4, 5, 6, 7, 2, 2, 1, 0, 0, 0, 0, 0, 5.0])).tolist() == [2, 8]  # one is left


def test_a_step_of_mined_training_depends_on_state_and_number_alone(tmp_path):
    first, second = (problem_with(tmp_path, patch=PRINTED) for _ in range(2))
    whole = list(steps(first, conditions=training_conditions(first, 8)))
    middle: State = whole[2].state
    again = list(steps(second, middle, training_conditions(second, 8)))
    assert [step.state.number for step in again] == [4, 5, 6]
    assert torch.equal(again[-1].state.design, whole[-1].state.design) and again[-1].loss == whole[-1].loss
    plain = list(steps(problem_with(tmp_path, patch=PRINTED)))
    assert not torch.equal(plain[-1].state.design, whole[-1].state.design)


def test_equal_cost_by_hand(monkeypatch):
    monkeypatch.setattr(loop, "SELECT_AFTER", 80)
    monkeypatch.setattr(loop, "SELECT_VIEWS", 64)
    plain = OptimizeSettings(steps=40, views=8)
    # 40 · 8 views, and 4 selections of 64 views forward only
    assert mining.passes(plain) == pytest.approx(320 + 256 / 3)
    # 192 tries cost 64 passes, which are 8 steps of 8 views
    assert mining.equal_steps(plain, 192) == 32 and mining.equal_steps(plain, 193) == 31
    assert mining.passes(plain.changed(steps=32), 192) == mining.passes(plain)
    # one step's worth of tries from the last training that can pay for them
    two = OptimizeSettings(steps=2, views=4)
    assert mining.equal_steps(two, 12) == 1
    with pytest.raises(Refused, match="raise steps or lower mine"):
        mining.equal_steps(two, 13)


# ----------------------------------------------------------------------------------------------------------- cells


def test_a_cell_moves_pose_and_light_as_far_as_they_lay_in_their_ranges(tmp_path):
    problem = problem_with(tmp_path)
    both = axes_of(problem.scene.settings, MapSettings(light="ambient", pose_cells=3, light_cells=2))
    assert both[0].edges == pytest.approx((-60, -20, 20, 60)) and both[1].edges == pytest.approx((0, 0.3, 0.6))
    drawn = problem.scene.draw("select", 32)
    there = in_cell(drawn, both, (2, 0))
    np.testing.assert_allclose(there.pose.azimuth_deg, 20 + (drawn.pose.azimuth_deg + 60) / 3)
    np.testing.assert_allclose(there.light.ambient, drawn.light.ambient / 2)
    others = [name for name in FIELDS if name not in ("azimuth_deg", "ambient")]
    np.testing.assert_array_equal(rows_of(there, others), rows_of(drawn, others))


def test_an_axis_without_a_range_is_refused(tmp_path):
    settings = problem_with(tmp_path, view={"roll_deg": [3, 3]}).scene.settings
    with pytest.raises(Refused, match=r"a range of roll_deg .* got \[3, 3\]"):
        axes_of(settings, MapSettings(pose="roll_deg"))


def test_the_worst_tenth_by_hand():
    hits = np.ones((4, 5, 2), bool)
    hits[1, 2] = hits[3, 0] = False
    hits[2, 2, 0] = False
    sure = np.full((4, 5, 2), 0.5)
    sure[3, 0] = 0.1
    assert worst_cells(hits, sure) == [(3, 0), (1, 2)]  # equal rates: the less sure one first
    assert (1, 2) not in worst_cells(hits, sure, goal=Goal.deceive)
    assert worst_cells(hits[:1, :1], sure[:1, :1]) == [(0, 0)]
    assert len(worst_cells(np.ones((3, 7, 1), bool), np.ones((3, 7, 1)))) == 3  # a tenth of 21, rounded up


def test_a_map_shows_where_light_fails(tmp_path):
    """A network that wants brightness, no background: without light nothing, with light everything."""
    dark = {"background": {"color": [0, 0, 0]}, "view": {"distance_mm": [330, 340], "look_at_jitter": 0}}
    light = {"ambient": [0.0, 1.2], "directional": [0, 0]}
    problem = problem_with(tmp_path, target=BRIGHT, light=light, camera={"exposure_ev": [0, 0]}, **dark)
    both = axes_of(problem.scene.settings, MapSettings(light="ambient", pose_cells=2, light_cells=3))
    hits, confidence = map_of(problem, both, problem.scene.draw("select", 8))
    assert hits.shape == confidence.shape == (2, 3, 8)
    assert not hits[:, 0].any() and (confidence.mean((0, 2))[1:] > confidence.mean((0, 2))[:-1]).all()
    assert worst_cells(hits, confidence)[0][1] == 0


# ------------------------------------------------------------------------------------------ black squares, searches


def test_the_black_square_that_hides_what_the_network_looks_at_is_the_worst(tmp_path):
    problem = problem_with(tmp_path, target=BRIGHT, light={"ambient": [1, 1]}, camera={"exposure_ev": [0, 0]})
    found, picture = occluded(problem, OcclusionSettings(share=0.5, positions=3, n=8), 0)
    picture = as_pixels(picture)
    assert found["worst"] == [0, 0] and found["worst_again"] == "0" * 8
    # of the other corners none reaches the upper left quarter
    assert found["hits"][2] == found["hits"][6] == found["hits"][8] and "1" in found["hits"][8]
    assert len(found["hits"]) == 9 and (picture[:48, :48] == 0).all() and (picture[60:, 60:] > 0).any()


def test_the_search_ends_in_the_dark_for_a_network_that_wants_brightness(tmp_path):
    """It begins with the worst of the first draws, never loses ground, and stays within the ranges."""
    problem = problem_with(tmp_path, target=BRIGHT, background={"color": [0, 0, 0]})
    settings = SearchSettings(tries=8, rounds=3, draws=2, n=8)
    best, found = worst_case(problem, LIGHT, settings, 0)
    assert found["losses"] == sorted(found["losses"]) and len(found["losses"]) == 3
    condition, ranges = found["condition"], problem.scene.settings.light
    assert set(condition) == {"ambient", "directional", "light_azimuth_deg", "light_elevation_deg", "exposure_ev"}
    assert ranges.ambient[0] <= condition["ambient"] <= 0.2 and ranges.directional[0] <= condition["directional"]
    drawn = problem.scene.draw("select", 2 + 8, 0)
    first = [
        losses_of(problem, with_values(drawn[:2], **{n: fields_of(drawn)[n][i : i + 1] for n in LIGHT})).mean()
        for i in range(2, 10)
    ]
    assert found["losses"][0] == pytest.approx(max(first)) and found["losses"][-1] > max(first)
    assert all(best[name].shape[0] == 1 for name in LIGHT) and found["confidence"] < found["confidence_anywhere"]


# ---------------------------------------------------------------------------------------------------- whole studies

STRESS = """
scenes = ["scene.toml"]
[[maps]]
pose_cells = 2
light_cells = 2
n = 2
[occlusion]
positions = 2
n = 2
[search]
tries = 2
rounds = 2
draws = 1
n = 4
"""
MINING = """
scenes = ["scene.toml"]
networks = ["builtin"]
mine = 4
n = 3
n_all = 4
map = {pose_cells = 2, light_cells = 2, n = 2}
"""


def test_the_stress_study_leaves_tables_maps_and_a_page_twice_alike(tmp_path):
    toml(tmp_path / "scene.toml")
    (tmp_path / "stress.toml").write_text(STRESS)
    for out in ("a", "b"):
        finished = run_study("stress", tmp_path / "stress.toml", tmp_path / out)
        assert not finished.failed
    names = {path.name for path in (tmp_path / "a").iterdir()}
    who = "scene.builtin.0"
    assert {f"stress_{what}_{who}.png" for what in ("map0", "occlusion", "views")} <= names
    assert [row[3] for row in finished.tables[0].rows] == ["worst pose", "worst light", "black square", "map"]
    assert len(finished.tables[1].rows) == 4 and all(row[-2].n == 2 for row in finished.tables[1].rows)
    for name in ("stress_worst.csv", "stress_maps.csv", "stress.html", "stress.json"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_the_mining_study_compares_at_equal_cost_on_the_same_conditions(tmp_path, monkeypatch):
    toml(tmp_path / "scene.toml", patch=PRINTED)
    (tmp_path / "mining.toml").write_text(MINING)
    finished = run_study("mining", tmp_path / "mining.toml", tmp_path / "out")
    assert not finished.failed
    worst = dict(zip(finished.tables[0].head, finished.tables[0].rows[0], strict=True))
    assert worst["steps"] == 6 and worst["steps mined"] == 5 and worst["passes mined"] <= worst["passes"]
    assert worst["clean"].n == worst["mined"].n == worst["mined - not mined"].n == 3
    assert finished.tables[1].rows[0][-1].n == 4 and finished.tables[2].rows[0][:3] == ("scene", "builtin", 1)


def test_settings_that_will_not_do_are_refused(tmp_path):
    flat = toml(tmp_path / "flat.toml")
    lines = flat.read_text().replace('mesh = "primitive:carton"', 'photos = "p"\nsheet = "s.json"')
    flat.write_text(lines.replace("length_mm = 300\n", "").replace('"texture"', '"patch"'))
    with pytest.raises(Refused, match="scenes with a mesh"):
        mesh_cells(GridSettings(scenes=("flat.toml",)), tmp_path)
    with pytest.raises(Refused, match="different names"):
        validated(GridSettings, {"scenes": ["a/s.toml", "b/s.toml"]}, "test")
    assert len(Axis("x", (0.0, 1.0, 2.0))) == 2
