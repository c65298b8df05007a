"""The promise: the rate that the finished design will reach under conditions not used so far, beside its controls.

In: a `Problem`, the design's pixels, and conditions in sessions: a few photographs each that share print, light, camera
and place. Out: the manifest's `Promise`. Controls are shown in some of each session's conditions, so that differences
are paired: the bare object, and a mean-color, a gray and a noise design in the same printed markers. The set is drawn
after the design is frozen. If a half width is given instead of a number of views, a control is left out as soon as its
difference is settled, and the promise stops as soon as none is left and the rate's interval is narrow enough; both are
checked after half and three quarters of the views.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch

from patchproof.base import geometry
from patchproof.base.color import linear_from_srgb
from patchproof.base.errors import Refused
from patchproof.base.progress import Advance, no_advance
from patchproof.base.sessions import count_by_session, rate_posterior, session_difference
from patchproof.optimizer.problem import Problem
from patchproof.optimizer.responses import Responses, merge_responses, responses
from patchproof.optimizer.subject import from_pixels
from patchproof.render.pixels import Appearance
from patchproof.scene.conditions import Conditions
from patchproof.scene.interface import require_piece
from patchproof.scene.patch_scene import PatchScene
from patchproof.sheets.manifest import ConditionClaim, ControlClaim, ModelClaim, Promise, Target

# Many short sessions: the spread between them is estimated from their number, not from their length.
PROMISE_VIEWS, VIEWS_PER_SESSION = 400, 4
CONTROL_VIEWS = 2  # of each session; with one, differences would be known to ± 6 to 10 points in place of 5 to 8
CONTROLS = ("bare", "mean", "gray", "noise")
# The least difference that is settled early, in half widths of its interval. Of 3,000 simulated controls as good as a
# design of 80 and 95 %, 6.0 and 4.0 % were called different, 5.2 and 3.9 % if all were shown to the end; intervals of
# real differences held in 95.7 to 97.1 % (`python tests/optimizer/test_promise_stops.py`).
SETTLED = 1.25


@dataclass(frozen=True)
class PromiseOptions:
    """How a finished design's rate is promised.

    Attributes:
        views: photographs simulated for the promise, 8 or more; fewer than 400 make it a draft. None: up to 400, as
            many as the scene's `promise.half_width` needs.
        controls: what the design is compared with, one at least: "bare", "mean", "gray", "noise".
    """

    views: int | None = None
    controls: tuple[str, ...] = CONTROLS

    def __post_init__(self):
        if isinstance(self.views, int) and self.views < 2 * VIEWS_PER_SESSION:
            expected = f"a promise of {2 * VIEWS_PER_SESSION} views, two sessions, at least"
            raise Refused(expected, f"{self.views} views", "ask for more")
        if not self.controls:
            raise Refused("one control at least", "none", f"name some of {', '.join(CONTROLS)}")


def make_promise(
    problem: Problem,
    design: np.ndarray,
    conditions: Conditions,
    controls: Sequence[str] = CONTROLS,
    advance: Advance = no_advance,
    per_session: int = 1,
    half_width: float | None = None,
) -> Promise:
    """Show the design in all conditions, `per_session` in a row of one session, and the controls in the first
    `CONTROL_VIEWS` of each; rate, interval and controls are those of the primary (first) network. With a `half_width`
    it stops after half or three quarters of the sessions, if the rate's interval is at most twice as wide there and
    every control's difference is settled; else it continues without the settled controls.
    """
    appearances = pictures_with_controls(problem, design, controls)
    by_kind = _responses_until_settled(problem, appearances, conditions, per_session, half_width, advance)
    design_responses = by_kind["design"]
    conditions = conditions[: design_responses.recognized.shape[1]]
    places = _place_numbers(conditions, per_session)
    models = model_claims(problem, design_responses, per_session, places)
    target = problem.scene.settings.target
    return Promise(
        target=Target(label=str(target.label), indices=problem.indices[0], goal=target.goal),
        models=models,
        rate=models[0].rate,
        interval=models[0].interval,
        n=len(conditions),
        per_session=per_session,
        places=places,
        controls=_paired_claims(by_kind, per_session),
        conditions=_condition_claims(problem, conditions, design_responses.recognized[0]),
        outermost_mm=_outermost_mm(problem),
    )


def _responses_until_settled(
    problem: Problem,
    appearances: Mapping[str, Appearance],
    conditions: Conditions,
    per_session: int,
    half_width: float | None,
    advance: Advance,
) -> dict[str, Responses]:
    """The responses to the design, and to each control until its difference is settled (never without `half_width`)."""
    by_kind: dict[str, Responses] = {}
    unsettled, n = list(appearances), len(conditions)
    for first, last in pairwise([0, n] if half_width is None else _look_positions(n, per_session)):
        shown, mask = {kind: appearances[kind] for kind in unsettled}, _control_mask(last - first, per_session)
        part = conditions[first:last]
        answers = responses(problem, shown, part, None, mask, lambda done, _, first=first: advance(first + done, n))
        by_kind = merge_responses([by_kind, answers]) if by_kind else answers
        if half_width is None or last == n:
            break
        claims = _paired_claims(by_kind, per_session)
        # a difference is as precise as the rate has to be, or so far from 0 that an early look does no harm
        halves = {kind: np.ptp(claim.difference_interval) / 2 for kind, claim in claims.items()}
        settled = {k for k, half in halves.items() if half <= half_width or abs(claims[k].difference) >= SETTLED * half}
        unsettled = [kind for kind in unsettled if kind not in settled]
        places = _place_numbers(conditions[:last], per_session)
        counts = count_by_session(by_kind["design"].recognized[0], per_session, places)
        if unsettled == ["design"] and np.ptp(rate_posterior(*counts).rate_interval) <= 2 * half_width:
            advance(last, last)  # a progress bar that stays at half would look broken
            break
    return by_kind


def _control_mask(n: int, per_session: int) -> np.ndarray:
    """A mask of the conditions, of n in sessions in a row, that controls are shown in."""
    return np.arange(n) % per_session < CONTROL_VIEWS


def _paired_claims(by_kind: Mapping[str, Responses], per_session: int) -> dict[str, ControlClaim]:
    """The control claims of the primary network, for the conditions that design and controls share."""
    design = by_kind["design"]
    paired = design.select(np.flatnonzero(_control_mask(design.recognized.shape[1], per_session)))
    return control_claims({**by_kind, "design": paired}, 0, min(CONTROL_VIEWS, per_session))


def _look_positions(total: int, per_session: int) -> list[int]:
    """The view counts at which a promise may stop, after a 0. Of 1,000 simulated promises each, of rates from 85 to
    99 % to ± 4 points, the intervals of those that stopped early held in 93.5 to 97.1 %, of full ones in 94.4 to
    96.4 %; a first look after two fifths, then one every fifth, saved 1 to 20 % more views, but held in 91.9 % in one
    case (`python tests/optimizer/test_promise_stops.py`).
    """
    sessions = math.ceil(total / per_session)
    return [0, *sorted({min(total, math.ceil(sessions * part) * per_session) for part in (0.5, 0.75, 1)})]


def _outermost_mm(problem: Problem) -> tuple[tuple[float, float, float], ...]:
    """The object's outermost points in the frame of its piece, if a network uses its box in photographs."""
    scene = problem.scene
    if not isinstance(scene, PatchScene) or not any(c.LOOKS_AT_BOXES for c in problem.classifiers):
        return ()
    points = geometry.transform_points(np.linalg.inv(scene.placement.world_from_piece), scene.outermost_mm)
    return tuple((round(x, 3), round(y, 3), round(z, 3)) for x, y, z in points.tolist())


def _place_numbers(conditions: Conditions, per_session: int) -> tuple[int, ...]:
    """A number for each session's place, in order; empty if all are different, or if there is only one place."""
    chosen = conditions.pose.background[::per_session, 0]
    places, first, which = np.unique(chosen, return_index=True, return_inverse=True)
    return tuple(map(int, first[which])) if 1 < len(places) < len(chosen) else ()


def pictures_with_controls(problem: Problem, design: np.ndarray, controls: Sequence[str]) -> dict[str, Appearance]:
    """The appearance of the design, and of each control by its name (None for "bare")."""
    subject, appearances = problem.subject, {}
    with torch.no_grad():
        for kind in ("design", *controls):
            pixels = design if kind in ("design", "bare") else subject.control(kind, design)
            design_srgb = from_pixels(pixels, problem.device)
            appearances[kind] = None if kind == "bare" else subject.appearance(design_srgb, kind)
    return appearances


def model_claims(
    problem: Problem, design: Responses, per_session: int = 1, places: Sequence[int] = ()
) -> tuple[ModelClaim, ...]:
    """Each network's rate and confidence for the design; intervals are over sessions, those at one place together."""
    rows = zip(problem.classifiers, design.recognized, design.confidence, strict=True)
    return tuple(
        ModelClaim(
            name=classifier.name,
            sha256=classifier.sha256,
            rate=float(recognized.mean()),
            interval=rate_posterior(*count_by_session(recognized, per_session, places)).rate_interval,
            confidence=float(confidence.mean()),
            least_score=classifier.least_score,
        )
        for classifier, recognized, confidence in rows
    )


def control_claims(by_kind: Mapping[str, Responses], model: int, per_session: int = 1) -> dict[str, ControlClaim]:
    """One network's claim for each control, paired with the design; a control may cover only the first conditions."""
    design, claims = by_kind["design"].recognized[model], {}
    for kind in (kind for kind in CONTROLS if kind in by_kind):
        recognized = by_kind[kind].recognized[model]
        difference, interval = session_difference(design[: len(recognized)], recognized, per_session)
        claims[kind] = ControlClaim(
            n=len(recognized),
            rate=float(recognized.mean()),
            interval=rate_posterior(*count_by_session(recognized, per_session)).rate_interval,
            confidence=float(by_kind[kind].confidence[model].mean()),
            difference=difference,
            difference_interval=interval,
        )
    return claims


def _condition_claims(problem: Problem, conditions: Conditions, recognized: np.ndarray) -> tuple[ConditionClaim, ...]:
    """The measurable properties of each condition; None where the patch's face is turned away or there is no piece."""
    names = ("px_per_mm", "tilt_deg", "azimuth_deg", "contrast")
    properties: dict[str, np.ndarray] = dict.fromkeys(names, np.full(len(conditions), np.nan))
    if problem.scene.HAS_PIECE:
        scene = require_piece(problem.scene)
        scale, tilt = scene.scales_and_tilts(conditions, scene.photo_px).T
        azimuth = scene.piece_azimuth_deg(conditions)
        white = scene.white_light(conditions) * 2**conditions.sensor.exposure_ev
        black = float(linear_from_srgb(problem.printer.apply(torch.zeros(1, 3, 1, 1))).mean())
        contrast = np.minimum(white, 1) - np.minimum(white * black, 1)  # of what is printed, in the photograph's light
        values = scale, tilt, azimuth, contrast
        turned_away = np.abs(azimuth) >= 90  # NaN, an unknown angle, counts as facing the camera
        properties = dict(zip(names, np.where(turned_away, np.nan, values), strict=True))
    properties["blur_px"] = conditions.sensor.blur_px
    columns = ([round(float(v), 4) if math.isfinite(v) else None for v in value] for value in properties.values())
    rows = (dict(zip(properties, row, strict=True)) for row in zip(*columns, strict=True))
    return tuple(ConditionClaim(**row, recognized=bool(hit)) for row, hit in zip(rows, recognized, strict=True))
