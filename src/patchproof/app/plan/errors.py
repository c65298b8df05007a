"""Measure the error of leaving out each term of the model, in pictures and in the primary classifier's confidence.

In: a problem, a design that the classifier responds to, and a few views of the select stream. Out: plain data.
Differences are those of the pictures that the classifier gets. Effects of sensors and files are measured on the
centered squares of whole photographs, stored as real JPEGs. Left out on purpose: interactions of terms.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from patchproof.base.output import image_bytes, image_pixels
from patchproof.base.progress import Advance, no_advance
from patchproof.channel.effects import EFFECTS, ViewEffect
from patchproof.channel.printer import identity_printer
from patchproof.classifier.network import center_square
from patchproof.optimizer.problem import Problem
from patchproof.optimizer.subject import as_pixels, from_pixels
from patchproof.render.photograph import expose
from patchproof.render.pixels import Appearance
from patchproof.render.stage import Stage
from patchproof.render.views import Views, relight, render_views
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
    """A term of the model and its settings key. `change` takes it out of a setup, or adds it if it is not `modeled`,
    and returns None if it is off. A term that `needs_whole_photo` shows fully in whole photographs only.
    """

    name: str
    key: str
    change: Callable[[Setup], Setup | None]
    modeled: bool = True
    needs_whole_photo: bool = False


def scene_terms(problem: Problem, design: Tensor, other_surface: Placement | None) -> tuple[Term, ...]:
    """The terms that a problem's kind of scene has."""
    scene = problem.scene
    terms = [term for table in scene.EFFECT_TABLES for term in effect_terms(table)]
    terms += [Term(p.name, p.key, partial(_without_part, part=p), True, p.needs_whole_photo) for p in scene.TERMS]
    if scene.HAS_PIECE:
        terms.append(Term(PRINTER, "printer.profile", partial(_without_printer, problem, design)))
    if other_surface is not None:
        placement, change = require_patch(scene).placement, partial(_on_surface, placement=other_surface)
        name = "bent piece" if placement.is_flat else f"{placement.family}, not a card"
        terms.append(Term(name, "patch.bend", change, modeled=not placement.is_flat))
    return tuple(terms)


def effect_terms(table: str) -> tuple[Term, ...]:
    """Terms for the effects that a table of the settings turns on and off."""
    return tuple(
        Term(effect.name, effect.keys[0], partial(_without_effect, effect=effect), True, effect.needs_whole_photo)
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
    return replace(setup, appearance=replace(problem.patch, printer=identity_printer()).appearance(design))


def _without_part(setup: Setup, part: SceneTerm) -> Setup | None:
    scene = setup.stage.scene.without(part)
    return None if scene is None else replace(setup, stage=replace(setup.stage, scene=scene))


def _on_surface(setup: Setup, placement: Placement) -> Setup:
    scene = replace(require_patch(setup.stage.scene), placement=placement)
    return replace(setup, stage=replace(setup.stage, scene=scene))


def measure_terms(
    problem: Problem,
    design: Tensor,
    conditions: Conditions,
    selection_views: int,
    other_surface: Placement | None = None,
    advance: Advance = no_advance,
) -> dict[str, Any]:
    """Measure the errors of all terms over `conditions`, as plain data: `views`, the base setup's mean `confidence`,
    the `threshold`, the `errors` by term, and why no verdict is known (`unknown`, empty if they are).

    An error has `codes_mean` and `codes_p95` (absolute differences of 8-bit code values), and of the target's
    confidence the mean absolute change (`confidence`) and the mean change (`bias`), by leaving the term out or by
    adding a missing one. `in_training` says if training's smaller views show a term that needs whole photographs.
    Verdicts of modeled terms are off, keep or can go; of others missing or left out; of all unknown if no term changes
    the confidence. Terms can go as long as the sum of their changes, from the smallest on, stays under the threshold,
    the standard error of the mean confidence over `selection_views` views: a smaller change decides no choice of a
    design.
    """
    base = Setup(problem.stage, problem.subject.appearance(design), conditions)
    terms, boxes, views = scene_terms(problem, design, other_surface), problem.boxes(conditions), len(conditions)
    setups = {term: setup for term in terms if (setup := term.change(base)) is not None}
    photo_px = min(problem.scene.settings.camera.photo_px)
    looks = ((problem.training_px, [*setups]), (photo_px, [term for term in setups if term.needs_whole_photo]))
    errors: dict[str, dict[str, Any]] = {term.name: {"key": term.key, "verdict": "off"} for term in terms}
    confidence = torch.zeros(views)
    for number, (side_px, shown) in enumerate(looks):
        with torch.no_grad():
            pictures = _squares(problem, side_px, base, [setups[term] for term in shown])
            confidence = _confidence(problem, pictures[0], boxes)
            for term, changed in zip(shown, pictures[1:], strict=True):
                error, change = errors[term.name], _confidence(problem, changed, boxes) - confidence
                codes = (255 * (changed - pictures[0])).abs().cpu().numpy()
                error |= {"in_training": error["codes_mean"] > 0} if "codes_mean" in error else {}
                error |= {"codes_mean": float(codes.mean()), "codes_p95": float(np.quantile(codes, 0.95))}
                error |= {"confidence": float(change.abs().mean()), "bias": float(change.mean())}
        advance(number + 1, len(looks))
    mean, threshold, unknown = float(confidence.mean()), float(confidence.std()) / selection_views**0.5, ""
    _set_verdicts([*setups], errors, threshold)
    if not any(errors[term.name]["confidence"] for term in setups):  # nothing was measured; every term seems small
        unknown = f"the draft's confidence in {views} views is {mean:.2g}, whatever is left out"
        errors |= {term.name: errors[term.name] | {"verdict": "unknown"} for term in setups}
    return {"views": views, "confidence": mean, "threshold": threshold, "errors": errors, "unknown": unknown}


def _set_verdicts(terms: list[Term], errors: dict[str, dict[str, Any]], threshold: float) -> None:
    """Set the verdicts of terms that are on."""
    sum_of_gone = 0.0
    for term in sorted(terms, key=lambda term: errors[term.name]["confidence"]):
        error, change = errors[term.name], errors[term.name]["confidence"]
        small = change < threshold or change == 0
        if term.modeled and small and term.key:  # errors that are small one by one may add up
            small = sum_of_gone + change < threshold or change == 0
            sum_of_gone += change
        error["verdict"] = ("can go" if small else "keep") if term.modeled else ("left out" if small else "missing")


def _confidence(problem: Problem, pictures: Tensor, boxes: np.ndarray | None) -> Tensor:
    """Confidences (N) of the primary network in the target."""
    classifier = problem.classifiers[0]
    return classifier.confidence(classifier.logits(pictures, boxes), problem.indices[0])


def _squares(problem: Problem, side_px: int, base: Setup, setups: list[Setup]) -> Tensor:
    """Render the views of base and other setups for the primary classifier: (1 + len(setups))×N×3×S×S."""
    size_px, stack = (side_px, side_px), []
    for rows in _chunks(len(base.conditions), side_px):
        base_conditions, pictures = base.conditions[rows], []
        base_views = render_views(base.stage, base.appearance, base_conditions, size_px)
        scale = base_conditions.pose.printed_scale
        for setup in (base, *setups):
            conditions = setup.conditions[rows]
            if setup.stage is base.stage and (conditions.pose.printed_scale == scale).all():  # the same geometry
                views = relight(base_views, conditions)
            else:
                views = render_views(setup.stage, setup.appearance, conditions, size_px)
            pictures.append(_pictures(problem, views, setup.appearance))
        stack.append(torch.stack(pictures))
    return torch.cat(stack, 1)


def _pictures(problem: Problem, views: Views, appearance: Appearance) -> Tensor:
    """Expose views as the classifier gets them: whole photographs through a real JPEG file, training views without."""
    pictures, quality = expose(views, appearance, jpeg=views.reduced), views.conditions.sensor.jpeg
    if not views.reduced and quality.any():
        files = [image_bytes(as_pixels(p), "JPEG", {"quality": int(q)}) for p, q in zip(pictures, quality, strict=True)]
        pictures = torch.stack([from_pixels(image_pixels(file), pictures.device) for file in files])
    return center_square(pictures, problem.classifiers[0].input_px)


def _chunks(views: int, side_px: int) -> list[slice]:
    """Split the views into slices that are rendered at a time, in about 300 MB of pictures and intermediate tensors."""
    count = max(1, (1 << 21) // side_px**2)
    return [slice(first, first + count) for first in range(0, views, count)]
