"""Estimate the patch's effect without photographs of controls: render controls into the photographs of the patch.

In: `PhotoSquare`s of judged photographs, the manifest and its printer, the promise's primary network, what it
recognized. Out: `EffectEstimate`. A control's pixels, as this print would have made them, are rendered into each
photograph under its light and blur (`reproject`) and classified. So is the design itself: if the network's answer then
differs from its answer to the original photograph in more than 20 %, nothing is estimated; the photographs in which it
differs are not compared, since there the rendering shows something else. Photographs of one session are alike.

Left out on purpose: the bare object, whose surface behind the piece no photograph shows; shadows and glare on the
piece, with which rendering the design back fails, too.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from patchproof.channel.print_colors import ShownColors
from patchproof.evidence.classify import Judges, predict, squares_of
from patchproof.evidence.reproject import PhotoSquare, fit_print_and_lights, reprojected_square
from patchproof.evidence.results import EffectEstimate
from patchproof.evidence.surface import Surface, piece_picture, printed_colors
from patchproof.evidence.verdict import compare_with_control
from patchproof.sheets.manifest import Manifest
from patchproof.sheets.piece import control_design

if TYPE_CHECKING:
    from patchproof.channel.printer import Printer

ESTIMATED_CONTROLS = ("mean", "gray", "noise")  # controls of the promise that are printed
LEAST_PHOTOS = 5
LEAST_AGREEMENT = 0.8  # share of the photographs


def estimate_effect(
    shots: Sequence[PhotoSquare],
    manifest: Manifest,
    surface: Surface,
    printer: "Printer",
    judges: Judges,
    recognized: Mapping[str, bool],
    session: Mapping[str, int],
) -> EffectEstimate | None:
    """Compare the patch with each of `ESTIMATED_CONTROLS` in the same photographs; `recognized` is the network's answer
    to each original photograph by file, `session` its session's number. None for fewer than `LEAST_PHOTOS`, or for a
    sheet without a design and promise.
    """
    if manifest.design is None or manifest.promise is None or len(shots) < LEAST_PHOTOS:
        return None
    pixels = manifest.design.pixels()
    kinds = ("design", *ESTIMATED_CONTROLS)
    looks = {kind: printed_colors(control_design(kind, pixels, ""), surface, printer) for kind in kinds}
    apply_print, _, lights = fit_print_and_lights(shots, looks["design"])
    pictures = {kind: piece_picture(surface, look.design) for kind, look in looks.items()}
    if apply_print is not None:
        pictures = {kind: apply_print(picture) for kind, picture in pictures.items()}
    answers = {
        kind: [_recognized(shot, picture, surface, light, judges) for shot, light in zip(shots, lights, strict=True)]
        for kind, picture in pictures.items()
    }
    files = [shot.file for shot in shots]
    same = [i for i, file in enumerate(files) if recognized[file] == answers["design"][i]]
    estimate = EffectEstimate(photos=len(files), agree=len(same) / len(files))
    if estimate.agree < LEAST_AGREEMENT:
        return estimate
    by_kind = {kind: {(session[files[i]], files[i]): hits[i] for i in same} for kind, hits in answers.items()}
    rows = (compare_with_control(by_kind["design"], k, by_kind[k], manifest.promise) for k in ESTIMATED_CONTROLS)
    return estimate.changed(controls=tuple(rows))


def _recognized(shot: PhotoSquare, look: np.ndarray, surface: Surface, light: ShownColors, judges: Judges) -> bool:
    """Classify the photograph with a piece of this look by the primary network."""
    codes = np.rint(255 * reprojected_square(shot, look, surface.rect_mm, light)).astype(np.uint8)
    model = judges.primary
    square = squares_of(codes, [model.input_px])[model.input_px]
    return predict(model, judges.indices[model.name], square, shot.box).recognized
