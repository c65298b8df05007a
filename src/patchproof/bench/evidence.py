"""What evidence costs: markers, the model that makes a sheet flat, lens terms, and how many photographs to take.

In: nothing. Out: a chart per knob; the first two are those of `sheets`. Boards for lenses are projected by OpenCV with
noise on their corners. Numbers of photographs are judged as `verify` does it, on counts drawn from known rates.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping

import cv2
import numpy as np

from patchproof.bench.chart import Chart, Check, OnStage, Point, Series, Table
from patchproof.bench.sheets import markers_chart, models_chart
from patchproof.calibrate.boards import View, corner_places_mm
from patchproof.calibrate.lens_ladder import FREE, Rung, climb
from patchproof.claims import prediction_interval, wilson
from patchproof.evidence.verdict import LEAST_JUDGED, SLACK, judge
from patchproof.journey.demo import PHOTOS
from patchproof.optimizer.promise import PROMISE_VIEWS
from patchproof.sheets.board import load_board

SIZE_PX, FOCAL_PX = (1600, 1200), 1300.0
LENSES = {
    "no distortion": (0.0, 0.0, 0.0, 0.0, 0.0),
    "a phone's main camera": (-0.015, 0.0, 0.0, 0.0, 0.0),
    "a wide lens, off its axis": (-0.12, 0.03, 1e-3, -5e-4, 0.0),
}
BOARD, BOARD_VIEWS, CORNER_NOISE_PX = "charuco_a4", 10, 0.05
RATES, VERDICT_RATES, COUNTS = (0.95, 0.8, 0.6), (0.9, 0.7), (5, 10, 20, 40, 80, 160)
WORSE = 0.25  # by which the true rate lies below the promise where it should be found broken


def evidence_charts(quick: bool, on_stage: OnStage) -> Iterator[Chart]:
    """Every chart of the evidence, one after the other."""
    yield markers_chart(6 if quick else 40, on_stage)
    yield models_chart(4 if quick else 24, on_stage)
    yield lens_chart(1 if quick else 6, on_stage)
    yield width_chart()
    yield verdict_chart(2000 if quick else 20000)


# Lens terms


def lens_chart(cameras: int, on_stage: OnStage) -> Chart:
    """Numbers of a lens model against the error on photographs of a board that it was not fitted to."""
    series, chosen = [], []
    for i, (name, terms) in enumerate(LENSES.items()):
        climbed = [climb(board_views(np.array(terms), BOARD_VIEWS, seed)) for seed in range(cameras)]
        names = Counter(one.fit.rung for one in climbed)
        usual = names.most_common(1)[0][0]
        series.append(Series(name, tuple(_rung([one.rungs for one in climbed], k, usual) for k in range(len(FREE)))))
        chosen.append((name, ", ".join(f"{rung} {count}" for rung, count in names.most_common())))
        on_stage("lenses", i + 1, len(LENSES))
    return Chart(
        "lens",
        "Terms of a lens model",
        "numbers that are fitted",
        "held-out reprojection error, px (mean, 95 %)",
        tuple(series),
        (
            f"{BOARD_VIEWS} photographs of a board, corners off by {CORNER_NOISE_PX:g} px; {cameras} of each camera",
            "ringed: the rung that is chosen most often, the lowest within one standard error of the best",
        ),
        tables=(Table(("camera", "chosen"), tuple(chosen)),),
    )


def _rung(ladders: list[tuple[Rung, ...]], k: int, usual: str) -> Point:
    name, errors = ladders[0][k].name, [ladder[k].held_out_px for ladder in ladders]
    middle = float(np.mean(errors))
    half = 1.96 * float(np.linalg.norm([ladder[k].standard_error_px for ladder in ladders])) / len(ladders)
    cost = float(FREE[name])
    return Point(name, cost, middle, (cost, cost), (middle - half, middle + half), name == usual)


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
        seen = ((px > 5) & (px < np.array(SIZE_PX) - 5)).all(1)
        if seen.sum() >= len(flat) // 2:
            px = px + rng.normal(0, CORNER_NOISE_PX, px.shape)
            views.append(View(f"{len(views):02d}.jpg", np.flatnonzero(seen), places[seen], px[seen], SIZE_PX))
    return views


# How many photographs


def width_chart() -> Chart:
    """Photographs against the width of the promise's prediction interval."""
    series = []
    for rate in RATES:
        points = []
        for n in COUNTS:
            low, high = prediction_interval(round(rate * PROMISE_VIEWS), PROMISE_VIEWS, n)
            width = (high - low) / n
            points.append(Point(f"{n}", n, width, (n, n), (width, width), n == PHOTOS))
        series.append(Series(f"promised {rate:g}", tuple(points)))
    return Chart(
        "width",
        "Photographs, and how much the promise allows",
        "photographs of the print",
        "width of the 95 % prediction interval, share of photographs",
        tuple(series),
        (f"the promise was made on {PROMISE_VIEWS} views; computed, not drawn", "ringed: as many as the demo takes"),
    )


def verdict_chart(draws: int) -> Chart:
    """Photographs against the chance of a verdict that does not say what is the case, by simulation."""
    rng, series, rows, covered, off = np.random.default_rng(0), [], [], [], 0.0
    for rate in VERDICT_RATES:
        verdicts = {n: _verdicts(rng, rate, n, draws) for n in COUNTS}
        covered += [inside for _, _, inside in verdicts.values()]
        untold = tuple(_chance(n, kept["cannot_tell"], draws) for n, (kept, _, _) in verdicts.items())
        off = max(off, *(abs(p.error - too_wide(rate, n)) for p, n in zip(untold, COUNTS, strict=True)))
        missed = tuple(_chance(n, draws - worse["broken"], draws) for n, (_, worse, _) in verdicts.items())
        series += [Series(f"promised {rate:g} and true: cannot tell", untold)]
        series += [Series(f"promised {rate:g}, {WORSE:g} worse: not broken", missed)]
        for n, (kept, worse, inside) in verdicts.items():
            cells = (kept["cannot_tell"], kept["broken"], worse["kept"], worse["cannot_tell"])
            rows.append((f"{rate:g}, {n}", *(f"{cell / draws:.3f}" for cell in cells), f"{inside:.3f}"))
    return Chart(
        "verdict",
        "Photographs, and the chance of a verdict that does not help",
        "photographs of the print",
        "chance (95 %)",
        tuple(series),
        (f"{draws} promises of {PROMISE_VIEWS} views, each with its photographs", "ringed: as many as the demo takes"),
        (
            Check("least share of counts within the prediction interval", min(covered), 0.94, at_least=True),
            Check("cannot_tell: largest difference of drawn and computed chance", off, 4 * 0.5 / draws**0.5),
        ),
        (
            Table(
                (
                    "promised, photographs",
                    "true: cannot_tell",
                    "true: broken",
                    "worse: kept",
                    "worse: cannot_tell",
                    "in interval",
                ),
                tuple(rows),
            ),
        ),
    )


def too_wide(rate: float, n: int) -> float:
    """The computed chance that n photographs of a true promise cannot tell: its interval reaches too far down."""
    from scipy.stats import binom

    promised, chance = np.arange(PROMISE_VIEWS + 1), 0.0
    for k in promised[binom.pmf(promised, PROMISE_VIEWS, rate) > 1e-6].tolist():
        low, _ = prediction_interval(k, PROMISE_VIEWS, n)
        if n < LEAST_JUDGED or low / n < k / PROMISE_VIEWS - SLACK - 1e-9:
            not_broken = 1.0 if n < LEAST_JUDGED else binom.sf(low - 1, n, rate)
            chance += float(binom.pmf(k, PROMISE_VIEWS, rate) * not_broken)
    return chance


def _chance(n: int, times: int, draws: int) -> Point:
    chance = times / draws
    return Point(f"{n}", n, chance, (n, n), wilson(times, draws), n == PHOTOS)


def _verdicts(rng, rate: float, n: int, draws: int) -> tuple[Mapping[str, int], Mapping[str, int], float]:
    """Verdicts where the print does as promised, where it does worse, and the share of counts in the interval."""
    promised = rng.binomial(PROMISE_VIEWS, rate, draws)
    found, inside = [], 0
    for true in (rate, rate - WORSE):
        pairs = Counter(zip(promised.tolist(), rng.binomial(n, true, draws).tolist(), strict=True))
        words: Counter[str] = Counter()
        for (k, seen), times in pairs.items():
            verdict = judge(seen, n, k / PROMISE_VIEWS, PROMISE_VIEWS, "assist", 0)
            words[verdict.verdict] += times
            low, high = verdict.prediction_interval
            inside += times * (low <= seen <= high) if true == rate else 0
        found.append(words)
    return found[0], found[1], inside / draws
