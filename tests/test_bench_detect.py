"""The detection benchmark's photographs are true to their homographies, and refinement shows in them."""

from __future__ import annotations

import numpy as np

from patchproof.bench import detect as bench_detect
from patchproof.bench.detect import find_fitted, find_plain, shoot, tried


def test_fitted_borders_beat_plain_corners_on_known_photographs():
    shots = [shoot((1200, 900), seed) for seed in range(2)]
    _, fitted, found = tried(shots, find_fitted, 1000)
    _, plain, _ = tried(shots, find_plain, 1000)
    assert found == 1 and np.median(fitted) < 0.1 and np.median(fitted) < 0.7 * np.median(plain)


def test_the_chart_has_a_series_per_size_and_one_default_each(monkeypatch):
    monkeypatch.setattr(bench_detect, "SIZES_PX", ((800, 600),))
    monkeypatch.setattr(bench_detect, "COARSEST", (500, 1000))
    (chart,) = bench_detect.detect_charts(True, lambda *stage: None)
    assert [sum(p.default for p in one.points) for one in chart.series] == [1]
    assert len(chart.series[0].points) == 4 and len(chart.checks) == 2
