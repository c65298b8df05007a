"""The digital piece put back into its photograph, with each effect of print, light and camera switched on or off.

In: a `PhotoSquare` (the centered square of a photograph as a network nearly sees it, and what was measured in it), the piece
as it could have been printed, and a `Reference`: light and blur of one of the promise's own conditions. Out: the
square with the whole piece replaced. Light and blur fall on the surroundings, too: there they are undone as
far as noise allows (Wiener's filter for the known blur). Work is done at three times the network's size at most: finer
detail is averaged away before the network sees it.

Left out on purpose: JPEG, whose blocks are smaller than a network's pixel in a photograph of usual size; shadows, glare
and uneven light, which the ledger counts as not explained.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from patchproof.base.color import LUMINANCE, srgb_from_linear
from patchproof.base.geometry import apply_homography, rect_corners
from patchproof.base.resample import index_homography
from patchproof.evidence.appearance import cells_fit
from patchproof.evidence.classify import BoxEdges, square_of
from patchproof.evidence.print_fit import fit_print
from patchproof.evidence.surface import PromisedColors, Surface
from patchproof.photo.colorfit import ColorFit, invert_affine, white_black
from patchproof.photo.detect import LINEAR_FLOAT32_FROM_CODE
from patchproof.photo.pattern_light import pattern_light
from patchproof.photo.quality import CLIPPED_CODE, FrameLight
from patchproof.photo.rectify import rectify, region_around
from patchproof.sheets.manifest import Rect

Switches = tuple[bool, ...]  # which effects are on
MAX_OVERSAMPLING = 3  # times the network's input size
_READ_SHARE_SQUARE = 1 / 16  # of noise at white, as the camera model has it
_CELLS = 16  # of the design, along its shorter side, in which its colors are read
_NOT_BLURRED_PX = 0.1
_LEAST_AGREEMENT = 0.6  # of marker cells with the print, where right homographies reach 0.9 and more
_LEAST_NOISE = 0.004  # of linear light: code values and JPEG
_DARKEST, _PATCH = 0.002, 5  # share of a photograph that noise may bring under its veil, in means over so many pixels
_SUPERSAMPLE = 2


@dataclass(frozen=True)
class PhotoSquare:
    """One photograph: `square` uint8 W×W×3, millimeters to its pixels, blur in its pixels, noise in linear light.

    `cells` h×w×3 are the design's linear light as photographed, NaN where clipped; `scale` is W over the photograph's
    shorter side; `matrix_px` is the camera's for the square, None where its focal length is not known; `box` is the
    object's, where networks ask for it.
    """

    file: str
    square: np.ndarray
    px_from_mm: np.ndarray
    light: FrameLight
    blur_px: float
    noise: float
    cells: np.ndarray
    scale: float
    matrix_px: np.ndarray | None = None
    box: BoxEdges | None = None


@dataclass(frozen=True)
class Reference:
    """Light and camera of a promised condition: light of white paper, blur in pixels of the square, noise at white."""

    white: float
    blur_px: float
    noise: float


def photo_square(
    file: str,
    srgb: np.ndarray,
    px_from_mm: np.ndarray,
    blur_px: float,
    light: FrameLight,
    surface: Surface,
    size_px: int,
    matrix_px: np.ndarray | None = None,
) -> PhotoSquare | None:
    """What is kept of an uint8 photograph to put other pieces into it, for a network of that input size.

    None where the markers do not lie where the homography says: few blurred corners can turn it far away.
    """
    square, (left, top) = square_of(srgb)
    work = min(len(square), MAX_OVERSAMPLING * size_px)
    scale = work / len(square)
    if scale < 1:
        square = cv2.resize(square, (work, work), interpolation=cv2.INTER_AREA)
    to_square = np.array([[scale, 0, -left * scale], [0, scale, -top * scale], [0, 0, 1.0]])
    on_piece = {i: surface.corners_mm[i] for i in surface.piece_ids}
    unmixed = pattern_light(srgb, px_from_mm, on_piece, surface.dictionary, blur_px)
    if unmixed is not None:
        if unmixed.agreement < _LEAST_AGREEMENT:
            return None
        light, blur_px = replace(light, paper=unmixed.paper, ink=unmixed.ink), unmixed.blur_px
    square, matrix = np.ascontiguousarray(square), None if matrix_px is None else to_square @ matrix_px
    cells = _cells(square, to_square @ px_from_mm, surface)
    return PhotoSquare(
        file, square, to_square @ px_from_mm, light, blur_px * scale, noise_of(square), cells, scale, matrix
    )


def _cells(square: np.ndarray, px_from_mm: np.ndarray, surface: Surface) -> np.ndarray:
    """The design's coarse colors in linear light, NaN where one is clipped."""
    cells_per_mm = _CELLS / min(surface.rect_mm[2:])
    cells = rectify(LINEAR_FLOAT32_FROM_CODE[square], px_from_mm, surface.rect_mm, cells_per_mm).astype(float)
    full = (square.max(-1, keepdims=True) >= CLIPPED_CODE).astype(np.float32)
    clipped = rectify(full, px_from_mm, surface.rect_mm, cells_per_mm).reshape(cells.shape[:2]) > 0.05
    return np.where(clipped[..., None], np.nan, cells)


def noise_of(srgb: np.ndarray) -> float:
    """Standard deviation of an uint8 picture's luminance noise, in linear light, read where the picture is smooth.

    Immerkaer, Fast Noise Variance Estimation, CVIU 64 (1996) 300-302, with a low quantile in place of the mean: a
    fifth of most photographs is smooth, and texture would count as noise.
    """
    luminance = (LINEAR_FLOAT32_FROM_CODE[srgb] @ np.array(LUMINANCE, np.float32)).astype(np.float32)
    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)  # of white noise, it makes 6 times as much
    detail = np.abs(cv2.filter2D(luminance, -1, mask)[1:-1, 1:-1])
    return float(np.quantile(detail, 0.2) / 0.2533 / 6)


def light_fit(shot: PhotoSquare, promised: PromisedColors) -> ColorFit:
    """From photographed to media-relative light by paper white and what veil of stray light lies over the photograph.

    A veil lifts all of it alike: it is no lighter than the darkest place, nor than makes marker black what was
    promised. Ink that is lighter still, or darker, is print.
    """
    paper, ink = shot.light.paper, shot.light.ink
    # means, since noise that is cut off at zero lifts dark ink as it lifts them
    darkest = np.quantile(
        cv2.blur(LINEAR_FLOAT32_FROM_CODE[shot.square], (_PATCH, _PATCH)).reshape(-1, 3), _DARKEST, axis=0
    )
    veil = np.clip((ink - paper * promised.ink) / (1 - promised.ink), 0, darkest)
    return white_black(paper, veil + (paper - veil) * promised.ink, promised.ink)


def fit_print_and_lights(
    shots: Sequence[PhotoSquare], promised: PromisedColors
) -> tuple[Callable[[np.ndarray], np.ndarray] | None, list[ColorFit], list[ColorFit]]:
    """What one print in several photographs makes of promised light, the light alone of each, and its print and light:
    together where the design's colors are too few or too alike to tell the print (None).
    """
    lights = [light_fit(shot, promised) for shot in shots]
    relative = [fit.apply(shot.cells) for fit, shot in zip(lights, shots, strict=True)]
    inks = [fit.apply(shot.light.ink) for fit, shot in zip(lights, shots, strict=True)]
    printed = fit_print(relative, promised.design, np.median(inks, axis=0), promised.ink)
    return printed, lights, lights if printed is not None else [design_fit(shot, promised) for shot in shots]


def design_fit(shot: PhotoSquare, promised: PromisedColors) -> ColorFit:
    """Print, light and camera together, from the design's own coarse colors; paper and ink where these do not do."""
    height, width = shot.cells.shape[:2]
    expected = cv2.resize(promised.design, (width, height), interpolation=cv2.INTER_AREA).astype(float)
    inner = np.s_[1:-1, 1:-1]
    readable = np.isfinite(shot.cells[inner]).all(-1)
    fit = cells_fit(shot.cells[inner][readable], expected[inner][readable], shot.light, promised.ink)
    return light_fit(shot, promised) if fit.name == "white_black" else fit


def reprojected_squares(
    shot: PhotoSquare,
    looks: Mapping[Switches, np.ndarray],
    rect_mm: Rect,
    undo: ColorFit,
    print_light: ColorFit,
    reference: Reference,
) -> dict[Switches, np.ndarray]:
    """Float32 sRGB squares W×W×3 by the switches of a look, light and blur.

    `looks` are the media-relative linear light of the piece at `rect_mm` by switches of their own. `undo` takes
    photographed light to media-relative; the inverse of `print_light` is what the photograph's light makes of a look.
    """
    box = _box(shot, rect_mm)
    photo = LINEAR_FLOAT32_FROM_CODE[shot.square]
    around = {}
    for blur, picture in ((True, photo), (False, deblurred(photo, shot.blur_px, reference.blur_px, shot.noise))):
        around[True, blur] = picture
        around[False, blur] = np.clip(reference.white * undo.apply(picture), 0, 1).astype(np.float32)
    coded = {key: srgb_from_linear(picture) for key, picture in around.items()}
    lit = {True: invert_affine(print_light.matrix), False: np.column_stack([np.eye(3) * reference.white, np.zeros(3)])}
    out = {}
    for switches, look in looks.items():
        sharp = _layer(look, shot.px_from_mm, rect_mm, box)
        for blur, sigma, noise in ((True, shot.blur_px, None), (False, reference.blur_px, reference.noise)):
            layer = _blurred(sharp, sigma)
            for light, matrix in lit.items():
                covered = _covered(layer, matrix, around[light, blur][box], shot.noise, noise)
                picture = out[(*switches, light, blur)] = coded[light, blur].copy()
                picture[box] = srgb_from_linear(covered)
    return out


def reprojected_square(shot: PhotoSquare, look: np.ndarray, rect_mm: Rect, light: ColorFit) -> np.ndarray:
    """The float32 sRGB square W×W×3 with a piece of this look (as in `reprojected_squares`) under the photograph's own light
    and blur, which the inverse of `light` and `shot` know.
    """
    box, photo = _box(shot, rect_mm), LINEAR_FLOAT32_FROM_CODE[shot.square]
    layer = _blurred(_layer(look, shot.px_from_mm, rect_mm, box), shot.blur_px)
    picture = srgb_from_linear(photo)
    picture[box] = srgb_from_linear(_covered(layer, invert_affine(light.matrix), photo[box], shot.noise))
    return picture


def _box(shot: PhotoSquare, rect_mm: Rect) -> tuple[slice, slice]:
    """The part of the square that a piece there reaches, with what blur carries over."""
    corners_px = apply_homography(shot.px_from_mm, rect_corners(rect_mm))
    return region_around(corners_px, 3 + int(4 * max(shot.blur_px, 2.0)), shot.square.shape)


def _covered(
    layer: np.ndarray, matrix: np.ndarray, behind: np.ndarray, noise: float, at_white: float | None = None
) -> np.ndarray:
    """Light of `behind` covered by a layer in light that `matrix` 3×4 makes of its own; noise is the photograph's, or
    a camera's whose noise at white is `at_white`.
    """
    share = layer[..., 3:]
    mixed = cv2.transform(layer, matrix.astype(np.float32)) + (1 - share) * behind
    if at_white is not None:  # what it is at this light; a scalar of numpy's would make all of it float64
        noise = at_white * math.sqrt(float(np.clip(np.mean(mixed), 0, 1)) + _READ_SHARE_SQUARE)
    return np.clip(mixed + share * noise * _grain(behind.shape), 0, 1)


@lru_cache(maxsize=2)
def _grain(shape: tuple[int, ...]) -> np.ndarray:
    """Noise, the same in all that is rendered into a photograph: half of what a look takes would be to draw it."""
    return np.random.default_rng(0).standard_normal(shape, np.float32)


def deblurred(linear: np.ndarray, from_px: float, to_px: float, noise: float) -> np.ndarray:
    """Linear light H×W×3 whose Gaussian blur is brought from one sigma to another, by Wiener's filter.

    Power is taken to fall with the square of frequency, as it does in pictures of nearly everything (Field, Relations
    between the statistics of natural images and the response properties of cortical cells, JOSA A 4, 1987).
    """
    if from_px <= to_px:
        return _blurred(linear, float(np.sqrt(to_px**2 - from_px**2)))
    margin = int(np.ceil(6 * from_px))
    wide = cv2.copyMakeBorder(linear, margin, margin, margin, margin, cv2.BORDER_REFLECT)
    height, width = wide.shape[:2]
    square = np.fft.fftfreq(height)[:, None] ** 2 + np.fft.rfftfreq(width) ** 2  # cycles per pixel, squared
    power = np.maximum(linear.var(), 1e-4) / (2 * np.pi * np.log(min(height, width) / 2))
    transfer = np.exp(-2 * np.pi**2 * from_px**2 * square)
    wanted = np.exp(-2 * np.pi**2 * to_px**2 * square)
    gain = wanted * transfer / (transfer**2 + max(noise, _LEAST_NOISE) ** 2 * square / power)
    back = np.fft.irfft2(np.fft.rfft2(wide, axes=(0, 1)) * gain[..., None], (height, width), axes=(0, 1))
    return np.clip(back[margin:-margin, margin:-margin], 0, 1).astype(np.float32)


def _layer(look: np.ndarray, px_from_mm: np.ndarray, rect_mm, box: tuple[slice, slice]) -> np.ndarray:
    """H×W×4: the look's light times its share of each pixel, and the share."""
    x, y, w, h = rect_mm
    finer, top, left = _SUPERSAMPLE, box[0].start, box[1].start
    height, width = box[0].stop - top, box[1].stop - left
    look = _no_finer_than(look, px_from_mm, rect_mm)
    mm_from_texel = np.array([[w / look.shape[1], 0, x], [0, h / look.shape[0], y], [0, 0, 1.0]])
    to_fine = np.array([[finer, 0, -finer * left], [0, finer, -finer * top], [0, 0, 1]])
    matrix = index_homography(to_fine @ px_from_mm @ mm_from_texel)
    # one texel of margin repeats the rim, so that interpolation does not darken it; the share cuts it off again
    size = (width * finer, height * finer)
    color = cv2.warpPerspective(look, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    inside = cv2.warpPerspective(np.ones(look.shape[:2], np.float32), matrix, size, flags=cv2.INTER_LINEAR)
    share = (inside > 0.5).astype(np.float32)
    fine = (color * share[..., None], share)  # apart: of four channels it would take twice as long
    return np.dstack([cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA) for part in fine])


def _no_finer_than(look: np.ndarray, px_from_mm: np.ndarray, rect_mm) -> np.ndarray:
    """The look averaged to about a texel per supersampled pixel, so that warping it does not alias."""
    quad = apply_homography(px_from_mm, rect_corners(rect_mm))
    sides = np.linalg.norm(np.roll(quad, -1, axis=0) - quad, axis=1) * _SUPERSAMPLE
    width, height = (max(2, int(np.ceil(side))) for side in sides.reshape(2, 2).max(0))
    width, height = min(look.shape[1], width), min(look.shape[0], height)
    return cv2.resize(look.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)


def _blurred(layer: np.ndarray, sigma_px: float) -> np.ndarray:
    if sigma_px < _NOT_BLURRED_PX:
        return layer
    return cv2.GaussianBlur(layer, (0, 0), float(sigma_px), borderType=cv2.BORDER_REPLICATE)
