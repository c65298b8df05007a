"""Sweep a run's patch to where recognition, detection and measurement stop working, in simulation.

This is the patch's operating envelope, with the tool's codes beyond. The design is judged by its gain over the bare
object and a gray piece under the same conditions, since a network may give the target's label where nothing is visible.
In: a run, and sweeps of one axis each (`envelope.axes`; by default all that the scene allows). Out: tables and
a page to print beside the patch. All points share their draws of everything that is not varied, so that differences
between them are not due to chance. Draws cover the ranges evenly (scrambled Sobol points of a seed of their own);
intervals treat them as independent, which is cautious.

Left out on purpose: shadows of a card off the surface, which the renderer does not have, and a camera that exposes
longer in the dark: here, darkness is light missing from the picture.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from patchlab.study.study import Cell, Study
from patchlab.validation.envelope.axes import AXES, is_possible
from patchlab.validation.envelope.fit import CONTROLS, find_break, gain_break
from patchlab.validation.envelope.pages import figures, found_and_measured, gains_in, tables
from patchlab.validation.envelope.simulation import measure_photos, open_simulation, recognize_target
from patchproof.base.errors import Refused
from patchproof.base.validation import Finite, StrictModel, spelling_hint
from patchproof.optimizer.run import load_run
from patchproof.scene.interface import require_piece

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
    """Hits per point and condition, status and code of each photograph, and the breaks."""
    world = open_simulation(base / settings.run, settings.other_printer)
    n, photos = settings.n, settings.photos
    drawn = world.scene.draw("select", max(n, photos), _FIRST_SEED + settings.seed)
    x, along = _values(cell.values["x"])
    points = [{x: value} for value in along]
    as_target = recognize_target(world, points, drawn[: _conditions_shown(settings, x)])
    photographed = measure_photos(world, points, drawn[:photos])
    wanted = world.scene.settings.target.goal.sign > 0
    works = {kind: (hits == wanted).astype(int).tolist() for kind, hits in as_target.items()}
    answers = {
        "goal": world.scene.settings.target.goal,
        "label": str(world.scene.settings.target.label),
        "model": world.problem.classifiers[0].name,
        "sheet": world.scene.sheet_id,
        "points": points,
        "recognized": works.pop("design"),
        "controls": works,
        "status": [[photo.status for photo in row] for row in photographed],
        "code": [[photo.code for photo in row] for row in photographed],
        "error_mm": [[photo.error_mm for photo in row] for row in photographed],
    }
    positions = np.linspace(0, 1, len(points))
    stages = found_and_measured(answers).items()
    of_sheet = {stage: find_break(hits.T, positions, settings.seed) for stage, hits in stages}
    breaks = {"gains": gain_break(gains_in(answers), positions)} | of_sheet
    return answers | {"breaks": {stage: vars(each) for stage, each in breaks.items()}}


def _values(axis: dict) -> tuple[str, list[float]]:
    return axis["axis"], AXES[axis["axis"]].values(axis["easy"], axis["hard"], axis["points"]).tolist()


def _extent(settings: EnvelopeSettings, sweeps: Sequence[Cell]) -> str:
    """Say how many pictures the sweeps render: minutes, as a rule."""
    points = {cell.values["x"]["axis"]: cell.values["x"]["points"] for cell in sweeps}
    views = sum(count * _conditions_shown(settings, axis) for axis, count in points.items()) * (1 + len(CONTROLS))
    photos = sum(points.values()) * settings.photos
    return f"this renders {views:,} views for the network, and {photos:,} whole photographs to measure"


def _conditions_shown(settings: EnvelopeSettings, axis: str) -> int:
    return max(settings.n // 4, settings.photos) if axis == "jpeg" else settings.n


STUDY = Study("envelope", EnvelopeSettings, cells, run, tables, figures, extent=_extent)
