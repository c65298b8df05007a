"""Benchmarks of training and evidence: known answers, laws, and checks that can fail."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from patchlab.bench import effort, evidence, train
from patchlab.bench.chart import Chart, ChartPoint, all_checks
from patchlab.bench.paper_photos import PIECE_MM, corners_mm, draw_sheet
from patchlab.bench.train import demo_problem
from patchproof.base.intervals import Estimate
from patchproof.base.settings import OptimizeSettings
from patchproof.optimizer import expectation, loop


def quiet(stage, done, total):
    pass


def point(cost, error, half=0.0, default=False):
    return ChartPoint(f"{cost:g}", cost, Estimate(error, error - half, error + half, 9), default)


def checked(*points, **more):
    (check,) = all_checks(Chart("some", "Some knob", "cost", "error", {"knob": points}, "", **more))
    return check


@pytest.fixture(scope="module")
def problem():
    return demo_problem()


def test_a_default_is_held_against_the_front_at_its_cost_alone():
    cheap, dear = point(1, 1.0), point(9, 0.1)
    assert checked(cheap, point(2, 1.04, default=True), dear).figure == pytest.approx(4)
    assert checked(cheap, point(2, 1.04, default=True), dear).holds
    assert not checked(cheap, point(2, 1.06, default=True), dear).holds
    assert checked(cheap, point(2, 1.06, half=0.1, default=True), dear).figure == 0  # intervals overlap
    assert not checked(point(1, 0.0), point(2, 1.0, default=True)).holds


def test_one_front_spans_all_series():
    series = {"a": [point(1, 1), point(2, 0.9)], "b": [point(1, 2), point(2, 0.5, default=True)]}
    chart = Chart("some", "Some knob", "cost", "error", series, "")
    own, shared = (replace(chart, one_front=is_one) for is_one in (False, True))
    assert [len(own.front(points)) for points in own.tasks.values()] == [2, 2]
    (points,) = shared.tasks.values()
    assert shared.front(points) == [series["a"][0], series["b"][1]]


def test_views_are_counted_as_the_loop_sees_them(problem, monkeypatch):
    seen = []
    score = expectation.score
    monkeypatch.setattr(expectation, "score", lambda *a: seen.append(len(a[1])) or score(*a))
    monkeypatch.setattr(loop, "SELECT_AFTER", 6)
    monkeypatch.setattr(loop, "SELECT_VIEWS", 8)
    train.designs_after(problem.with_training(OptimizeSettings(views=3, steps=2)), [2])
    assert sum(seen) == loop.views_per_network(OptimizeSettings(views=3, steps=2))


def test_training_charts_have_one_default_and_its_real_settings(monkeypatch):
    usual = OptimizeSettings()

    def losses(problem, runs, effort, on_stage):
        return {(run, end): [run.step_size] * effort.seeds for run in runs for end in train.charted_ends(run, effort)}

    monkeypatch.setattr(train, "train_and_judge", losses)
    charts = train.charts(True, quiet)
    for chart, name in ((next(charts), f"{usual.views}"), (next(charts), f"{usual.optimizer} {usual.step_size:g}")):
        (default,) = (p for points in chart.series.values() for p in points if p.default)
        assert default.setting == name and default.cost == loop.views_per_network(
            usual.changed(steps=120 // usual.views)
        )
    (*_, last) = chart.series.values()
    assert [p.error.value for p in last] == pytest.approx([*train.QUICK_ADAM_STEP_SIZES, *train.QUICK_SIGN_STEP_SIZES])


def test_designs_are_judged_on_the_same_new_conditions(problem, monkeypatch):
    monkeypatch.setattr(loop, "SELECT_AFTER", 6)
    monkeypatch.setattr(loop, "SELECT_VIEWS", 4)
    run, effort = OptimizeSettings(views=3), train.TrainingEffort(6, 2, 4)
    losses = train.train_and_judge(problem, [run], effort, quiet)
    assert list(losses) == [(run, 6)] and len(set(losses[run, 6])) == 2
    assert losses == train.train_and_judge(problem, [run], effort, quiet)


@pytest.mark.parametrize("kind", ["flat", "lens", "rolled"])
def test_pixels_and_paper_are_each_other_s_inverse(kind):
    sheet, rng = draw_sheet(kind, 1)
    mm = rng.uniform(0, PIECE_MM, (50, 2))
    assert sheet.mm(sheet.px(mm)) == pytest.approx(mm, abs=1e-6)
    assert evidence.error_mm(sheet.px, sheet) == pytest.approx(0, abs=1e-9)
    assert evidence.error_mm(lambda at: sheet.px(at + np.array([0.3, 0.4])), sheet) == pytest.approx(0.5, rel=0.03)


def test_a_photograph_shows_the_paper_where_the_sheet_says():
    found, (sheet, _) = evidence.find_sheet_corners("flat", 0), draw_sheet("flat", 0)
    assert found.keys() == corners_mm().keys()
    off = np.concatenate([found[i] - sheet.px(corners_mm()[i]) for i in found])
    assert np.linalg.norm(off, axis=1).max() < 0.2


@pytest.mark.parametrize(("kind", "beaten"), [("lens", "robust plane"), ("rolled", "lens")])
def test_exact_corners_of_bent_sheets_need_their_model(kind, beaten):
    sheet, _ = draw_sheet(kind, 2)
    corners = {i: sheet.px(mm) for i, mm in corners_mm().items()}
    right, wrong = (evidence.error_mm(evidence.MODELS[name](corners), sheet) for name in ("what pays", beaten))
    assert right < wrong / 3


def test_efforts_are_timed_beside_the_default_and_judged_in_the_same_views(monkeypatch):
    monkeypatch.setattr(loop, "SELECT_VIEWS", 4)
    efforts = {"draft": (1, 8), effort.DEFAULT: (2, 9)}
    chart = effort.effort_chart(["carton"], efforts, 6, lambda stage, done, total: None)
    draft, default = chart.series["carton"]
    assert (draft.setting, default.setting, default.default) == ("draft", "default", True)
    (table,) = chart.tables
    assert default.cost == 1.0 and draft.cost == table.rows[0][2] / table.rows[1][2]
    assert [row[:2] for row in table.rows] == [("carton", "draft"), ("carton", "default")]
    for point, row in zip((draft, default), table.rows, strict=True):
        assert point.error.n == 6 and row[-1] == 1 - point.error.value
