"""Sweep a run's patch to where recognition, detection and measurement stop working, in simulation.

This is the patch's operating envelope. The design is judged by its gain over the bare object and a gray piece under the
same conditions, since a network may give the target's label where nothing is visible.
In: a run, and sweeps of one axis each (`envelope.axes`; by default all that the scene allows). Out: for each stage
along each axis the last good and the first bad point with the tool's codes there, a table of all points, and a page of
bars to print beside the patch. All points share their draws of everything that is not varied, so that differences
between them are not due to chance. Draws cover the ranges evenly (scrambled Sobol points of a seed of their own);
intervals treat them as independent, which is cautious.

Left out on purpose: shadows of a card off the surface, which the renderer does not have, and a camera that exposes
longer in the dark: here, darkness is light missing from the picture.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from patchlab.charts.bars import BAR_HEAD, ROW_IN, Bar, BarPoint, draw_bars, said_text
from patchlab.study.study import Cell, Result, Study
from patchlab.validation.envelope.axes import AXES, is_possible
from patchlab.validation.envelope.simulation import CONTROLS, measure_photos, open_simulation, recognize_target
from patchproof.base.errors import Refused
from patchproof.base.goal import Goal
from patchproof.base.intervals import Estimate, paired_difference, rate
from patchproof.base.validation import Finite, StrictModel, spelling_hint
from patchproof.optimizer.run import load_run
from patchproof.report.tables import Drawing, Table
from patchproof.scene.interface import require_piece

STAGES = ("design gains", "sheet found", "measured")
NO_GAIN = "no gain shown"
MIN_SHARE = 0.8  # of photographs in which the sheet is found, or measured, at a good point
_CONTROL = "the better of the bare object and a gray piece in the same markers, on the same conditions"
_FIRST_SEED = 1_000_000  # the study's first seed, far from scenes' seeds, whose Sobol points select designs
ConditionCount = Annotated[int, Field(ge=1, le=4096)]
PointCount = Annotated[int, Field(ge=3, le=33)]


class Sweep(StrictModel):
    """One axis from an easy to a hard value; by default ends that suit the scene."""

    axis: str  # such as tilt, distance, blur; an unknown name is refused with all names
    easy: Finite | None = None  # value at the easy end
    hard: Finite | None = None  # value at the hard end
    points: PointCount | None = None  # values; by default the study's


class EnvelopeSettings(StrictModel):
    """The run, and how finely its envelope is sampled. Over a control at 55 %, a gain of 20 points is shown by 32
    conditions, one of 10 by 96, where 3 % of them go the other way.
    """

    run: str  # the folder of a finished run of a patch
    seed: Annotated[int, Field(ge=0)] = 0  # seed of all draws
    n: ConditionCount = 96  # conditions per point that the network sees; a quarter where JPEG is varied
    photos: ConditionCount = 6  # of them photographed in full and measured
    points: PointCount = 6  # values of each swept axis
    sweeps: tuple[Sweep, ...] | None = None  # by default every axis that suits the scene
    other_printer: str | None = None  # `mismatch` goes from the run's printer towards this one


def cells(settings: EnvelopeSettings, base: Path) -> Sequence[Cell]:
    """A cell per sweep; refuses an axis that the scene does not have."""
    scene = require_piece(load_run(base / settings.run, trust=True).scene, "name the run of a printed patch")
    possible = [name for name in AXES if is_possible(scene, name)]
    sweeps = settings.sweeps
    if sweeps is None:
        sweeps = tuple(Sweep(axis=name) for name in possible)
    for name in (sweep.axis for sweep in sweeps):
        if name not in possible:
            raise Refused("an axis along which this scene can be varied", f'"{name}"', spelling_hint(name, possible))
    return [Cell(f"sweep-{sweep.axis}", _sweep_values(sweep, scene, settings)) for sweep in sweeps]


def _sweep_values(sweep: Sweep, scene, settings: EnvelopeSettings) -> dict[str, Any]:
    axis = AXES[sweep.axis]
    easy, hard = axis.ends(scene)
    easy, hard = easy if sweep.easy is None else sweep.easy, hard if sweep.hard is None else sweep.hard
    if easy == hard or (axis.ratio and (easy <= 0 or hard <= 0)):
        expected = f"two different ends of {axis.title}, above 0 where it multiplies"
        raise Refused(expected, f"{easy:g} and {hard:g}", "change them")
    points = 5 if sweep.axis == "hidden" and sweep.points is None else sweep.points or settings.points
    return {"x": {"axis": sweep.axis, "easy": easy, "hard": hard, "points": points}}


def run(settings: EnvelopeSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Hits per point and condition, status and code of each photograph."""
    world = open_simulation(base / settings.run, settings.other_printer)
    n, photos = settings.n, settings.photos
    drawn = world.scene.draw("select", max(n, photos), _FIRST_SEED + settings.seed)
    x = cell.values["x"]
    axis, values = x["axis"], AXES[x["axis"]].values(x["easy"], x["hard"], x["points"]).tolist()
    as_target = recognize_target(world, axis, values, drawn[: _conditions_shown(settings, axis)])
    photographed = measure_photos(world, axis, values, drawn[:photos])
    wanted = world.scene.settings.target.goal.sign > 0
    works = {kind: (hits == wanted).astype(int).tolist() for kind, hits in as_target.items()}
    return {
        "goal": world.scene.settings.target.goal,
        "label": str(world.scene.settings.target.label),
        "model": world.problem.classifiers[0].name,
        "sheet": world.scene.sheet_id,
        "values": values,
        "recognized": works.pop("design"),
        "controls": works,
        "status": [[photo.status for photo in row] for row in photographed],
        "code": [[photo.code for photo in row] for row in photographed],
        "error_mm": [[photo.error_mm for photo in row] for row in photographed],
    }


def gains_in(answers: Mapping[str, Any]) -> list[Estimate]:
    """Per point the design's rate minus that of the better control there."""
    gains = []
    for hits, *controls in zip(answers["recognized"], *answers["controls"].values(), strict=True):
        value, (low, high) = paired_difference(hits, max(controls, key=sum))
        gains.append(Estimate(value, low, high, len(hits)))
    return gains


def sweep_bars(result: Result) -> list[Bar]:
    """A sweep's bars, one a stage: its design gains where the gain's interval lies above 0."""
    answers, axis = result.answers, AXES[result.cell.values["x"]["axis"]]
    title, shown, photos = f"{axis.title}, {axis.unit}", len(answers["recognized"][0]), len(answers["status"][0])
    gaining = [BarPoint(gain.low > 0, () if gain.low > 0 else ((NO_GAIN, 1),)) for gain in gains_in(answers)]
    bars = [Bar(STAGES[0], title, answers["values"], gaining, shown)]
    for stage, bad in zip(STAGES[1:], (("rejected",), ("rejected", "judged")), strict=True):
        points = []
        for statuses, codes in zip(answers["status"], answers["code"], strict=True):
            said = [code for status, code in zip(statuses, codes, strict=True) if status in bad]
            points.append(BarPoint(photos - len(said) >= MIN_SHARE * photos, Counter(filter(None, said)).most_common()))
        bars.append(Bar(stage, title, answers["values"], points, photos))
    return bars


def _all_bars(results: Sequence[Result]) -> list[Bar]:
    return sorted((bar for result in results for bar in sweep_bars(result)), key=lambda bar: STAGES.index(bar.method))


def tables(settings: EnvelopeSettings, results: Sequence[Result]) -> tuple[Table, ...]:
    """A table of the last good and the first bad point of each stage along each axis, and one of all points."""
    about = f"The design gains where the 95 % interval of its rate minus that of {_CONTROL} lies above 0; the sheet is "
    about += f"found, or measured, where {MIN_SHARE:.0%} of the photographs are. “{NO_GAIN}”: whatever is answered."
    rows = tuple(bar.row for bar in _all_bars(results))
    head = ("axis", "value", "recognized", *CONTROLS, "gain", "effect", "sheet found", "measured")
    head = (*head, "median error mm", "largest error mm", "said")
    points = tuple(row for result in results for row in _point_rows(result))
    about_points = f"Gain: over {_CONTROL} (Newcombe). Errors are the largest of the design's four corners, against "
    about_points += "the simulation's truth, of flat sheets. Intervals: Wilson."
    return (
        Table("breaks", "Where it breaks, and what is said there", BAR_HEAD, rows, about),
        Table("sweeps", "All points", head, points, about_points),
    )


def _point_rows(result: Result) -> list[tuple]:
    answers, title, rows = result.answers, AXES[result.cell.values["x"]["axis"]].title, []
    for i, (value, gain) in enumerate(zip(answers["values"], gains_in(answers), strict=True)):
        rates = [rate(hits[i]) for hits in (answers["recognized"], *answers["controls"].values())]
        status, errors = answers["status"][i], [e for e in answers["error_mm"][i] if e is not None]
        sheet = rate([s != "rejected" for s in status]), rate([s == "measured" for s in status])
        said = said_text(Counter(filter(None, answers["code"][i])).most_common())
        median, largest = (float(np.median(errors)), max(errors)) if errors else (None, None)
        rows.append((title, value, *rates, gain, "gains" if gain.low > 0 else NO_GAIN, *sheet, median, largest, said))
    return rows


def figures(settings: EnvelopeSettings, results: Sequence[Result]) -> tuple[Drawing, ...]:
    """The operating envelope as one page to print."""
    first, bars = results[0].answers, _all_bars(results)
    goal = "seen as" if Goal(first["goal"]).sign > 0 else "not seen as"
    title = f"Operating envelope of sheet {first['sheet']}: {goal} {first['label']} by {first['model']}\n"
    size_in = (8.3, 1.0 + ROW_IN * len(bars))
    about = tables(settings, results)[0].about
    return (Drawing("page", "Operating envelope", partial(draw_bars, bars, title=title), size_in, about),)


def _extent(settings: EnvelopeSettings, sweeps: Sequence[Cell]) -> str:
    """Say how many pictures the sweeps render: minutes, as a rule."""
    points = {cell.values["x"]["axis"]: cell.values["x"]["points"] for cell in sweeps}
    views = sum(count * _conditions_shown(settings, axis) for axis, count in points.items()) * (1 + len(CONTROLS))
    photos = sum(points.values()) * settings.photos
    return f"this renders {views:,} views for the network, and {photos:,} whole photographs to measure"


def _conditions_shown(settings: EnvelopeSettings, axis: str) -> int:
    return max(settings.n // 4, settings.photos) if axis == "jpeg" else settings.n


STUDY = Study("envelope", EnvelopeSettings, cells, run, tables, figures, extent=_extent)
