"""Calibrating printers: what each rung of the ladder costs and how near it comes, by the number of swatches.

In: nothing; printers are those of `inkjets` and the shipped profiles (each with the other as its only prior), charts
are photographed by `page_photos`. Out: a chart of every rung's time against its error, with the choice among them.

The error is the mean ΔE00 over 1,000 colors that no chart holds, against what the same camera would show of the true
print under even light at the chart's exposure: paper is white in both. A choice is held against the best of all rungs
on these colors.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from patchlab.bench.chart import Chart, ChartPoint, Check
from patchlab.bench.chart_page import chart_manifest, printed_page
from patchlab.bench.inkjets import DRIVERS, draw_inkjet
from patchlab.study.estimates import mean, median
from patchproof.base.color import linear_from_srgb, srgb_from_linear
from patchproof.base.intervals import rate, student_mean
from patchproof.base.progress import Progress
from patchproof.calibrate.chart import known_printers
from patchproof.calibrate.chart_photo import read_chart
from patchproof.calibrate.color_ladder import ColorMap, average_repeats, choose_map, color_difference, map_kinds
from patchproof.report.tables import Table
from patchproof.reprints.page_photos import PrintFunction, Shot, photograph_page

SWATCHES = (6, 48, 96)
MAX_DELTA_E = {48: 2.5, 96: 1.8}
HELD_OUT_COLORS = 1000
NEAR_DELTA_E, MAX_DELTA_E_LOSS = 0.3, 0.8  # ΔE00 by which a choice may be worse than the best rung: mostly, and ever


@dataclass(frozen=True)
class PrinterTrial:
    """One printer photographed once: held-out ΔE00 and seconds of a fit by rung, the choice, whose driver it was."""

    driver: str
    swatches: int
    errors: dict[str, float]
    seconds: dict[str, float]
    chosen: str

    @property
    def behind(self) -> float:
        """How much worse the choice is than the best rung that could be tried."""
        return self.errors[self.chosen] - min(self.errors.values())


def charts(quick: bool, progress: Progress) -> Iterator[Chart]:
    """The ladder's chart for each size of a printer's chart."""
    count, trials = 6 if quick else 36, []  # three minutes of one core; a multiple of the six kinds of printer
    for i in range(count):
        trials += [try_printer(i, swatches) for swatches in SWATCHES]
        progress("printers", i + 1, count)
    for swatches in SWATCHES:
        yield ladder_chart([trial for trial in trials if trial.swatches == swatches])


def ladder_chart(trials: list[PrinterTrial]) -> Chart:
    """Every rung on charts of one size."""
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
        f"the mean over {HELD_OUT_COLORS} colors that the chart does not hold, against what the camera shows of the true print "
        "under even light; intervals are over printers. Default: the rung that is chosen most often.",
        checks=tuple(_checks(swatches, trials)),
        tables=(_choices(trials),),
    )


def _checks(swatches: int, trials: list[PrinterTrial]) -> list[Check]:
    behind = np.array([trial.behind for trial in trials])
    if swatches not in MAX_DELTA_E:
        fitted = np.mean([trial.chosen not in ("identity", "white_black", "prior") for trial in trials])
        return [Check(f"{swatches} swatches: share of choices with anything fitted", float(fitted), 0.0)]
    chosen = float(np.mean([trial.errors[trial.chosen] for trial in trials]))
    return [
        Check(f"{swatches} swatches: mean ΔE00 of the chosen rung", chosen, MAX_DELTA_E[swatches]),
        Check(
            f"{swatches} swatches: share chosen within {NEAR_DELTA_E} of the best",
            float((behind <= NEAR_DELTA_E).mean()),
            0.9,
            True,
        ),
        Check(f"{swatches} swatches: largest distance from the best", float(behind.max()), MAX_DELTA_E_LOSS),
    ]


def _choices(trials: list[PrinterTrial]) -> Table:
    """By driver: the chosen rung's error, how often it is near the best, what was chosen."""
    rows = []
    for driver in (*dict.fromkeys(trial.driver for trial in trials), "all"):
        own = [trial for trial in trials if driver in (trial.driver, "all")]
        errors, names = [trial.errors[trial.chosen] for trial in own], [trial.chosen for trial in own]
        near = rate([trial.behind <= NEAR_DELTA_E for trial in own])
        picked = ", ".join(f"{name} {names.count(name)}" for name in sorted(set(names), key=names.count)[::-1])
        rows.append((driver, mean(errors), max(errors), near, picked))
    head = ("printer", "ΔE00 of the chosen", "worst", f"within {NEAR_DELTA_E} of the best", "chosen")
    return Table(
        f"{trials[0].swatches}_swatches_chosen", f"Chosen with {trials[0].swatches} swatches", head, tuple(rows)
    )


def try_printer(seed: int, swatches: int) -> PrinterTrial:
    """One printer's chart photographed and read, every rung on it."""
    driver, shows, priors = draw_printer(seed)
    manifest = chart_manifest(swatches)
    shot = photograph_page(printed_page(manifest, shows), seed)
    light = read_chart(shot.photo, manifest).light
    usable = np.isfinite(light).all(1)
    sent, shown = np.array([s.srgb for s in manifest.chart])[usable], srgb_from_linear(light[usable])
    kinds = map_kinds(priors)
    choice = choose(kinds, sent, shown)
    truth, errors = camera_colors(shows, shot, draw_held_out_colors()), {}
    for kind in (kind for kind in kinds if kind.name not in choice.left_out):
        predicted = relative_to_paper(kind.fit(*distinct(sent, shown)), draw_held_out_colors())
        errors[kind.name] = float(difference(predicted, truth).mean())
    return PrinterTrial(driver, swatches, errors, choice.seconds, choice.chosen.name)


def relative_to_paper(predict: ColorMap, colors: np.ndarray) -> np.ndarray:
    """What a map shows of colors N×3, white being paper, as in the printer's table."""
    light = linear_from_srgb(np.clip(predict(np.vstack([colors, np.ones((1, 3))])), 0, 1.2))
    return srgb_from_linear(np.clip(light[:-1] / light[-1], 0, 1))


def draw_printer(seed: int) -> tuple[str, PrintFunction, dict]:
    """A printer's kind, what it shows, and the priors that a calibration may have: never the printer itself."""
    priors, kinds = known_printers(), len(DRIVERS) + 1
    if seed % kinds < len(DRIVERS):
        inkjet = draw_inkjet(len(DRIVERS) * (seed // kinds) + seed % kinds)
        return inkjet.driver, inkjet, priors
    name = ("coated", "uncoated")[seed // kinds % 2]
    own = priors.pop(name)
    return "the other profile", lambda colors: linear_from_srgb(own(colors)), priors


def camera_colors(shows: PrintFunction, shot: Shot, colors: np.ndarray) -> np.ndarray:
    """sRGB N×3 that a camera shows of colors on the true print under even light, which clips at its exposure."""
    white = np.ones((1, 3))
    light = np.clip(shows(np.vstack([colors, white])) / shows(white) * shot.paper, 0, 1)
    return srgb_from_linear(light[:-1] / light[-1])


def draw_held_out_colors() -> np.ndarray:
    """Colors N×3 spread evenly over the cube."""
    return np.random.default_rng(99).random((HELD_OUT_COLORS, 3))
