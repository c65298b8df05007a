"""The gap ledger: how much confidence each step from the ideal picture to the photograph costs.

    ideal → gamut → print → light and camera → blur and noise → photo

In: `PhotoSquare`s of judged photographs, the manifest, the promise's primary network. Out: a `Ledger`: shares in confidence
(for a goal of deceiving, confidence gained), mean over photographs, with bootstrap intervals over photographs. Each
photograph is classified with its piece re-projected under all combinations of four effects on or off (`reproject`),
and each effect gets its mean cost over all orders of switching them on (Shapley, A Value for n-Person Games, 1953):

    share_k = Σ_{S ∌ k} |S|! (n - |S| - 1)! / n! · (v(S) - v(S ∪ {k}))

`photo` is what remains between all effects on and the photograph itself: shadows, glare, curl, whatever no effect
explains. Shares sum to the whole, v(nothing on) - v(photograph), and may be negative. "Off" means off by the promise:
each photograph borrows light and blur from one of the promise's own conditions, so that what was promised is no loss.

Gains and a veil that make paper white and marker black what was promised are light and camera, the rest of a color
difference is print. Ink lighter than promised and a veil of stray light look alike but for one thing: a veil lies over
the whole photograph, so what exceeds its darkest place is ink; up to there it counts as light. Where the design's
colors are too few or too much alike to say what the print made of them, print and light are one step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from math import factorial
from typing import Any

import numpy as np

from patchproof.base.color import linear_from_srgb
from patchproof.base.intervals import MIN_CLUSTERS, resampled_means
from patchproof.base.resample import downscale
from patchproof.evidence.classify import BoxEdges, Judges, boxes_of
from patchproof.evidence.reproject import PhotoSquare, Reference, Switches, fit_print_and_lights, reprojected_squares
from patchproof.evidence.results import Ledger, LedgerShare
from patchproof.evidence.surface import DESIGN_PX, PromisedColors, Surface, piece_picture, with_markers
from patchproof.sheets.manifest import Manifest

ConfidenceBySwitches = Mapping[Switches, float]  # confidence by what is switched on

GAMUT, PRINT, LIGHT, BLUR, PHOTO = "gamut", "print", "light_and_camera", "blur_and_noise", "photo"
PRINT_AND_LIGHT = "print_light_and_camera"
LEAST_PHOTOS = MIN_CLUSTERS
LEAST_SHARE = 0.05  # a culprit costs at least as much
_RESAMPLES = 2000


def ledger_of(
    shots: Sequence[PhotoSquare],
    manifest: Manifest,
    surface: Surface,
    promised: PromisedColors,
    judges: Judges,
    confidence: Mapping[str, float],
) -> Ledger | None:
    """The ledger of photographs whose own target confidence is `confidence` by file; None where nothing can be said."""
    if not shots or manifest.promise is None or manifest.design is None:
        return None
    conditions = manifest.promise.conditions
    claims = [(c.contrast, c.blur_px) for c in conditions if c.contrast is not None and c.blur_px is not None]
    if not claims:
        return None
    printed, undo, print_lights = fit_print_and_lights(shots, promised)
    looks = _looks(manifest.design.pixels(), surface, promised, printed)
    camera = manifest.settings.get("camera", {})
    values = []
    references = _references(claims, shots, camera, promised)
    for shot, fit, print_light, reference in zip(shots, undo, print_lights, references, strict=True):
        squares = reprojected_squares(shot, looks, surface.rect_mm, fit, print_light, reference)
        values.append(_confidences(squares, judges, shot.box))
    steps = (GAMUT, PRINT, LIGHT, BLUR) if printed is not None else (GAMUT, PRINT_AND_LIGHT, BLUR)
    own = np.array([confidence[shot.file] for shot in shots])
    return _ledger(steps, values, own, manifest.promise.target.goal.sign)


def shapley(values: ConfidenceBySwitches) -> np.ndarray:
    """Mean cost of switching each of k players on, over all orders; `values` has all 2^k combinations."""
    k = len(next(iter(values)))
    cost = np.zeros(k)
    for on in product((False, True), repeat=k):
        weight = factorial(sum(on)) * factorial(max(k - sum(on) - 1, 0)) / factorial(k)
        for player in range(k):
            if not on[player]:
                cost[player] += weight * (values[on] - values[(*on[:player], True, *on[player + 1 :])])
    return cost


def _ledger(steps: Sequence[str], values: Sequence[ConfidenceBySwitches], photo: np.ndarray, sign: float) -> Ledger:
    """The ledger of `values` by photograph, whose own confidences are `photo` (n)."""
    parts = np.array([[*shapley(v), v[(True,) * len(steps)] - own] for v, own in zip(values, photo, strict=True)])
    parts, names = sign * parts, (*steps, PHOTO)
    means, resampled, intervals = parts.mean(0), None, [None] * len(names)
    if len(parts) >= LEAST_PHOTOS:
        resampled = resampled_means(parts, _RESAMPLES)
        intervals = np.quantile(resampled, (0.025, 0.975), axis=0).T.tolist()
    return Ledger(
        shares={n: LedgerShare(share=m, interval=i) for n, m, i in zip(names, means, intervals, strict=True)},
        culprit=_culprit(names, means, resampled),
        ideal=float(np.mean([v[(False,) * len(steps)] for v in values])),
        photo=float(photo.mean()),
        photos=len(values),
    )


def _culprit(names: Sequence[str], means: np.ndarray, resampled: np.ndarray | None) -> str | None:
    """The step with the largest share, where resampling hardly ever lets another one be larger.

    Gamut is no candidate: the promise was made with it. What no step explains is none, but stands in the way.
    """
    if resampled is None:
        return None
    rivals = [i for i, name in enumerate(names) if name != GAMUT]
    top = max(rivals, key=lambda i: means[i])
    others = [i for i in rivals if i != top]
    lead = np.minimum(resampled[:, top] - resampled[:, others].max(1), resampled[:, top])
    clear = np.quantile(lead, 0.025) > 0 and means[top] >= LEAST_SHARE
    return names[top] if clear and names[top] != PHOTO else None


def _looks(sent_srgb: np.ndarray, surface: Surface, promised: PromisedColors, printed) -> dict[Switches, np.ndarray]:
    """The piece's light by (gamut, print), or by (gamut,) alone where the print is not known."""
    design = downscale(linear_from_srgb(sent_srgb / 255.0).astype(np.float32), DESIGN_PX)
    sent = piece_picture(surface, with_markers(design, surface, np.zeros(3)))
    looks = {False: sent, True: piece_picture(surface, promised.design)}
    if printed is None:
        return {(gamut,): look for gamut, look in looks.items()}
    return {(gamut, on): printed(look) if on else look for on in (False, True) for gamut, look in looks.items()}


def _references(
    claims: Sequence[tuple[float, float]],
    shots: Sequence[PhotoSquare],
    camera: Mapping[str, Any],
    promised: PromisedColors,
) -> list[Reference]:
    """One of the promise's conditions (contrast, blur_px) for each photograph, spread evenly over their contrasts.

    The brightest photograph gets the brightest, and so on: paired by chance, a few photographs' light share is mostly
    the luck of the draw.
    """
    claims = sorted(claims, key=lambda claim: claim[0])
    spread = ((np.arange(len(shots)) + 0.5) / len(shots) * len(claims)).astype(int)
    rank = np.argsort(np.argsort([float(np.mean(shot.light.paper - shot.light.ink)) for shot in shots]))
    low, high = camera.get("noise", (0.0, 0.0))
    noise = low + (high - low) * np.random.default_rng(1).permutation(len(shots) * 2)[: len(shots)] / (2 * len(shots))
    references = []
    for shot, (contrast, blur_px), level in zip(shots, (claims[i] for i in spread[rank]), noise, strict=True):
        scale = len(shot.square) / min(camera["photo_px"]) if "photo_px" in camera else shot.scale
        white = contrast / (1 - float(promised.ink.mean()))
        references.append(Reference(white, blur_px * scale, float(level) * scale))
    return references


def _confidences(squares: Mapping[Switches, np.ndarray], judges: Judges, box: BoxEdges | None) -> ConfidenceBySwitches:
    """Target confidence by combination, of squares with the object in `box`."""
    import torch

    from patchproof.classifier import center_square

    model, boxes = judges.primary, boxes_of(box, len(squares))
    with torch.inference_mode():
        pictures = [torch.from_numpy(square.transpose(2, 0, 1))[None].float() for square in squares.values()]
        batch = torch.cat([center_square(picture, model.input_px) for picture in pictures])
        confidence = model.confidence(model.logits(batch, boxes), judges.indices[model.name]).cpu().tolist()
    return dict(zip(squares, confidence, strict=True))
