"""Benchmarks of training, numbers and evidence: known answers, laws, and checks that can fail."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from patchproof.bench import evidence, measure, numbers, sheets, train
from patchproof.bench.chart import Chart, Point, Series, with_default_checks, with_front
from patchproof.bench.detect import PIECE_MM, corners_mm
from patchproof.bench.world import demo_problem, with_settings
from patchproof.evidence.verdict import judge
from patchproof.optimizer import loop
from patchproof.optimizer.patch import Patch
from patchproof.settings import OptimizeSettings


def quiet(stage, done, total):
    pass


def point(cost, error, half=0.0, default=False):
    return Point(f"{cost:g}", cost, error, (cost, cost), (error - half, error + half), default)


def checked(*points, **more):
    chart = Chart("some", "Some knob", "cost", "error", (Series("knob", points),), **more)
    (check,) = with_default_checks(with_front(chart)).checks
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


def test_a_default_s_quality_in_decibels_is_an_error_too():
    # 1 dB less is 12 % more error
    worse = checked(point(1, 41.0), point(2, 40.0, default=True), higher_is_better=True)
    assert worse.figure == pytest.approx(100 * (10**0.05 - 1)) and not worse.holds


def test_one_front_spans_all_series():
    series = (Series("a", (point(1, 1), point(2, 0.9))), Series("b", (point(1, 2), point(2, 0.5, default=True))))
    chart = Chart("some", "Some knob", "cost", "error", series)
    own, shared = (with_front(replace(chart, one_front=one)) for one in (False, True))
    assert [p.front for one in own.series for p in one.points] == [True, True, True, True]
    assert [p.front for one in shared.series for p in one.points] == [True, False, False, True]


def test_paired_intervals_leave_out_what_settings_share():
    seeds, own = np.array([0.0, 10, 20]), np.array([[1, 2], [1, 2], [1, 2.0]])
    (a, a_interval), (b, _) = measure.paired_means(own + seeds[:, None])
    assert (a, b) == (11, 12) and a_interval == pytest.approx((11, 11))
    # by hand: what is left of a is ±0.5, its deviation 0.5, times √2 for two settings, /√3, t of 2 degrees 4.303
    (_, (low, high)), _ = measure.paired_means(np.array([[1, 0], [0, 1], [0.5, 0.5]]))
    assert (high - low) / 2 == pytest.approx(4.303 * 0.5 * math.sqrt(2 / 3), rel=1e-3)


def test_the_luckiest_setting_is_judged_on_the_seeds_that_did_not_choose_it():
    errors = np.array([[1.0, 0.8, 0.1], [1.0, 1.6, 0.1], [1.0, 0.8, 0.1], [1.0, 1.6, 0.1]])
    assert measure.checked_pick(errors, [2, 1, 3], 0) == (1, pytest.approx(1 / 1.6 - 1))
    assert measure.checked_pick(errors, [2, 3, 3], 0) == (0, 0)


def test_views_are_counted_as_the_loop_sees_them(problem, monkeypatch):
    seen = []
    score = loop._score
    monkeypatch.setattr(loop, "_score", lambda *a: seen.append(len(a[1])) or score(*a))
    monkeypatch.setattr(loop, "SELECT_AFTER", 6)
    train.trained(with_settings(problem, views=3, steps=2), [2])
    assert sum(seen) == train.seen(3, 2)


def test_training_charts_have_one_default_and_its_real_settings(problem, monkeypatch):
    monkeypatch.setattr(train, "trained_losses", lambda *how: [how[5]] * len(how[6]))
    effort, usual = train.Effort(240, 2, 16), OptimizeSettings()
    views = train.views_chart(problem, train.QUICK_VIEWS, effort, quiet)
    moves = train.optimizer_chart(problem, train.QUICK_STEP_SIZES, effort, quiet)
    for chart, name in ((views, f"{usual.views}"), (moves, f"{usual.optimizer} {Patch.STEP_SIZE:g}")):
        (default,) = (p for one in chart.series for p in one.points if p.default)
        assert default.setting == name and default.cost == train.seen(usual.views, 240 // usual.views)
    assert [p.error for p in moves.series[-1].points][:3] == list(train.QUICK_STEP_SIZES["adam"])


def test_a_spread_of_known_values_has_its_textbook_interval():
    # χ² with 9 degrees of freedom: 2.700 and 19.023
    assert train._spread_interval(1.0, 10) == pytest.approx((math.sqrt(9 / 19.023), math.sqrt(9 / 2.700)), rel=1e-3)


def test_only_bfloat16_is_off_by_more_than_rounding(problem):
    small = [replace(problem.classifiers[0], name="builtin")]
    (series,) = numbers.types_chart(problem, small, 1, quiet).series
    points = {p.setting: p for p in series.points}
    assert [p.setting for p in series.points if p.default] == ["float32 channels last, few at a time"]
    assert points["float32 rows"].error < 1e-5 < 1e-4 < points["bfloat16 rows"].error


@pytest.mark.parametrize("kind", ["flat", "lens", "rolled"])
def test_pixels_and_paper_are_each_other_s_inverse(kind):
    sheet, rng = sheets.drawn_sheet(kind, 1)
    mm = rng.uniform(0, PIECE_MM, (50, 2))
    assert sheet.mm(sheet.px(mm)) == pytest.approx(mm, abs=1e-6)
    assert sheets.error_mm(sheet.px, sheet) == pytest.approx(0, abs=1e-9)
    assert sheets.error_mm(lambda at: sheet.px(at + np.array([0.3, 0.4])), sheet) == pytest.approx(0.5, rel=0.03)


def test_a_photograph_shows_the_paper_where_the_sheet_says():
    found, (sheet, _) = sheets.corners_found("flat", 0), sheets.drawn_sheet("flat", 0)
    assert found.keys() == corners_mm().keys()
    off = np.concatenate([found[i] - sheet.px(corners_mm()[i]) for i in found])
    assert np.linalg.norm(off, axis=1).max() < 0.2


@pytest.mark.parametrize(("kind", "beaten"), [("lens", "robust plane"), ("rolled", "lens")])
def test_exact_corners_of_bent_sheets_need_their_model(kind, beaten):
    sheet, _ = sheets.drawn_sheet(kind, 2)
    corners = {i: sheet.px(mm) for i, mm in corners_mm().items()}
    right, wrong = (sheets.error_mm(sheets.MODELS[name](corners), sheet) for name in ("what pays", beaten))
    assert right < wrong / 3


def test_the_ladder_s_chart_rings_the_terms_that_a_lens_has(monkeypatch):
    monkeypatch.setattr(evidence, "LENSES", {"bent": (-0.05, 0.0, 0.0, 0.0, 0.0)})
    monkeypatch.setattr(evidence, "BOARD_VIEWS", 6)
    (series,) = evidence.lens_chart(1, quiet).series
    assert [p.setting for p in series.points if p.default] == ["k1"]
    assert series.points[0].error > 3 * series.points[1].error


def test_more_photographs_narrow_what_the_promise_allows():
    for one in evidence.width_chart().series:
        assert one.points[-1].error < one.points[0].error / 2
        assert [p.default for p in one.points].count(True) == 1


def test_the_computed_chance_agrees_with_the_judge_count_by_count():
    from scipy.stats import binom

    rate, n, views = 0.8, 10, evidence.PROMISE_VIEWS
    chance = 0.0
    for k in range(290, 351):  # all but a thousandth of the promises
        words = [judge(seen, n, k / views, views, "assist", 0).verdict for seen in range(n + 1)]
        untold = sum(binom.pmf(seen, n, rate) for seen, word in enumerate(words) if word == "cannot_tell")
        chance += binom.pmf(k, views, rate) * untold
    assert evidence.too_wide(rate, n) == pytest.approx(chance, abs=2e-3)
    assert evidence.too_wide(0.9, 4) == pytest.approx(1, abs=1e-3) and evidence.too_wide(0.9, 160) == 0


def test_drawn_verdicts_follow_the_computed_chance():
    chart = evidence.verdict_chart(400)
    assert all(check.holds for check in chart.checks) and len(chart.series) == 4
