"""The detection benchmark's photographs are true to their sheets, and refinement shows in them."""

from __future__ import annotations

import numpy as np

from patchlab.bench import detect
from patchlab.bench.detect import find_fitted_corners, find_opencv_corners, photograph_sheet, try_finder


def test_fitted_borders_beat_plain_corners_on_known_photographs():
    shots = [photograph_sheet((1200, 900), seed) for seed in range(2)]
    fitted, plain = (try_finder(shots, find, 1000) for find in (find_fitted_corners, find_opencv_corners))
    off_px = np.median(fitted.errors_px)
    assert fitted.share == 1 and off_px < 0.1 and off_px < 0.7 * np.median(plain.errors_px)


def test_the_chart_has_a_series_per_size_and_one_default_each(monkeypatch):
    monkeypatch.setattr(detect, "SIZES_PX", ((640, 480),))
    monkeypatch.setattr(detect, "START_SIDES_PX", (400, 1000))
    (chart,) = detect.charts(True, lambda *stage: None)
    (points,) = chart.series.values()
    assert [p.default for p in points] == [False, False, True, False] and len(chart.checks) == 2
