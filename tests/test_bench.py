"""Benchmarks: the front, the slope and the intervals are right, what is broken shows, and the files can be read."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from patchproof.bench import chart as charts
from patchproof.bench import measure, render, run, speed, texture
from patchproof.bench.chart import Chart, Check, Growth, Point, Series, Shares
from patchproof.bench.world import set_world

LOOKED_AT = (45, 60)  # px wide, degrees


def point(setting="a", cost=1.0, error=1.0, default=False):
    return Point(setting, cost, error, (cost * 0.9, cost * 1.1), (error * 0.9, error * 1.1), default)


def chart(kind=Chart, points=((1, 3), (2, 1), (3, 2)), **more):
    series = Series("knob", tuple(point(str(i), *p, default=i == 1) for i, p in enumerate(points)), slope=1.0)
    return kind("some", "Some knob", "cost, relative", "error, dB", (series,), **more)


def quiet(stage, done, total):
    pass


@pytest.fixture(scope="module")
def world():
    return set_world(1, quiet)


def test_a_point_that_another_beats_is_not_on_the_front():
    #                 cheap  exact  beaten  as exact but dearer  the same as another
    cost, error = [1, 3, 4, 4, 1], [5, 1, 2, 1, 5]
    assert charts.pareto(cost, error).tolist() == [True, True, False, False, True]


def test_the_front_of_a_quality_is_its_upper_edge():
    on_front = [p.front for p in charts.with_front(chart()).series[0].points]
    upper = [p.front for p in charts.with_front(chart(higher_is_better=True)).series[0].points]
    assert on_front == [True, True, False] and upper == [True, False, False]


@pytest.mark.parametrize("power", [0.5, 1.0, 1.3])
def test_the_slope_is_that_of_the_larger_half(power):
    size = np.array([1e3, 1e4, 1e5, 1e6])
    seconds = 1e-6 * size**power
    assert measure.slope(size, seconds) == pytest.approx(power)
    assert measure.slope(size, np.where(size < 1e5, seconds[2], seconds)) == pytest.approx(power)


def test_intervals_of_medians_are_order_statistics():
    # of 100 values the binomial's 2.5 % point is 40: the 40th and 61st, as tables of the sign test have it
    middle, interval = measure.median_interval(np.arange(1.0, 101))
    assert middle == 50.5 and interval == (40, 61)
    assert measure.median_interval(np.array([3.0, 1, 2])) == (2, (1, 3))


def test_ratios_are_those_of_the_same_round():
    seconds = {"a": np.array([2.0, 20, 200]), "b": np.array([1.0, 10, 100])}
    assert measure.ratio(seconds, "a", "b") == (2, (2, 2))


def test_calls_are_timed_in_turn_after_a_warm_up():
    order = []
    seconds = measure.timed({"a": lambda: order.append("a"), "b": lambda: order.append("b")}, 2)
    assert order == ["a", "b"] * 3 and [len(values) for values in seconds.values()] == [2, 2]


def test_psnr_of_a_tenth_is_twenty():
    assert measure.psnr(torch.full((4, 3), 0.6), torch.full((4, 3), 0.5)) == pytest.approx(20, abs=1e-4)


def test_a_check_that_fails_is_said_to_fail():
    checks = (Check("width", 3.0, 2.0), Check("PSNR", 40.0, 38.0, at_least=True), Check("nothing", float("nan"), 1.0))
    assert [check.holds for check in checks] == [False, True, False]
    lines = charts.text(chart(checks=checks))
    assert [line.split(":")[0].strip() for line in lines[-3:]] == ["FAILS", "holds", "FAILS"]


def test_json_table_and_charts_can_be_read_back(tmp_path, monkeypatch):
    named = [replace(chart(kind), name=name) for kind, name in ((Chart, "a"), (Growth, "b"), (Shares, "c"))]
    monkeypatch.setattr(run, "_benches", lambda: {"render": lambda quick, on_stage: iter(named)})
    lines = run.run_bench("render", tmp_path / "out", quick=True)
    data = json.loads((tmp_path / "out" / "render.json").read_text("utf-8"))
    assert data["quick"] and data["machine"]["threads"] == torch.get_num_threads()
    points = data["charts"]["a"]["series"][0]["points"]
    assert [p["front"] for p in points] == [True, True, False] and points[1]["default"]
    assert (tmp_path / "out" / "table.txt").read_text("utf-8").splitlines() == lines[:-2]
    for name in "abc":
        with Image.open(tmp_path / "out" / f"render_{name}.png") as image:
            assert np.asarray(image.convert("L")).std() > 5


def test_an_unknown_benchmark_is_refused_with_the_nearest(tmp_path):
    with pytest.raises(ValueError, match='did you mean "render"'):
        run.run_bench("rendr", tmp_path / "out")


def test_one_tap_is_further_off_than_the_default(world):
    look = texture.look(world.problem.scene.piece, world.shown("noise"), *LOOKED_AT)
    noise = texture.texels(world.shown("noise"))
    few, default = (measure.psnr(noise.seen(look, n).detach(), look.truth) for n in (1, texture.DESIGN_TAPS))
    assert default > texture.LEAST_PSNR > few + 5


def test_the_reference_is_the_mean_of_what_a_pixel_sees(world):
    """A slow twin for one pixel: 256 samples one by one."""
    piece, picture = world.problem.scene.piece, world.shown("noise")
    pose = texture._pose(piece, *LOOKED_AT)
    side = texture.PICTURE_PX
    matrix = np.array([[side, 0, side / 2], [0, side, side / 2], [0, 0, 1.0]])
    homography = matrix @ pose[:3, [0, 1, 3]]
    x, y = side // 2 + 5, side // 2 - 4
    mean, inside = texture.reference(homography, piece, picture, torch.tensor([y * side + x, 0]))
    total = np.zeros(3)
    x0, y0, x1, y1 = picture.box_px
    for i in range(16):
        for j in range(16):
            mm = np.linalg.solve(homography, [x + (i + 0.5) / 16, y + (j + 0.5) / 16, 1])
            mm = mm[:2] / mm[2] / piece.size_mm
            total += picture.srgb[int(y0 + mm[1] * (y1 - y0)), int(x0 + mm[0] * (x1 - x0))].numpy()
    assert inside.tolist() == [True, False]
    assert mean[0].numpy() == pytest.approx(total / 256, abs=1e-5)


def test_samples_at_edges_bring_the_bare_object_nearer_to_the_truth(world, monkeypatch):
    monkeypatch.setattr(render, "EDGES_PX", 96)
    made = render.edges_chart(world, 1, 1, quiet)
    points = {p.setting: p for p in made.series[0].points}
    assert points["1 × 1"].default and points["1 × 1"].cost == 1
    assert points["3 × 3"].error > points["1 × 1"].error


def test_a_sphere_that_is_larger_has_more_fragments_and_a_process_tells_its_peak():
    small, large = (len(speed.rasterize(*speed.sphere(3, 1, side))) for side in (64, 128))
    assert large == pytest.approx(4 * small, rel=0.03)
    peak = speed.peak_gb(1, 64)
    assert peak is None or 0.05 < peak < 4
