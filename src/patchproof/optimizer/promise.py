"""The promise: what rate the finished design will reach on conditions that nobody has looked at yet, beside its
controls.

In: a `Problem`, the design's pixels, and a stream of conditions. Out: `Outcomes` (per classifier and control, per
condition) and from them the manifest's `Promise`. Controls are shown on the very same conditions, so that differences
are paired: the bare object, and a mean-color, a gray and a noise design in the same printed frame. The set is drawn and
looked at once, after the design is frozen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from patchproof import geometry
from patchproof.claims import paired_difference, wilson
from patchproof.color import linear_from_srgb
from patchproof.optimizer.pixels import from_pixels
from patchproof.optimizer.problem import Problem
from patchproof.render.photograph import Shown, expose
from patchproof.scene.conditions import Conditions
from patchproof.sheets.manifest import ConditionClaim, ControlClaim, ModelClaim, Promise, Target

PROMISE_VIEWS = 400  # the Wilson interval of a rate of 0.9 is then 6 points wide
CONTROLS = ("bare", "mean", "grey", "noise")
CHUNK = 4  # views at a time: before a small network 16 took 1.4 times as long, out of the cache


@dataclass(frozen=True)
class Outcomes:
    """Per shown thing ("design" and the controls): recognized M×N and confidence M×N, M classifiers, N conditions."""

    recognized: dict[str, np.ndarray]
    confidence: dict[str, np.ndarray]
    conditions: Conditions


def try_out(
    problem: Problem,
    design: np.ndarray,
    conditions: Conditions,
    progress: Callable[[int], None] = lambda n: None,
    controls: Sequence[str] = CONTROLS,
) -> Outcomes:
    """Show the design and its controls under every condition to every classifier."""
    return judged(problem, shown_with_controls(problem, design, controls), conditions, progress)


def shown_with_controls(problem: Problem, design: np.ndarray, controls: Sequence[str]) -> dict[str, Shown]:
    """What shows under "design" and under each control's name."""
    subject, device = problem.subject, problem.device
    pixels = {"design": design} | {kind: subject.control(kind, design) for kind in controls if kind != "bare"}
    with torch.no_grad():
        shown = {kind: subject.shown(from_pixels(one, device), kind) for kind, one in pixels.items()}
    return {kind: shown.get(kind) for kind in ("design", *controls)}


def judged(
    problem: Problem,
    shown: Mapping[str, Shown],
    conditions: Conditions,
    progress: Callable[[int], None] = lambda n: None,
) -> Outcomes:
    """Show each thing (None is the bare object) under every condition to every classifier."""
    first_shown = next((one for one in shown.values() if one is not None), None)
    parts: dict[str, list] = {kind: [] for kind in shown}
    with torch.no_grad():
        for first in range(0, len(conditions), CHUNK):
            part = conditions[first : first + CHUNK]
            seen = problem.see(first_shown, part, problem.figure_px)
            for kind, one in shown.items():
                parts[kind].append(_judge(problem, expose(seen, one)))
            progress(len(part))
    joined = {kind: np.concatenate(part, -1) for kind, part in parts.items()}  # 2×M×N
    recognized = {kind: both[0] > 0.5 for kind, both in joined.items()}
    return Outcomes(recognized, {kind: both[1] for kind, both in joined.items()}, conditions)


def promise_from(problem: Problem, outcomes: Outcomes) -> Promise:
    """The manifest's promise; rate and controls are those of the primary (first) classifier."""
    recognized, n = outcomes.recognized["design"], len(outcomes.conditions)
    models = []
    for i, classifier in enumerate(problem.classifiers):
        models.append(
            ModelClaim(
                name=classifier.name,
                sha256=classifier.sha256,
                rate=float(recognized[i].mean()),
                interval=wilson(int(recognized[i].sum()), n),
                confidence=float(outcomes.confidence["design"][i].mean()),
            )
        )
    settings = problem.scene.settings.target
    target = Target(label=str(settings.label), indices=problem.indices[0], goal=settings.goal)
    return Promise(
        target=target,
        models=tuple(models),
        rate=models[0].rate,
        interval=models[0].interval,
        n=n,
        controls=control_claims(outcomes, 0),
        conditions=_condition_claims(problem, outcomes),
    )


def control_claims(outcomes: Outcomes, model: int) -> dict[str, ControlClaim]:
    """Each control beside the design on the same conditions, for one classifier."""
    design, claims = outcomes.recognized["design"][model], {}
    for kind in (kind for kind in CONTROLS if kind in outcomes.recognized):
        control = outcomes.recognized[kind][model]
        difference, interval = paired_difference(design.tolist(), control.tolist())
        claims[kind] = ControlClaim(
            rate=float(control.mean()),
            interval=wilson(int(control.sum()), len(control)),
            confidence=float(outcomes.confidence[kind][model].mean()),
            difference=difference,
            difference_interval=interval,
        )
    return claims


def _judge(problem: Problem, pictures: torch.Tensor) -> np.ndarray:
    """2×M×N: recognized and confidence."""
    rows = []
    for classifier, indices in zip(problem.classifiers, problem.indices, strict=True):
        logits = classifier.logits(pictures)
        rows.append(
            torch.stack([classifier.recognized(logits, indices).double(), classifier.confidence(logits, indices)])
        )
    return torch.stack(rows, 1).cpu().numpy()


def _condition_claims(problem: Problem, outcomes: Outcomes) -> tuple[ConditionClaim, ...]:
    """What a photograph could show of each condition; null where the patch's face is turned away or there is none."""
    scene, conditions, recognized = problem.scene, outcomes.conditions, outcomes.recognized["design"][0]
    if scene.piece is None:
        return tuple(
            ConditionClaim(
                px_per_mm=None,
                tilt_deg=None,
                azimuth_deg=None,
                contrast=None,
                blur_px=_rounded(blur),
                recognized=bool(seen),
            )
            for blur, seen in zip(conditions.sensor.blur_px, recognized, strict=True)
        )
    x, y, width, height = scene.piece.design_rect_mm
    middle = np.array([x + width / 2, y + height / 2])
    homographies = scene.piece_homographies(conditions, scene.settings.camera.photo_px)
    azimuths, contrast = scene.piece_azimuth_deg(conditions), _contrasts(problem, conditions)
    claims = []
    for i, homography in enumerate(homographies):
        faces = not abs(azimuths[i]) >= 90  # unknown angles are of photographs that show it
        scale, tilt = geometry.local_scale(homography, middle)
        claims.append(
            ConditionClaim(
                px_per_mm=_rounded(scale) if faces else None,
                tilt_deg=_rounded(tilt) if faces else None,
                azimuth_deg=_rounded(azimuths[i]) if faces else None,
                contrast=_rounded(contrast[i]) if faces else None,
                blur_px=_rounded(conditions.sensor.blur_px[i]),
                recognized=bool(recognized[i]),
            )
        )
    return tuple(claims)


def _contrasts(problem: Problem, conditions: Conditions) -> np.ndarray:
    """Paper white minus printed black in the photograph's linear light."""
    exposed = problem.scene.white_light(conditions) * conditions.print.paper[:, 1] * 2**conditions.sensor.exposure_ev
    black = float(linear_from_srgb(problem.printer.apply(torch.zeros(1, 3, 1, 1))).mean())
    return np.minimum(exposed, 1) - np.minimum(exposed * black, 1)


def _rounded(value: float) -> float | None:
    return round(float(value), 4) if math.isfinite(value) else None
