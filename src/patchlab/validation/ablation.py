"""What each modeled effect earns when training knows it.

It is left out of training, and the design is tried in the whole world.
In: scene files in which the effects of interest are on, networks, seeds. Out: for each effect how much rate and
confidence designs lose that were trained without it, against designs trained with all, under the same conditions; by
our renderer, and in path-traced photographs (`path_traced`), whose light is not ours. What takes an effect's place is
what `plan` puts there (`plan.terms`): even light for the sun, not darkness. Effects joined by " + " go together.

All designs of a scene, network and seed share their draws, but each is another design: its own luck is in every
difference, so intervals are over such groups, not over conditions. Views keep their poses for one step. What an effect
costs is the share of a step's time that goes when it is left out, steps taken in turn; on a busy machine it is noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from patchlab.bench.measure import ratio
from patchlab.study.claims import mean
from patchlab.study.grid import GridSettings, Names, grid_cells, grouped, problem_of, who
from patchlab.study.record import Record, recorded
from patchlab.study.study import Cell, Result, Study
from patchproof.app.plan.cost import in_turn, steps_ms
from patchproof.app.plan.terms import PRINTER, Setup, effect_terms, scene_terms
from patchproof.base.claims import Estimate
from patchproof.base.strict import Refused
from patchproof.channel.printer import identity_printer
from patchproof.optimizer.loop import best_design
from patchproof.optimizer.pixels import from_pixels
from patchproof.optimizer.problem import Problem
from patchproof.optimizer.responses import ask, joined, responses
from patchproof.render.photograph import Shown
from patchproof.render.pixels import PiecePicture
from patchproof.render.views import Views, see
from patchproof.report.tables import Table
from patchproof.reprints.path_traced import photograph_traced
from patchproof.scene.conditions import Conditions

ALL = "all"
ROUNDS = 5  # of steps in turn, to know what they take
# What goes together, because alone it is too little to tell.
_TOGETHER = ("dot gain + ink density + printed black + paper white", "blur + motion blur")
_UNSEEN = "JPEG"  # training's views are too small to show it


def _default_effects() -> tuple[str, ...]:
    """All effects that `plan` can switch off, in its order."""
    printed = (PRINTER, *(term.name for term in effect_terms("printer")))
    names = (*(term.name for term in effect_terms("light")), *printed, *(term.name for term in effect_terms("camera")))
    joined = {name: group for group in _TOGETHER for name in group.split(" + ")}
    return tuple(dict.fromkeys(joined.get(name, name) for name in names if name != _UNSEEN))


EFFECTS = _default_effects()
WORLDS = ("modeled", "path_traced")  # whose photographs: our renderer's, or the path tracer's


class AblationSettings(GridSettings):
    """A design for each scene, network and seed with all effects, and one without each."""

    effects: Names = EFFECTS  # left out one by one; "a + b" leaves out both at once
    n: Annotated[int, Field(ge=10)] = 400  # unseen conditions for each design
    photos: Annotated[int, Field(ge=0, le=1000)] = 40  # path-traced photographs of each design


@dataclass(frozen=True, eq=False)
class Without(Problem):
    """A problem that sees its views without some effects."""

    changes: tuple[Callable[[Setup], Setup | None], ...] = ()

    def see(self, shown: Shown, conditions: Conditions, side_px: int) -> Views:
        """Views in which what is left out is as in the simpler model."""
        setup = Setup(self.stage, shown, conditions)
        for change in self.changes:
            setup = change(setup) or setup
        return see(setup.stage, shown, setup.conditions, (side_px, side_px))


def without(problem: Problem, effect: str) -> Problem:
    """The problem without the effects of that name, joined by " + "; refused where none of them is on."""
    terms = {term.name: term for term in scene_terms(problem, problem.subject.start(), None) if term.modeled}
    names = effect.split(" + ")
    unknown = [name for name in names if name not in terms]
    if unknown:
        raise Refused("an effect that this kind of scene has", f'"{unknown[0]}"', "choose of " + ", ".join(terms))
    setup = Setup(problem.stage, problem.subject.shown(problem.subject.start()), problem.scene.draw("select", 64))
    on = [name for name in names if terms[name].change(setup) is not None]
    if not on:
        raise Refused(f"a scene with {effect} in it", "one where it is off", f"give {terms[names[0]].key} a range")
    subject = problem.subject
    if PRINTER in on:
        subject = subject.printed_by(identity_printer())
    changes = tuple(terms[name].change for name in on if name != PRINTER)
    return Without(**vars(replace(problem, subject=subject)), changes=changes)


def cells(settings: AblationSettings, base: Path) -> list[Cell]:
    """For each scene, network and seed: a design trained with all effects, and one without each."""
    effects = (ALL, *settings.effects)
    return grid_cells(settings, base, lambda values: ((values | {"effect": each}, (each[:40],)) for each in effects))


def run(settings: AblationSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Train without the effect; hits and confidences in the whole world."""
    problem, effect = problem_of(base, cell.values), cell.values["effect"]
    design = best_design(problem if effect == ALL else without(problem, effect))
    shown = problem.subject.shown(from_pixels(design, problem.device))
    answers = {"modeled": responses(problem, {"design": shown}, problem.scene.draw("evaluate", settings.n))}
    if settings.photos:
        drawn = problem.scene.draw("reprint", settings.photos)
        piece = shown if isinstance(shown, PiecePicture) else None
        alone = [drawn[i : i + 1] for i in range(len(drawn))]
        photos = (photograph_traced(problem.stage, piece, each) for each in alone)
        asked = (ask(problem, photo, problem.boxes(each)) for photo, each in zip(photos, alone, strict=True))
        answers["path_traced"] = joined([{"design": answer} for answer in asked])
    costs = _costs(problem, settings.effects) if effect == ALL else {}
    return {"cost": costs, **{world: recorded(some) for world, some in answers.items()}}


def _costs(problem: Problem, effects: Sequence[str]) -> dict[str, float]:
    """The share of a step's time that goes where each effect is left out: medians over rounds."""
    tried = {ALL: problem} | {effect: without(problem, effect) for effect in effects}
    calls = {name: steps_ms(some, problem.subject.start()) for name, some in tried.items()}
    times = {name: np.array([sum(row.values()) for row in rows]) for name, rows in in_turn(calls, ROUNDS).items()}
    return {name: 1 - ratio(times, name, ALL).value for name in effects}


def tables(settings: AblationSettings, results: Sequence[Result]) -> tuple[Table, ...]:
    """What each effect earned over all groups, and in each."""
    head = ("trained without", "groups", "rate", "confidence", "rate, path-traced", "confidence, path-traced")
    about = f"trained with all effects minus without: positive is what the effect earned; {settings.n} conditions and "
    about += f"{settings.photos} photographs for each design; intervals over groups of scene, network and seed"
    rows, designs = [], []
    for group in _groups(results):
        designs += [(*who(result), result.cell.values["effect"], *_means(result)) for result in group.values()]
    for effect in settings.effects:
        compared = [(group[ALL], group[effect]) for group in _groups(results) if ALL in group and effect in group]
        if compared:
            costs = [whole.answers["cost"][effect] for whole, _ in compared]
            rows.append((effect, len(compared), *_earned(compared), mean(costs)))
    start = ("scene", "network", "seed", "trained without", *head[2:])
    cost = "share of a step's time"
    return (
        Table("earned", "What each effect earns", (*head, cost), tuple(rows), about),
        Table("designs", "Every design", start, tuple(designs), "its own rates and confidences in the whole world"),
    )


def _groups(results: Sequence[Result]) -> list[dict[str, Result]]:
    """By scene, network and seed the results of each effect."""
    groups = grouped(results, who).values()
    return [{result.cell.values["effect"]: result for result in group} for group in groups]


def _means(result: Result) -> list[float | None]:
    """Rate and confidence of a design in each world; None where nothing was photographed."""
    records = [Record([result], "design", world) if world in result.answers else None for world in WORLDS]
    figures = [some for record in records for some in ((record.hits(), record.confidences()) if record else ((), ()))]
    return [float(np.mean(some)) if some else None for some in figures]


def _earned(compared: Sequence[tuple[Result, Result]]) -> list[Estimate | None]:
    """What the first of each pair is better by: rate and confidence in each world."""
    differences = [
        [None if a is None or b is None else a - b for a, b in zip(_means(whole), _means(less), strict=True)]
        for whole, less in compared
    ]
    columns = ([value for value in column if value is not None] for column in zip(*differences, strict=True))
    return [mean(column) for column in columns]


STUDY = Study("ablation", AblationSettings, cells, run, tables)
