"""Measure the light of paper and ink from whole markers, for photographs too blurred to show either one unmixed.

In: a photograph, its homography, the printed markers. Out: `PatternLight`. The printed cells are blurred as the
photograph is, and every channel's linear light is regressed on them at the cells' centers:
light = ink + (paper - ink) · pattern. At a blur of half a module no place shows pure paper or ink, and samples beside a
border are off by a quarter of the contrast; the regression is unbiased as long as the blur is known.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from patchproof.base.color import linear_from_srgb
from patchproof.base.geometry import apply_homography, local_scale
from patchproof.photo.edges import sample
from patchproof.photo.quality import CLIPPED_CODE
from patchproof.sheets.markers import marker_cells

_OVERSAMPLING = 8  # samples per module of the blurred pattern
_MIN_SAMPLES = 30
_BLUR_FACTORS = np.linspace(0.8, 1.5, 15)  # of the blur from borders, which is 10 % too low at half a module


@dataclass(frozen=True)
class PatternLight:
    """Linear light (3,) of paper and ink, and the Gaussian blur in pixels that fits the cells best.

    `agreement` is the correlation of the cells' light with the printed cells, near 1 if the homography is right.
    """

    paper: np.ndarray
    ink: np.ndarray
    blur_px: float
    agreement: float


def pattern_light(
    srgb: np.ndarray, px_from_mm: np.ndarray, corners_mm: Mapping[int, np.ndarray], dictionary: str, blur_px: float
) -> PatternLight | None:
    """Fit paper, ink and blur to a uint8 photograph, given the blur from borders; None if it shows too few cells."""
    ids = sorted(corners_mm)
    markers, lights = [], []
    for cells, corners in zip(marker_cells(dictionary, ids), (corners_mm[i] for i in ids), strict=True):
        module_px = local_scale(px_from_mm, corners.mean(0))[0] * np.linalg.norm(corners[1] - corners[0]) / len(cells)
        points = apply_homography(px_from_mm, _centers_mm(corners, len(cells)))
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
        if pattern.std() > 0.02:
            agreement = float(np.corrcoef(pattern, light.mean(1))[0, 1])
            fits.append((*_regress(pattern, light), blur, agreement))
    if not fits:
        return None
    _, paper, ink, blur, agreement = min(fits, key=lambda fit: fit[0])
    return PatternLight(np.minimum(paper, 1.2), np.maximum(ink, 0), float(blur), agreement)


def _regress(pattern: np.ndarray, light: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Median error, paper and ink by robust regression, since a glare or a thumb may cover a marker."""
    rows, weight, error = np.column_stack([1 - pattern, pattern]), np.ones(len(pattern)), np.zeros(len(pattern))
    ink = paper = np.zeros(3)
    for _ in range(4):
        ink, paper = np.linalg.lstsq(rows * weight[:, None], light * weight[:, None], rcond=None)[0]
        error = np.linalg.norm(rows @ np.stack([ink, paper]) - light, axis=1)
        weight = np.sqrt(np.minimum(1, 1.345 * 1.4826 * np.median(error) / np.maximum(error, 1e-9)))
    return float(np.median(error)), paper, ink


def _centers_mm(corners: np.ndarray, modules: int) -> np.ndarray:
    """The centers of a marker's modules, row by row."""
    across, down = (corners[1] - corners[0]) / modules, (corners[3] - corners[0]) / modules
    rows, columns = np.mgrid[0:modules, 0:modules] + 0.5
    return corners[0] + columns.reshape(-1, 1) * across + rows.reshape(-1, 1) * down


def _blur_cells(cells: np.ndarray, sigma_modules: float) -> np.ndarray:
    """The blurred pattern at the cells' centers, row by row, with paper around the marker."""
    step, half = _OVERSAMPLING, _OVERSAMPLING // 2
    fine = np.kron(np.pad(cells, 2, constant_values=1.0), np.ones((step, step)))
    if sigma_modules > 0.05:
        fine = cv2.GaussianBlur(fine, (0, 0), sigma_modules * step, borderType=cv2.BORDER_REPLICATE)
    # an even number of samples has no middle one: average two beside it, on the diagonal
    middle = (fine[half - 1 :: step, half - 1 :: step] + fine[half::step, half::step]) / 2
    return middle[2:-2, 2:-2].ravel()
