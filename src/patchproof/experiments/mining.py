"""Designs trained with and without mining of the clean object's worst cases, at equal cost in classifier passes.

In: scenes whose `optimize` settings say how a design is trained without mining, networks, seeds. Per cell a map of
pose × light finds the tenth of its cells where the clean object fails most, on draws of the select stream with a seed
of their own. Then two designs are trained, one without mining and one with, the latter for as many steps fewer as its
tries cost; both are measured in those cells, and over the whole ranges, on draws of the evaluate stream with another
seed. The map, training and measuring share no background, light or camera.

Cost is counted in classifier passes: a view forward and backward is one, a view forward only a third, and that
includes what selects a design. Differences are paired by condition; their intervals are of the designs that were
trained: another seed's may do better or worse.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from patchproof.experiments.hard_views import training_conditions
from patchproof.experiments.heat import heat_map, map_ticks
from patchproof.experiments.stress_map import (
    MapSettings,
    axes_of,
    axes_values,
    in_cells,
    map_of,
    mesh_cells,
    worst_cells,
)
from patchproof.optimizer import loop
from patchproof.optimizer.loop import best_design, selections
from patchproof.optimizer.pixels import from_pixels
from patchproof.optimizer.problem import Problem
from patchproof.optimizer.responses import responses
from patchproof.render.photograph import Shown
from patchproof.report.tables import Drawing, Table
from patchproof.settings import OptimizeSettings
from patchproof.strict import Refused
from patchproof.study.grid import Count, GridSettings, grouped, of_values, problem_of, who, with_tables
from patchproof.study.record import Record, recorded
from patchproof.study.study import Cell, Result, Study

FORWARD, BOTH = 1, 3  # thirds of a pass: going back takes two products of matrices where going forward takes one
_CHOOSING, _MEASURING = 1_000_003, 2_000_003  # added to seeds, so that a seed's draws are used once
_THINGS = ("clean", "plain", "mined")


class MiningSettings(GridSettings):
    """Two designs per cell, one of them trained on mined views."""

    map: MapSettings = MapSettings(n=16)  # what finds the worst cells
    mine: Count = 240  # conditions that are tried before mined training
    n: Count = 60  # draws in each worst cell that measure
    n_all: Count = 200  # draws over the whole ranges that measure


def cells(settings: MiningSettings, base: Path) -> list[Cell]:
    """A cell per scene, network and seed."""
    return mesh_cells(settings, base)


def run(settings: MiningSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Map, train twice, measure."""
    plain, seed = problem_of(base, cell.values), cell.values["seed"]
    usual = plain.scene.settings.optimize
    fewer = usual.changed(steps=equal_steps(usual, settings.mine))
    mined = problem_of(base, with_tables(dict(cell.values), {"optimize": {"steps": fewer.steps}}))
    axes = axes_of(plain.scene.settings, settings.map)
    hits, confidence = map_of(plain, axes, plain.scene.draw("select", settings.map.n, seed + _CHOOSING))
    worst = worst_cells(hits, confidence, plain.scene.settings.target.goal)
    things = {"clean": None, "plain": _trained(plain), "mined": _trained(mined, settings.mine)}
    drawn = plain.scene.draw("evaluate", settings.n * len(worst) + settings.n_all, seed + _MEASURING)
    in_worst, over_all = drawn[: settings.n * len(worst)], drawn[settings.n * len(worst) :]
    return {
        "axes": axes_values(axes),
        "rates": hits.mean(2).tolist(),
        "worst": [list(place) for place in worst],
        "steps": [usual.steps, fewer.steps],
        "passes": [passes(usual), passes(fewer, settings.mine)],
        "in_worst": recorded(responses(plain, things, in_cells(in_worst, axes, worst))),
        "over_all": recorded(responses(plain, things, over_all)),
    }


def passes(settings: OptimizeSettings, tries: int = 0) -> float:
    """What a training costs, in classifier passes (forward and backward) per classifier."""
    return _thirds(settings, tries) / BOTH


def equal_steps(plain: OptimizeSettings, mine: int) -> int:
    """The most steps with which mined training costs no more than training without."""
    for count in range(plain.steps, 0, -1):
        if _thirds(plain.changed(steps=count), mine) <= _thirds(plain, 0):
            return count
    raise Refused(f"a training that costs more than {mine} tries", f"{plain.steps} steps", "raise steps or lower mine")


def _thirds(settings: OptimizeSettings, tries: int) -> int:
    forward = selections(settings) * loop.SELECT_VIEWS + tries
    return BOTH * settings.steps * settings.views + FORWARD * forward


def _trained(problem: Problem, tries: int = 0) -> Shown:
    """The best design of the whole loop, in 8 bits; with `tries`, on mined views."""
    conditions = training_conditions(problem, tries) if tries else None
    return problem.subject.shown(from_pixels(best_design(problem, conditions), problem.device))


def tables(settings: MiningSettings, results: Sequence[Result]) -> tuple[Table, ...]:
    """The lift in the worst cells and over all, per scene, network and seed; and pooled over seeds."""
    head = ("scene", "network", "seed", "steps", "steps mined", "passes", "passes mined")
    rates = ("clean", "not mined", "mined", "mined - not mined")
    pooled = grouped(results, of_values("name", "network"))
    return (
        Table(
            "worst",
            "In the clean object's worst cells",
            (*head, *rates),
            tuple(_row(result, "in_worst") for result in results),
            "Rates in the worst tenth of the cells of pose × light, chosen on other draws.",
        ),
        Table(
            "all",
            "Over the whole ranges",
            (*head, *rates),
            tuple(_row(result, "over_all") for result in results),
            "What mining costs or brings elsewhere.",
        ),
        Table(
            "pooled",
            "Worst cells, seeds together",
            ("scene", "network", "seeds", *rates),
            tuple((*key, len(group), *_compared(group, "in_worst")) for key, group in pooled.items()),
            "All seeds' conditions in one; differences are paired by condition.",
        ),
    )


def _row(result: Result, where: str) -> tuple:
    return (*who(result), *result.answers["steps"], *result.answers["passes"], *_compared([result], where))


def _compared(results: Sequence[Result], where: str) -> tuple:
    """(clean, not mined, mined, mined - not mined)."""
    clean, plain, mined = (Record(results, thing, where) for thing in _THINGS)
    return *(record.level()[0] for record in (clean, plain, mined)), mined.gain(plain)[0]


def figures(settings: MiningSettings, results: Sequence[Result]) -> tuple[Drawing, ...]:
    """The clean object's map with the worst cells framed, per cell of the study."""
    caption = f"rate, n = {settings.map.n} draws per cell; framed: the worst tenth"
    drawings = []
    for result in results:
        title = "{}, {}, seed {}: clean object".format(*who(result))
        answers, name = result.answers, f"map_{result.cell.name}"
        ticks = map_ticks(answers["axes"])
        drawings.append(heat_map(name, (title, caption), answers["rates"], answers["worst"], ticks))
    return tuple(drawings)


STUDY = Study("mining", MiningSettings, cells, run, tables, figures)
