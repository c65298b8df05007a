"""Leave each modeled effect out of training: the rate that it earns, and the error of a promise without it.

A design is trained without the effect and tested in the full world and in the world without it.
In: scene files in which the effects of interest are on, networks, seeds. Out: for each effect the rate and
confidence that designs trained without it lose against designs trained with all, under the same conditions, by our
renderer and in path-traced photographs (`path_traced`), whose light is not ours. And the design's rate in the full
world minus that in the world without the effect, which would be its promise: same design, same sessions.
An effect is replaced as `plan` does it (`plan.errors`): even light for the sun, not darkness. Effects joined by " + "
are left out together; a scene in which all of them are off is skipped.

All designs of a scene, network and seed share their draws, but designs differ by chance, so intervals of earned rates
are over such groups, not over conditions; errors of promises hardly depend on the design, and their intervals are over
pairs of scene and network. Views keep their poses for one step. Left out on purpose: an effect's share of a step's
time, which varies by some 20 % from run to run.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from patchlab.study.estimates import mean
from patchlab.study.grid import CellValues, GridSettings, Names, by_values, cell_key, grid_cells, group_by, problem_of
from patchlab.study.record import parse_hits, to_record
from patchlab.study.study import Cell, Result, Study
from patchlab.study.trained_designs import best_design
from patchlab.validation.path_traced import photograph_traced
from patchproof.app.plan.errors import PRINTER, Setup, effect_terms, scene_terms
from patchproof.base.errors import Refused
from patchproof.base.intervals import Estimate
from patchproof.base.sessions import count_by_session, rate_posterior
from patchproof.base.settings import SceneSettings
from patchproof.base.validation import validate_model
from patchproof.channel.effects import EFFECT_BY_NAME
from patchproof.channel.printer import identity_printer
from patchproof.optimizer.problem import Problem
from patchproof.optimizer.promise import VIEWS_PER_SESSION
from patchproof.optimizer.responses import ask_networks, merge_responses, responses
from patchproof.optimizer.subject import from_pixels
from patchproof.render.photograph import Appearance
from patchproof.render.pixels import PiecePicture
from patchproof.render.views import Views, relight_and_replace_background
from patchproof.report.tables import Table
from patchproof.scene.conditions import Conditions, draw
from patchproof.scene.conditions import without_effect as drawn_without

ALL_EFFECTS = "all"
# effects left out together, because each alone is too small to measure
_EFFECT_GROUPS = ("dot gain + ink density + chroma + veil", "blur + motion blur")
_INVISIBLE_EFFECT = "JPEG"  # training views are too small to show it


def _default_effects() -> tuple[str, ...]:
    """All effects that `plan` can switch off, in its order, grouped."""
    printed = (PRINTER, *(term.name for term in effect_terms("printer")))
    names = (*(term.name for term in effect_terms("light")), *printed, *(term.name for term in effect_terms("camera")))
    group_of = {name: group for group in _EFFECT_GROUPS for name in group.split(" + ")}
    return tuple(dict.fromkeys(group_of.get(name, name) for name in names if name != _INVISIBLE_EFFECT))


EFFECTS = _default_effects()
WORLDS = ("modeled", "path_traced")  # photographs by our renderer, or by the path tracer


class AblationSettings(GridSettings):
    """Settings: for each scene, network and seed a design with all effects, and one without each."""

    effects: Names = EFFECTS  # left out one by one; "a + b" leaves out both at once
    n: Annotated[int, Field(ge=10)] = 400  # unseen conditions for each design, in sessions as a promise has them
    photos: Annotated[int, Field(ge=0, le=1000)] = 40  # path-traced photographs of each design


@dataclass(frozen=True, eq=False)
class SimplifiedProblem(Problem):
    """A problem whose views are rendered without some effects."""

    changes: tuple[Callable[[Setup], Setup | None], ...] = ()

    def see(self, appearance: Appearance, conditions: Conditions, side_px: int) -> Views:
        """Render views with the simpler model."""
        setup = self._simpler(appearance, conditions)
        return Problem.see(replace(self, stage=setup.stage), appearance, setup.conditions, side_px)

    def see_again(self, views: Views, conditions: Conditions) -> Views:
        """Relight views as `Problem` does, without the effects left out."""
        return relight_and_replace_background(views, self._simpler(self.start_appearance, conditions).conditions)

    def _simpler(self, appearance: Appearance, conditions: Conditions) -> Setup:
        setup = Setup(self.stage, appearance, conditions)
        for change in self.changes:
            setup = change(setup) or setup
        return setup


def simplify_problem(problem: Problem, effect: str) -> Problem:
    """The problem without the effects joined by " + "; refused if none of them is on."""
    terms = {term.name: term for term in scene_terms(problem, problem.subject.start(), None) if term.modeled}
    names = effect.split(" + ")
    unknown = [name for name in names if name not in terms]
    if unknown:
        raise Refused("an effect that this kind of scene has", f'"{unknown[0]}"', "choose one of " + ", ".join(terms))
    setup = Setup(problem.stage, problem.subject.appearance(problem.subject.start()), problem.scene.draw("select", 64))
    on = [name for name in names if terms[name].change(setup) is not None]
    if not on:
        do = f"give {terms[names[0]].key} a range"
        raise Refused(f"a scene with {effect} in it", "a scene in which it is off", do)
    subject = problem.subject
    if PRINTER in on:
        subject = replace(problem.patch, printer=identity_printer())
    changes = tuple(terms[name].change for name in on if name != PRINTER)
    return SimplifiedProblem(**vars(replace(problem, subject=subject)), changes=changes)


def cells(settings: AblationSettings, base: Path) -> list[Cell]:
    """A cell per scene, network, seed and effect that is on, and one with all effects."""

    def vary(values: CellValues) -> list[tuple[CellValues, tuple[str, ...]]]:
        on = [effect for effect in settings.effects if _is_on(values, effect)]
        return [(values | {"effect": effect}, (effect[:40],)) for effect in (ALL_EFFECTS, *on)]

    return grid_cells(settings, base, vary)


def _is_on(values: CellValues, effect: str) -> bool:
    """True if the scene has one of the effects joined by " + "; an effect that is not in `EFFECTS` counts as on."""
    scene = validate_model(SceneSettings, values["scene"], values["file"])
    drawn = draw(scene, "select", 64, 0)
    names = [name for name in effect.split(" + ") if name in EFFECT_BY_NAME]
    on = [
        drawn_without(drawn, EFFECT_BY_NAME[name], lambda azimuth, _: np.ones(azimuth.shape)) is not None
        for name in names
    ]
    return any(on) or len(on) < len(effect.split(" + "))


def run(settings: AblationSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Train without the effect; record hits and confidences in the full world, and in the world without it."""
    problem, effect = problem_of(base, cell.values), cell.values["effect"]
    simpler = problem if effect == ALL_EFFECTS else simplify_problem(problem, effect)
    design = best_design(simpler)
    shown = problem.subject.appearance(from_pixels(design, problem.device))
    conditions = problem.scene.draw("evaluate", settings.n, per_session=VIEWS_PER_SESSION)
    answers = {"modeled": responses(problem, {"design": shown}, conditions)}
    if effect != ALL_EFFECTS:
        as_trained = simpler.subject.appearance(from_pixels(design, problem.device))
        answers["promised"] = responses(simpler, {"design": as_trained}, conditions)
    if settings.photos:
        drawn = problem.scene.draw("reprint", settings.photos)
        piece = shown if isinstance(shown, PiecePicture) else None
        alone = [drawn[i : i + 1] for i in range(len(drawn))]
        photos = (photograph_traced(problem.stage, piece, each) for each in alone)
        replies = (ask_networks(problem, photo, problem.boxes(each)) for photo, each in zip(photos, alone, strict=True))
        answers["path_traced"] = merge_responses([{"design": answer} for answer in replies])
    return {world: to_record(some) for world, some in answers.items()}


def tables(settings: AblationSettings, results: Sequence[Result]) -> tuple[Table, ...]:
    """Tables of the rate each effect earned, of the errors of promises without it, and of every design."""
    head = ("rate", "confidence", "rate, path-traced", "confidence, path-traced")
    about = f"trained with all effects minus without: positive is what the effect earned; {settings.n} conditions and "
    about += f"{settings.photos} photographs for each design; intervals over groups of scene, network and seed"
    missed_about = "the same design, trained without the effect, in the same sessions: the whole world minus the world "
    missed_about += "without it; “half width” is the mean of the promises' own 95 % intervals, “outside” counts "
    missed_about += "designs whose rate in the whole world lies outside of them"
    earned, missed, designs, groups = [], [], [], _group_by_effect(results)
    for group in groups:
        designs += [_design_row(result) for result in group.values()]
    for effect in settings.effects:
        compared = [(group[ALL_EFFECTS], group[effect]) for group in groups if ALL_EFFECTS in group and effect in group]
        if compared:
            earned.append((effect, len(compared), *_mean_differences(compared)))
            missed.append((effect, *_promise_errors([less for _, less in compared])))
    missed_head = ("left out", "designs", "rate", "confidence", "largest", "half width", "outside")
    start = ("scene", "network", "seed", "trained without", *head, "promised", "promised confidence")
    return (
        Table("earned", "What each effect earns", ("trained without", "groups", *head), tuple(earned), about),
        Table("missed", "What a promise without it is off by", missed_head, tuple(missed), missed_about),
        Table("designs", "Every design", start, tuple(designs), "its own rates and confidences in the whole world"),
    )


def _design_row(result: Result) -> tuple:
    traced_and_ours = (*cell_key(result), result.cell.values["effect"], *_world_means(result))
    if "promised" not in result.answers:
        return (*traced_and_ours, None, None)
    return (*traced_and_ours, _promised_rate(result), _mean_of(result, "promised", "confidence"))


def _promised_rate(result: Result) -> Estimate:
    """The rate in the world without the effect, with a promise's interval over sessions."""
    hits = parse_hits(result.answers["promised"]["hits"]["design"][0])
    posterior = rate_posterior(*count_by_session(hits, VIEWS_PER_SESSION))
    return Estimate(float(np.mean(hits)), *posterior.rate_interval, len(hits))


def _promise_errors(results: Sequence[Result]) -> tuple:
    """(designs, rate, confidence, largest change of rate, mean half width of promises, number outside)."""
    of_pairs = group_by(results, by_values("name", "network")).values()
    rate, confidence = (
        mean([float(np.mean([_promise_error(result, kind) for result in pair])) for pair in of_pairs])
        for kind in ("hits", "confidence")
    )
    promises = [_promised_rate(result) for result in results]
    half = float(np.mean([(promise.high - promise.low) / 2 for promise in promises]))
    rates = [_mean_of(result, "modeled", "hits") for result in results]
    outside = sum(not promise.low <= rate <= promise.high for rate, promise in zip(rates, promises, strict=True))
    return len(results), rate, confidence, max((_promise_error(r, "hits") for r in results), key=abs), half, outside


def _promise_error(result: Result, kind: str) -> float:
    return _mean_of(result, "modeled", kind) - _mean_of(result, "promised", kind)


def _mean_of(result: Result, world: str, kind: str) -> float:
    values = result.answers[world][kind]["design"][0]
    return float(np.mean(parse_hits(values) if kind == "hits" else values))


def _group_by_effect(results: Sequence[Result]) -> list[dict[str, Result]]:
    groups = group_by(results, cell_key).values()
    return [{result.cell.values["effect"]: result for result in group} for group in groups]


def _world_means(result: Result) -> list[float | None]:
    """Rate and confidence of a design in each world; None without photographs."""
    kinds = ("hits", "confidence")
    return [_mean_of(result, world, kind) if world in result.answers else None for world in WORLDS for kind in kinds]


def _mean_differences(compared: Sequence[tuple[Result, Result]]) -> list[Estimate | None]:
    """Mean differences, first minus second of each pair: rate and confidence in each world."""
    pairs = [zip(_world_means(whole), _world_means(less), strict=True) for whole, less in compared]
    differences = [[None if a is None or b is None else a - b for a, b in pair] for pair in pairs]
    columns = ([value for value in column if value is not None] for column in zip(*differences, strict=True))
    return [mean(column) for column in columns]


STUDY = Study("ablation", AblationSettings, cells, run, tables)
