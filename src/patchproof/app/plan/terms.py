"""The terms of the model that a plan measures, and the simpler model that replaces each.

In: a problem. Out: `Term`s: functions that take a term out of a `Setup`, everything that pictures are made of. A term
is replaced by the best simpler model: the sun by even light that is as strong on the patch, not by darkness.
`channel.effects` defines how drawn effects are switched off.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from torch import Tensor

from patchproof.channel.effects import EFFECT_BY_NAME, EFFECTS, ViewEffect
from patchproof.channel.printer import identity_printer
from patchproof.optimizer.problem import Problem
from patchproof.render.pixels import Appearance
from patchproof.render.stage import Stage, set_stage
from patchproof.scene.conditions import Conditions, without_effect
from patchproof.scene.interface import SceneTerm
from patchproof.scene.mesh_scene import require_mesh
from patchproof.scene.patch_scene import require_patch
from patchproof.scene.placement import Placement

PRINTER = "printer's colors"


@dataclass(frozen=True)
class Setup:
    """Everything that pictures are made of."""

    stage: Stage
    appearance: Appearance
    conditions: Conditions


@dataclass(frozen=True)
class Term:
    """A term of the model: the settings key that governs it, and `change`, which takes it out of a setup, or returns
    None if it is off. A term that is not `modeled` is added by `change`. One that `needs_whole_photo` shows fully in
    whole photographs only.
    """

    name: str
    key: str
    change: Callable[[Setup], Setup | None]
    modeled: bool = True
    needs_whole_photo: bool = False


def scene_terms(problem: Problem, design: Tensor, other_surface: Placement | None) -> tuple[Term, ...]:
    """The terms that a problem's kind of scene has."""
    scene = problem.scene
    effects = {
        table: tuple(term for term in effect_terms(table) if scene.models(EFFECT_BY_NAME[term.name]))
        for table in ("light", "printer", "camera")
    }
    parts = [
        Term(part.name, part.key, partial(_without_part, part=part), needs_whole_photo=part.needs_whole_photo)
        for part in scene.TERMS
    ]
    terms = (*effects["light"], *(term for term in parts if not term.key))
    if scene.HAS_PIECE:
        terms = (*terms, Term(PRINTER, "printer.profile", partial(_without_printer, problem, design)))
    terms = (*terms, *effects["printer"], *effects["camera"], *(term for term in parts if term.key))
    if other_surface is not None:
        placement, change = require_patch(scene).placement, partial(_on_surface, placement=other_surface)
        name = "bent piece" if placement.is_flat else f"{placement.family}, not a card"
        terms = (*terms, Term(name, "patch.bend", change, modeled=not placement.is_flat))
    return terms


def effect_terms(table: str) -> tuple[Term, ...]:
    """Terms for the effects that a table of the settings turns on and off."""
    return tuple(
        Term(
            effect.name,
            effect.keys[0],
            partial(_without_effect, effect=effect),
            needs_whole_photo=effect.needs_whole_photo,
        )
        for effect in EFFECTS
        if effect.can_be_off and effect.keys[0].startswith(f"{table}.")
    )


def _without_effect(setup: Setup, effect: ViewEffect) -> Setup | None:
    facing = lambda *angles: require_mesh(setup.stage.scene).cosines(*angles)  # noqa: E731
    conditions = without_effect(setup.conditions, effect, facing)
    return None if conditions is None else replace(setup, conditions=conditions)


def _without_printer(problem: Problem, design: Tensor, setup: Setup) -> Setup | None:
    if problem.printer.name == "identity":
        return None
    return replace(setup, appearance=problem.subject.with_printer(identity_printer()).appearance(design))


def _without_part(setup: Setup, part: SceneTerm) -> Setup | None:
    scene = setup.stage.scene.without(part)
    return None if scene is None else replace(setup, stage=replace(setup.stage, scene=scene))


def _on_surface(setup: Setup, placement: Placement) -> Setup:
    scene = replace(require_patch(setup.stage.scene), placement=placement)
    piece = set_stage(scene, setup.stage.device).piece
    return replace(setup, stage=replace(setup.stage, scene=scene, piece=piece))
