"""The error that each part of the model would leave, in pictures and before the primary classifier.

In: a problem, a design that the classifier responds to, and a few views of the select stream. Out: `Terms`. The
difference is taken where it counts: in the picture as the classifier gets it. What sensors and files do is measured on
whole photographs' centered squares, stored as real JPEGs, and then asked whether training, which renders smaller views,
shows it at all.
Left out on purpose: interactions of terms, but for one check of all that can go, left out at once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from patchproof.app.plan.terms import Setup, Term, scene_terms
from patchproof.base.output import image_bytes, image_pixels
from patchproof.base.progress import Advance, no_advance
from patchproof.base.validation import StrictModel
from patchproof.classifier.network import center_square
from patchproof.optimizer.pixels import as_pixels, from_pixels
from patchproof.optimizer.problem import Problem
from patchproof.render.photograph import expose
from patchproof.render.pixels import Appearance
from patchproof.render.views import Views, relight, render_views
from patchproof.scene.conditions import Conditions
from patchproof.scene.placement import Placement

_PIXELS_AT_ONCE = 1 << 21  # about 300 MB of pictures and what is between them


class TermError(StrictModel):
    """The error that a term leaves where it is left out; of one that is not modeled, the error that it leaves now.

    `codes_mean` and `codes_p95` are absolute differences of 8-bit code values over the picture that the classifier
    gets, `confidence` is the mean absolute change of the target's. Figures are null where the term is off.
    """

    name: str
    key: str  # empty where there is no setting to change
    verdict: Literal["off", "keep", "can go", "missing", "left out"]  # the last two are of what is not modeled
    codes_mean: float | None = None
    codes_p95: float | None = None
    confidence: float | None = None
    bias: float | None = None  # the mean change with its sign: of leaving out, or of putting in what is not modeled
    in_training: bool | None = None  # whether training's smaller views show it


class Terms(StrictModel):
    """All terms, over `views` views in which the design has a mean `confidence`. Those can go whose changes, added up
    from the smallest on, stay under `threshold`; `together` is the change when they are left out at once.
    """

    views: int
    confidence: float
    threshold: float
    errors: tuple[TermError, ...]
    together: float | None = None


def measure_terms(
    problem: Problem,
    design: Tensor,
    conditions: Conditions,
    selection_views: int,
    other_surface: Placement | None = None,
    advance: Advance = no_advance,
) -> Terms:
    """The errors of all terms over `conditions`. The threshold is the standard error that the mean confidence has over
    `selection_views` views: a smaller change decides about no design.
    """
    base = Setup(problem.stage, problem.subject.appearance(design), conditions)
    terms = scene_terms(problem, design, other_surface)
    changed = {term.name: setup for term in terms if (setup := term.change(base)) is not None}
    on = [term for term in terms if term.name in changed]
    photo_px = min(problem.scene.settings.camera.photo_px)
    done = 0

    def add_views(count: int) -> None:
        nonlocal done
        done += count
        advance(done, 3 * len(conditions))

    with torch.no_grad():
        wholes = [term for term in on if term.whole]
        whole = _squares(problem, photo_px, base, [changed[term.name] for term in wholes], add_views)
        small = _squares(problem, problem.training_px, base, [changed[term.name] for term in on], add_views)
        boxes = problem.boxes(conditions)
        confidence = _confidence(problem, whole[0], boxes)
        threshold = float(confidence.std()) / selection_views**0.5
        rows = {t.name: _row(problem, t, small[0], pictures, boxes) for t, pictures in zip(on, small[1:], strict=True)}
        for term, pictures in zip(wholes, whole[1:], strict=True):
            shows = bool(rows[term.name].codes_mean)
            rows[term.name] = _row(problem, term, whole[0], pictures, boxes).changed(in_training=shows)
        judged = _judged(terms, rows, threshold)
        gone, setup, together = [t for t in on if t.key and judged[t.name].verdict == "can go"], base, None
        for term in gone:
            setup = term.change(setup) or setup
        if gone:
            (pictures,) = _squares(problem, photo_px, setup, [], add_views)
            together = float((_confidence(problem, pictures, boxes) - confidence).abs().mean())
    return Terms(
        views=len(conditions),
        confidence=float(confidence.mean()),
        threshold=threshold,
        errors=tuple(judged.values()),
        together=together,
    )


def _judged(terms: tuple[Term, ...], rows: dict[str, TermError], threshold: float) -> dict[str, TermError]:
    """The rows of all terms by name, with verdicts; terms without a row are off."""
    judged = {term.name: TermError(name=term.name, key=term.key, verdict="off") for term in terms}
    changes, sum_of_gone = {name: row.confidence or 0.0 for name, row in rows.items()}, 0.0
    for term in sorted((t for t in terms if t.name in rows), key=lambda t: changes[t.name]):
        change = changes[term.name]
        small = change < threshold or change == 0
        if term.modeled and small and term.key:  # errors that are small one by one may add up
            small = sum_of_gone + change < threshold or change == 0
            sum_of_gone += change
        verdict = ("can go" if small else "keep") if term.modeled else ("left out" if small else "missing")
        judged[term.name] = rows[term.name].changed(verdict=verdict)
    return judged


def _row(problem: Problem, term: Term, base: Tensor, changed: Tensor, boxes: np.ndarray | None) -> TermError:
    codes = (255 * (changed - base)).abs().cpu().numpy()
    change = _confidence(problem, changed, boxes) - _confidence(problem, base, boxes)
    return TermError(
        name=term.name,
        key=term.key,
        verdict="keep",
        codes_mean=float(codes.mean()),
        codes_p95=float(np.quantile(codes, 0.95)),
        confidence=float(change.abs().mean()),
        bias=float(change.mean()),
    )


def _confidence(problem: Problem, pictures: Tensor, boxes: np.ndarray | None) -> Tensor:
    """N confidences of the primary network in the target."""
    classifier = problem.classifiers[0]
    return classifier.confidence(classifier.logits(pictures, boxes), problem.indices[0])


def _squares(
    problem: Problem, side_px: int, base: Setup, setups: list[Setup], add_views: Callable[[int], None]
) -> Tensor:
    """(1 + len(setups))×N×3×S×S views as the primary classifier gets them: the base setup's, then each other one's."""
    size_px, stack = (side_px, side_px), []
    for rows in _chunks(len(base.conditions), side_px):
        known, parts = base.conditions[rows], []
        views = render_views(base.stage, base.shown, known, size_px)
        for setup in (base, *setups):
            conditions = setup.conditions[rows]
            same = setup.stage is base.stage and (conditions.pose.printed_scale == known.pose.printed_scale).all()
            seen = relight(views, conditions) if same else render_views(setup.stage, setup.shown, conditions, size_px)
            parts.append(_pictures(problem, seen, setup.shown))
        stack.append(torch.stack(parts))
        add_views(len(known))
    return torch.cat(stack, 1)


def _pictures(problem: Problem, views: Views, shown: Appearance) -> Tensor:
    """A whole photograph goes through a real JPEG file, a training view as training exposes it."""
    pictures, quality = expose(views, shown, jpeg=views.reduced), views.conditions.sensor.jpeg
    if not views.reduced and quality.any():
        files = [image_bytes(as_pixels(p), "JPEG", {"quality": int(q)}) for p, q in zip(pictures, quality, strict=True)]
        pictures = torch.stack([from_pixels(image_pixels(file), pictures.device) for file in files])
    return center_square(pictures, problem.classifiers[0].input_px)


def _chunks(views: int, side_px: int) -> list[slice]:
    """The views to render at a time."""
    count = max(1, _PIXELS_AT_ONCE // side_px**2)
    return [slice(first, first + count) for first in range(0, views, count)]
