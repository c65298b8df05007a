"""Promises against photographs: the shares by hand, and one cell from scene to verdict."""

import json
from pathlib import Path

import pytest

from patchproof.claims import prediction_interval
from patchproof.optimizer import loop, run
from patchproof.study.study import Cell, Result, run_study
from patchproof.validation import promises
from test_optimize import SCENE


def count(rate, recognized, judged=40, n=400):
    return {"rate": rate, "n": n, "judged": judged, "recognized": recognized, "verdict": "kept"}


def result(scene, one):
    values = {
        "name": scene,
        "networks": ["builtin"],
        "network": "builtin",
        "scene": {"printer": {"profile": "coated"}},
        "seed": 0,
    }
    return Result(Cell(f"{scene}{one['recognized']}", values), one, Path())


def test_an_interval_holds_up_to_its_ends_and_not_beyond():
    low, high = prediction_interval(320, 400, 40)
    assert [promises.held(count(0.8, hits)) for hits in (low - 1, low, high, high + 1)] == [False, True, True, False]
    assert promises.interval_of(count(0.8, 0)) == (low, high)


def test_shares_and_biases_by_hand():
    settings = promises.PromisesSettings(scenes=("a", "b"), networks=("builtin",))
    low = [result("a", count(0.8, hits)) for hits in (20, 21, 22)]  # promised too much
    fair = [result("b", count(0.8, hits)) for hits in (31, 32, 33)]
    held, each = promises.tables(settings, low + fair)
    assert [(row[0], row[1].value, row[1].n) for row in held.rows] == [("a", 0, 3), ("b", 1, 3), ("all", 0.5, 6)]
    assert held.rows[0][3].value == pytest.approx(21 / 40 - 0.8)
    assert len(each.rows) == 6


def test_a_cell_goes_from_the_scene_to_the_count(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "PROMISE_VIEWS", 16)
    monkeypatch.setattr(loop, "SELECT_VIEWS", 4)
    data = {key: dict(value) for key, value in SCENE.items()} | {"camera": {"photo_px": [480, 360]}}
    data["optimize"] |= {"steps": 2}
    lines = [
        line
        for table, values in data.items()
        for line in (f"[{table}]", *(f"{key} = {json.dumps(value)}" for key, value in values.items()))
    ]
    (tmp_path / "scene.toml").write_text("\n".join(lines), encoding="utf-8")
    names = 'scenes = ["scene.toml"]\nnetworks = ["module:fake_networks.red_against_blue"]\nprinters = ["uncoated"]\n'
    (tmp_path / "study.toml").write_text(names + "photos = 10\npath_traced = false\n")
    finished = run_study("promises", tmp_path / "study.toml", tmp_path / "out")
    assert not finished.failed
    (one,) = finished.results
    assert (
        one.answers["n"] == 16
        and one.answers["judged"] <= 10
        and 0 <= one.answers["recognized"] <= one.answers["judged"]
    )
    assert (tmp_path / "out" / "promises_calibration.png").is_file() or not one.answers["judged"]
