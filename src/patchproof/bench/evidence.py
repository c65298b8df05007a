"""What evidence costs: markers, the model that makes a sheet flat, and lens terms.

In: nothing. Out: a chart per knob; the first two are those of `sheets`. Boards for lenses are projected by OpenCV with
noise on their corners.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import cv2
import numpy as np

from patchproof.bench.chart import Chart, OnStage, Point
from patchproof.bench.paper import SIZE_PX
from patchproof.bench.sheets import markers_chart, models_chart
from patchproof.calibrate.boards import View, corner_places_mm
from patchproof.calibrate.ladder import Rung
from patchproof.calibrate.lens_ladder import FREE, climb
from patchproof.claims import Estimate, mean
from patchproof.report.tables import Table
from patchproof.sheets.board import load_board

FOCAL_PX = 1300.0
LENSES = {
    "no distortion": (0.0, 0.0, 0.0, 0.0, 0.0),
    "a phone's main camera": (-0.015, 0.0, 0.0, 0.0, 0.0),
    "a wide lens, off its axis": (-0.12, 0.03, 1e-3, -5e-4, 0.0),
}
BOARD, BOARD_VIEWS, CORNER_NOISE_PX = "charuco_a4", 10, 0.05


def charts(quick: bool, on_stage: OnStage) -> Iterator[Chart]:
    """Every chart of the evidence, one after the other."""
    yield markers_chart(6 if quick else 40, on_stage)
    yield models_chart(4 if quick else 24, on_stage)
    yield lens_chart(1 if quick else 6, on_stage)


def lens_chart(cameras: int, on_stage: OnStage) -> Chart:
    """Numbers of a lens model against the error on photographs of a board that it was not fitted to."""
    series, chosen = {}, []
    for i, (name, terms) in enumerate(LENSES.items()):
        ladders = [climb(board_views(np.array(terms), BOARD_VIEWS, seed)) for seed in range(cameras)]
        names = Counter(fit.rung for _, fit in ladders)
        default = names.most_common(1)[0][0]
        rungs = zip(*(rungs for rungs, _ in ladders), strict=True)
        series[name] = [_point(rung, default) for rung in rungs]
        chosen.append((name, ", ".join(f"{rung} {count}" for rung, count in names.most_common())))
        on_stage("lenses", i + 1, len(LENSES))
    return Chart(
        name="lens",
        title="Terms of a lens model",
        cost="numbers that are fitted",
        error="held-out reprojection error, px (mean)",
        series=series,
        about=f"{BOARD_VIEWS} photographs of a board, corners off by {CORNER_NOISE_PX:g} px; {cameras} of each camera. "
        "Default: the rung that is chosen most often, the lowest within one standard error of the best.",
        tables=(Table("lens_chosen", "Chosen rungs", ("camera", "chosen"), tuple(chosen)),),
    )


def _point(rungs: Sequence[Rung], default: str) -> Point:
    """One rung over all cameras; of a single camera without an interval."""
    name, errors = rungs[0].name, [rung.error for rung in rungs]
    return Point(name, FREE[name], mean(errors) or Estimate(errors[0], errors[0], errors[0], 1), name == default)


def board_views(terms: np.ndarray, count: int, seed: int) -> list[View]:
    """Photographs of a board that fills most of the picture, tilted by 10 to 40° about any axis."""
    places = corner_places_mm(load_board(BOARD))
    flat = np.column_stack([places, 0 * places[:, 0]])
    matrix = np.array([[FOCAL_PX, 0, SIZE_PX[0] / 2 - 10], [0, FOCAL_PX, SIZE_PX[1] / 2 + 10], [0, 0, 1.0]])
    rng, views = np.random.default_rng([seed, 2]), []
    while len(views) < count:
        tilt, about, roll = np.radians(rng.uniform([10, 0, 0], [40, 360, 360]))
        turn = cv2.Rodrigues(np.array([np.cos(about), np.sin(about), 0]) * tilt)[0]
        turn = turn @ cv2.Rodrigues(np.array([0, 0, roll]))[0]
        away = FOCAL_PX * 270 / (min(SIZE_PX) * rng.uniform(0.7, 1.2))
        aside = rng.uniform(-0.25, 0.25, 2) * SIZE_PX / FOCAL_PX * away
        move = np.array([*aside, away]) - turn @ flat.mean(0)
        px = cv2.projectPoints(flat, cv2.Rodrigues(turn)[0], move, matrix, terms)[0].reshape(-1, 2)
        inside = ((px > 5) & (px < np.array(SIZE_PX) - 5)).all(1)
        if inside.sum() >= len(flat) // 2:
            px = px + rng.normal(0, CORNER_NOISE_PX, px.shape)
            views.append(View(f"{len(views):02d}.jpg", np.flatnonzero(inside), places[inside], px[inside], SIZE_PX))
    return views
