"""The effect without photographs of controls: what photographs of the patch would have shown with a control in its
place.

In: `PhotoSquare`s of judged photographs, the manifest and its printer, the promise's primary network, what it recognized.
Out: `EffectEstimate`. A control's pixels, as this print would have made them, are put into each photograph under its own
light and blur (`reproject`) and classified. The same is done with the design itself: where that does not nearly always
get the photograph's own answer, nothing is estimated.

Left out on purpose: the bare object, whose surface behind the piece no photograph shows; shadows and glare on the
piece, in which the design put back fails, too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from patchproof.base.intervals import paired_difference
from patchproof.evidence.classify import Judges, predict, squares_of
from patchproof.evidence.reproject import PhotoSquare, fit_print_and_lights, reprojected_square
from patchproof.evidence.results import EffectEstimate, EstimatedControl
from patchproof.evidence.surface import Surface, piece_picture, printed_colors
from patchproof.photo.colorfit import ColorFit
from patchproof.sheets.manifest import Manifest
from patchproof.sheets.piece import control_design

if TYPE_CHECKING:
    from patchproof.channel.printer import Printer

KINDS = ("mean", "gray", "noise")  # controls of the promise that are printed
LEAST_PHOTOS = 5
LEAST_AGREEING = 0.8  # of the photographs


def estimate_effect(
    shots: Sequence[PhotoSquare],
    manifest: Manifest,
    surface: Surface,
    printer: Printer,
    judges: Judges,
    recognized: Mapping[str, bool],
) -> EffectEstimate | None:
    """The patch beside each of `KINDS` in the same photographs, whose own answers are `recognized` by file; None of
    fewer than `LEAST_PHOTOS`, or of a sheet without a design.
    """
    if manifest.design is None or len(shots) < LEAST_PHOTOS:
        return None
    pixels = manifest.design.pixels()
    looks = {kind: printed_colors(control_design(kind, pixels, ""), surface, printer) for kind in ("design", *KINDS)}
    printed, _, lights = fit_print_and_lights(shots, looks["design"])
    pictures = {kind: piece_picture(surface, look.design) for kind, look in looks.items()}
    if printed is not None:
        pictures = {kind: printed(picture) for kind, picture in pictures.items()}
    answers = {
        kind: [_recognized(shot, picture, surface, light, judges) for shot, light in zip(shots, lights, strict=True)]
        for kind, picture in pictures.items()
    }
    own = [recognized[shot.file] for shot in shots]
    agree = float(np.mean([a == b for a, b in zip(own, answers["design"], strict=True)]))
    controls = []
    for kind in KINDS if agree >= LEAST_AGREEING else ():
        difference, ends = paired_difference(own, answers[kind])
        rate = float(np.mean(answers[kind]))
        controls.append(EstimatedControl(name=kind, rate=rate, difference=difference, difference_interval=ends))
    return EffectEstimate(photos=len(own), agree=agree, controls=tuple(controls))


def _recognized(shot: PhotoSquare, look: np.ndarray, surface: Surface, light: ColorFit, judges: Judges) -> bool:
    """Whether the primary network recognizes the photograph with that piece in it."""
    codes = np.rint(255 * reprojected_square(shot, look, surface.rect_mm, light)).astype(np.uint8)
    model = judges.primary
    square = squares_of(codes, [model.input_px])[model.input_px]
    return predict(model, judges.indices[model.name], square, shot.box).recognized
