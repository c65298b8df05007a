"""The promise: what rate the finished design will reach on conditions that nobody has looked at yet, beside its
controls.

In: a `Problem`, the design's pixels, and conditions in sessions: a few photographs each that share print, light, camera
and place. Out: the manifest's `Promise`. Controls are shown in some of each session's conditions, so that differences
are paired: the bare object, and a mean-color, a gray and a noise design in the same printed markers. The set is drawn
after the design is frozen, and looked at once; twice or three times where a promise may stop as soon as its interval is
as narrow as asked.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import pairwise

import numpy as np
import torch

from patchproof import geometry
from patchproof.classifier.detector import Detector
from patchproof.color import linear_from_srgb
from patchproof.optimizer.pixels import from_pixels
from patchproof.optimizer.problem import Problem
from patchproof.optimizer.responses import Answers, joined, responses
from patchproof.render.pixels import Shown
from patchproof.scene.conditions import Conditions
from patchproof.scene.patch_scene import PatchScene
from patchproof.scene.scene import PieceScene, needs_piece
from patchproof.sessions import difference_in_sessions, in_sessions, spread_of
from patchproof.sheets.manifest import ConditionClaim, ControlClaim, ModelClaim, Promise, Target

# Many short sessions: how much they differ is known from their number, not from their length.
PROMISE_VIEWS, PER_SESSION = 400, 4
CONTROL_VIEWS = 2  # of each session: of one, differences would be known to ± 6 to 10 points in place of 5 to 8
CONTROLS = ("bare", "mean", "gray", "noise")


def make_promise(
    problem: Problem,
    design: np.ndarray,
    conditions: Conditions,
    controls: Sequence[str] = CONTROLS,
    on_views: Callable[[int, int], None] = lambda done, total: None,
    per_session: int = 1,
    half_width: float | None = None,
) -> Promise:
    """Show the design in all conditions, `per_session` in a row of one session, and the controls in the first
    `CONTROL_VIEWS` of each; rate, interval and controls are those of the primary (first) network. A `half_width` of the
    rate's interval stops it after half or three quarters of the sessions, if it is no wider there.
    """
    shown = shown_with_controls(problem, design, controls)
    beside = np.arange(len(conditions)) % per_session < CONTROL_VIEWS
    looks = [0, len(conditions)] if half_width is None else _looks(len(conditions), per_session)
    parts: list[dict[str, Answers]] = []
    for first, last in pairwise(looks):
        part, on_part = slice(first, last), partial(_counted, on_views, first, len(conditions))
        parts.append(responses(problem, shown, conditions[part], beside=beside[part], on_views=on_part))
        hits = joined(parts)["design"].recognized[0]
        counts = in_sessions(hits, per_session, _places(conditions[:last], per_session))
        if half_width is not None and np.ptp(spread_of(*counts).rate) <= 2 * half_width:
            break
    compared = joined(parts)
    answers = compared["design"]
    conditions, beside = conditions[: answers.recognized.shape[1]], beside[: answers.recognized.shape[1]]
    places = _places(conditions, per_session)
    models = model_claims(problem, answers, per_session, places)
    compared["design"] = answers.at(np.flatnonzero(beside))
    target = problem.scene.settings.target
    return Promise(
        target=Target(label=str(target.label), indices=problem.indices[0], goal=target.goal),
        models=models,
        rate=models[0].rate,
        interval=models[0].interval,
        n=len(conditions),
        per_session=per_session,
        places=places,
        controls=control_claims(compared, 0, min(CONTROL_VIEWS, per_session)),
        conditions=_condition_claims(problem, conditions, answers.recognized[0]),
        outermost_mm=_outermost_mm(problem),
    )


def _looks(total: int, per_session: int) -> list[int]:
    """Where the parts of a promise begin and end that may stop between them. Its interval held in 94 to 98 % of 1,000
    simulated promises with a first look after half of the sessions, in 94 to 96 % of full ones; one after a quarter,
    which knows little of how sessions differ, saves 0 to 14 % more views (`python tests/test_promise_stops.py`).
    """
    sessions = math.ceil(total / per_session)
    return [0, *sorted({min(total, math.ceil(sessions * part) * per_session) for part in (0.5, 0.75, 1)})]


def _counted(on_views: Callable[[int, int], None], before: int, total: int, done: int, _: int) -> None:
    on_views(before + done, total)


def _outermost_mm(problem: Problem) -> tuple[tuple[float, float, float], ...]:
    """The object's outermost points in the frame of its piece, where a network asks for its box in photographs."""
    scene = problem.scene
    if not isinstance(scene, PatchScene) or not any(isinstance(c, Detector) for c in problem.classifiers):
        return ()
    points = geometry.carried(np.linalg.inv(scene.placement.world_from_piece), scene.outermost_mm)
    return tuple((round(x, 3), round(y, 3), round(z, 3)) for x, y, z in points.tolist())


def _places(conditions: Conditions, per_session: int) -> tuple[int, ...]:
    """A number for each session's place, as they come; none where all are others, or the one place is known."""
    chosen = conditions.pose.background[::per_session, 0]
    places, first, which = np.unique(chosen, return_index=True, return_inverse=True)
    return tuple(map(int, first[which])) if 1 < len(places) < len(chosen) else ()


def shown_with_controls(problem: Problem, design: np.ndarray, controls: Sequence[str]) -> dict[str, Shown]:
    """What shows under "design" and under each control's name."""
    subject, shown = problem.subject, {}
    with torch.no_grad():
        for kind in ("design", *controls):
            pixels = design if kind in ("design", "bare") else subject.control(kind, design)
            shown[kind] = None if kind == "bare" else subject.shown(from_pixels(pixels, problem.device), kind)
    return shown


def model_claims(
    problem: Problem, design: Answers, per_session: int = 1, places: Sequence[int] = ()
) -> tuple[ModelClaim, ...]:
    """Each network's rate and confidence of the design; intervals are over sessions, those of one place together."""
    rows = zip(problem.classifiers, design.recognized, design.confidence, strict=True)
    return tuple(
        ModelClaim(
            name=classifier.name,
            sha256=classifier.sha256,
            rate=float(recognized.mean()),
            interval=spread_of(*in_sessions(recognized, per_session, places)).rate,
            confidence=float(confidence.mean()),
            least_score=classifier.least_score if isinstance(classifier, Detector) else None,
        )
        for classifier, recognized, confidence in rows
    )


def control_claims(answers: Mapping[str, Answers], model: int, per_session: int = 1) -> dict[str, ControlClaim]:
    """Each control beside the design on the same conditions, for one network."""
    design, claims = answers["design"].recognized[model], {}
    for kind in (kind for kind in CONTROLS if kind in answers):
        recognized = answers[kind].recognized[model]
        difference, interval = difference_in_sessions(design, recognized, per_session)
        claims[kind] = ControlClaim(
            rate=float(recognized.mean()),
            interval=spread_of(*in_sessions(recognized, per_session)).rate,
            confidence=float(answers[kind].confidence[model].mean()),
            difference=difference,
            difference_interval=interval,
        )
    return claims


def _condition_claims(problem: Problem, conditions: Conditions, recognized: np.ndarray) -> tuple[ConditionClaim, ...]:
    """What a photograph could show of each condition; null where the patch's face is turned away or there is none."""
    n = len(conditions)
    shows: dict[str, np.ndarray] = dict.fromkeys(
        ("px_per_mm", "tilt_deg", "azimuth_deg", "contrast"), np.full(n, np.nan)
    )
    if problem.scene.HAS_PIECE:
        scene = needs_piece(problem.scene)
        scale, tilt = scene.scales_and_tilts(conditions, scene.photo_px).T
        azimuth = scene.piece_azimuth_deg(conditions)
        values = scale, tilt, azimuth, _contrasts(problem, scene, conditions)
        away = np.abs(azimuth) >= 90  # unknown angles are of photographs that show it
        shows = {name: np.where(away, np.nan, value) for name, value in zip(shows, values, strict=True)}
    return tuple(
        ConditionClaim(
            **{name: _rounded(value[i]) for name, value in shows.items()},
            blur_px=_rounded(conditions.sensor.blur_px[i]),
            recognized=bool(recognized[i]),
        )
        for i in range(n)
    )


def _contrasts(problem: Problem, scene: PieceScene, conditions: Conditions) -> np.ndarray:
    """Paper white minus printed black in the photograph's linear light."""
    exposed = scene.white_light(conditions) * conditions.print.paper[:, 1] * 2**conditions.sensor.exposure_ev
    black = float(linear_from_srgb(problem.printer.apply(torch.zeros(1, 3, 1, 1))).mean())
    return np.minimum(exposed, 1) - np.minimum(exposed * black, 1)


def _rounded(value: float) -> float | None:
    return round(float(value), 4) if math.isfinite(value) else None
