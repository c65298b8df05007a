"""What each modeled effect earns: it is left out of training, and the design is tried in the whole world.

In: scene files in which the effects of interest are on, networks, seeds. Out: for each effect how much rate and
confidence designs lose that were trained without it, against designs trained with all, under the same conditions; by
our renderer, and in path-traced photographs (`path_traced`), whose light is not ours. What takes an effect's place is
what `plan` puts there (`plan.terms`): even light for the sun, not darkness. Effects joined by " + " go together.

All designs of a scene, network and seed share their draws, but each is another design: its own luck is in every
difference, so intervals are over such groups, not over conditions. Views keep their poses for one step. What an effect
costs is the share of a step's time that goes when it is left out, steps taken in turn; on a busy machine it is noise.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field

from patchproof.channel.printer import identity_printer
from patchproof.claims import Estimate, mean
from patchproof.classifier.network import recognized
from patchproof.optimizer.loop import best_design
from patchproof.optimizer.patch import Patch
from patchproof.optimizer.pixels import from_pixels
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.optimizer.promise import judged
from patchproof.plan.cost import relative_costs
from patchproof.plan.terms import PRINTER, Setup, effect_terms, scene_terms
from patchproof.render.photograph import Shown
from patchproof.render.pixels import PiecePicture
from patchproof.render.views import Views, see
from patchproof.report.tables import Drawing, Table
from patchproof.reprints.path_traced import photograph_traced
from patchproof.scene.conditions import Conditions
from patchproof.settings import SceneSettings
from patchproof.strict import Refused, Strict, expand, read_toml, validated
from patchproof.study.study import Cell, Result, Study, short_name
from patchproof.study.trained import scene_of

ALL = "all"
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
Names = Annotated[tuple[str, ...], Field(min_length=1)]


class AblationSettings(Strict):
    """Every scene with every network and seed."""

    scenes: Names  # scene files
    networks: Names  # each trains and judges its own designs
    seeds: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)] = (0,)  # of the optimizer
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
        piece = shown if isinstance(shown, PiecePicture) else None
        return see(setup.stage, piece, setup.conditions, (side_px, side_px))


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
        if not isinstance(subject, Patch):
            raise Refused("a printed patch", "a texture", f'leave "{PRINTER}" out')
        subject = replace(subject, printer=identity_printer())
    parts = {field.name: getattr(problem, field.name) for field in fields(Problem)} | {"subject": subject}
    return Without(**parts, changes=tuple(terms[name].change for name in on if name != PRINTER))


def cells(settings: AblationSettings, base: Path) -> list[Cell]:
    """For each scene, network and seed: a design trained with all effects, and one without each."""
    found = []
    for file in settings.scenes:
        path = Path(expand(file, base))
        scene = validated(SceneSettings, read_toml(path), path.name)
        for network in settings.networks:
            for seed in settings.seeds:
                for effect in (ALL, *settings.effects):
                    word = re.sub(r"[^\w=,-]+", "-", effect)[:40]
                    name = re.sub(r"[^\w=+.,-]", "-", f"{path.stem}.{short_name(network)}.{seed}.{word}")
                    values = {"name": path.stem, "file": file, "scene": scene.model_dump(mode="json"), "seed": seed}
                    found.append(Cell(name, values | {"network": network, "effect": effect}))
    return found


def run(settings: AblationSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Train without the effect; hits and confidences in the whole world."""
    values, scene = cell.values, scene_of(base, cell)
    problem = set_problem(scene, models=(expand(values["network"], base),))
    whole = values["effect"] == ALL
    design = best_design(problem if whole else without(problem, values["effect"]))
    shown = problem.subject.shown(from_pixels(design, problem.device))
    outcomes = judged(problem, {"design": shown}, scene.draw("evaluate", settings.n))
    traced = _traced(problem, shown, scene.draw("reprint", settings.photos)) if settings.photos else ([], [])
    return {
        "hits": outcomes.recognized["design"][0].astype(int).tolist(),
        "confidence": np.round(outcomes.confidence["design"][0], 5).tolist(),
        "traced_hits": traced[0],
        "traced_confidence": traced[1],
        "cost": _costs(problem, settings.effects) if whole else {},
    }


def _costs(problem: Problem, effects: Sequence[str]) -> dict[str, float]:
    """The share of a step's time that goes where each effect is left out."""
    less = {effect: without(problem, effect) for effect in effects}
    return {name: 1 - ratio for name, ratio in relative_costs(problem, less, problem.subject.start()).items()}


def _traced(problem: Problem, shown: Shown, conditions: Conditions) -> tuple[list[int], list[float]]:
    hits, confidences = [], []
    (classifier,), (indices,) = problem.classifiers, problem.indices
    for i in range(len(conditions)):
        picture = photograph_traced(problem.stage, shown, conditions[i : i + 1])
        with torch.no_grad():
            logits = classifier.logits(picture)
        hits.append(int(recognized(logits, indices)[0]))
        confidences.append(round(float(classifier.confidence(logits, indices)[0]), 5))
    return hits, confidences


def tables(settings: AblationSettings, results: Sequence[Result]) -> tuple[Table, ...]:
    """What each effect earned over all groups, and in each."""
    groups = _groups(results)
    head = ("trained without", "groups", "rate", "confidence", "rate, path-traced", "confidence, path-traced")
    cost = "share of a step's time"
    keys = ("hits", "confidence", "traced_hits", "traced_confidence")
    rows = []
    for effect in settings.effects:
        both = [(one[ALL], one[effect]) for one in groups.values() if ALL in one and effect in one]
        if both:
            costs = mean([whole["cost"][effect] for whole, _ in both])
            rows.append((effect, len(both), *(_earned(both, key) for key in keys), costs))
    about = f"trained with all effects minus without: positive is what the effect earned; {settings.n} conditions and "
    about += f"{settings.photos} photographs for each design; intervals over groups of scene, network and seed"
    every = []
    for (name, network, seed), one in groups.items():
        for effect, found in one.items():
            means = [float(np.mean(found[key])) if found[key] else None for key in keys]
            every.append((name, short_name(network), seed, effect, *means))
    said = ("scene", "network", "seed", "trained without", *head[2:])
    return (
        Table("earned", "What each effect earns", (*head, cost), tuple(rows), about),
        Table("designs", "Every design", said, tuple(every), "its own rates and confidences in the whole world"),
    )


def _groups(results: Sequence[Result]) -> dict[tuple[str, str, int], dict[str, Any]]:
    found: dict[tuple[str, str, int], dict[str, Any]] = {}
    for one in results:
        values = one.cell.values
        found.setdefault((values["name"], values["network"], values["seed"]), {})[values["effect"]] = one.found
    return found


def _earned(both: Sequence[tuple], key: str) -> Estimate | None:
    if not both[0][0][key]:
        return None
    return mean([float(np.mean(whole[key]) - np.mean(less[key])) for whole, less in both])


def figures(settings: AblationSettings, results: Sequence[Result]) -> tuple[Drawing, ...]:
    """Confidence earned, by effect."""
    rows = tables(settings, results)[0].rows
    if not rows:
        return ()

    def draw(figure) -> None:
        axes = figure.subplots()
        for shift, at, label in ((-0.15, 3, "our renderer"), (0.15, 5, "path-traced")):
            some = [(i + shift, row[at]) for i, row in enumerate(rows) if row[at] is not None]
            if some:
                places, found = zip(*some, strict=True)
                low = [max(0.0, one.value - one.low) for one in found]
                high = [max(0.0, one.high - one.value) for one in found]
                axes.errorbar([one.value for one in found], places, xerr=[low, high], fmt="o", label=label, capsize=2)
        axes.axvline(0, color="0.6", linewidth=1)
        axes.set_yticks(range(len(rows)), [str(row[0]).replace(" + ", ",\n") for row in rows], fontsize=8)
        axes.invert_yaxis()
        axes.set_xlabel("confidence earned in the whole world (95 %)")
        axes.legend(fontsize=8)

    size = (7.0, 1.5 + 0.38 * len(rows))
    return (Drawing("earned", "What each effect earns", draw, size),)


STUDY = Study(
    "ablation",
    "What each modeled effect earns when training knows it.",
    AblationSettings,
    cells,
    run,
    tables,
    figures,
)
