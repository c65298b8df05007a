"""The parts of the model that a plan weighs, and what a simpler model would put in the place of each.

In: a problem. Out: `Term`s: functions that take a part out of a `Setup`, everything that pictures are made of. What
takes a part's place is the best of what is simpler: even light as strong on the patch in place of the sun, not
darkness.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from torch import Tensor

from patchproof import geometry
from patchproof.channel.printer import identity_printer
from patchproof.optimizer.problem import Problem
from patchproof.render.photograph import Shown
from patchproof.render.stage import Stage, set_stage
from patchproof.scene.conditions import Conditions
from patchproof.scene.mesh_scene import MeshScene
from patchproof.scene.photo_scene import PhotoScene
from patchproof.scene.placement import Placement

_LEAST_COSINE = 0.2  # the sun is made five times as strong at most where it has to light the patch alone


@dataclass(frozen=True)
class Setup:
    """Everything that pictures are made of."""

    stage: Stage
    shown: Shown
    conditions: Conditions
    jpeg: bool = True
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
    scene = problem.scene
    terms = _light_terms(scene) if isinstance(scene, MeshScene) else ()
    if isinstance(scene, PhotoScene):
        terms = _photograph_terms()
    if scene.piece is not None:
        terms += (
            Term("printer's colors", "printer.profile", partial(_without_printer, problem, design)),
            Term("dot gain", "printer.dot_gain", partial(_set, name="dot_gain")),
            Term("ink density", "printer.density", partial(_set, name="density")),
            Term("printed black", "printer.black", partial(_set, name="black")),
            Term("paper white", "printer.paper_white", partial(_set, name="paper", value=1.0)),
            Term("misregistration", "printer.misregistration_mm", partial(_set, name="misregistration_mm")),
            Term("print scale", "printer.scale", partial(_set, name="printed_scale", value=1.0)),
        )
    terms += _camera_terms()
    if isinstance(scene, MeshScene):
        terms += (
            Term("lens distortion", "camera.file", _without_distortion),
            Term("object at 2×2 samples", "", lambda setup: replace(setup, supersample=2), modeled=False),
        )
    if other_surface is not None:
        name = "bent piece" if scene.placement.is_flat else f"{scene.placement.family}, not a card"
        change = partial(_on_surface, placement=other_surface)
        terms += (Term(name, "patch.bend", change, modeled=not scene.placement.is_flat),)
    return terms


def _light_terms(scene: MeshScene) -> tuple[Term, ...]:
    terms = (
        Term("directional light", "light.directional", _without_sun),
        Term("ambient light", "light.ambient", _without_ambient),
        Term("lamp", "light.point", _without_lamp),
        Term("uneven ambient", "light.sh2", partial(_set, name="sh2")),
    )
    gloss = Term("gloss", "light.gloss", partial(_set, name="gloss"))
    return terms if scene.piece is None else (*terms, gloss)


def _camera_terms() -> tuple[Term, ...]:
    return (
        Term("exposure", "camera.exposure_ev", partial(_set, name="exposure_ev")),
        Term("white balance", "camera.white_balance", partial(_set, name="white_balance", value=1.0)),
        Term("vignetting", "camera.vignetting", partial(_set, name="vignetting")),
        Term("motion blur", "camera.motion_px", partial(_set, name="motion_px"), whole=True),
        Term("blur", "camera.blur_px", partial(_set, name="blur_px"), whole=True),
        Term("noise", "camera.noise", partial(_set, name="noise"), whole=True),
        Term("JPEG", "camera.jpeg", lambda setup: replace(setup, jpeg=False), whole=True),
    )


def _photograph_terms() -> tuple[Term, ...]:
    return (
        Term("uneven light on paper", "", _without_own_light),
        Term("photographs' own blur", "", _without_own_blur, whole=True),
        Term("photographs' own noise", "", _without_own_noise, whole=True),
    )


def _set(setup: Setup, name: str, value: float = 0.0) -> Setup | None:
    """The setup with one of its conditions the same in all views."""
    drawn = getattr(setup.conditions, name)
    if (drawn == value).all():
        return None
    return replace(setup, conditions=replace(setup.conditions, **{name: np.full_like(drawn, value)}))


def _facing(setup: Setup, azimuth_deg: np.ndarray, elevation_deg: np.ndarray) -> np.ndarray:
    """N cosines between the piece's normal (without one, its side's) and a direction, 0 from behind."""
    scene = setup.stage.scene
    normal = scene.frame.normal if scene.placement is None else scene.placement.normal
    return np.clip(geometry.orbit(azimuth_deg, elevation_deg, scene.frame.normal, scene.frame.up) @ normal, 0, None)


def _without_sun(setup: Setup) -> Setup | None:
    drawn = setup.conditions
    cosine = _facing(setup, drawn.light_azimuth_deg, drawn.light_elevation_deg)
    return _evenly(setup, "directional", drawn.directional * cosine)


def _without_lamp(setup: Setup) -> Setup | None:
    drawn = setup.conditions
    return _evenly(setup, "point", drawn.point * _facing(setup, drawn.point_azimuth_deg, drawn.point_elevation_deg))


def _evenly(setup: Setup, name: str, light: np.ndarray) -> Setup | None:
    """What a source gives to the middle of the patch given by even light; the uneven part of that stays."""
    drawn, source = setup.conditions, getattr(setup.conditions, name)
    if not source.any():
        return None
    ambient = drawn.ambient + light
    sh2 = drawn.sh2 * drawn.ambient / np.maximum(ambient, 1e-9)
    return replace(setup, conditions=replace(drawn, ambient=ambient, sh2=sh2, **{name: np.zeros_like(source)}))


def _without_ambient(setup: Setup) -> Setup | None:
    """The sun alone, as strong on the patch as both were."""
    drawn = setup.conditions
    if not drawn.ambient.any():
        return None
    cosine = _facing(setup, drawn.light_azimuth_deg, drawn.light_elevation_deg)
    sun = (drawn.ambient + drawn.directional * cosine) / np.maximum(cosine, _LEAST_COSINE)
    return replace(setup, conditions=replace(drawn, ambient=np.zeros_like(drawn.ambient), directional=sun))


def _without_printer(problem: Problem, design: Tensor, setup: Setup) -> Setup | None:
    if problem.printer.name == "identity":
        return None
    return replace(setup, shown=replace(problem.subject, printer=identity_printer()).shown(design))


def _without_distortion(setup: Setup) -> Setup | None:
    camera = setup.stage.camera
    if camera is None or not camera.bends:
        return None
    straight = camera.model_copy(update=dict.fromkeys(("k1", "k2", "p1", "p2", "k3"), 0.0))
    return replace(setup, stage=replace(setup.stage, camera=straight))


def _on_surface(setup: Setup, placement: Placement) -> Setup:
    scene = replace(setup.stage.scene, placement=placement)
    piece = set_stage(scene, setup.stage.device).piece
    return replace(setup, stage=replace(setup.stage, scene=scene, piece=piece))


def _without_own_light(setup: Setup) -> Setup:
    """Photographs that light their paper evenly."""
    even = np.array([1.0, 0, 0, 0, 0, 0])

    def lit(photo):
        return replace(photo, light=replace(photo.light, coefficients=photo.light.coefficients * even))

    return _with_photos(setup, lit)


def _without_own_blur(setup: Setup) -> Setup | None:
    blurred = any(photo.blur_px for photo in setup.stage.scene.photos)
    return _with_photos(setup, lambda photo: replace(photo, blur_px=0.0)) if blurred else None


def _without_own_noise(setup: Setup) -> Setup | None:
    noisy = any(photo.light.noise for photo in setup.stage.scene.photos)
    return _with_photos(setup, lambda photo: replace(photo, light=replace(photo.light, noise=0.0))) if noisy else None


def _with_photos(setup: Setup, changed: Callable) -> Setup:
    scene = replace(setup.stage.scene, photos=tuple(changed(photo) for photo in setup.stage.scene.photos))
    return replace(setup, stage=replace(setup.stage, scene=scene))


def without_camera(setup: Setup) -> Setup:
    """The setup before a camera without blur, noise, motion, vignetting and distortion."""
    for name in ("blur_px", "noise", "motion_px", "vignetting"):
        setup = _set(setup, name) or setup
    if isinstance(setup.stage.scene, PhotoScene):
        setup = _without_own_noise(_without_own_blur(setup) or setup) or setup
    return _without_distortion(setup) or setup
