"""What gamut in the loop buys: one scene, optimized with and without knowing its printer, reprinted by others.

In: scenes, seeds, the printer that is known while optimizing and those that print in the end. Out: a row per way to
optimize and printer: rate and confidence on the same fresh conditions (the evaluate stream), their intervals, and
paired differences to the design that was optimized as if any color could be printed. All ways share the piece's frame,
their training views and the number of steps.

Intervals are over conditions, with the designs as they are: what another seed would do shows in `gain_by_seed`.
Left out on purpose: page, detection and photographs at full size; no way to optimize differs in them. Views are as
large as in training, a tenth of the work of whole ones: what is read off here are differences.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field

from patchproof.channel.printer import IN_GAMUT, Printer, identity_printer, load_printer, vary
from patchproof.claims import Estimate, difference, rate
from patchproof.color import linear_from_srgb, srgb_from_linear
from patchproof.optimizer.loop import best_design
from patchproof.optimizer.pixels import from_pixels
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.render.photograph import expose
from patchproof.report.tables import Drawing, Table
from patchproof.scene.scene import Scene, build_scene, load_scene
from patchproof.strict import Refused, Strict, shipped
from patchproof.study.study import Cell, Result, Study

VIEWS = 200
CHUNK = 16


@dataclass(frozen=True)
class Way:
    """One way to optimize: whether pictures are made through the printer's table, and what `[optimize]` says."""

    name: str
    printed: bool
    gamut: float = 0.0
    in_gamut: bool = False


UNPRINTED = Way("any color (no printer)", printed=False)
WAYS = (
    UNPRINTED,
    Way("printer's table", printed=True),
    Way("table and gamut term", printed=True, gamut=1.0),
    Way("table and gamut term × 10", printed=True, gamut=10.0),
    Way("in gamut by construction", printed=True, in_gamut=True),
)


class GamutSettings(Strict):
    """Every scene with every seed; paths are relative to the config's folder."""

    # Scene files; their `printer.profile` is the printer that is known while optimizing.
    scenes: Annotated[tuple[str, ...], Field(min_length=1)]
    seeds: Annotated[tuple[int, ...], Field(min_length=1)] = (0, 1)  # of the optimizer
    views: Annotated[int, Field(ge=2)] = VIEWS  # unseen conditions that measure


@dataclass(frozen=True)
class Row:
    """A way's designs as one printer prints them; `difference` (of rates) and `gain` (of confidence) are to the designs
    of `UNPRINTED` in the same views. `out_of_gamut`: share of the designs' pixels that the known printer misses by more
    than IN_GAMUT.
    """

    printer: str
    way: str
    rate: Estimate
    difference: Estimate
    confidence: Estimate
    gain: Estimate
    gain_by_seed: tuple[float, ...]
    out_of_gamut: float


@dataclass(frozen=True)
class Outcomes:
    """One seed's results: ways × printers × {recognized, confidence} × views, and per way the share of its design's
    pixels that are out of the known printer's gamut.
    """

    ways: tuple[str, ...]
    printers: tuple[str, ...]
    outcomes: np.ndarray
    out_of_gamut: np.ndarray


def gamut_cell(
    scene: Scene,
    seed: int,
    printers: Sequence[Printer],
    ways: Sequence[Way] = WAYS,
    views: int = VIEWS,
) -> Outcomes:
    """A design for each way, all from this seed, in the same `views` conditions by every printer."""
    problem, designs = set_problem(build_scene(scene.settings, scene.base, seed)), []
    for way in ways:
        designs.append(best_design(way_problem(problem, way)))
    missed = np.array([_missed(problem.printer, design) for design in designs])
    outcomes = _reprinted(problem, designs, printers, views)
    return Outcomes(tuple(w.name for w in ways), tuple(p.name for p in printers), outcomes, missed)


def gamut_rows(seeds: Sequence[Outcomes]) -> list[Row]:
    """A row per printer and way, over all seeds."""
    first, outcomes = seeds[0], np.stack([seed.outcomes for seed in seeds])
    base, missed = first.ways.index(UNPRINTED.name), np.mean([seed.out_of_gamut for seed in seeds], 0)
    return [
        _row(way, printer, outcomes[:, i, k], outcomes[:, base, k], float(missed[i]))
        for k, printer in enumerate(first.printers)
        for i, way in enumerate(first.ways)
    ]


def other_printers(known: Printer) -> list[Printer]:
    """Those that print in the end: the known one, the shipped ones that differ from it, and one that was made up: the
    last of them with 10 points more dot gain and a paler black, as on newsprint.
    """
    names = sorted(path.stem for path in shipped("calibration", "printers").glob("*.npz"))
    others = [load_printer(name) for name in names if name != known.name]
    light = vary(linear_from_srgb(others[-1].lut), torch.tensor([0.10, 0.0, 0.05]))
    made = replace(others[-1], name=f"{others[-1].name}, +10 % dot gain, pale black", lut=srgb_from_linear(light))
    return [known, *others, made]


def way_problem(problem: Problem, way: Way) -> Problem:
    """The problem as this way poses it."""
    scene = problem.scene
    changed = {"gamut": way.gamut, "in_gamut": way.in_gamut}
    optimize = scene.settings.optimize.model_copy(update=changed)
    scene = replace(scene, settings=scene.settings.model_copy(update={"optimize": optimize}))
    printer = problem.printer if way.printed else identity_printer()
    subject = replace(problem.subject, scene=scene, printer=printer)
    return replace(problem, scene=scene, printer=printer, subject=subject)


def _reprinted(problem: Problem, designs: Sequence[np.ndarray], printers, views: int) -> np.ndarray:
    """ways × printers × {recognized, confidence} × views, of the primary classifier."""
    classifier, indices = problem.classifiers[0], problem.indices[0]
    conditions = problem.scene.draw("evaluate", views)
    result = np.zeros((len(designs), len(printers), 2, views))
    with torch.no_grad():
        shown = [
            [replace(problem.subject, printer=p).shown(from_pixels(d, problem.device)) for p in printers]
            for d in designs
        ]
        for first in range(0, views, CHUNK):
            part = conditions[first : first + CHUNK]
            seen = problem.see(shown[0][0], part, problem.training_px)
            for i, row in enumerate(shown):
                for k, picture in enumerate(row):
                    logits = classifier.logits(expose(seen, picture))
                    both = classifier.recognized(logits, indices).double(), classifier.confidence(logits, indices)
                    result[i, k, :, first : first + len(part)] = torch.stack(both).cpu().numpy()
    return result


def _missed(printer: Printer, design: np.ndarray) -> float:
    distance = printer.gamut_distance(from_pixels(design)[None])
    return float((distance > IN_GAMUT).double().mean())


def _row(way: str, printer: str, outcome: np.ndarray, base: np.ndarray, out_of_gamut: float) -> Row:
    """`outcome` and `base` seeds × {recognized, confidence} × views."""
    (hit, confidence), (base_hit, base_confidence) = (one.transpose(1, 0, 2) for one in (outcome, base))
    hits, base_hits = ([bool(one) for one in which.ravel()] for which in (hit, base_hit))
    gains = confidence - base_confidence
    return Row(
        printer,
        way,
        rate(hits),
        difference(hits, base_hits),
        _mean(confidence),
        _mean(gains),
        tuple(gains.mean(1).tolist()),
        out_of_gamut,
    )


def _mean(values: np.ndarray) -> Estimate:
    """A mean with its normal 95 % interval."""
    mean, half = float(values.mean()), 1.96 * float(values.std(ddof=1)) / math.sqrt(values.size)
    return Estimate(mean, mean - half, mean + half, values.size)


# ------------------------------------------------------------------------------------------------ as a study


def _cells(settings: GamutSettings, base: Path) -> list[Cell]:
    names = [Path(scene).stem for scene in settings.scenes]
    if len(set(names)) < len(names):
        raise Refused("scene files with names of their own", ", ".join(settings.scenes), "rename one")
    return [
        Cell(f"{name}-seed-{seed}", {"scene": scene, "name": name, "seed": seed})
        for name, scene in zip(names, settings.scenes, strict=True)
        for seed in settings.seeds
    ]


def _run(settings: GamutSettings, base: Path, cell: Cell) -> dict[str, Any]:
    scene = load_scene(base / cell.values["scene"])
    known = load_printer(scene.settings.printer.profile, scene.base)
    found = gamut_cell(scene, cell.values["seed"], other_printers(known), views=settings.views)
    return {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in vars(found).items()}


def _by_scene(results: Sequence[Result]) -> dict[str, list[Row]]:
    found: dict[str, list[Outcomes]] = {}
    for result in results:
        one = result.found
        arrays = (np.array(one[key]) for key in ("outcomes", "out_of_gamut"))
        outcomes = Outcomes(tuple(one["ways"]), tuple(one["printers"]), *arrays)
        found.setdefault(result.cell.values["name"], []).append(outcomes)
    return {name: gamut_rows(seeds) for name, seeds in found.items()}


def _tables(settings: GamutSettings, results: Sequence[Result]) -> list[Table]:
    head = ("printed by", "optimized", "rate", "difference", "confidence", "gain", "gain by seed", "missed")
    about = (
        f"{settings.views} views per seed, the same for all rows. Differences (of rates) and gains (of confidence) are "
        "to the first way, paired. The first printer is the known one. Missed: pixels that it shows more than ΔE00 "
        f"{IN_GAMUT:g} off."
    )
    return [
        Table(name, name, head, tuple(_table_row(row) for row in rows), about)
        for name, rows in _by_scene(results).items()
    ]


def _table_row(row: Row) -> tuple:
    by_seed = " ".join(f"{gain:+.3f}" for gain in row.gain_by_seed)
    return row.printer, row.way, row.rate, row.difference, row.confidence, row.gain, by_seed, row.out_of_gamut


def _figures(settings: GamutSettings, results: Sequence[Result]) -> list[Drawing]:
    return [
        Drawing(name, f"{name}: gain in confidence over designs of any color", partial(_draw, rows), (7.0, 3.4))
        for name, rows in _by_scene(results).items()
    ]


def _draw(rows: Sequence[Row], figure) -> None:
    """A group of intervals per printer, a color per way."""
    axes = figure.add_subplot()
    printers, ways = (list(dict.fromkeys(names)) for names in zip(*((r.printer, r.way) for r in rows), strict=True))
    for i, way in enumerate(ways[1:]):
        mine = [row.gain for row in rows if row.way == way]
        x = np.arange(len(mine)) + (i - len(ways) / 2 + 1) * 0.13
        reach = [[one.value - one.low for one in mine], [one.high - one.value for one in mine]]
        axes.errorbar(x, [one.value for one in mine], reach, fmt="o", ms=4, capsize=2, label=way)
    axes.axhline(0, color="0.5", lw=0.8)
    axes.set_xticks(range(len(printers)), printers)
    axes.set(ylabel="confidence, paired difference", xlabel="printed by")
    axes.legend(fontsize=7, frameon=False)


_ABOUT = "What gamut in the loop buys: designs optimized with and without their printer, reprinted by others."
STUDY = Study("gamut", _ABOUT, GamutSettings, _cells, _run, _tables, _figures)
