"""The promise: what rate the finished design will reach on conditions that nobody has looked at yet, beside its
controls.

In: a `Problem`, the design's pixels, and a stream of conditions. Out: `Outcomes` (per classifier and control, per
condition) and from them the manifest's `Promise`. Controls are shown on the very same conditions, so that differences
are paired: the bare object, and a mean-color, a gray and a noise design in the same printed frame. The set is drawn and
looked at once, after the design is frozen.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from patchproof import geometry
from patchproof.claims import paired_difference, wilson
from patchproof.color import linear_from_srgb
from patchproof.optimize.problem import Problem, from_pixels
from patchproof.render.photograph import expose, see
from patchproof.scene.conditions import Conditions
from patchproof.sheet.manifest import ConditionClaim, ControlClaim, ModelClaim, Promise, Target
from patchproof.sheet.piece import control_design

PROMISE_VIEWS = 400  # the Wilson interval of a rate of 0.9 is then 6 points wide
CONTROLS = ("bare", "mean", "grey", "noise")
CHUNK = 16


@dataclass(frozen=True)
class Outcomes:
    """Per shown thing ("design" and the controls): recognized M×N and confidence M×N, M classifiers, N conditions."""

    recognized: dict[str, np.ndarray]
    confidence: dict[str, np.ndarray]
    conditions: Conditions


def try_out(
    problem: Problem, design: np.ndarray, conditions: Conditions, progress: Callable[[int], None] = lambda n: None
) -> Outcomes:
    """Show the design and its controls under every condition to every classifier."""
    sheet_id, device = problem.scene.sheet_id, problem.device
    shown = {"design": design} | {kind: control_design(kind, design, sheet_id) for kind in CONTROLS if kind != "bare"}
    with torch.no_grad():
        pieces = {kind: problem.piece_picture(from_pixels(pixels, device), kind) for kind, pixels in shown.items()}
        parts: dict[str, list] = {kind: [] for kind in ("design", *CONTROLS)}
        side = problem.figure_px
        for first in range(0, len(conditions), CHUNK):
            part = conditions[first : first + CHUNK]
            seen = see(problem.stage, pieces["design"], part, (side, side))
            for kind, piece in pieces.items():
                parts[kind].append(_judge(problem, expose(problem.stage, seen, piece)))
            parts["bare"].append(_judge(problem, expose(problem.stage, seen, None)))
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
    for kind in CONTROLS:
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
    """What a photograph could show of each condition; null where the patch's face is turned away."""
    scene, conditions = problem.scene, outcomes.conditions
    x, y, width, height = scene.piece.design_rect_mm
    middle = np.array([x + width / 2, y + height / 2])
    matrix, poses = scene.matrix_px(scene.settings.camera.photo_px), scene.camera_from_world(conditions)
    contrast = _contrasts(problem, conditions)
    claims = []
    for i, pose in enumerate(poses):
        camera_from_piece = pose @ scene.card.world_from_piece
        azimuth, _, _ = geometry.view_angles(camera_from_piece, middle)
        faces = abs(azimuth) < 90
        scale, tilt = geometry.local_scale(geometry.plane_homography(matrix, pose, scene.card.world_from_piece), middle)
        claims.append(
            ConditionClaim(
                px_per_mm=_rounded(scale) if faces else None,
                tilt_deg=_rounded(tilt) if faces else None,
                azimuth_deg=_rounded(azimuth) if faces else None,
                contrast=_rounded(contrast[i]) if faces else None,
                blur_px=_rounded(conditions.blur_px[i]),
                recognized=bool(outcomes.recognized["design"][0, i]),
            )
        )
    return tuple(claims)


def _contrasts(problem: Problem, conditions: Conditions) -> np.ndarray:
    """Paper white minus printed black in the photograph's linear light."""
    scene = problem.scene
    toward = geometry.orbit(
        conditions.light_azimuth_deg, conditions.light_elevation_deg, scene.frame.normal, scene.frame.up
    )
    light = conditions.ambient + conditions.directional * np.clip(toward @ scene.card.normal, 0, None)
    exposed = light * 2**conditions.exposure_ev
    black = float(linear_from_srgb(problem.printer.apply(torch.zeros(1, 3, 1, 1))).mean())
    return np.minimum(exposed, 1) - np.minimum(exposed * black, 1)


def _rounded(value: float) -> float | None:
    return round(float(value), 4) if math.isfinite(value) else None
