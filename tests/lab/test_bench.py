"""Benchmarks: the front and the times are right, what is broken shows, and the files can be read."""

from __future__ import annotations

import csv
import json
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from patchlab.bench import chart as charts
from patchlab.bench import measure, run
from patchlab.bench.chart import Chart, ChartPoint, Check, all_checks, pareto_mask, points_table
from patchlab.bench.render import resolution_chart
from patchlab.bench.train import demo_problem
from patchproof.base.intervals import Estimate


def point(setting="a", cost=1.0, error=1.0, default=False):
    return ChartPoint(setting, *(Estimate(x, 0.9 * x, 1.1 * x, 5) for x in (cost, error)), default)


def chart(points=((1, 3), (2, 1), (3, 2)), **more):
    series = {"knob": [point(str(i), *p, default=i == 1) for i, p in enumerate(points)]}
    return Chart("some", "Some knob", "cost, relative", "error, dB", series, "About it.", **more)


def quiet(stage, done, total):
    pass


def test_a_point_that_another_beats_is_not_on_the_front():
    #                 cheap  exact  beaten  as exact but dearer  the same as another
    cost, error = [1, 3, 4, 4, 1], [5, 1, 2, 1, 5]
    assert pareto_mask(cost, error).tolist() == [True, True, False, False, True]


def test_the_front_is_the_lower_edge_cheapest_first():
    (points,) = chart().tasks.values()
    assert [p.setting for p in chart().front(points)] == ["0", "1"]


def test_a_point_without_a_finite_error_is_no_choice():
    made = chart(((1, np.inf), (2, 1), (3, 2)))
    assert [row[3] is None for row in points_table(made).rows] == [True, False, False]
    assert [p.setting for p in made.tasks["knob"]] == ["1", "2"]


def test_ratios_are_those_of_the_same_round():
    seconds = {"a": np.array([2.0, 20, 200]), "b": np.array([1.0, 10, 100])}
    assert measure.time_ratio(seconds, "a", "b") == Estimate(2, 2, 2, 3)


def test_calls_are_timed_in_turn_after_a_warm_up():
    order = []
    seconds = measure.time_calls({"a": lambda: order.append("a"), "b": lambda: order.append("b")}, 2)
    assert order == ["a", "b"] * 3 and [len(values) for values in seconds.values()] == [2, 2]


def test_waiting_is_not_counted_as_work():
    answer, milliseconds = measure.time_call(lambda: time.sleep(0.05) or 7)
    assert answer == 7 and 0 <= milliseconds < 25


def test_a_check_that_fails_is_said_to_fail():
    checks = (Check("width", 3.0, 2.0), Check("PSNR", 40.0, 38.0, at_least=True), Check("nothing", float("nan"), 1.0))
    made = chart(checks=checks)
    assert [check.holds for check in checks] == [False, True, False]
    assert [row[-1] for row in charts.checks_table([made]).rows] == [False, True, False, True]
    assert list(charts.failed_checks([made]).values()) == ["3, at most 2 was claimed", "nan, at most 1 was claimed"]


def test_json_tables_charts_and_page_can_be_read_back(tmp_path, monkeypatch):
    named = [chart(), replace(chart(checks=(Check("width", 3.0, 2.0),)), name="other", one_front=True)]
    monkeypatch.setattr(run, "load_bench", lambda name: lambda quick, on_stage: iter(named))
    (results,) = run.run_bench("render", tmp_path / "out", quick=True)
    data = json.loads((tmp_path / "out" / "render.json").read_text("utf-8"))
    assert data["settings"] == {"quick": True} and data["machine"]["threads"] == torch.get_num_threads()
    assert list(data["tables"]) == ["some", "other", "checks"] == [table.name for table in results.tables]
    assert [row[-1] for row in data["tables"]["some"]["rows"]] == ["front", "default, front", ""]
    assert data["failed"] == {"other, width": "3, at most 2 was claimed"}
    (head, first, *_) = csv.reader((tmp_path / "out" / "render_some.csv").read_text().splitlines())
    assert dict(zip(head, first, strict=True))["error_high"] == "3.3000000000000003"
    page = (tmp_path / "out" / "render.html").read_text("utf-8")
    assert "patchlab bench: render" in page and "About it." in page and "3, at most 2" in page
    for name in ("some", "other"):
        with Image.open(tmp_path / "out" / f"render_{name}.png") as image:
            assert np.asarray(image.convert("L")).std() > 5


def test_every_benchmark_has_charts():
    assert all(callable(run.load_bench(name)) for name in run.BENCHES)


def test_an_unknown_benchmark_is_refused_with_the_nearest(tmp_path):
    with pytest.raises(ValueError, match='did you mean "render"'):
        run.run_bench("rendr", tmp_path / "out")


def test_a_default_is_checked_where_it_stands():
    (check,) = all_checks(chart())
    assert check.claim.startswith("knob: ") and check.figure == 0


def test_the_default_is_among_the_sides_of_training_s_views(monkeypatch):
    monkeypatch.setattr("patchlab.bench.render.SIDES_PX", (96,))
    problem = demo_problem()
    drawn = problem.subject.start()
    chart = resolution_chart(problem, drawn, views=2, rounds=1, progress=lambda *_: None)
    (points,) = chart.series.values()
    assert [point.setting for point in points if point.default] == [f"{problem.training_px} px"]
