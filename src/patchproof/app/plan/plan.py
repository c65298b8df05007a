"""`plan`: which parts of a scene are modeled and which are not, each with the figure that decided it.

In: a scene file. Out: the plan as lines: where the piece lies (after a search, if the scene asks for one) and how a
simpler or richer surface would differ, the pixels that views have for design and markers, the error of leaving out each
term of light, camera and renderer, how many photographs prove a promise, and the cost of a step. All figures come from
the code that optimizes. Terms are measured with a draft of a few steps, since leaving one out changes nothing for a
classifier that ignores the design. A small promise of the draft shows how much sessions differ, and hence what
photographs can prove; the sheet's plan page states that for the final design.

Left out on purpose: deciding for the user. The plan says which terms can go; the scene file decides.
"""

import math
import statistics
import time
from collections.abc import Iterable
from dataclasses import replace
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
from patchproof.optimizer.patch import Patch
from patchproof.optimizer.place_search import choose_place, place_lines
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.optimizer.promise import CONTROLS, VIEWS_PER_SESSION, make_promise
from patchproof.optimizer.subject import as_pixels, from_pixels
from patchproof.render.photograph import affected_windows, expose
from patchproof.scene.bent_scene import placement_with_other_bend
from patchproof.scene.conditions import Conditions
from patchproof.scene.interface import PX_PER_MODULE, READABLE_SHARE, PieceScene, fit_text, measurable_text
from patchproof.scene.patch_scene import UnplacedScene
from patchproof.scene.scene import load_scene
from patchproof.sheets.markers import MARKER_MODULES
from patchproof.sheets.piece import SMALLEST_MARKER_MM
from patchproof.sheets.rects import size_text

TERM_VIEWS, PROOF_VIEWS = 16, 40
DRAFT_VIEWS = 120  # that the draft is trained on
REPEATS = 5  # of a step that is timed
PlanData = dict[str, Any]


def plan_geometry(scene_path: str | Path, *, progress: Progress = no_progress) -> tuple[Problem, list[str]]:
    """Return the problem to measure, and lines on how the piece lies and how well views resolve it. Takes seconds, plus
    the time of any search for a place.
    """
    scene, found = load_scene(scene_path), []
    if isinstance(scene, UnplacedScene):
        place = choose_place(scene, progress=progress)
        scene, found = scene.with_piece_at(place.at, place.spin_deg), ["place", *_indented(place_lines(place))]
    problem, target, fit = set_problem(scene), scene.settings.target, scene.placement_summary()
    networks = ", ".join(classifier.name for classifier in problem.classifiers)
    lies = fit_text(fit) if fit["family"] == "card" else fit["reason"]
    surface = f"{fit['family']}, {size_text(fit['size_mm'])} mm: {lies}", placement_with_other_bend(scene)[1]
    head = f"{Path(scene_path).name}: {target.goal} {target.label}, {scene.description()}, seen by {networks}"
    lines = [head, *found, "surface", *_indented(filter(None, surface))]
    lines += ["resolution", *_indented(_resolution_lines(resolution_plan(problem)))]
    if isinstance(scene, PieceScene):
        lines += ["markers", f"  {_marker_line(scene, fit['family'])}"]
    return problem, lines


def measured_lines(problem: Problem, *, views: int = TERM_VIEWS, progress: Progress = no_progress) -> list[str]:
    """Measure the rest of a plan and return its lines: a draft of the design, the model's terms in `views` views, how
    many photographs prove a promise, and the cost of a step.
    """
    scene, (design, draft) = problem.scene, _draft(problem, progress)
    conditions, other = scene.draw("select", views), placement_with_other_bend(scene)[0]
    terms = measure_terms(problem, design, conditions, SELECT_VIEWS, other, partial(progress, "terms"))
    lines = _term_lines(terms, draft)
    if scene.HAS_PIECE:
        sessions = scene.draw("select", PROOF_VIEWS, per_session=VIEWS_PER_SESSION)
        advance = partial(progress, "photographs")
        promise = make_promise(problem, as_pixels(design), sessions, CONTROLS, advance, VIEWS_PER_SESSION)
        lines += ["photographs, by the promise of this draft", f"  {photos_line(promise)}"]
    cost = measure_cost(problem, design, partial(progress, "cost"))
    views_text = f"{cost['views']} views of {cost['side_px']} px, {cost['threads']} threads"
    lines += ["not modeled", *_indented(scene.OMITTED), f"cost of a step ({views_text}): {cost['ms']:.0f} ms"]
    return lines + [f"  {name:38} {ms:7.0f} ms {ms / cost['ms']:6.1%}" for name, ms in cost["parts"].items()]


def resolution_plan(problem: Problem) -> PlanData:
    """Compute how finely views and print resolve the design: px/mm at the 5 % and 95 % points of the views, in the
    closest view that the settings allow, and in print (None for textures).
    """
    scene, subject = problem.scene, problem.subject
    patch = subject if isinstance(subject, Patch) else None
    network, photo = (
        np.quantile(scene.px_per_mm(size_px), [1 - READABLE_SHARE, READABLE_SHARE]).tolist()
        for size_px in ((problem.network_px, problem.network_px), scene.photo_px)
    )
    closest = scene.closest_px_per_mm((problem.network_px, problem.network_px))
    return {
        "network_px": problem.network_px,
        "photo_px": scene.photo_px,
        "px_per_mm_network": network,
        "px_per_mm_photo": photo,
        "closest_px_per_mm": closest,  # at the network's size
        "design_px": patch and patch.design_px,
        "printed_px": patch and patch.printed_px,
        "printed_px_per_mm": patch and patch.printed_px[0] / patch.scene.piece.size_mm[0],
        "texels": subject.start()[0].numel(),
        "texels_per_px": subject.texels_per_mm / closest,  # along a side, in the closest view
    }


def needed_marker_mm(scene: PieceScene) -> float:
    """Apply the rule for the markers' size (PX_PER_MODULE in READABLE_SHARE of the views) to this scene's views."""
    px_per_mm = float(np.quantile(scene.px_per_mm(scene.photo_px, shorter=True), 1 - READABLE_SHARE))
    return max(MARKER_MODULES * PX_PER_MODULE / px_per_mm, SMALLEST_MARKER_MM)


def _draft(problem: Problem, progress: Progress) -> tuple[Tensor, PlanData]:
    """Optimize a design for a few steps: its 8-bit colors, and its steps and rate on the selection set."""
    settings = problem.scene.settings
    count = min(settings.optimize.steps, math.ceil(DRAFT_VIEWS / settings.optimize.views))
    short = replace(problem.scene, settings=settings.changed(optimize={"steps": count}))  # of the same sheet id
    state, rate = start(problem), None
    for step in steps(replace(problem, scene=short), state):
        state, rate = step.state, step.select_rate
        progress("draft", state.number, count)
    assert rate is not None  # the last step ends with a selection
    return from_pixels(as_pixels(state.design), problem.device), {"steps": count, "rate": rate}


def measure_cost(problem: Problem, design: Tensor, advance: Advance = no_advance) -> PlanData:
    """Time each part of steps that show `design` here, with all classifiers: median milliseconds after a warm-up."""
    views, rows = problem.scene.settings.optimize.views, []
    problem.see(None, problem.scene.draw("train", views), 16)  # loads the background pictures, which a run does once
    for number in range(REPEATS + 1):  # the first one warms up
        rows.append(_step_ms(problem, design, problem.scene.draw("train", views, start=number * views)))
        advance(number + 1, REPEATS + 1)
    parts = {name: statistics.median(row[name] for row in rows[1:]) for name in rows[0]}
    figures = {"views": views, "side_px": problem.training_px, "threads": torch.get_num_threads()}
    return {**figures, "ms": sum(parts.values()), "parts": parts}


def _step_ms(problem: Problem, design: Tensor, conditions: Conditions) -> dict[str, float]:
    """Time each part of one step in milliseconds, in the loop's order; views of one pose share its rasterization."""
    design = design.clone().requires_grad_()
    appearance, ends = problem.subject.appearance(design.detach()), {"": time.perf_counter()}
    views = problem.see(appearance, conditions, problem.training_px)
    ends["rasterize object, piece and background"] = time.perf_counter()
    appearance = problem.subject.appearance(design)
    ends["printer" if problem.scene.HAS_PIECE else "textures"] = time.perf_counter()
    pictures = expose(views, appearance)
    ends["light, piece and camera"] = time.perf_counter()
    leaf, boxes, windows = pictures.detach().requires_grad_(), problem.boxes(conditions), affected_windows(views)
    losses = [
        problem.losses(classifier, classifier.logits(leaf, boxes, windows), indices).mean()
        for classifier, indices in zip(problem.classifiers, problem.indices, strict=True)
    ]
    loss = torch.stack(losses).mean()
    ends["classifier forward"] = time.perf_counter()
    (gradient,) = torch.autograd.grad(loss, leaf)
    ends["classifier backward"] = time.perf_counter()
    torch.autograd.grad((pictures * gradient).sum() + problem.subject.penalty(design), design)
    ends["design backward"] = time.perf_counter()
    ms = 1000 * np.diff([*ends.values()])
    ms[0] *= new_pose_share(problem.scene)
    return dict(zip([*ends][1:], ms.tolist(), strict=True))


def _indented(lines: Iterable[str]) -> list[str]:
    return [f"  {line}" for line in lines]


def _resolution_lines(views: PlanData) -> list[str]:
    (far, near), (far_photo, near_photo) = views["px_per_mm_network"], views["px_per_mm_photo"]
    width, height = views["photo_px"]
    line = f"{far:.2f} to {near:.2f} px/mm at the network's {views['network_px']} px, {far_photo:.2f} to "
    line += f"{near_photo:.2f} in photographs of {width} × {height} px (5 % and 95 % of the views)"
    density = f"{views['texels_per_px']:.1f} per pixel along a side in the closest"
    if views["design_px"] is None:
        return [line, f"{views['texels']} texels may change, {density} view"]
    return [
        line,
        "design {} × {} texels, ".format(*views["design_px"])
        + f"{density} possible view ({views['closest_px_per_mm']:.2f} px/mm)",
        "printed as {} × {} px, ".format(*views["printed_px"]) + f"{views['printed_px_per_mm']:.1f} per mm",
    ]


def _marker_line(scene: PieceScene, family: str) -> str:
    needed, printed = needed_marker_mm(scene), scene.piece.marker_mm
    if not printed:
        return "none: photographs are located by the design's corners"
    note = "" if printed > 0.95 * needed else " (all that page, object or blank allows)"
    return (
        f"needed {needed:.1f} mm ({PX_PER_MODULE:g} px per module at the {READABLE_SHARE:.0%} point of the views), "
        f"printed {printed:.1f} mm{note}; {measurable_text(scene.unreadable_share, family)}"
    )


def _term_lines(terms: PlanData, draft: PlanData) -> list[str]:
    lines = [
        f"error if not modeled ({terms['views']} views of a draft of {draft['steps']} steps, rate "
        f"{draft['rate']:.0%}, on the first classifier)",
        f"  {'':23} {'codes: mean':>11} {'95 %':>6}   {'confidence':<15}  (terms that add up to less than "
        f"{terms['threshold']:.3f} can be left out: they change no choice of a design)",
    ]
    on = {name: error for name, error in terms["errors"].items() if error["verdict"] != "off"}
    off = [f"{name} ({error['key'] or 'no setting'})" for name, error in terms["errors"].items() if name not in on]
    lines += [_term_line(name, error) for name, error in on.items()]
    lines += [f"  off: {', '.join(off)}"] if off else []
    return lines + ([f"  not measured: which can go ({terms['unknown']})"] if terms["unknown"] else [])


def _term_line(name: str, error: PlanData) -> str:
    words = {"missing": "missing in training", "left out": "left out, negligible"}
    verdict, key = words.get(error["verdict"], error["verdict"]), f" ({error['key']})" if error["key"] else ""
    verdict = "negligible" if verdict == "can go" and not key else verdict
    unseen = "; training's views do not show it" if error.get("in_training") is False else ""
    codes = f"{error['codes_mean']:11.2f} {error['codes_p95']:6.1f}"
    return f"  {name:23} {codes}   {error['confidence']:.3f} ({error['bias']:+.3f})   {verdict}{key}{unseen}"
