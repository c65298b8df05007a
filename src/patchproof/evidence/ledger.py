"""Tell from photographs alone, by rendering into them, where confidence is lost and what controls would show.

The gap ledger: the confidence lost in each step from the ideal picture to the photograph.

    ideal → gamut → print → light and camera → blur and noise → photo

In: a `PhotographedPrint` in judged photographs, the manifest, the promise's primary network. Out: a `Ledger`: shares in
confidence (for a goal of deceiving, confidence gained), mean over photographs, with bootstrap intervals. Each
photograph is classified with its piece re-projected under all combinations of four effects on or off (`reproject`); an
effect's share is its mean cost over all orders of switching them on (Shapley, A Value for n-Person Games, 1953):

    share_k = Σ_{S ∌ k} |S|! (n - |S| - 1)! / n! · (v(S) - v(S ∪ {k}))

`photo` is the difference between all effects on and the photograph itself: shadows, glare, curl, whatever no effect
explains. Shares sum to the whole, v(nothing on) - v(photograph), and may be negative. With an effect off, light and
blur are those of one of the promise's conditions, so that what the promise already contains is no loss.

Light and camera are what differs from photograph to photograph: gains, a veil, tone and chroma. What all photographs
share is print: a veil in all of them looks like lighter ink. Around the piece, stray light is undone up to that of the
darkest place. If the design's colors are too few or too alike to fit the print, print and light are one step.

The estimated effect: a control's pixels, as this print would have made them, are rendered into each photograph under
its light and blur and classified. So is the design itself: photographs in which that changes the network's answer are
not compared, and if they are more than 20 %, nothing is estimated. Photographs of one session are alike. Left out on
purpose: the bare object, whose surface behind the piece no photograph shows; shadows and glare on the piece.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import product
from math import factorial
from typing import TYPE_CHECKING, Any

import numpy as np

from patchproof.base.color import linear_from_srgb
from patchproof.base.intervals import MIN_CLUSTERS, resampled_means
from patchproof.base.resample import downscale, halving_pyramid
from patchproof.base.workers import fork_workers
from patchproof.channel.print_colors import ShownColors
from patchproof.evidence import reproject
from patchproof.evidence.classify import Judges, boxes_of, predict, squares_of
from patchproof.evidence.reproject import PhotographedPrint, PhotoSquare, Pyramid, Reference, Switches
from patchproof.evidence.results import EffectEstimate, Ledger, LedgerShare
from patchproof.evidence.surface import DESIGN_PX, PromisedColors, Surface, piece_picture, printed_colors, with_markers
from patchproof.evidence.task import Task
from patchproof.evidence.verdict import compare_with_control
from patchproof.sheets.manifest import Manifest
from patchproof.sheets.piece import control_design

if TYPE_CHECKING:
    from patchproof.channel.printer import Printer

ConfidenceBySwitches = Mapping[Switches, float]  # confidence by the effects that are on

GAMUT, PRINT, LIGHT, BLUR, PHOTO = "gamut", "print", "light_and_camera", "blur_and_noise", "photo"
PRINT_AND_LIGHT = "print_light_and_camera"
LEAST_PHOTOS = MIN_CLUSTERS
LEAST_SHARE = 0.05  # of confidence that a culprit costs
_RESAMPLES = 2000
ESTIMATED_CONTROLS = ("mean", "gray", "noise")  # controls of the promise that are printed
LEAST_AGREEMENT = 0.8  # share of the photographs


def ledger_of(
    found: PhotographedPrint, manifest: Manifest, task: Task, judges: Judges, confidence: Mapping[str, float], jobs: int
) -> Ledger | None:
    """Make the ledger, of target `confidence` by file; None without photographs, promise, design or conditions."""
    surface, promised, shots = task.surface, task.promised, found.shots
    if not shots or manifest.promise is None or manifest.design is None or promised is None:
        return None
    conditions = manifest.promise.conditions
    claims = [(c.contrast, c.blur_px) for c in conditions if c.contrast is not None and c.blur_px is not None]
    if not claims:
        return None
    looks = _looks(manifest.design.pixels(), surface, promised, found.add)
    references = _references(claims, [shot for shot, *_ in shots], manifest.settings.get("camera", {}), promised)
    with fork_workers(partial(_confidences, looks, surface, judges), jobs) as (workers, confidences):
        values = workers.map(confidences, [(*shot, ref) for shot, ref in zip(shots, references, strict=True)])
    steps = (GAMUT, PRINT_AND_LIGHT, BLUR) if found.add is None else (GAMUT, PRINT, LIGHT, BLUR)
    photo = np.array([confidence[shot.file] for shot, *_ in shots])
    return _ledger(steps, values, photo, manifest.promise.target.goal.sign)


def shapley(values: ConfidenceBySwitches) -> np.ndarray:
    """Shapley values: the mean cost of switching each of k effects on, over all orders, from all 2^k `values`."""
    k = len(next(iter(values)))
    cost = np.zeros(k)
    for on in product((False, True), repeat=k):
        weight = factorial(sum(on)) * factorial(max(k - sum(on) - 1, 0)) / factorial(k)
        for effect in range(k):
            if not on[effect]:
                cost[effect] += weight * (values[on] - values[(*on[:effect], True, *on[effect + 1 :])])
    return cost


def _ledger(steps: Sequence[str], values: Sequence[ConfidenceBySwitches], photo: np.ndarray, sign: float) -> Ledger:
    """Sum up n photographs, each with its `values` and the confidence in it as it is (`photo`)."""
    shares = np.array([[*shapley(v), v[(True,) * len(steps)] - p] for v, p in zip(values, photo, strict=True)])
    shares, names = sign * shares, (*steps, PHOTO)
    means, resampled, intervals = shares.mean(0), None, [None] * len(names)
    if len(shares) >= LEAST_PHOTOS:
        resampled = resampled_means(shares, _RESAMPLES)
        intervals = np.quantile(resampled, (0.025, 0.975), axis=0).T.tolist()
    return Ledger(
        shares={n: LedgerShare(share=m, interval=i) for n, m, i in zip(names, means, intervals, strict=True)},
        culprit=_culprit(names, means, resampled),
        ideal=float(np.mean([v[(False,) * len(steps)] for v in values])),
        photo=float(photo.mean()),
        photos=len(values),
    )


def _culprit(names: Sequence[str], means: np.ndarray, resampled: np.ndarray | None) -> str | None:
    """Name the step with the largest share, if no other is larger in 97.5 % of the resamples; else None.

    Gamut is no candidate: the promise was made with it. If `photo` is the largest, there is no culprit.
    """
    if resampled is None:
        return None
    rivals = [i for i, name in enumerate(names) if name != GAMUT]
    top = max(rivals, key=lambda i: means[i])
    lead = np.minimum(resampled[:, top] - resampled[:, [i for i in rivals if i != top]].max(1), resampled[:, top])
    clear = np.quantile(lead, 0.025) > 0 and means[top] >= LEAST_SHARE
    return names[top] if clear and names[top] != PHOTO else None


def _looks(pixels: np.ndarray, surface: Surface, promised: PromisedColors, add_print) -> dict[Switches, Pyramid]:
    """The piece's light by (gamut, print), or by (gamut,) alone if the print's map is unknown."""
    design = downscale(linear_from_srgb(pixels / 255.0).astype(np.float32), DESIGN_PX)
    ideal = piece_picture(surface, with_markers(design, surface, np.zeros(3)))
    looks: dict[Switches, np.ndarray] = {(False,): ideal, (True,): piece_picture(surface, promised.design)}
    if add_print is not None:
        looks = {(*key, on): add_print(look) if on else look for on in (False, True) for key, look in looks.items()}
    return {key: halving_pyramid(look) for key, look in looks.items()}


def _references(
    claims: list[tuple[float, float]], shots: Sequence[PhotoSquare], camera: Mapping[str, Any], promised: PromisedColors
) -> list[Reference]:
    """Pair each photograph with one of the promise's conditions (contrast, blur_px), spread evenly over contrast.

    The brightest photograph gets the brightest condition, and so on: random pairs would make light's share chance.
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


def _confidences(
    looks: Mapping[Switches, Pyramid],
    surface: Surface,
    judges: Judges,
    item: tuple[PhotoSquare, ShownColors, ShownColors, Reference],
) -> ConfidenceBySwitches:
    """Target confidence in a photograph by combination of effects."""
    import torch

    from patchproof.classifier import center_square

    shot, undo, print_light, reference = item
    squares = reproject.reprojected_squares(shot, looks, surface.rect_mm, undo, print_light, reference)
    model, boxes = judges.primary, boxes_of(shot.box, len(squares))
    with torch.inference_mode():
        pictures = [torch.from_numpy(square.transpose(2, 0, 1))[None].float() for square in squares.values()]
        batch = torch.cat([center_square(picture, model.input_px) for picture in pictures])
        confidence = model.confidence(model.logits(batch, boxes), judges.indices[model.name]).cpu().tolist()
    return dict(zip(squares, confidence, strict=True))


def estimate_effect(
    found: PhotographedPrint,
    manifest: Manifest,
    task: Task,
    printer: "Printer",
    judges: Judges,
    recognized: Mapping[str, bool],
    session: Mapping[str, int],
    jobs: int,
) -> EffectEstimate | None:
    """Compare the patch with each of `ESTIMATED_CONTROLS` in the same photographs; `recognized` is the network's answer
    to each original photograph by file, `session` its session's number. None for fewer than `LEAST_PHOTOS`, or for a
    sheet without a design and promise.
    """
    shots, surface = [(shot, light) for shot, _, light in found.shots], task.surface
    if manifest.design is None or manifest.promise is None or task.promised is None or len(shots) < LEAST_PHOTOS:
        return None
    pixels, looks = manifest.design.pixels(), {"design": task.promised}
    for kind in ESTIMATED_CONTROLS:
        looks[kind] = printed_colors(control_design(kind, pixels, ""), surface, printer)
    pictures = {kind: piece_picture(surface, look.design) for kind, look in looks.items()}
    pyramids = {kind: halving_pyramid(found.add(look) if found.add else look) for kind, look in pictures.items()}
    with fork_workers(partial(_recognized, pyramids, surface, judges), jobs) as (workers, recognized_in):
        answers = workers.map(recognized_in, shots)
    files = [shot.file for shot, _ in shots]
    same = [i for i, file in enumerate(files) if recognized[file] == answers[i]["design"]]
    estimate = EffectEstimate(photos=len(files), agree=len(same) / len(files))
    if estimate.agree < LEAST_AGREEMENT:
        return estimate
    by_kind = {kind: {(session[files[i]], files[i]): answers[i][kind] for i in same} for kind in looks}
    rows = (compare_with_control(by_kind["design"], k, by_kind[k], manifest.promise) for k in ESTIMATED_CONTROLS)
    return estimate.changed(controls=tuple(rows))


def _recognized(
    looks: Mapping[str, Pyramid], surface: Surface, judges: Judges, item: tuple[PhotoSquare, ShownColors]
) -> dict[str, bool]:
    """Classify a photograph with a piece of each look by the primary network."""
    (shot, light), model, recognized = item, judges.primary, {}
    for kind, look in looks.items():
        codes = np.rint(255 * reproject.reprojected_square(shot, look, surface.rect_mm, light)).astype(np.uint8)
        square = squares_of(codes, [model.input_px])[model.input_px]
        recognized[kind] = predict(model, judges.indices[model.name], square, shot.box).recognized
    return recognized
