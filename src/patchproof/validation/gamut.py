"""What gamut in the loop buys: designs optimized with and without their printer, reprinted by others.

In: scenes, seeds, the printer that is known while optimizing (the scene's) and those that print in the end. Out: a row
per way to optimize and printer: rate and confidence on the same fresh conditions (the evaluate stream), their
intervals, and paired differences to the design that was optimized as if any color could be printed. All ways share the
piece's frame, their training views and the number of steps.

Intervals are over conditions, with the designs as they are: what another seed would do shows in `gain by seed`.
Left out on purpose: page, detection and photographs at full size; no way to optimize differs in them. Views are as
large as in training, a tenth of the work of whole ones: what is read off here are differences.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
import torch
from pydantic import Field

from patchproof.channel.printer import IN_GAMUT, Printer, identity_printer, load_printer, vary
from patchproof.claims import Estimate
from patchproof.color import linear_from_srgb, srgb_from_linear
from patchproof.optimizer.loop import best_design
from patchproof.optimizer.pixels import from_pixels
from patchproof.optimizer.problem import Problem
from patchproof.optimizer.responses import responses
from patchproof.report.tables import Drawing, Table
from patchproof.scene.scene import needs_piece
from patchproof.strict import shipped
from patchproof.study.figures import whiskers
from patchproof.study.grid import GridSettings, Seeds, cell_of, grouped, of_values, problem_of, teams
from patchproof.study.record import Record, recorded
from patchproof.study.study import Cell, Result, Study

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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


class GamutSettings(GridSettings):
    """A design in each way for each scene and seed, for all networks together; the first one tells."""

    seeds: Seeds = (0, 1)  # of the scenes' draws
    n: Annotated[int, Field(ge=2)] = 200  # views per seed


class Row(NamedTuple):
    """A way's designs as one printer prints them; `difference` (of rates) and `gain` (of confidence) are to the designs
    of `UNPRINTED` in the same views. `missed`: share of the designs' pixels that the known printer shows more than
    IN_GAMUT off.
    """

    printer: str
    way: str
    rate: Estimate | None
    difference: Estimate | None
    confidence: Estimate | None
    gain: Estimate | None
    gain_by_seed: str
    missed: float


def cells(settings: GamutSettings, base: Path) -> list[Cell]:
    """One per scene and seed."""
    return [cell_of(values, seed) for values in teams(settings, base) for seed in settings.seeds]


def run(settings: GamutSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """All ways, by all printers."""
    problem = problem_of(base, cell.values)
    return reprinted(problem, other_printers(problem.printer), WAYS, settings.n)


def reprinted(problem: Problem, printers: Sequence[Printer], ways: Sequence[Way], n: int) -> dict[str, Any]:
    """A design for each way, shown in the same n conditions as every printer prints it."""
    shown, missed = {}, {}
    for way in ways:
        design = from_pixels(best_design(way_problem(problem, way)), problem.device)
        distance = problem.printer.gamut_distance(design[None])
        missed[way.name] = float((distance > IN_GAMUT).double().mean())
        with torch.no_grad():
            for printer in printers:
                shown[_thing(way.name, printer.name)] = problem.subject.printed_by(printer).shown(design)
    answers = responses(problem, shown, problem.scene.draw("evaluate", n), problem.training_px)
    return recorded(answers) | {"missed": missed, "printers": [printer.name for printer in printers]}


def _thing(way: str, printer: str) -> str:
    return f"{way}, printed by {printer}"


def other_printers(known: Printer) -> list[Printer]:
    """Those that print in the end: the known one, the shipped ones that differ from it, and one that was made up: the
    last of them with 10 points more dot gain and a paler black, as on newsprint.
    """
    names = sorted(path.stem for path in shipped("calibration", "printers").glob("*.npz"))
    others = [load_printer(name) for name in names if name != known.name]
    light = vary(torch.as_tensor(linear_from_srgb(others[-1].lut)), torch.tensor([0.10, 0.0, 0.05]))
    name = f"{others[-1].name}, +10 % dot gain, pale black"
    made = replace(others[-1], name=name, lut=torch.as_tensor(srgb_from_linear(light)))
    return [known, *others, made]


def way_problem(problem: Problem, way: Way) -> Problem:
    """The problem as this way poses it."""
    settings = problem.scene.settings.changed(optimize={"gamut": way.gamut, "in_gamut": way.in_gamut})
    scene = replace(problem.scene, settings=settings)
    printer = problem.printer if way.printed else identity_printer()
    subject = replace(problem.patch, scene=needs_piece(scene), printer=printer)
    return replace(problem, scene=scene, printer=printer, subject=subject)


def rows_of(results: Sequence[Result]) -> list[Row]:
    """A row per printer and way, over all seeds of a scene."""
    rows = []
    for printer in results[0].answers["printers"]:
        for way in results[0].answers["missed"]:
            of_way, usual = (partial(Record, thing=_thing(name, printer)) for name in (way, UNPRINTED.name))
            rate, confidence = of_way(results).level()
            difference, gain = of_way(results).gain(usual(results))
            gains = [np.mean(of_way([r]).confidences()) - np.mean(usual([r]).confidences()) for r in results]
            by_seed = " ".join(f"{gain:+.3f}" for gain in gains)
            missed = float(np.mean([result.answers["missed"][way] for result in results]))
            rows.append(Row(printer, way, rate, difference, confidence, gain, by_seed, missed))
    return rows


def tables(settings: GamutSettings, results: Sequence[Result]) -> list[Table]:
    """One per scene."""
    head = ("printed by", "optimized", "rate", "difference", "confidence", "gain", "gain by seed", "missed")
    about = (
        f"{settings.n} views per seed, the same for all rows. Differences (of rates) and gains (of confidence) are "
        "to the first way, paired. The first printer is the known one. Missed: pixels that it shows more than ΔE00 "
        f"{IN_GAMUT:g} off."
    )
    scenes = grouped(results, of_values("name"))
    return [Table(name, name, head, tuple(rows_of(group)), about) for (name,), group in scenes.items()]


def figures(settings: GamutSettings, results: Sequence[Result]) -> list[Drawing]:
    """What each way gained, one per scene."""
    title = "gain in confidence over designs of any color"
    scenes = grouped(results, of_values("name"))
    return [
        Drawing(name, f"{name}: {title}", partial(_draw, rows_of(group)), (7.0, 3.4))
        for (name,), group in scenes.items()
    ]


def _draw(rows: Sequence[Row], figure: Figure) -> None:
    """A group of intervals per printer, a color per way."""
    axes = figure.add_subplot()
    printers, ways = (list(dict.fromkeys(names)) for names in zip(*((r.printer, r.way) for r in rows), strict=True))
    for i, way in enumerate(ways[1:]):
        values, reach = whiskers([row.gain for row in rows if row.way == way and row.gain is not None])
        x = np.arange(len(values)) + (i - len(ways) / 2 + 1) * 0.13
        axes.errorbar(x, values, reach, fmt="o", ms=4, capsize=2, label=way)
    axes.axhline(0, color="0.5", lw=0.8)
    axes.set_xticks(range(len(printers)), printers)
    axes.set(ylabel="confidence, paired difference", xlabel="printed by")
    axes.legend(fontsize=7, frameon=False)


STUDY = Study("gamut", GamutSettings, cells, run, tables, figures)
