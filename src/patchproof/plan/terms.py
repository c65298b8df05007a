"""The parts of the model that a plan weighs, and what a simpler model would put in the place of each.

In: a problem. Out: `Term`s: functions that take a part out of a `Setup`, everything that pictures are made of. What
takes a part's place is the best of what is simpler: even light as strong on the patch in place of the sun, not
darkness. How drawn effects are switched off is said in `channel.effects`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from torch import Tensor

from patchproof import geometry
from patchproof.channel.effects import EFFECT, EFFECTS, Effect
from patchproof.channel.printer import identity_printer
from patchproof.optimizer.patch import Patch
from patchproof.optimizer.problem import Problem
from patchproof.render.photograph import Shown
from patchproof.render.stage import Stage, set_stage
from patchproof.scene.conditions import Conditions, without
from patchproof.scene.mesh_scene import MeshScene
from patchproof.scene.photo_scene import BasePhoto, PhotoScene
from patchproof.scene.placement import Placement
from patchproof.scene.scene import Scene

PRINTER = "printer's colors"


@dataclass(frozen=True)
class Setup:
    """Everything that pictures are made of."""

    stage: Stage
    shown: Shown
    conditions: Conditions
    supersample: int = 1


@dataclass(frozen=True)
class Term:
    """A part of the model: the settings key that governs it and the same setup without it, None where it is off.

    Of a term that is not `modeled`, `change` puts it in. `whole`: it needs whole photographs to be seen as it is.
    """

    name: str
    key: str
    change: Callable[[Setup], Setup | None]
    modeled: bool = True
    whole: bool = False


def scene_terms(problem: Problem, design: Tensor, other_surface: Placement | None) -> tuple[Term, ...]:
    """The terms that a problem's kind of scene has."""
    scene, terms = problem.scene, ()
    if isinstance(scene, MeshScene):
        terms = tuple(term for term in effect_terms("light") if scene.piece or not EFFECT[term.name].only_paper)
    if isinstance(scene, PhotoScene):
        terms = _photograph_terms()
    if scene.piece is not None:
        printer = Term(PRINTER, "printer.profile", partial(_without_printer, problem, design))
        terms = (*terms, printer, *effect_terms("printer"))
    terms = (*terms, *effect_terms("camera"))
    if isinstance(scene, MeshScene):
        samples = Term("object at 2×2 samples", "", lambda setup: replace(setup, supersample=2), modeled=False)
        terms = (*terms, Term("lens distortion", "camera.file", _without_distortion), samples)
        placement = scene.placement
        if other_surface is not None and placement is not None:
            name = "bent piece" if placement.is_flat else f"{placement.family}, not a card"
            change = partial(_on_surface, placement=other_surface)
            terms = (*terms, Term(name, "patch.bend", change, modeled=not placement.is_flat))
    return terms


def effect_terms(table: str) -> tuple[Term, ...]:
    """The effects that a table of the settings turns on and off."""
    return tuple(
        Term(effect.name, effect.keys[0], partial(_without, effect=effect), whole=effect.whole)
        for effect in EFFECTS
        if effect.switch and effect.keys[0].startswith(f"{table}.")
    )


def _photograph_terms() -> tuple[Term, ...]:
    return (
        Term("uneven light on paper", "", _without_own_light),
        Term("photographs' own blur", "", _without_own_blur, whole=True),
        Term("photographs' own noise", "", _without_own_noise, whole=True),
    )


def _without(setup: Setup, effect: Effect) -> Setup | None:
    conditions = without(setup.conditions, effect, partial(_facing, setup.stage.scene))
    return None if conditions is None else replace(setup, conditions=conditions)


def _facing(scene: Scene, azimuth_deg: np.ndarray, elevation_deg: np.ndarray) -> np.ndarray:
    """N cosines between the piece's normal (without one, its side's) and a direction, 0 from behind."""
    if not isinstance(scene, MeshScene):
        raise ValueError("pictures face nowhere")
    normal = scene.frame.normal if scene.placement is None else scene.placement.normal
    return np.clip(geometry.orbit(azimuth_deg, elevation_deg, scene.frame.normal, scene.frame.up) @ normal, 0, None)


def _without_printer(problem: Problem, design: Tensor, setup: Setup) -> Setup | None:
    if problem.printer.name == "identity" or not isinstance(problem.subject, Patch):
        return None
    return replace(setup, shown=replace(problem.subject, printer=identity_printer()).shown(design))


def _without_distortion(setup: Setup) -> Setup | None:
    camera = setup.stage.camera
    if camera is None or not camera.bends:
        return None
    straight = camera.changed(k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0)
    return replace(setup, stage=replace(setup.stage, camera=straight))


def _on_surface(setup: Setup, placement: Placement) -> Setup:
    scene = replace(setup.stage.scene, placement=placement)
    piece = set_stage(scene, setup.stage.device).piece
    return replace(setup, stage=replace(setup.stage, scene=scene, piece=piece))


def _without_own_light(setup: Setup) -> Setup | None:
    """Photographs that light their paper evenly."""
    even = np.array([1.0, 0, 0, 0, 0, 0])

    def lit(photo: BasePhoto) -> BasePhoto:
        return replace(photo, light=replace(photo.light, coefficients=photo.light.coefficients * even))

    return _with_photos(setup, lit)


def _without_own_blur(setup: Setup) -> Setup | None:
    return _with_photos(setup, lambda photo: replace(photo, blur_px=0.0), lambda photo: photo.blur_px)


def _without_own_noise(setup: Setup) -> Setup | None:
    def clean(photo: BasePhoto) -> BasePhoto:
        return replace(photo, light=replace(photo.light, noise=0.0))

    return _with_photos(setup, clean, lambda photo: photo.light.noise)


def _with_photos(
    setup: Setup, changed: Callable[[BasePhoto], BasePhoto], strength: Callable[[BasePhoto], float] = lambda _: 1.0
) -> Setup | None:
    """The setup with its photographs changed; None where what would go has no strength in any."""
    scene = setup.stage.scene
    if not isinstance(scene, PhotoScene) or not any(map(strength, scene.photos)):
        return None
    scene = replace(scene, photos=tuple(map(changed, scene.photos)))
    return replace(setup, stage=replace(setup.stage, scene=scene))


def without_camera(setup: Setup) -> Setup:
    """The setup before a camera without blur, noise, motion, vignetting and distortion."""
    for name in ("blur", "noise", "motion blur", "vignetting"):
        setup = _without(setup, EFFECT[name]) or setup
    for change in (_without_own_blur, _without_own_noise, _without_distortion):
        setup = change(setup) or setup
    return setup
