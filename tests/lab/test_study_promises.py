"""Promises against photographs: the shares by hand, and one cell from scene to verdict."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from patchlab.study.study import Cell, Result, run_study
from patchlab.validation import promises
from patchproof.base.errors import Refused
from patchproof.base.sessions import rate_posterior
from patchproof.optimizer import loop, run
from patchproof.optimizer.promise import VIEWS_PER_SESSION
from test_optimize import SCENE
from undrawn import draw_nothing


def result(scene, *sessions, hits=320, n=400):
    """A run whose promise drew every condition anew."""
    values = {
        "name": scene,
        "networks": ["builtin"],
        "network": "builtin",
        "scene": {"printer": {"profile": "coated"}},
        "seed": 0,
    }
    found = {"promised": "1" * hits + "0" * (n - hits), "per_session": 1, "places": []}
    found |= {
        "gain": ("bare", 0.5, {"value": 0.3, "low": 0.2, "high": 0.4, "n": 100}),
        "sessions": sessions,
        "verdict": "kept",
        "elsewhere": "1" * 79 + "0" * 21,
        "rendered": sessions,
    }
    return Result(Cell(f"{scene}{sessions}", values), found, Path())


def test_an_interval_holds_up_to_its_ends_and_not_beyond():
    low, high = rate_posterior([1] * 320 + [0] * 80, [1] * 400).count_interval([40])
    sessions = promises.count_sessions(result("a", *((hits, 40) for hits in (low - 1, low, high, high + 1)), (0, 0)))
    assert [session.held() for session in sessions] == [False, True, True, False]
    assert sessions[0].interval() == (low, high) == sessions[0].interval(independent=True)


def test_shares_and_biases_by_hand():
    settings = promises.PromisesSettings(scenes=("a", "b"), networks=("builtin",))
    low = [result("a", (20, 40), (21, 40)), result("a", (22, 40))]  # promised too much
    fair = [result("b", *((hits, 40) for hits in (31, 32, 33)))]
    held, gains, each = promises.tables(settings, low + fair)
    assert gains.rows[0][3:6] == (0.8, "bare", 0.5) and gains.rows[0][6].low == 0.2
    assert [(row[0], row[1].value, row[1].n) for row in held.rows] == [("a", 0, 3), ("b", 1, 3), ("all", 0.5, 6)]
    assert held.rows[0][6].value == pytest.approx((20.5 + 22) / 80 - 0.8) and held.rows[0][3] is None
    assert len(each.rows) == 6
    many = promises.tables(settings, [result("a", *((20 + i % 20, 40) for i in range(40)))])[0]
    assert many.rows[0][3] == pytest.approx(19 / 40, abs=0.01)
    settings = settings.model_copy(update={"elsewhere": 100, "rendered": 1})
    of_photos, of_views, elsewhere, *_ = promises.tables(
        settings, [result("a", (20, 40)), result("a", (20, 40), hits=280)]
    )
    assert of_photos.rows == of_views.rows
    assert [(row[6].value, row[7]) for row in elsewhere.rows] == [(0.79, True), (0.79, False)]


def small_study(study, tmp_path, monkeypatch, sessions, more=""):
    """A finished study of that name: one cell, sessions of five photographs by our own renderer."""
    monkeypatch.setattr(run, "PROMISE_VIEWS", 8)
    monkeypatch.setattr(loop, "SELECT_VIEWS", 4)
    data = {key: dict(value) for key, value in SCENE.items()} | {"camera": {"photo_px": [440, 330]}}
    data |= {"background": {"color": [0.5, 0.5, 0.5]}, "optimize": data["optimize"] | {"steps": 2, "views": 2}}
    lines = [
        line
        for table, values in data.items()
        for line in (f"[{table}]", *(f"{key} = {json.dumps(value)}" for key, value in values.items()))
    ]
    (tmp_path / "scene.toml").write_text("\n".join(lines), encoding="utf-8")
    names = 'scenes = ["scene.toml"]\nnetworks = ["module:fake_networks.red_against_blue"]\nprinters = ["uncoated"]\n'
    (tmp_path / "study.toml").write_text(names + f"sessions = {sessions}\nphotos = 5\npath_traced = false\n" + more)
    finished = run_study(study, tmp_path / "study.toml", tmp_path / "out")
    assert not finished.failed
    return finished


def test_a_cell_goes_from_the_scene_to_the_count(tmp_path, monkeypatch):
    finished = small_study("promises", tmp_path, monkeypatch, 2, "elsewhere = 6\nrendered = 2\n")
    (one,) = finished.results
    assert len(one.answers["promised"]) == 8 and one.answers["per_session"] == VIEWS_PER_SESSION
    assert len(one.answers["elsewhere"]) == 6 and [n for _, n in one.answers["rendered"]] == [5, 5]
    judged = [judged for _, judged in one.answers["sessions"]]
    assert len(judged) == 2 and all(recognized <= judged <= 5 for recognized, judged in one.answers["sessions"])
    assert (tmp_path / "out" / "promises_calibration.png").is_file()


def test_a_picture_made_elsewhere_takes_the_place_of_a_design(tmp_path, monkeypatch):
    draw_nothing(monkeypatch)
    Image.new("RGB", (48, 48), (220, 30, 30)).save(tmp_path / "red.png")
    finished = small_study("promises", tmp_path, monkeypatch, 1, 'pictures = {scene = ["red.png"]}\n')
    (only,) = finished.results
    assert only.cell.values["picture"] == "red.png" and len(only.answers["promised"]) == 8
    (row,) = next(table for table in finished.tables if table.name == "promises").rows
    assert row[4] == "red"
    (tmp_path / "b").mkdir()
    with pytest.raises(Refused, match='got "other": use one of: scene'):
        small_study("promises", tmp_path / "b", monkeypatch, 1, 'pictures = {other = ["red.png"]}\n')


def test_gains_before_detectors_in_the_notebook_are_the_stored_ones():
    results = Path(promises.__file__).parents[1] / "results"
    tables = json.loads((results / "detector/coco/promises.json").read_text("utf-8"))["tables"]
    page = " ".join((results / "measured.md").read_text("utf-8").split())
    gains = [round(100 * row[6]["value"]) for row in tables["gains"]["rows"]]
    pairs = [f"{first:+} and {second:+}" for first, second in zip(gains[::2], gains[1::2], strict=True)]
    assert len(pairs) == 5 and all(pair in page for pair in pairs)
    assert all(min(abs(row[6]["low"]), abs(row[6]["high"])) > 0.05 for row in tables["gains"]["rows"])
    _, held, width, *_, bias = tables["held"]["rows"][-1]
    assert f"{round(held['value'] * held['n'])} of {held['n']} sessions lay in their intervals" in page
    figures = (100 * bias[end] for end in ("value", "low", "high"))
    assert f"{100 * width:.0f} % of a session's photographs wide" in page
    assert "showed {:.1f} points more than was promised [{:.1f}, {:.1f}] over the ten runs".format(*figures) in page


def test_promises_by_the_default_printer_in_the_notebook_are_the_stored_ones():
    results = Path(promises.__file__).parents[1] / "results"
    page = (results / "measured.md").read_text("utf-8")
    for name in ("office", "again", "office_025", "former_025"):
        tables = json.loads((results / f"promises/{name}.json").read_text("utf-8"))["tables"]
        _, held, width, *_, bias = tables["held"]["rows"][-1]
        head, rows = tables["promises"]["head"], tables["promises"]["rows"]
        promised, judged, seen = (
            np.array([row[head.index(name)] for row in rows], float) for name in ("promised", "judged", "recognized")
        )
        brier = (seen * (1 - promised) ** 2 + (judged - seen) * promised**2).sum() / judged.sum()
        figures = f"{held['value'] * held['n']:.0f} of {held['n']} | {100 * width:.0f} % | "
        figures += "{:+.1f} [{:.1f}, {:.1f}]".format(*(100 * bias[end] for end in ("value", "low", "high")))
        assert f"(promises/{name}.toml), [figures](promises/{name}.json) | {figures} | {brier:.3f} |" in page
