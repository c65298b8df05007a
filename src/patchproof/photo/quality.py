"""Measure a photograph's quality: empty or not, the blur of markers' borders, the light of paper and ink, clipping.

In: a photograph and its fitted markers, or its homography. Out: `FrameLight`: paper and ink are sampled half a module
outside and inside of every border and corrected for their mixture by the blur, per channel in linear light. At a blur
of half a module no place shows pure paper or ink, and samples beside a border are off by a quarter of the contrast. So
`pattern_light` blurs the printed cells of whole markers as the photograph is, and regresses the light at their centers
on them, light = ink + (paper - ink) · pattern, which is unbiased as long as the blur is known.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.special import ndtr

from patchproof.base.color import LUMINANCE, linear_from_srgb
from patchproof.base.geometry import apply_homography, local_scale
from patchproof.photo.edges import Borders, border_frame, sample
from patchproof.sheets.markers import marker_cells

CLIPPED_CODE = 253  # JPEG and sharpening move full white by a code or two
_ALONG = 16
_CELLS = 8  # along each side; their mean colors are compared
_MIN_DEVIATION_CODES = 1.0  # standard deviation of the means: covered lenses, black and burnt-out frames have less
_MIN_DEVIATION_NOISES = 2.0  # in units of the deviation that pixel noise alone gives the means
_OVERSAMPLING = 8  # samples per module of the blurred pattern
_MIN_SAMPLES = 30
_BLUR_FACTORS = np.linspace(0.8, 1.5, 15)  # of the blur from borders, which is 10 % too low at half a module
_LEAST_SPREAD = 0.02  # standard deviation of a channel's printed light that tells gain from veil


@dataclass(frozen=True)
class FrameLight:
    """Linear light (3,) of paper and ink, 1 = the photo's full white; contrast is their difference in luminance."""

    paper: np.ndarray
    ink: np.ndarray
    contrast: float
    clipped: float  # share of paper samples with a channel at full white


def is_featureless(srgb: np.ndarray) -> bool:
    """True if a uint8 picture H×W×3 is one tone or noise: its 8 × 8 cells' mean colors differ no more than by noise."""
    means = cv2.resize(srgb, (_CELLS, _CELLS), interpolation=cv2.INTER_AREA).reshape(-1, 3)
    steps = np.diff(srgb[:: max(1, len(srgb) // 200)].astype(np.int16), axis=1).astype(float)
    noise = np.sqrt((steps**2).mean() / 2) if steps.size else 0.0
    pixels = srgb.shape[0] * srgb.shape[1] / _CELLS**2
    return float(means.std(0).max()) < max(_MIN_DEVIATION_CODES, _MIN_DEVIATION_NOISES * noise / np.sqrt(pixels))


def blur_px(markers: Iterable[Borders]) -> float:
    """The Gaussian sigma of the borders in photo pixels: the median over the fitted markers, or over all if none is."""
    return float(np.median([b.blur_px for b in _fitted_or_all(markers)]))


def frame_light(srgb: np.ndarray, markers: Iterable[Borders]) -> FrameLight:
    """Measure paper and ink at the borders of at least one marker in a uint8 sRGB photograph."""
    markers = _fitted_or_all(markers)
    module = np.array([b.module_px for b in markers])[:, None, None, None]
    middle, half, normal = border_frame(np.stack([b.corners_px for b in markers]))
    border = middle[:, :, None] + np.linspace(-0.8, 0.8, _ALONG)[:, None] * half[:, :, None]
    outside, inside = (sample(srgb, border + sign * 0.5 * module * normal[:, :, None]) for sign in (1, -1))
    clipped = float((outside >= CLIPPED_CODE).any(-1).mean())
    light_out, light_in = (np.median(linear_from_srgb(v / 255.0), axis=(0, 1, 2)) for v in (outside, inside))
    # half a module m to either side of a step blurred by sigma the share of paper is Φ(±m/2σ)
    blur = np.median([b.blur_px / max(b.module_px, 1e-6) for b in markers])
    share = float(ndtr(0.5 / max(blur, 1e-3)))
    span = (light_out - light_in) / max(2 * share - 1, 0.3)
    ink = np.maximum(light_in - (1 - share) * span, 0)
    paper = np.minimum(ink + span, 1.2)
    return FrameLight(paper, ink, float(np.dot(LUMINANCE, paper - ink)), clipped)


def _fitted_or_all(markers: Iterable[Borders]) -> list[Borders]:
    markers = list(markers)
    return [b for b in markers if b.fitted] or markers


def pattern_light(
    srgb: np.ndarray, px_from_mm: np.ndarray, corners_mm: Mapping[int, np.ndarray], dictionary: str, blur_px: float
) -> tuple[np.ndarray, np.ndarray, float, float] | None:
    """Fit the light (3,) of paper and ink and the blur in px, given that of borders, to a uint8 photograph; None if it
    shows too few cells. Last comes the correlation of light and print, near 1 if the homography is right.
    """
    ids = sorted(corners_mm)
    markers, lights = [], []
    for cells, corners in zip(marker_cells(dictionary, ids), (corners_mm[i] for i in ids), strict=True):
        module_px = local_scale(px_from_mm, corners.mean(0))[0] * np.linalg.norm(corners[1] - corners[0]) / len(cells)
        rows, columns = (np.mgrid[: len(cells), : len(cells)].reshape(2, -1, 1) + 0.5) / len(cells)
        centers_mm = corners[0] + columns * (corners[1] - corners[0]) + rows * (corners[3] - corners[0])
        points = apply_homography(px_from_mm, centers_mm)
        usable = ((points > 1) & (points < [srgb.shape[1] - 1, srgb.shape[0] - 1])).all(1)
        values = sample(srgb, points)
        usable &= (values < CLIPPED_CODE).all(1)
        markers.append((cells, module_px, usable))
        lights.append(linear_from_srgb(values[usable] / 255.0))
    light = np.concatenate(lights)
    if len(light) < _MIN_SAMPLES:
        return None
    fits = []
    for blur in blur_px * _BLUR_FACTORS:
        pattern = np.concatenate([_blur_cells(cells, blur / module)[usable] for cells, module, usable in markers])
        if pattern.std() > _LEAST_SPREAD:
            agreement = float(np.corrcoef(pattern, light.mean(1))[0, 1])
            fits.append((*gain_and_veil(np.repeat(pattern[:, None], 3, 1), light), blur, agreement))
    if not fits:
        return None
    _, gain, ink, blur, agreement = min(fits, key=lambda fit: np.median(fit[0]))
    return np.minimum(gain + ink, 1.2), np.maximum(ink, 0), float(blur), agreement


def gain_and_veil(printed: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit seen ≈ veil + gain · printed to N×3 pixels robustly, since glare may cover some; errors (N,) come first."""
    known, weight = printed.std(0) >= _LEAST_SPREAD, np.ones(len(seen))
    gain, veil, error = np.ones(3), np.zeros(3), np.zeros(len(seen))
    for _ in range(4):
        total = weight.sum()
        x, y = (weight @ values / total for values in (printed, seen))
        slope = weight @ ((printed - x) * (seen - y)) / np.maximum(weight @ (printed - x) ** 2, 1e-9)
        gain = np.where(known, np.maximum(slope, 1e-3), y / np.maximum(x, 1e-3))
        veil = np.where(known, y - gain * x, 0.0)
        error = np.linalg.norm(veil + gain * printed - seen, axis=1)
        weight = np.minimum(1, 2 * np.median(error) / np.maximum(error, 1e-6))
    return error, gain, veil


def _blur_cells(cells: np.ndarray, sigma_modules: float) -> np.ndarray:
    """The blurred pattern at the cells' centers, row by row, with paper around the marker."""
    step, half = _OVERSAMPLING, _OVERSAMPLING // 2
    fine = np.kron(np.pad(cells, 2, constant_values=1.0), np.ones((step, step)))
    if sigma_modules > 0.05:
        fine = cv2.GaussianBlur(fine, (0, 0), sigma_modules * step, borderType=cv2.BORDER_REPLICATE)
    # an even number of samples has no middle one: average two beside it, on the diagonal
    middle = (fine[half - 1 :: step, half - 1 :: step] + fine[half::step, half::step]) / 2
    return middle[2:-2, 2:-2].ravel()
