"""Study "mining": does training that mines the clean object's worst cases lift it there, at equal cost?

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

from patchproof.claims import difference, rate
from patchproof.experiments.hard_views import training_conditions
from patchproof.experiments.heat import heat_map
from patchproof.experiments.stress_map import (
    Count,
    MapSettings,
    ScenesSettings,
    axes,
    axes_said,
    bits,
    hits_of,
    in_cells,
    judge,
    map_of,
    problem_of,
    scene_cells,
    worst_cells,
)
from patchproof.optimizer.loop import SELECT_VIEWS, best_design, selections
from patchproof.optimizer.pixels import from_pixels
from patchproof.optimizer.problem import Problem
from patchproof.render.photograph import Shown
from patchproof.report.tables import Drawing, Table
from patchproof.scene.conditions import Conditions
from patchproof.settings import OptimizeSettings
from patchproof.strict import Refused
from patchproof.study.study import Cell, Result, Study

FORWARD, BOTH = 1, 3  # thirds of a pass: going back takes two products of matrices where going forward takes one
_CHOOSING, _MEASURING = 1_000_003, 2_000_003  # added to seeds, so that a seed's draws are used once
_THINGS = ("clean", "plain", "mined")


class MiningSettings(ScenesSettings):
    """How much is tried, and how much measures."""

    map: MapSettings = MapSettings(n=16)  # what finds the worst cells
    mine: Count = 240  # conditions that are tried before mined training
    n: Count = 60  # draws per worst cell that measure
    n_all: Count = 200  # draws over the whole ranges that measure


def cells(settings: MiningSettings, base: Path) -> list[Cell]:
    """A cell per scene, network and seed."""
    return scene_cells(settings, base)


def run(settings: MiningSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Map, train twice, measure."""
    plain, seed = problem_of(cell, base), cell.values["seed"]
    steps_of_mined = equal_steps(plain.scene.settings.optimize, settings.mine)
    mined = problem_of(cell, base, steps=steps_of_mined)
    both = axes(plain.scene.settings, settings.map)
    hits, confidence = map_of(plain, both, plain.scene.draw("select", settings.map.n, seed + _CHOOSING))
    worst = worst_cells(hits, confidence, plain.scene.settings.target.goal)
    things = {"clean": None, "plain": _trained(plain), "mined": _trained(mined, settings.mine)}
    drawn = plain.scene.draw("evaluate", settings.n * len(worst) + settings.n_all, seed + _MEASURING)
    return {
        "axes": axes_said(both),
        "rates": hits.mean(2).tolist(),
        "worst": [list(one) for one in worst],
        "steps": {"plain": plain.scene.settings.optimize.steps, "mined": steps_of_mined},
        "passes": {
            "plain": passes(plain.scene.settings.optimize),
            "mined": passes(mined.scene.settings.optimize, settings.mine),
        },
        "in_worst": _hits(plain, things, in_cells(drawn[: settings.n * len(worst)], both, worst)),
        "over_all": _hits(plain, things, drawn[settings.n * len(worst) :]),
    }


def passes(settings: OptimizeSettings, tries: int = 0) -> float:
    """What a training costs, in classifier passes (forward and backward) per classifier."""
    return _thirds(settings, tries) / BOTH


def equal_steps(plain: OptimizeSettings, mine: int) -> int:
    """The most steps with which mined training costs no more than training without."""
    for count in range(plain.steps, 0, -1):
        if _thirds(plain.model_copy(update={"steps": count}), mine) <= _thirds(plain, 0):
            return count
    raise Refused(f"a training that costs more than {mine} tries", f"{plain.steps} steps", "raise steps or lower mine")


def _thirds(settings: OptimizeSettings, tries: int) -> int:
    forward = selections(settings) * SELECT_VIEWS + tries
    return BOTH * settings.steps * settings.views + FORWARD * forward


def _trained(problem: Problem, tries: int = 0) -> Shown:
    """The best design of the whole loop, in 8 bits; with `tries`, on mined views."""
    conditions = training_conditions(problem, tries) if tries else None
    return problem.subject.shown(from_pixels(best_design(problem, conditions), problem.device))


def _hits(problem: Problem, things: dict[str, Shown], conditions: Conditions) -> dict[str, str]:
    return {name: bits(said.recognized) for name, said in judge(problem, things, conditions).items()}


def tables(settings: MiningSettings, results: Sequence[Result]) -> tuple[Table, ...]:
    """The lift in the worst cells and over all, per scene, network and seed; and pooled over seeds."""
    head = ("scene", "network", "seed", "steps", "steps mined", "passes", "passes mined")
    head = (*head, "clean", "not mined", "mined", "mined - not mined")
    share = "the worst tenth of the cells of pose × light, chosen on other draws"
    rows = {where: tuple(_row(one, where) for one in results) for where in ("in_worst", "over_all")}
    return (
        Table("worst", "In the clean object's worst cells", head, rows["in_worst"], f"Rates in {share}."),
        Table("all", "Over the whole ranges", head, rows["over_all"], "What mining costs or brings elsewhere."),
        Table(
            "pooled",
            "Worst cells, seeds together",
            ("scene", "network", "seeds", *head[-4:]),
            tuple(_pooled(results)),
            "All seeds' conditions in one; differences are paired by condition.",
        ),
    )


def _row(one: Result, where: str) -> tuple:
    values, found = one.cell.values, one.found
    costs = (*found["steps"].values(), *found["passes"].values())
    return (values["scene"], values["network"], values["seed"], *costs, *_compared([one], where))


def _pooled(results: Sequence[Result]):
    for scene, network in dict.fromkeys((one.cell.values["scene"], one.cell.values["network"]) for one in results):
        those = [one for one in results if (one.cell.values["scene"], one.cell.values["network"]) == (scene, network)]
        yield (scene, network, len(those), *_compared(those, "in_worst"))


def _compared(results: Sequence[Result], where: str) -> tuple:
    """(clean, not mined, mined, mined - not mined)."""
    clean, plain, mined = ([hit for one in results for hit in hits_of(one.found[where][thing])] for thing in _THINGS)
    return rate(clean), rate(plain), rate(mined), difference(mined, plain)


def figures(settings: MiningSettings, results: Sequence[Result]) -> tuple[Drawing, ...]:
    """The clean object's map with the worst cells framed, per cell of the study."""
    return tuple(
        heat_map(
            f"map_{one.cell.name}",
            f"{one.cell.values['scene']}, {one.cell.values['network']}, seed {one.cell.values['seed']}: clean object",
            one.found["axes"],
            one.found["rates"],
            settings.map.n,
            one.found["worst"],
        )
        for one in results
    )


STUDY = Study(
    "mining",
    "Designs trained with and without mining of the clean object's worst cases, at equal cost in classifier passes.",
    MiningSettings,
    cells,
    run,
    tables,
    figures,
)
