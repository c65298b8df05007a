"""`plan`: what of a scene is modeled, what is not, and why, each time with the figure that decided it.

In: a scene file. Out: `Plan`: where the piece lies and what a simpler or richer surface would do, the pixels that views
have for design and markers, the error that each term of light, camera and renderer would leave, what chance leaves, and
the cost of a step. All of it comes from the code that optimizes: a draft of a few steps is what the terms are measured
with, because a classifier that a design says nothing to would miss none of them.

Left out on purpose: deciding for the user. The plan says what can go; the scene file says what is modeled.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from torch import Tensor

from patchproof.geometry import local_scale
from patchproof.optimizer.loop import SELECT_VIEWS, selects, steps
from patchproof.optimizer.pixels import as_pixels, from_pixels
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.optimizer.texture import Texture
from patchproof.plan.cost import Cost, measure_cost
from patchproof.plan.errors import Terms, measure_terms
from patchproof.plan.samples import Sample, sample_plan
from patchproof.scene.bend import place_bent
from patchproof.scene.mesh_scene import MeshScene
from patchproof.scene.photo_scene import PhotoScene
from patchproof.scene.placement import Placement, place_card
from patchproof.scene.resolution import PX_PER_MODULE, READABLE_SHARE
from patchproof.scene.scene import Scene, load_scene
from patchproof.sheets.piece import MODULES, SMALLEST_MARKER_MM, Piece
from patchproof.strict import Refused, Strict

TERM_VIEWS = 16
_VIEWS = 1024  # for quantiles over the views; as many as the marker rule looks at

_OMITTED_MESH = (
    "cast shadows: a 10 mm ledge along the top of a 110 mm patch takes 4 % of its light, 9 % at the 95 % point",
    "(computed for the default ranges, see channel/light); interreflection; curl: paper is as flat or bent as stated",
)
_OMITTED_PICTURES = (
    "other viewpoints, backgrounds and lamps than the pictures show; what stands in front of the piece;",
    "curl: the piece is a plane",
)


class Surface(Strict):
    """Where the piece lies. `other` is what `patch.bend` the other way round would do."""

    family: str
    size_mm: tuple[float, float]
    gap_mm: float | None = None
    gap_mean_mm: float | None = None
    overhang_share: float | None = None
    stretch: float | None = None
    reason: str
    other: str | None = None


class Resolution(Strict):
    """Pixels per millimetre at the 5 % and 95 % points of the views, and the design's own; null where unknown."""

    network_px: int
    photo_px: tuple[int, int]
    px_per_mm_network: tuple[float, float]
    px_per_mm_photo: tuple[float, float]
    closest_px_per_mm: float  # at the network's size, in the closest view that the settings allow
    design_px: tuple[int, int] | None  # None of textures, which keep their own sizes
    printed_px: tuple[int, int] | None
    printed_px_per_mm: float | None
    texels: int
    texels_per_px: float  # along a side, in the closest view


class Markers(Strict):
    """Markers needed by the rule (PX_PER_MODULE in READABLE_SHARE of the views) and printed."""

    needed_mm: float
    printed_mm: float
    unreadable_share: float


class Draft(Strict):
    """The design that terms are measured with: the loop's own after `steps` steps, and the rate it has there."""

    steps: int
    rate: float


class Plan(Strict):
    """Everything that `plan` found out."""

    scene: str
    kind: str
    target: str
    models: tuple[str, ...]
    surface: Surface
    resolution: Resolution
    markers: Markers | None
    draft: Draft
    terms: Terms
    samples: tuple[Sample, ...]
    omitted: tuple[str, ...]
    cost: Cost | None
    warnings: tuple[str, ...]


def plan_scene(
    scene_path: str | Path,
    *,
    timing: bool = True,
    views: int = TERM_VIEWS,
    device: str = "cpu",
    on_stage: Callable[[str, int, int], None] = lambda name, done, total: None,
) -> Plan:
    """Plan a scene, its terms over `views` views; without `timing`, all but the cost, which differs from run to run."""
    scene = load_scene(scene_path)
    problem = set_problem(scene, device)
    other, sentence = other_surface(scene)
    design, draft = _draft(problem, on_stage)
    conditions = scene.draw("select", views)
    advance = lambda done, total: on_stage("terms", done, total)  # noqa: E731
    terms = measure_terms(problem, design, conditions, SELECT_VIEWS, other, advance)
    cost = None
    if timing:
        cost = measure_cost(problem, design, lambda done, total: on_stage("cost", done, total))
    target = scene.settings.target
    return Plan(
        scene=Path(scene_path).name,
        kind=_kind(scene),
        target=f"{target.goal} {target.label}",
        models=tuple(classifier.name for classifier in problem.classifiers),
        surface=surface_plan(scene, sentence),
        resolution=resolution_plan(problem),
        markers=None if scene.piece is None else marker_plan(scene, scene.piece),
        draft=draft,
        terms=terms,
        samples=sample_plan(draft.rate, terms.threshold),
        omitted=_OMITTED_MESH if isinstance(scene, MeshScene) else _OMITTED_PICTURES,
        cost=cost,
        warnings=scene.warnings,
    )


def other_surface(scene: Scene) -> tuple[Placement | None, str | None]:
    """(where the piece would lie with `patch.bend` the other way round, what that would be like in a sentence).

    No placement where it is refused or would be the same card; no sentence where there is no surface to lie on.
    """
    if not isinstance(scene, MeshScene) or scene.placement is None or scene.piece is None:
        return None, None
    patch, placement = scene.settings.patch, scene.placement
    place, flag = (place_card, "false") if patch.bend else (place_bent, "true")
    try:
        other = place(scene.mesh, scene.frame, scene.piece.size_mm, patch.spin_deg)
    except Refused as refused:
        return None, f"bend = {flag} is refused. {refused}"
    if other.family == placement.family:
        return None, f"bend = {flag} would be a card, too: leave bend out"
    gaps = f"{other.gap_mean_mm:.2f} mm off the surface on average, here {placement.gap_mean_mm:.2f} mm"
    return other, f"bend = {flag} would be a {other.family} (stretch {other.stretch:.2%}), {gaps}"


def surface_plan(scene: Scene, other: str | None) -> Surface:
    """Where the piece of a scene lies, or what takes its place."""
    if not isinstance(scene, MeshScene):
        reason = "pictures say nothing of a surface: the piece is a plane that their homographies carry"
        return Surface(family="plane", size_mm=scene.piece.size_mm, reason=reason)
    if scene.placement is None:
        return Surface(family="texture", size_mm=scene.frame.extent_mm, reason="the object's own texture is the design")
    laid = scene.placement
    return Surface(
        family=laid.family,
        size_mm=laid.size_mm,
        gap_mm=laid.gap_mm,
        gap_mean_mm=laid.gap_mean_mm,
        overhang_share=laid.overhang_share,
        stretch=laid.stretch,
        reason=laid.reason,
        other=other,
    )


def resolution_plan(problem: Problem) -> Resolution:
    """What views resolve of the design."""
    scene, subject = problem.scene, problem.subject
    network_px = max(classifier.input_px for classifier in problem.classifiers)
    photo_px = scene.settings.camera.photo_px
    closest = scene.closest_px_per_mm((network_px, network_px))
    if isinstance(subject, Texture):
        design_px = printed_px = printed = None
        texels, per_mm = _texture_texels(subject.scene)
    else:
        design_px, printed_px, width_mm = subject.design_px, subject.printed_px, subject.design_mm[0]
        printed, per_mm, texels = printed_px[0] / width_mm, design_px[0] / width_mm, design_px[0] * design_px[1]
    return Resolution(
        network_px=network_px,
        photo_px=photo_px,
        px_per_mm_network=_quantiles(scales(scene, (network_px, network_px))),
        px_per_mm_photo=_quantiles(scales(scene, photo_px)),
        closest_px_per_mm=closest,
        design_px=design_px,
        printed_px=printed_px,
        printed_px_per_mm=printed,
        texels=texels,
        texels_per_px=per_mm / closest,
    )


def marker_plan(scene: Scene, piece: Piece) -> Markers:
    """The marker rule on this scene's views."""
    px_per_mm = np.quantile(scales(scene, scene.settings.camera.photo_px, shorter=True), 1 - READABLE_SHARE)
    return Markers(
        needed_mm=max(MODULES * PX_PER_MODULE / float(px_per_mm), SMALLEST_MARKER_MM),
        printed_mm=piece.module_mm * MODULES,
        unreadable_share=scene.unreadable_share,
    )


def scales(scene: Scene, size_px: tuple[int, int], shorter: bool = False) -> np.ndarray:
    """Pixels per millimetre at the piece's middle in views of `size_px` that face it: the mean of all directions, or
    along the `shorter`, foreshortened one. Of a texture, at the object's middle.
    """
    conditions = scene.draw("select", _VIEWS, 0)
    if scene.piece is None:
        if not isinstance(scene, MeshScene):
            raise ValueError("pictures without a piece have no scale")
        return scene.matrix_px(size_px)[0, 0] / conditions.pose.distance_mm
    faces = ~(np.abs(scene.piece_azimuth_deg(conditions)) >= 90)  # unknown angles are of pictures that show it
    middle, px_per_mm = np.array(scene.piece.size_mm) / 2, []
    for homography in scene.piece_homographies(conditions[faces], size_px):
        mean, tilt_deg = local_scale(homography, middle)
        px_per_mm.append(mean * np.sqrt(np.cos(np.radians(tilt_deg))) if shorter else mean)
    return np.array(px_per_mm)


def _quantiles(values: np.ndarray) -> tuple[float, float]:
    low, high = np.quantile(values, [1 - READABLE_SHARE, READABLE_SHARE])
    return float(low), float(high)


def _texture_texels(scene: MeshScene) -> tuple[int, float]:
    """(number of texels that may change, texels per millimetre of the surface on average)."""
    mesh, masks = scene.mesh, scene.canvas.mask if scene.canvas else ()
    sizes = np.array([mask.shape[1::-1] for mask in masks])
    uv = mesh.corner_uv.astype(float) * sizes[mesh.face_material][:, None]
    flat = np.abs(np.linalg.det(uv[:, 1:] - uv[:, :1])).sum()
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    surface = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    return int(sum(mask.sum() for mask in masks)), float(np.sqrt(flat / surface))


def _draft(problem: Problem, on_stage: Callable[[str, int, int], None]) -> tuple[Tensor, Draft]:
    """The loop's design when it is first tried on the selection set, in 8-bit colors."""
    settings = problem.scene.settings.optimize
    total = next(number for number in range(1, settings.steps + 1) if selects(settings, number))
    for step in steps(problem):
        on_stage("draft", step.state.number, total)
        if step.select_rate is not None:
            design = from_pixels(as_pixels(step.state.design), problem.device)
            return design, Draft(steps=step.state.number, rate=step.select_rate)
    raise ValueError("the loop ended before it selected a design")


def _kind(scene: Scene) -> str:
    if not isinstance(scene, MeshScene):
        return f"{len(scene.photos)} photographs" if isinstance(scene, PhotoScene) else f"{len(scene.images)} images"
    return f"a mesh of {len(scene.mesh.faces)} faces"
