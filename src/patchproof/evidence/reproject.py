"""Render the digital piece into a photograph of it, with each effect of print, light and camera switched on or off.

In: a `PhotoSquare` (the centered square of a photograph at up to three times the network's size, and its measured
figures), the piece as it could have been printed, and a `Reference`: light and blur of one of the promise's conditions.
Out: the square with the whole piece replaced. Effects that are off are also undone in the surroundings: light by its
inverse, blur by Wiener's filter as far as noise allows.

Left out on purpose: JPEG, whose blocks are smaller than a network's pixel in a photograph of usual size; shadows, glare
and uneven light, which the ledger counts as `photo`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import cv2
import numpy as np

from patchproof.base.color import lift_tone, srgb_from_linear
from patchproof.base.geometry import apply_homography, rect_corners
from patchproof.base.resample import index_homography
from patchproof.channel.print_colors import ShownColors, add_ink, fit_ink_and_photos, lower_light, white_black
from patchproof.evidence.appearance import fit_cells, noise_of
from patchproof.evidence.classify import BoxEdges, square_of
from patchproof.evidence.surface import PhotographedDesign, PromisedColors, Surface, choose_photo_cells, design_cells
from patchproof.photo.detect import LINEAR_FLOAT32_FROM_CODE, luminance
from patchproof.photo.quality import FrameLight, pattern_light
from patchproof.photo.rectify import region_around
from patchproof.sheets.manifest import Rect

Switches = tuple[bool, ...]  # which effects are on
Pyramid = Sequence[np.ndarray]  # a picture of media-relative linear light, its half and so on
MAX_OVERSAMPLING = 3  # times the network's input size; finer detail is averaged away before the network sees it
_READ_SHARE_SQUARE = 1 / 16  # of noise at white, as the camera model has it
_LEAST_BLUR_PX = 0.1
_LEAST_AGREEMENT = 0.6  # of marker cells with the print; correct homographies reach 0.9 and more
_LEAST_NOISE = 0.004  # of linear light: code values and JPEG
# share of a photograph that noise may bring below its veil, and the side in px of the square to average noise over
_DARKEST_SHARE, _AVERAGE_PX = 0.002, 5
_SUPERSAMPLE, _ROUNDS = 2, 3  # of pixels along a side; of fitting ink and photographs in turn


@dataclass(frozen=True)
class PhotoSquare:
    """A photograph's centered square: uint8 W×W×3, page millimeters to its pixels, blur in pixels, noise in light.

    `cells` h×w×3 are the design's linear light as photographed, NaN where clipped, `blur_cells` their blur in cells;
    `scale` is W over the photograph's shorter side; `box` is the object's, for detectors.
    """

    file: str
    square: np.ndarray
    px_from_mm: np.ndarray
    light: FrameLight
    blur_px: float
    noise: float
    cells: np.ndarray
    scale: float
    box: BoxEdges | None = None
    blur_cells: float = 0.0


@dataclass(frozen=True)
class PhotographedPrint:
    """One print in several photographs: `add` maps promised light to the print's, None if colors do not tell it; each
    photograph comes with its light, to be undone around the print, and with what it makes of the print's light (of
    promised light where there is no `add`).
    """

    add: Callable[[np.ndarray], np.ndarray] | None
    shots: list[tuple[PhotoSquare, ShownColors, ShownColors]]


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
) -> PhotoSquare | None:
    """Prepare an uint8 photograph to render other pieces into it, for a network of input size `size_px`.

    None if the markers' cells disagree with the homography: few blurred corners can make it wrong.
    """
    square, (left, top) = square_of(srgb)
    work = min(len(square), MAX_OVERSAMPLING * size_px)
    scale = work / len(square)
    if scale < 1:
        square = cv2.resize(square, (work, work), interpolation=cv2.INTER_AREA)
    to_square = np.array([[scale, 0, -left * scale], [0, scale, -top * scale], [0, 0, 1.0]])
    unmixed = unmix_markers(srgb, px_from_mm, blur_px, light, surface)
    if unmixed is None:
        return None
    light, blur_px = unmixed
    square = np.ascontiguousarray(square)
    to_square, blur_px, noise = to_square @ px_from_mm, blur_px * scale, float(noise_of(luminance(square)))
    cells, blur_cells = design_cells(square, to_square, surface.rect_mm, blur_px)
    return PhotoSquare(file, square, to_square, light, blur_px, noise, cells, scale, blur_cells=blur_cells)


def unmix_markers(
    srgb: np.ndarray, px_from_mm: np.ndarray, blur_px: float, light: FrameLight, surface: Surface
) -> tuple[FrameLight, float] | None:
    """Read paper, ink and blur from all cells of the piece's markers; None if they disagree with the homography."""
    on_piece = {i: surface.corners_mm[i] for i in surface.piece_ids}
    unmixed = pattern_light(srgb, px_from_mm, on_piece, surface.dictionary, blur_px) if on_piece else None
    if unmixed is None:
        return light, blur_px
    paper, ink, blur_px, agreement = unmixed
    return None if agreement < _LEAST_AGREEMENT else (replace(light, paper=paper, ink=ink), blur_px)


def light_fit(shot: PhotoSquare, promised: PromisedColors, tone: np.ndarray | float = 0.0) -> ShownColors:
    """Fit a photograph's light before its `tone` to media-relative light by paper white and a veil of stray light.

    A veil lightens all pixels alike: it is at most the darkest place's light, and at most what takes marker black to
    its promised value. Any other difference of ink is print.
    """
    paper, ink = lower_light(shot.light.paper, tone), lower_light(shot.light.ink, tone)
    # of local means: noise that is clipped at zero lightens them as it lightens dark ink
    means = cv2.blur(_light_before(shot, tone), (_AVERAGE_PX, _AVERAGE_PX)).reshape(-1, 3)
    darkest = np.quantile(means, _DARKEST_SHARE, axis=0)
    veil = np.clip((ink - paper * promised.ink) / (1 - promised.ink), 0, darkest)
    return white_black(paper, veil + (paper - veil) * promised.ink, promised.ink)


def _light_before(shot: PhotoSquare, tone: np.ndarray | float) -> np.ndarray:
    """The square's linear light before the photograph's tone, float32 W×W×3."""
    light = lower_light(np.repeat(LINEAR_FLOAT32_FROM_CODE[:, None], 3, 1), tone)
    return cv2.LUT(shot.square, light.astype(np.float32)[None])


def read_print(shots: Sequence[PhotoSquare], promised: PromisedColors) -> PhotographedPrint:
    """Fit the print's map of promised light, and each photograph's light."""
    designs = [PhotographedDesign(shot.cells, shot.blur_cells, shot.light) for shot in shots]
    if (read := choose_photo_cells(designs, promised)) is None:
        return PhotographedPrint(None, [(s, light_fit(s, promised), design_fit(s, promised)) for s in shots])
    ink, terms = fit_ink_and_photos(read, _ROUNDS)
    pairs = zip(shots, map(ShownColors.of_terms, terms), strict=True)
    return PhotographedPrint(partial(add_ink, ink=ink), [(s, light_fit(s, promised, t.tone), t) for s, t in pairs])


def design_fit(shot: PhotoSquare, promised: PromisedColors) -> ShownColors:
    """Fit print, light and camera together to the design's coarse colors, or else to paper and ink alone."""
    height, width = shot.cells.shape[:2]
    expected = cv2.resize(promised.design, (width, height), interpolation=cv2.INTER_AREA).astype(float)
    inner = np.s_[1:-1, 1:-1]
    readable = np.isfinite(shot.cells[inner]).all(-1)
    fit = fit_cells(shot.cells[inner][readable], expected[inner][readable], shot.light, promised.ink)
    return light_fit(shot, promised) if fit.kind == "white_black" else fit


def reprojected_squares(
    shot: PhotoSquare,
    looks: Mapping[Switches, Pyramid],
    rect_mm: Rect,
    undo: ShownColors,
    print_light: ShownColors,
    reference: Reference,
) -> dict[Switches, np.ndarray]:
    """Render the piece into the square with each effect on and off: float32 sRGB W×W×3 by (look, light, blur).

    `looks` are the piece at `rect_mm` by their own switches. `undo` takes
    photographed light before its tone to media-relative; `print_light` takes a look to the photograph's light.
    """
    box = _affected_part(shot, rect_mm)
    photo, tone = _light_before(shot, print_light.tone), print_light.tone
    surroundings = {}
    for blur, picture in ((True, photo), (False, change_blur(photo, shot.blur_px, reference.blur_px, shot.noise))):
        surroundings[True, blur] = picture
        surroundings[False, blur] = np.clip(reference.white * undo.undo(picture), 0, 1).astype(np.float32)
    srgb = {key: _codes(picture, tone if key[0] else 0.0) for key, picture in surroundings.items()}
    promised_light = np.column_stack([np.eye(3) * reference.white, np.zeros(3)])
    lights = {True: print_light.matrix, False: promised_light}
    squares = {}
    for switches, look in looks.items():
        sharp = _layer(look, shot.px_from_mm, rect_mm, box)
        for blur, sigma, noise in ((True, shot.blur_px, None), (False, reference.blur_px, reference.noise)):
            layer = _blur(sharp, sigma)
            for light, matrix in lights.items():
                part = _compose(layer, matrix, surroundings[light, blur][box], shot.noise, noise)
                picture = squares[(*switches, light, blur)] = srgb[light, blur].copy()
                picture[box] = _codes(part, tone if light else 0.0)
    return squares


def reprojected_square(shot: PhotoSquare, look: Pyramid, rect_mm: Rect, light: ShownColors) -> np.ndarray:
    """Render a piece of this look into the square under the photograph's blur and light: float32 sRGB W×W×3."""
    box, photo = _affected_part(shot, rect_mm), _light_before(shot, light.tone)
    layer = _blur(_layer(look, shot.px_from_mm, rect_mm, box), shot.blur_px)
    picture = shot.square.astype(np.float32) / 255
    picture[box] = _codes(_compose(layer, light.matrix, photo[box], shot.noise), light.tone)
    return picture


def _codes(linear: np.ndarray, tone: np.ndarray | float) -> np.ndarray:
    codes = srgb_from_linear(linear)
    return lift_tone(codes, np.asarray(tone, codes.dtype)) if np.any(tone) else codes


def _affected_part(shot: PhotoSquare, rect_mm: Rect) -> tuple[slice, slice]:
    corners_px = apply_homography(shot.px_from_mm, rect_corners(rect_mm))
    return region_around(corners_px, 3 + int(4 * max(shot.blur_px, 2.0)), shot.square.shape)


def _compose(
    layer: np.ndarray, matrix: np.ndarray, behind: np.ndarray, noise: float, noise_at_white: float | None = None
) -> np.ndarray:
    """Cover the light `behind` with a layer, whose colors `matrix` (3×4) maps; add the photograph's noise, or that of a
    camera whose noise at white is `noise_at_white`.
    """
    share = layer[..., 3:]
    mixed = cv2.transform(layer, matrix.astype(np.float32)) + (1 - share) * behind
    if noise_at_white is not None:  # noise at this light; a NumPy scalar would make all of it float64
        noise = noise_at_white * math.sqrt(float(np.clip(np.mean(mixed), 0, 1)) + _READ_SHARE_SQUARE)
    return np.clip(mixed + share * noise * _grain(behind.shape), 0, 1)


@lru_cache(maxsize=2)
def _grain(shape: tuple[int, ...]) -> np.ndarray:
    """Unit noise, cached for all pieces that are rendered into a photograph: drawing it took half of their time."""
    return np.random.default_rng(0).standard_normal(shape, np.float32)


def change_blur(linear: np.ndarray, from_px: float, to_px: float, noise: float) -> np.ndarray:
    """Change the Gaussian blur of linear light H×W×3 from one sigma to another; to a smaller one by Wiener's filter.

    Power is taken to fall with the square of frequency, as in natural images (Field, Relations between the statistics
    of natural images and the response properties of cortical cells, JOSA A 4, 1987).
    """
    if from_px <= to_px:
        return _blur(linear, float(np.sqrt(to_px**2 - from_px**2)))
    margin = int(np.ceil(6 * from_px))
    extended = cv2.copyMakeBorder(linear, margin, margin, margin, margin, cv2.BORDER_REFLECT)
    height, width = extended.shape[:2]
    square = np.fft.fftfreq(height)[:, None] ** 2 + np.fft.rfftfreq(width) ** 2  # cycles per pixel, squared
    power = np.maximum(linear.var(), 1e-4) / (2 * np.pi * np.log(min(height, width) / 2))
    transfer = np.exp(-2 * np.pi**2 * from_px**2 * square)
    wanted = np.exp(-2 * np.pi**2 * to_px**2 * square)
    gain = wanted * transfer / (transfer**2 + max(noise, _LEAST_NOISE) ** 2 * square / power)
    filtered = np.fft.irfft2(np.fft.rfft2(extended, axes=(0, 1)) * gain[..., None], (height, width), axes=(0, 1))
    return np.clip(filtered[margin:-margin, margin:-margin], 0, 1).astype(np.float32)


def _layer(look: Pyramid, px_from_mm: np.ndarray, rect_mm, box: tuple[slice, slice]) -> np.ndarray:
    """Warp a look to the part `box` of a square, H×W×4: its light times its share of each pixel, and the share."""
    x, y, w, h = rect_mm
    finer, top, left = _SUPERSAMPLE, box[0].start, box[1].start
    height, width = box[0].stop - top, box[1].stop - left
    # about a texel per supersampled pixel, so that warping does not alias
    quad = apply_homography(px_from_mm, rect_corners(rect_mm))
    sides = np.linalg.norm(np.roll(quad, -1, axis=0) - quad, axis=1).reshape(2, 2).max(0) * finer
    wide, high = (min(n, max(2, int(np.ceil(s)))) for n, s in zip(look[0].shape[1::-1], sides, strict=True))
    level = [part for part in look if part.shape[1] >= wide and part.shape[0] >= high][-1]
    texels = cv2.resize(level.astype(np.float32), (wide, high), interpolation=cv2.INTER_AREA)
    mm_from_texel = np.array([[w / wide, 0, x], [0, h / high, y], [0, 0, 1.0]])
    to_fine = np.array([[finer, 0, -finer * left], [0, finer, -finer * top], [0, 0, 1]])
    matrix = index_homography(to_fine @ px_from_mm @ mm_from_texel)
    # the rim is repeated outside, so that interpolation does not darken it; the share cuts it off again
    size = (width * finer, height * finer)
    color = cv2.warpPerspective(texels, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    inside = cv2.warpPerspective(np.ones((high, wide), np.float32), matrix, size, flags=cv2.INTER_LINEAR)
    share = (inside > 0.5).astype(np.float32)
    fine = (color * share[..., None], share)  # resized separately: four channels at once take twice as long
    return np.dstack([cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA) for part in fine])


def _blur(layer: np.ndarray, sigma_px: float) -> np.ndarray:
    if sigma_px < _LEAST_BLUR_PX:
        return layer
    return cv2.GaussianBlur(layer, (0, 0), float(sigma_px), borderType=cv2.BORDER_REPLICATE)
