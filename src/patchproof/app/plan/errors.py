"""Measure the error of leaving out each term of the model, in pictures and in the primary classifier's confidence.

In: a problem, a design that the classifier responds to, and a few views of the select stream. Out: `Terms`. Differences
are those of the pictures that the classifier gets. Effects of sensors and files are measured on the centered squares of
whole photographs, stored as real JPEGs; a flag says if training's smaller views show them, too. Left out on purpose:
interactions of terms, except for one check with all terms left out that can go.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from patchproof.base.output import image_bytes, image_pixels
from patchproof.base.progress import Advance, no_advance
from patchproof.base.validation import StrictModel
from patchproof.channel.effects import EFFECT_BY_NAME, EFFECTS, ViewEffect
from patchproof.channel.printer import identity_printer
from patchproof.classifier.network import center_square
from patchproof.optimizer.pixels import as_pixels, from_pixels
from patchproof.optimizer.problem import Problem
from patchproof.render.photograph import expose
from patchproof.render.pixels import Appearance
from patchproof.render.stage import Stage, set_stage
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
    return replace(setup, appearance=replace(problem.patch, printer=identity_printer()).appearance(design))


def _without_part(setup: Setup, part: SceneTerm) -> Setup | None:
    scene = setup.stage.scene.without(part)
    return None if scene is None else replace(setup, stage=replace(setup.stage, scene=scene))


def _on_surface(setup: Setup, placement: Placement) -> Setup:
    scene = replace(require_patch(setup.stage.scene), placement=placement)
    piece = set_stage(scene, setup.stage.device).piece
    return replace(setup, stage=replace(setup.stage, scene=scene, piece=piece))


_PIXELS_AT_ONCE = 1 << 21  # about 300 MB of pictures and intermediate tensors


class TermError(StrictModel):
    """The error of leaving out a term; for a term that is not modeled, the error that the model has without it.

    `codes_mean` and `codes_p95` are absolute differences of 8-bit code values over the picture that the classifier
    gets, `confidence` is the mean absolute change of the target's. Figures of a term that is off are null.
    """

    name: str
    key: str  # empty if there is no setting to change
    # missing, left out: of what is not modeled; unknown: no term changes the confidence at all
    verdict: Literal["off", "keep", "can go", "missing", "left out", "unknown"]
    codes_mean: float | None = None
    codes_p95: float | None = None
    confidence: float | None = None
    bias: float | None = None  # the mean change with its sign: of leaving the term out, or of adding a missing one
    in_training: bool | None = None  # True if training's smaller views show it


class Terms(StrictModel):
    """The errors of all terms, over `views` views in which the design has a mean `confidence`. Terms can go as long as
    their changes, added up from the smallest on, stay under `threshold`; `together` is the change without all of them.
    """

    views: int
    confidence: float
    threshold: float
    errors: tuple[TermError, ...]
    together: float | None = None

    @property
    def unknown(self) -> str:
        """Why no term's verdict is known; empty if they are."""
        same = f"the draft's confidence in {self.views} views is {self.confidence:.2g}, whatever is left out"
        return same if any(error.verdict == "unknown" for error in self.errors) else ""


def measure_terms(
    problem: Problem,
    design: Tensor,
    conditions: Conditions,
    selection_views: int,
    other_surface: Placement | None = None,
    advance: Advance = no_advance,
) -> Terms:
    """Measure the errors of all terms over `conditions`. The threshold is the standard error of the mean confidence
    over `selection_views` views: a smaller change decides no choice of a design.
    """
    base = Setup(problem.stage, problem.subject.appearance(design), conditions)
    terms = scene_terms(problem, design, other_surface)
    setups = {term.name: setup for term in terms if (setup := term.change(base)) is not None}
    on = [term for term in terms if term.name in setups]
    photo_px = min(problem.scene.settings.camera.photo_px)
    done = 0

    def add_views(count: int) -> None:
        nonlocal done
        done += count
        advance(done, 3 * len(conditions))

    with torch.no_grad():
        photo_terms = [term for term in on if term.needs_whole_photo]
        photos = _squares(problem, photo_px, base, [setups[term.name] for term in photo_terms], add_views)
        small = _squares(problem, problem.training_px, base, [setups[term.name] for term in on], add_views)
        boxes = problem.boxes(conditions)
        confidence = _confidence(problem, photos[0], boxes)
        threshold = float(confidence.std()) / selection_views**0.5
        rows = {t.name: _row(problem, t, small[0], pictures, boxes) for t, pictures in zip(on, small[1:], strict=True)}
        for term, pictures in zip(photo_terms, photos[1:], strict=True):
            in_training = bool(rows[term.name].codes_mean)
            rows[term.name] = _row(problem, term, photos[0], pictures, boxes).changed(in_training=in_training)
        errors = _with_verdicts(terms, rows, threshold)
        if not any(row.confidence for row in rows.values()):  # nothing was measured; every term would seem to be small
            errors = {name: e if e.verdict == "off" else e.changed(verdict="unknown") for name, e in errors.items()}
        small_terms, setup, together = [t for t in on if t.key and errors[t.name].verdict == "can go"], base, None
        for term in small_terms:
            setup = term.change(setup) or setup
        if small_terms:
            (pictures,) = _squares(problem, photo_px, setup, [], add_views)
            together = float((_confidence(problem, pictures, boxes) - confidence).abs().mean())
        else:
            add_views(len(conditions))  # the third look, of all that can go, is of nothing
    views, mean = len(conditions), float(confidence.mean())
    return Terms(views=views, confidence=mean, threshold=threshold, errors=tuple(errors.values()), together=together)


def _with_verdicts(terms: tuple[Term, ...], rows: dict[str, TermError], threshold: float) -> dict[str, TermError]:
    """Add verdicts to the rows of all terms, by name; terms without a row are off."""
    errors = {term.name: TermError(name=term.name, key=term.key, verdict="off") for term in terms}
    changes, sum_of_gone = {name: row.confidence or 0.0 for name, row in rows.items()}, 0.0
    for term in sorted((t for t in terms if t.name in rows), key=lambda t: changes[t.name]):
        change = changes[term.name]
        small = change < threshold or change == 0
        if term.modeled and small and term.key:  # errors that are small one by one may add up
            small = sum_of_gone + change < threshold or change == 0
            sum_of_gone += change
        verdict = ("can go" if small else "keep") if term.modeled else ("left out" if small else "missing")
        errors[term.name] = rows[term.name].changed(verdict=verdict)
    return errors


def _row(problem: Problem, term: Term, base: Tensor, changed: Tensor, boxes: np.ndarray | None) -> TermError:
    codes = (255 * (changed - base)).abs().cpu().numpy()
    change = _confidence(problem, changed, boxes) - _confidence(problem, base, boxes)
    figures: dict[str, Any] = {"codes_mean": float(codes.mean()), "codes_p95": float(np.quantile(codes, 0.95))}
    figures |= {"confidence": float(change.abs().mean()), "bias": float(change.mean())}
    return TermError(name=term.name, key=term.key, verdict="keep", **figures)


def _confidence(problem: Problem, pictures: Tensor, boxes: np.ndarray | None) -> Tensor:
    """Confidences (N) of the primary network in the target."""
    classifier = problem.classifiers[0]
    return classifier.confidence(classifier.logits(pictures, boxes), problem.indices[0])


def _squares(
    problem: Problem, side_px: int, base: Setup, setups: list[Setup], add_views: Callable[[int], None]
) -> Tensor:
    """Render the views of the base setup, then of each other one, as the primary classifier gets them:
    (1 + len(setups))×N×3×S×S.
    """
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
        add_views(len(base_conditions))
    return torch.cat(stack, 1)


def _pictures(problem: Problem, views: Views, appearance: Appearance) -> Tensor:
    """Expose views as the classifier gets them: whole photographs through a real JPEG file, training views without."""
    pictures, quality = expose(views, appearance, jpeg=views.reduced), views.conditions.sensor.jpeg
    if not views.reduced and quality.any():
        files = [image_bytes(as_pixels(p), "JPEG", {"quality": int(q)}) for p, q in zip(pictures, quality, strict=True)]
        pictures = torch.stack([from_pixels(image_pixels(file), pictures.device) for file in files])
    return center_square(pictures, problem.classifiers[0].input_px)


def _chunks(views: int, side_px: int) -> list[slice]:
    """Split the views into slices that are rendered at a time."""
    count = max(1, _PIXELS_AT_ONCE // side_px**2)
    return [slice(first, first + count) for first in range(0, views, count)]
