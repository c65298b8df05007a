"""`plan`: which parts of a scene are modeled and which are not, each with the figure that decided it.

In: a scene file. Out: `Plan`: where the piece lies (after a search, if the scene asks for one) and how a simpler or
richer surface would differ, the pixels that views have for design and markers, the error of leaving out each term of
light, camera and renderer, sampling errors, and the cost of a step. All figures come from the code that optimizes.
Terms are measured with a draft of a few steps, since a classifier that ignores the design would miss none of them.

Sampling errors are the half-widths of 95 % intervals of selection and promise, with the numbers of views that they use,
and with four times as many: errors shrink with the root of the number, cost grows with it. The promise's interval is
Wilson's, of views that share no session. What photographs can prove depends on how much sessions differ, which a small
promise of the draft measures; the sheet's plan page says it of the design.

Left out on purpose: deciding for the user. The plan says which terms can go; the scene file decides.
"""

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from torch import Tensor

from patchproof.app.plan.cost import Cost, measure_cost
from patchproof.app.plan.errors import Terms, measure_terms
from patchproof.base.intervals import wilson
from patchproof.base.progress import Advance, Progress, no_progress
from patchproof.base.validation import StrictModel
from patchproof.evidence.verdict import photos_line
from patchproof.optimizer.loop import SELECT_VIEWS, start, steps
from patchproof.optimizer.pixels import as_pixels, from_pixels
from patchproof.optimizer.place_search import Place, choose_place
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.optimizer.promise import CONTROLS, PROMISE_VIEWS, VIEWS_PER_SESSION, make_promise
from patchproof.scene.bent_scene import placement_with_other_bend
from patchproof.scene.interface import PX_PER_MODULE, READABLE_SHARE, PieceScene, require_piece
from patchproof.scene.scene import load_scene
from patchproof.scene.unplaced_scene import UnplacedScene
from patchproof.sheets.markers import MARKER_MODULES
from patchproof.sheets.piece import SMALLEST_MARKER_MM

TERM_VIEWS, PROOF_VIEWS = 16, 40
DRAFT_VIEWS = 120  # that the draft is trained on
_NEXT_FACTOR = 4  # of the number of samples


class SurfacePlan(StrictModel):
    """The piece on the object; `other` says how it would lie with the opposite `patch.bend`."""

    family: str
    size_mm: tuple[float, float]
    gap_mm: float | None = None
    gap_mean_mm: float | None = None
    overhang_share: float | None = None
    reason: str
    other: str | None = None


class Resolution(StrictModel):
    """Pixels per millimeter at the 5 % and 95 % points of the views, and of the design; null if unknown."""

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


class Markers(StrictModel):
    """Markers needed by the rule (PX_PER_MODULE in READABLE_SHARE of the views) and printed."""

    needed_mm: float
    printed_mm: float
    unreadable_share: float


class Draft(StrictModel):
    """The design that terms are measured with: the number of optimization steps, and the rate it reached."""

    steps: int
    rate: float


class Sample(StrictModel):
    """Half the width of a 95 % interval, of a mean confidence or a rate in [0, 1], from `n` and from `next_n`."""

    name: str
    n: int
    half_width: float
    next_n: int
    next_half_width: float


class GeometryPlan(StrictModel):
    """The part of a plan that needs no design: computed in seconds, unless a place is searched for."""

    scene: str
    kind: str
    target: str
    models: tuple[str, ...]
    place: Place | None  # the search for it, where the scene asks for one
    surface: SurfacePlan
    resolution: Resolution
    markers: Markers | None
    warnings: tuple[str, ...]


class Plan(GeometryPlan):
    """A whole plan: its geometry, and all that is measured with a draft of the design."""

    draft: Draft
    terms: Terms
    samples: tuple[Sample, ...]
    photographs: str  # how many prove a promise of the draft
    omitted: tuple[str, ...]
    cost: Cost | None
    not_measured: dict[str, str]  # reasons by figure


def plan_geometry(scene_path: str | Path, *, progress: Progress = no_progress) -> tuple[GeometryPlan, Problem]:
    """Compute how the piece of a scene lies and how well views resolve it; also returns the problem to measure."""
    scene, place = load_scene(scene_path), None
    if isinstance(scene, UnplacedScene):
        place = choose_place(scene, progress=progress)
        scene = scene.with_piece_at(place.at, place.spin_deg)
    problem, target = set_problem(scene), scene.settings.target
    _, sentence = placement_with_other_bend(scene)
    geometry = GeometryPlan(
        scene=Path(scene_path).name,
        kind=scene.description(),
        target=f"{target.goal} {target.label}",
        models=tuple(classifier.name for classifier in problem.classifiers),
        place=place,
        surface=SurfacePlan(**scene.placement_summary(), other=sentence),
        resolution=resolution_plan(problem),
        markers=marker_plan(require_piece(scene)) if scene.HAS_PIECE else None,
        warnings=scene.warnings,
    )
    return geometry, problem


def measured_plan(
    geometry: GeometryPlan,
    problem: Problem,
    *,
    timing: bool = True,
    views: int = TERM_VIEWS,
    progress: Progress = no_progress,
) -> Plan:
    """Measure the rest of a plan: a draft of the design, the terms and, with `timing`, the cost of a step."""
    scene = problem.scene
    other, _ = placement_with_other_bend(scene)
    design, draft = _draft(problem, progress)
    conditions = scene.draw("select", views)
    terms = measure_terms(problem, design, conditions, SELECT_VIEWS, other, partial(progress, "terms"))
    reasons = {
        "terms that can go": terms.unknown,
        "the size of markers": "" if geometry.markers else "the scene has no printed piece",
        "how the piece fits the object": "" if geometry.surface.gap_mm is not None else geometry.surface.reason,
        "the cost of a step": "" if timing else "left out by --no-timing",
    }
    return Plan(
        **dict(geometry),
        not_measured={figure: reason for figure, reason in reasons.items() if reason},
        draft=draft,
        terms=terms,
        samples=sample_plan(draft.rate, terms.threshold),
        photographs=_photographs_needed(problem, design, partial(progress, "photographs")) if scene.HAS_PIECE else "",
        omitted=scene.OMITTED,
        cost=measure_cost(problem, design, partial(progress, "cost")) if timing else None,
    )


def resolution_plan(problem: Problem) -> Resolution:
    """Compute how finely views and print resolve the design."""
    scene, grid = problem.scene, problem.subject.grid
    network_px = max(classifier.input_px for classifier in problem.classifiers)
    closest = scene.closest_px_per_mm((network_px, network_px))
    return Resolution(
        network_px=network_px,
        photo_px=scene.photo_px,
        px_per_mm_network=_quantiles(scene.px_per_mm((network_px, network_px))),
        px_per_mm_photo=_quantiles(scene.px_per_mm(scene.photo_px)),
        closest_px_per_mm=closest,
        design_px=grid.design_px,
        printed_px=grid.printed_px,
        printed_px_per_mm=grid.printed_px_per_mm,
        texels=grid.texels,
        texels_per_px=grid.texels_per_mm / closest,
    )


def marker_plan(scene: PieceScene) -> Markers:
    """Apply the rule for the markers' size to this scene's views."""
    px_per_mm = np.quantile(scene.px_per_mm(scene.photo_px, shorter=True), 1 - READABLE_SHARE)
    return Markers(
        needed_mm=max(MARKER_MODULES * PX_PER_MODULE / float(px_per_mm), SMALLEST_MARKER_MM),
        printed_mm=scene.piece.marker_mm,
        unreadable_share=scene.unreadable_share,
    )


def sample_plan(rate: float, standard_error: float) -> tuple[Sample, ...]:
    """Compute the sampling errors at a rate; `standard_error` is that of the selection set's mean confidence."""
    selection = [1.96 * standard_error / k**0.5 for k in (1, _NEXT_FACTOR)]
    promise = [np.ptp(wilson(round(rate * n), n)) / 2 for n in (PROMISE_VIEWS, _NEXT_FACTOR * PROMISE_VIEWS)]
    rows = (("selection: mean confidence", SELECT_VIEWS, selection), ("promise: rate", PROMISE_VIEWS, promise))
    return tuple(
        Sample(name=name, n=n, half_width=width, next_n=_NEXT_FACTOR * n, next_half_width=next_width)
        for name, n, (width, next_width) in rows
    )


def _photographs_needed(problem: Problem, design: Tensor, advance: Advance) -> str:
    """Say how many photographs, in how many places, prove a promise of the draft."""
    conditions = problem.scene.draw("select", PROOF_VIEWS, per_session=VIEWS_PER_SESSION)
    promise = make_promise(problem, as_pixels(design), conditions, CONTROLS, advance, VIEWS_PER_SESSION)
    return f"To prove a promise of such a draft: {photos_line(promise)}"


def _quantiles(values: np.ndarray) -> tuple[float, float]:
    low, high = np.quantile(values, [1 - READABLE_SHARE, READABLE_SHARE])
    return float(low), float(high)


def _draft(problem: Problem, progress: Callable[[str, int, int], None]) -> tuple[Tensor, Draft]:
    """Optimize a design for a few steps: its 8-bit colors, and its rate on the selection set."""
    settings = problem.scene.settings.optimize
    count = min(settings.steps, math.ceil(DRAFT_VIEWS / settings.views))
    state, rate = start(problem), None
    for step in steps(problem.with_training(settings.changed(steps=count)), state):
        state, rate = step.state, step.select_rate
        progress("draft", state.number, count)
    assert rate is not None  # the last step ends with a selection
    return from_pixels(as_pixels(state.design), problem.device), Draft(steps=count, rate=rate)
