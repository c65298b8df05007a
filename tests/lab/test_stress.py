"""Stress tests: cells, and worst cases on a network whose weakness is known."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from patchlab.paper import stress
from patchlab.paper.stress import OcclusionSettings, WorstCaseSettings, _empty_cells, find_worst_case, measure_occlusion
from patchlab.paper.stress_map import (
    LIGHT_FIELDS,
    MapAxis,
    MapSettings,
    clean_responses,
    map_axes,
    measure_map,
    mesh_cells,
    move_into_cell,
    worst_cells,
)
from patchlab.study.grid import GridSettings
from patchlab.study.record import hits_text
from patchlab.study.study import run_study
from patchproof.base.errors import Refused
from patchproof.base.goal import Goal
from patchproof.base.settings import SceneSettings
from patchproof.base.validation import validate_model
from patchproof.channel.effects import FIELDS
from patchproof.optimizer import loop, run
from patchproof.optimizer.problem import set_problem
from patchproof.optimizer.subject import as_pixels
from patchproof.scene.conditions import fields_of, with_values
from patchproof.scene.scene import build_scene

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
    return set_problem(build_scene(validate_model(SceneSettings, data, "test"), tmp_path))


@pytest.fixture(autouse=True)
def few_views(monkeypatch):
    monkeypatch.setattr(run, "PROMISE_VIEWS", 4)
    monkeypatch.setattr(loop, "SELECT_VIEWS", 4)
    monkeypatch.setattr(loop, "SELECT_AFTER", 4)


def losses_of(problem, conditions):
    return clean_responses(problem, conditions, problem.training_px).loss.mean(0)


def rows_of(conditions, names):
    return np.concatenate([fields_of(conditions)[name].astype(float).reshape(len(conditions), -1) for name in names], 1)


# ----------------------------------------------------------------------------------------------------------- cells


def test_a_cell_moves_pose_and_light_as_far_as_they_lay_in_their_ranges(tmp_path):
    problem = problem_with(tmp_path)
    both = map_axes(problem.scene.settings, MapSettings(light="ambient", pose_cells=3, light_cells=2))
    assert both[0].edges == pytest.approx((-60, -20, 20, 60)) and both[1].edges == pytest.approx((0, 0.3, 0.6))
    drawn = problem.scene.draw("select", 32)
    there = move_into_cell(drawn, both, (2, 0))
    np.testing.assert_allclose(there.pose.azimuth_deg, 20 + (drawn.pose.azimuth_deg + 60) / 3)
    np.testing.assert_allclose(there.light.ambient, drawn.light.ambient / 2)
    others = [name for name in FIELDS if name not in ("azimuth_deg", "ambient")]
    np.testing.assert_array_equal(rows_of(there, others), rows_of(drawn, others))


def test_an_axis_without_a_range_is_refused(tmp_path):
    settings = problem_with(tmp_path, view={"roll_deg": [3, 3]}).scene.settings
    with pytest.raises(Refused, match=r"a range of roll_deg .* got \[3, 3\]"):
        map_axes(settings, MapSettings(pose="roll_deg"))


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
    both = map_axes(problem.scene.settings, MapSettings(light="ambient", pose_cells=2, light_cells=3))
    hits, confidence, alone = measure_map(problem, both, problem.scene.draw("select", 4))
    assert hits.shape == confidence.shape == alone.shape == (2, 3, 4) and not alone.any()
    assert not hits[:, 0].any() and (confidence.mean((0, 2))[1:] > confidence.mean((0, 2))[:-1]).all()
    assert worst_cells(hits, confidence)[0][1] == 0


def test_cells_where_the_object_is_recognized_no_more_often_than_its_background_are_empty(tmp_path):
    """Before black the lit object is bright and the background is not; before white it is, with the object or not."""
    light = {"ambient": [0.0, 4.0], "directional": [0, 0]}
    view = {"azimuth_deg": [-10, 10], "elevation_deg": [0, 5], "distance_mm": [280, 290], "look_at_jitter": 0}
    look, empty = {"view": view, "camera": {"exposure_ev": [0, 0]}}, {}
    for color in (0, 1):
        problem = problem_with(tmp_path, target=BRIGHT, light=light, background={"color": [color] * 3}, **look)
        both = map_axes(problem.scene.settings, MapSettings(light="ambient", pose_cells=1, light_cells=8))
        hits, _, alone = measure_map(problem, both, problem.scene.draw("select", 4))
        assert alone.all() == alone.any() == color
        map_ = {"hits": [[hits_text(cell) for cell in hits[0]]], "alone": [[hits_text(cell) for cell in alone[0]]]}
        empty[color] = _empty_cells(map_)
        assert hits[0, 7].all()
    assert (0, 0) in empty[0] and (0, 7) not in empty[0] and len(empty[1]) == 8


# ------------------------------------------------------------------------------------------ black squares, searches


def test_the_black_square_that_hides_what_the_network_looks_at_is_the_worst(tmp_path):
    problem = problem_with(tmp_path, target=BRIGHT, light={"ambient": [1, 1]}, camera={"exposure_ev": [0, 0]})
    found, picture = measure_occlusion(problem, OcclusionSettings(share=0.5, positions=3, n=8), 0)
    picture = as_pixels(picture)
    assert found["worst"] == [0, 0] and found["worst_again"] == "0" * 8
    # of the other corners none reaches the upper left quarter
    assert found["hits"][2] == found["hits"][6] == found["hits"][8] and "1" in found["hits"][8]
    half = len(picture) // 2
    assert (
        len(found["hits"]) == 9 and (picture[:half, :half] == 0).all() and (picture[half + 3 :, half + 3 :] > 0).any()
    )


def test_the_search_ends_in_the_dark_for_a_network_that_wants_brightness(tmp_path):
    """It begins with the worst of the first draws, never loses ground, and stays within the ranges."""
    problem = problem_with(tmp_path, target=BRIGHT, background={"color": [0, 0, 0]})
    settings = WorstCaseSettings(tries=8, rounds=3, draws=2, n=8)
    best, found = find_worst_case(problem, LIGHT_FIELDS, settings, 0)
    assert found["losses"] == sorted(found["losses"]) and len(found["losses"]) == 3
    condition, ranges = found["condition"], problem.scene.settings.light
    assert set(condition) == {"ambient", "directional", "light_azimuth_deg", "light_elevation_deg", "exposure_ev"}
    assert ranges.ambient[0] <= condition["ambient"] <= 0.2 and ranges.directional[0] <= condition["directional"]
    drawn = problem.scene.draw("select", 2 + 8, 0)
    first = [
        losses_of(problem, with_values(drawn[:2], **{n: fields_of(drawn)[n][i : i + 1] for n in LIGHT_FIELDS})).mean()
        for i in range(2, 10)
    ]
    assert found["losses"][0] == pytest.approx(max(first)) and found["losses"][-1] > max(first)
    assert all(best[name].shape[0] == 1 for name in LIGHT_FIELDS) and found["confidence"] < found["confidence_anywhere"]


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


def test_the_stress_study_leaves_tables_maps_and_a_page_and_cells_twice_alike(tmp_path, monkeypatch):
    toml(tmp_path / "scene.toml")
    (tmp_path / "stress.toml").write_text(STRESS)
    finished = run_study("stress", tmp_path / "stress.toml", tmp_path / "a")
    # the pages of alike cells are alike: toy studies say so
    monkeypatch.setattr(stress, "STUDY", replace(stress.STUDY, figures=lambda settings, results: ()))
    again = run_study("stress", tmp_path / "stress.toml", tmp_path / "b")
    assert not finished.failed and not again.failed
    names = {path.name for path in (tmp_path / "a").iterdir()}
    who = "scene.builtin.0"
    assert {f"stress_{what}_{who}.png" for what in ("map0", "occlusion", "views")} <= names
    assert [row[3] for row in finished.tables[0].rows] == ["worst pose", "worst light", "black square", "map"]
    rates, effects = zip(*((row[9:12], row[12]) for row in finished.tables[1].rows), strict=True)
    assert len(rates) == 4 and all(each.n == 2 for row in rates for each in row)
    assert set(effects) <= {"seen", "no effect"}
    contents = [
        {
            path.name: path.read_bytes()
            for kind in ("*.csv", "cells/*", "files/*")
            for path in (tmp_path / out).glob(kind)
        }
        for out in ("a", "b")
    ]
    assert len(contents[0]) >= 4 and contents[0] == contents[1]


def test_settings_that_will_not_do_are_refused(tmp_path):
    flat = toml(tmp_path / "flat.toml")
    lines = flat.read_text().replace('mesh = "primitive:carton"', 'photos = "p"\nsheet = "s.json"')
    flat.write_text(lines.replace("length_mm = 300\n", "").replace('"texture"', '"patch"'))
    with pytest.raises(Refused, match="scenes with a mesh"):
        mesh_cells(GridSettings(scenes=("flat.toml",)), tmp_path)
    with pytest.raises(Refused, match="different names"):
        validate_model(GridSettings, {"scenes": ["a/s.toml", "b/s.toml"]}, "test")
    assert len(MapAxis("x", (0.0, 1.0, 2.0))) == 2
