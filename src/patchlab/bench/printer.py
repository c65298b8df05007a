"""Benchmark printer calibration: time and error of each model on the ladder, by number of swatches.

In: nothing; printers come from `inkjets` and the packaged profiles (each with the other as its only prior), and
`page_photos` photographs their charts. Out: a chart of every model's time against its error, and the choices.

The error is the mean ΔE00 over 1,000 colors that no chart holds, against those that the same camera would show of the
true print under even light at the chart's exposure; paper is white in both. A choice is compared with the best of all
models on these colors.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from patchlab.bench.chart import Chart, ChartPoint, Check
from patchlab.bench.inkjets import DRIVERS, draw_inkjet
from patchlab.study.estimates import mean, median
from patchproof.base.color import codes_from_srgb, linear_from_srgb, srgb_from_linear
from patchproof.base.intervals import rate, student_mean
from patchproof.base.progress import Progress
from patchproof.calibrate.chart import known_printers
from patchproof.calibrate.chart_photo import read_chart
from patchproof.calibrate.color_ladder import ColorMap, average_repeats, choose_map, color_difference, map_kinds
from patchproof.report.tables import Table
from patchproof.reprints.page_photos import PX_PER_MM, PrintFunction, Shot, page_light, photograph_page
from patchproof.sheets.manifest import Manifest
from patchproof.sheets.markers import DICTIONARY, marker_cells
from patchproof.sheets.page import chart_colors
from patchproof.sheets.piece import hash_order, manifest_marker, square_marker

SWATCHES = (6, 48, 96)
MAX_DELTA_E = {48: 2.5, 96: 1.8}
HELD_OUT_COLORS = 1000
NEAR_DELTA_E, MAX_DELTA_E_LOSS = 0.3, 0.8  # ΔE00 by which a choice may exceed the best model: in 90 %, in all
PAGE_MM = (210.0, 148.0)
MARKER_MM, _MARKERS_MM = 14.0, ((8.0, 8.0), (188.0, 8.0), (188.0, 126.0), (8.0, 126.0))
_CHART_MM = (30.0, 34.0, 150.0, 84.0)
_GAP_MM = 0.4


@dataclass(frozen=True)
class PrinterTrial:
    """One printer photographed once: its driver, held-out ΔE00 and fit seconds by model, and the model chosen."""

    driver: str
    swatches: int
    errors: dict[str, float]
    seconds: dict[str, float]
    chosen: str

    @property
    def excess(self) -> float:
        """ΔE00 by which the choice is worse than the best model tried."""
        return self.errors[self.chosen] - min(self.errors.values())


def charts(quick: bool, progress: Progress) -> Iterator[Chart]:
    """Chart the ladder for each number of swatches."""
    count, trials = 6 if quick else 36, []  # three minutes of one core; a multiple of the six kinds of printer
    for i in range(count):
        trials += [try_printer(i, swatches) for swatches in SWATCHES]
        progress("printers", i + 1, count)
    for swatches in SWATCHES:
        yield ladder_chart([trial for trial in trials if trial.swatches == swatches])


def ladder_chart(trials: list[PrinterTrial]) -> Chart:
    """Chart all models for one number of swatches."""
    names, swatches = [trial.chosen for trial in trials], trials[0].swatches
    usual = max(sorted(set(names)), key=names.count)
    points = []
    for name in trials[0].errors:
        cost = median([trial.seconds[name] / trial.seconds["white_black"] for trial in trials])
        points.append(ChartPoint(name, cost, student_mean([trial.errors[name] for trial in trials]), name == usual))
    return Chart(
        name=f"{swatches}_swatches",
        title=f"Models of a printer from a chart of {swatches} swatches",
        cost="time of one fit, ÷ that of white_black",
        error="mean ΔE00 of unseen colors",
        series={"rungs": points},
        about=f"{len(trials)} printers, each chart photographed once under uneven light with noise and JPEG. Error: "
        f"the mean over {HELD_OUT_COLORS} colors that the chart does not hold, against what the camera shows of the "
        "true print under even light; intervals are over printers. Default: the rung that is chosen most often.",
        checks=tuple(_checks(swatches, trials)),
        tables=(_choices(trials),),
    )


def _checks(swatches: int, trials: list[PrinterTrial]) -> list[Check]:
    excess = np.array([trial.excess for trial in trials])
    if swatches not in MAX_DELTA_E:
        fitted = np.mean([trial.chosen not in ("identity", "white_black", "prior") for trial in trials])
        return [Check(f"{swatches} swatches: share of choices with anything fitted", float(fitted), 0.0)]
    chosen = float(np.mean([trial.errors[trial.chosen] for trial in trials]))
    near = float((excess <= NEAR_DELTA_E).mean())
    return [
        Check(f"{swatches} swatches: mean ΔE00 of the chosen rung", chosen, MAX_DELTA_E[swatches]),
        Check(f"{swatches} swatches: share chosen within {NEAR_DELTA_E} of the best", near, 0.9, True),
        Check(f"{swatches} swatches: largest distance from the best", float(excess.max()), MAX_DELTA_E_LOSS),
    ]


def _choices(trials: list[PrinterTrial]) -> Table:
    rows = []
    for driver in (*dict.fromkeys(trial.driver for trial in trials), "all"):
        some = [trial for trial in trials if driver in (trial.driver, "all")]
        errors, names = [trial.errors[trial.chosen] for trial in some], [trial.chosen for trial in some]
        near = rate([trial.excess <= NEAR_DELTA_E for trial in some])
        picked = ", ".join(f"{name} {names.count(name)}" for name in sorted(set(names), key=names.count)[::-1])
        rows.append((driver, mean(errors), max(errors), near, picked))
    head = ("printer", "ΔE00 of the chosen", "worst", f"within {NEAR_DELTA_E} of the best", "chosen")
    count = trials[0].swatches
    return Table(f"{count}_swatches_chosen", f"Chosen with {count} swatches", head, tuple(rows))


def try_printer(seed: int, swatches: int) -> PrinterTrial:
    """Photograph and read one printer's chart, and fit every model to it."""
    driver, printer, priors = draw_printer(seed)
    manifest = chart_manifest(swatches)
    shot = photograph_page(printed_page(manifest, printer), seed)
    light = read_chart(shot.photo, manifest).light
    usable = np.isfinite(light).all(1)
    sent, seen = np.array([s.srgb for s in manifest.chart])[usable], srgb_from_linear(light[usable])
    kinds = map_kinds(priors)
    choice = choose_map(kinds, sent, seen)
    truth, errors = camera_colors(printer, shot, draw_held_out_colors()), {}
    for kind in (kind for kind in kinds if kind.name not in choice.left_out):
        predicted = relative_to_paper(kind.fit(*average_repeats(sent, seen)), draw_held_out_colors())
        errors[kind.name] = float(color_difference(predicted, truth).mean())
    return PrinterTrial(driver, swatches, errors, choice.seconds, choice.chosen.name)


def relative_to_paper(predict: ColorMap, colors: np.ndarray) -> np.ndarray:
    """sRGB N×3 that a color map predicts for sRGB N×3, relative to paper as in the printer's table."""
    light = linear_from_srgb(np.clip(predict(np.vstack([colors, np.ones((1, 3))])), 0, 1.2))
    return srgb_from_linear(np.clip(light[:-1] / light[-1], 0, 1))


def draw_printer(seed: int) -> tuple[str, PrintFunction, dict]:
    """(kind, print function, priors that a calibration may use): the priors never hold the printer itself."""
    priors, kinds = known_printers(), len(DRIVERS) + 1
    if seed % kinds < len(DRIVERS):
        inkjet = draw_inkjet(len(DRIVERS) * (seed // kinds) + seed % kinds)
        return inkjet.driver, inkjet, priors
    name = ("coated", "uncoated")[seed // kinds % 2]
    profile = priors.pop(name)
    return "the other profile", lambda colors: linear_from_srgb(profile(colors)), priors


def camera_colors(printer: PrintFunction, shot: Shot, colors: np.ndarray) -> np.ndarray:
    """sRGB N×3 that a camera records of printed colors N×3 under even light, clipped at its exposure."""
    white = np.ones((1, 3))
    light = np.clip(printer(np.vstack([colors, white])) / printer(white) * shot.paper, 0, 1)
    return srgb_from_linear(light[:-1] / light[-1])


def draw_held_out_colors() -> np.ndarray:
    """sRGB N×3, uniform over the cube."""
    return np.random.default_rng(99).random((HELD_OUT_COLORS, 3))


def chart_manifest(count: int) -> Manifest:
    """The manifest of a page with `count` swatches in the middle, colored and ordered like those of printed sheets."""
    x, y, width, height = _CHART_MM
    columns = math.ceil(math.sqrt(count * width / height))
    side = min(width / columns, height / math.ceil(count / columns))
    cells = [(x + side * (i % columns), y + side * (i // columns)) for i in range(count)]
    colors, order = chart_colors(count), hash_order(f"photographed {count}", count)
    swatches = [
        {"rect_mm": (*cell, side - _GAP_MM, side - _GAP_MM), "srgb": colors[index], "page": 1}
        for cell, index in zip(cells, order, strict=True)
    ]
    markers = [manifest_marker(square_marker(7 + i, corner, MARKER_MM)) for i, corner in enumerate(_MARKERS_MM)]
    head = {
        "version": 2,
        "sheet_id": "CHART00000",
        "kind": "blank",
        "page_mm": PAGE_MM,
        "design": None,
        "promise": None,
    }
    rest = {"cut_mm": (100.0, 6.0, 1.0, 1.0), "ruler_mm": (100.0, 100.0), "settings": {}}
    return Manifest.model_validate(head | rest | {"markers": markers, "chart": swatches})


def printed_page(manifest: Manifest, shows: PrintFunction) -> np.ndarray:
    """The printed page as light H×W×3 at `PX_PER_MM`, with lines of text beside the chart as on sheets."""
    width, height = (round(side * PX_PER_MM) for side in manifest.page_mm)
    page = np.full((height, width, 3), 255, np.uint8)
    for marker, code in zip(manifest.markers, marker_cells(DICTIONARY, [m.id for m in manifest.markers]), strict=True):
        side = round(MARKER_MM * PX_PER_MM)
        picture = 255 * cv2.resize(code, (side, side), interpolation=0)
        _fill(page, (*marker.corners_mm[0], MARKER_MM, MARKER_MM), picture)
    for line, y_mm in enumerate((14, 20, 26, 124, 131, 138)):
        position = (30 * PX_PER_MM, y_mm * PX_PER_MM)
        cv2.putText(page, f"{line} what stands beside a chart is not white paper", position, 0, 0.9, (0, 0, 0), 2)
    for swatch in manifest.chart:
        _fill(page, swatch.rect_mm, codes_from_srgb(np.array(swatch.srgb)))
    return page_light(page, shows)


def _fill(page: np.ndarray, rect_mm, value: np.ndarray) -> None:
    x, y, w, h = (round(v * PX_PER_MM) for v in rect_mm)
    page[y : y + h, x : x + w] = value[..., None] if value.ndim == 2 else value
