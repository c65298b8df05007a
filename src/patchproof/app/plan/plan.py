"""`plan`: which parts of a scene are modeled and which are not, each with the figure that decided it.

In: a scene file. Out: the plan as plain data: where the piece lies (after a search, if the scene asks for one) and how
a simpler or richer surface would differ, the pixels that views have for design and markers, the error of leaving out
each term of light, camera and renderer, how many photographs prove a promise, and the cost of a step. All figures come
from the code that optimizes. Terms are measured with a draft of a few steps, since a classifier that ignores the design
would miss none of them. What photographs can prove depends on how much sessions differ, which a small promise of the
draft measures; the sheet's plan page says it of the design.

Left out on purpose: deciding for the user. The plan says which terms can go; the scene file decides.
"""

import math
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from patchproof.app.plan.errors import measure_terms
from patchproof.base.progress import Advance, Progress, no_advance, no_progress
from patchproof.evidence.verdict import photos_line
from patchproof.optimizer.expectation import new_pose_share
from patchproof.optimizer.loop import SELECT_VIEWS, start, steps
from patchproof.optimizer.pixels import as_pixels, from_pixels
from patchproof.optimizer.place_search import choose_place
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.optimizer.promise import CONTROLS, VIEWS_PER_SESSION, make_promise
from patchproof.render.photograph import affected_windows, expose
from patchproof.scene.bent_scene import placement_with_other_bend
from patchproof.scene.conditions import Conditions
from patchproof.scene.interface import PX_PER_MODULE, READABLE_SHARE, PieceScene, require_piece
from patchproof.scene.scene import load_scene
from patchproof.scene.unplaced_scene import UnplacedScene
from patchproof.sheets.markers import MARKER_MODULES
from patchproof.sheets.piece import SMALLEST_MARKER_MM

TERM_VIEWS, PROOF_VIEWS = 16, 40
DRAFT_VIEWS = 120  # that the draft is trained on
REPEATS = 5  # of a step that is timed
PlanData = dict[str, Any]


def plan_geometry(scene_path: str | Path, *, progress: Progress = no_progress) -> tuple[PlanData, Problem]:
    """Compute how the piece of a scene lies and how well views resolve it, in seconds unless a place is searched for;
    also returns the problem to measure.
    """
    scene, place = load_scene(scene_path), None
    if isinstance(scene, UnplacedScene):
        place = choose_place(scene, progress=progress)
        scene = scene.with_piece_at(place.at, place.spin_deg)
    problem, target = set_problem(scene), scene.settings.target
    geometry = {
        "scene": Path(scene_path).name,
        "kind": scene.description(),
        "target": f"{target.goal} {target.label}",
        "models": [classifier.name for classifier in problem.classifiers],
        "place": place,
        # `other` says how the piece would lie with the opposite `patch.bend`
        "surface": {**scene.placement_summary(), "other": placement_with_other_bend(scene)[1]},
        "resolution": resolution_plan(problem),
        "markers": marker_plan(require_piece(scene)) if scene.HAS_PIECE else None,
        "warnings": scene.warnings,
    }
    return geometry, problem


def measured_plan(
    geometry: PlanData, problem: Problem, *, views: int = TERM_VIEWS, progress: Progress = no_progress
) -> PlanData:
    """Measure the rest of a plan: a draft of the design, the terms in so many views, and the cost of a step."""
    scene = problem.scene
    other, _ = placement_with_other_bend(scene)
    design, draft = _draft(problem, progress)
    conditions, surface = scene.draw("select", views), geometry["surface"]
    terms = measure_terms(problem, design, conditions, SELECT_VIEWS, other, partial(progress, "terms"))
    reasons = {
        "terms that can go": terms["unknown"],
        "the size of markers": "" if geometry["markers"] else "the scene has no printed piece",
        "how the piece fits the object": "" if surface.get("gap_mm") is not None else surface["reason"],
    }
    return geometry | {
        "draft": draft,
        "terms": terms,
        "photographs": _photographs_needed(problem, design, progress) if scene.HAS_PIECE else "",
        "omitted": scene.OMITTED,
        "cost": measure_cost(problem, design, partial(progress, "cost")),
        "not_measured": {figure: reason for figure, reason in reasons.items() if reason},
    }


def resolution_plan(problem: Problem) -> PlanData:
    """Compute how finely views and print resolve the design: pixels per millimeter at the 5 % and 95 % points of the
    views, in the closest view that the settings allow, and in print. Textures keep their own sizes (None).
    """
    scene, grid = problem.scene, problem.subject.grid
    network_px = max(classifier.input_px for classifier in problem.classifiers)
    network, photo = (
        np.quantile(scene.px_per_mm(size_px), [1 - READABLE_SHARE, READABLE_SHARE]).tolist()
        for size_px in ((network_px, network_px), scene.photo_px)
    )
    closest = scene.closest_px_per_mm((network_px, network_px))
    return {
        "network_px": network_px,
        "photo_px": scene.photo_px,
        "px_per_mm_network": network,
        "px_per_mm_photo": photo,
        "closest_px_per_mm": closest,  # at the network's size
        "design_px": grid.design_px,
        "printed_px": grid.printed_px,
        "printed_px_per_mm": grid.printed_px_per_mm,
        "texels": grid.texels,
        "texels_per_px": grid.texels_per_mm / closest,  # along a side, in the closest view
    }


def marker_plan(scene: PieceScene) -> dict[str, float]:
    """Apply the rule for the markers' size (PX_PER_MODULE in READABLE_SHARE of the views) to this scene's views."""
    px_per_mm = float(np.quantile(scene.px_per_mm(scene.photo_px, shorter=True), 1 - READABLE_SHARE))
    needed_mm = max(MARKER_MODULES * PX_PER_MODULE / px_per_mm, SMALLEST_MARKER_MM)
    return {
        "needed_mm": needed_mm,
        "printed_mm": scene.piece.marker_mm,
        "unreadable_share": scene.unreadable_share,
    }


def _photographs_needed(problem: Problem, design: Tensor, progress: Progress) -> str:
    """Say how many photographs, in how many places, prove a promise of the draft."""
    conditions = problem.scene.draw("select", PROOF_VIEWS, per_session=VIEWS_PER_SESSION)
    advance = partial(progress, "photographs")
    promise = make_promise(problem, as_pixels(design), conditions, CONTROLS, advance, VIEWS_PER_SESSION)
    return f"To prove a promise of such a draft: {photos_line(promise)}"


def _draft(problem: Problem, progress: Progress) -> tuple[Tensor, PlanData]:
    """Optimize a design for a few steps: its 8-bit colors, and its steps and rate on the selection set."""
    settings = problem.scene.settings.optimize
    count = min(settings.steps, math.ceil(DRAFT_VIEWS / settings.views))
    state, rate = start(problem), None
    for step in steps(problem.with_training(settings.changed(steps=count)), state):
        state, rate = step.state, step.select_rate
        progress("draft", state.number, count)
    assert rate is not None  # the last step ends with a selection
    return from_pixels(as_pixels(state.design), problem.device), {"steps": count, "rate": rate}


def measure_cost(problem: Problem, design: Tensor, advance: Advance = no_advance) -> PlanData:
    """Time steps that show `design` on this machine, with all classifiers of the problem: the median milliseconds of
    each part over a few steps' views, after a warm-up.
    """
    views, rows = problem.scene.settings.optimize.views, []
    problem.see(None, problem.scene.draw("train", views), 16)  # loads the background pictures, which a run does once
    for number in range(REPEATS + 1):  # the first one warms up
        rows.append(_step_ms(problem, design, problem.scene.draw("train", views, start=number * views)))
        advance(number + 1, REPEATS + 1)
    parts = {name: statistics.median(row[name] for row in rows[1:]) for name in rows[0]}
    figures = {"views": views, "side_px": problem.training_px, "threads": torch.get_num_threads()}
    return {**figures, "ms": sum(parts.values()), "parts": parts}


def _step_ms(problem: Problem, design: Tensor, conditions: Conditions) -> dict[str, float]:
    """Time each part of one step in milliseconds, in the order of the loop, in which views of one pose share its
    rasterization.
    """
    design = design.clone().requires_grad_()
    appearance, lap = problem.subject.appearance(design.detach()), _stopwatch(problem.device)
    views = problem.see(appearance, conditions, problem.training_px)
    parts = {"rasterize object, piece and background": lap() * new_pose_share(problem.scene)}
    appearance = problem.subject.appearance(design)
    parts[problem.subject.STAGE_NAME] = lap()
    pictures = expose(views, appearance)
    parts["light, piece and camera"] = lap()
    leaf, boxes, windows = pictures.detach().requires_grad_(), problem.boxes(conditions), affected_windows(views)
    losses = [
        problem.losses(classifier, classifier.logits(leaf, boxes, windows), indices).mean()
        for classifier, indices in zip(problem.classifiers, problem.indices, strict=True)
    ]
    loss = torch.stack(losses).mean()
    parts["classifier forward"] = lap()
    (gradient,) = torch.autograd.grad(loss, leaf)
    parts["classifier backward"] = lap()
    torch.autograd.grad((pictures * gradient).sum() + problem.subject.penalty(design), design)
    parts["design backward"] = lap()
    return parts


def _stopwatch(device: torch.device) -> Callable[[], float]:
    """A function that waits for the device and returns the milliseconds since its last call."""
    last = time.perf_counter()

    def lap() -> float:
        nonlocal last
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        start, last = last, time.perf_counter()
        return 1000 * (last - start)

    return lap
