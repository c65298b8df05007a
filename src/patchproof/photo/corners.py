"""Locate a print without markers by the four corners of its design, and read its light from the design itself.

In: a photograph, the design's corners in it with their uncertainty (named by a person, or found by a search), and the
linear light that was promised. Out: `PlacedDesign`: the homography, blur, and the light of paper and ink. The corners
are a start: the design's cells are registered round it, and all of them together with the corners give the homography,
so that corners may be off by 5 % of the design's side. Where too few cells have detail the corners alone give it.

Without white paper and black ink of markers, light is a gain and a veil per channel that take the promised cells to the
photographed ones. A channel without contrast leaves its veil unknown, which is taken as none.
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from patchproof.base.color import LUMINANCE
from patchproof.base.geometry import apply_homography, local_scale, rect_corners
from patchproof.photo.detect import LINEAR_FLOAT32_FROM_CODE
from patchproof.photo.quality import CLIPPED_CODE, FrameLight
from patchproof.photo.rectify import PageFit, crop_around, fit_points, rectified_px, rectify, resize_by_area
from patchproof.photo.registration import register

_ROUNDS, _CONVERGED_PX = 3, 0.1  # of registration: cells are found within 5 % of the shorter side
_LEAST_CELLS = 8  # with a place of their own, to correct corners
_CELL_NOISE_PX = 0.05  # least standard deviation of a cell's place
_MAX_SIDE_PX = 192  # of the design's shorter side, where blur and light are read
_BLURS_PX = (0.0, 0.4, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0)
_LEAST_SPREAD = 0.03  # standard deviation of a channel's promised light that tells gain from veil


@dataclass(frozen=True)
class DesignCorners:
    """The outer corners 4×2 px of a design in an upright photograph, pixel centers at .5: the design's own top-left,
    top-right, bottom-right and bottom-left; the standard deviation of a coordinate, and who located them.
    """

    px: np.ndarray
    sigma_px: float
    located: Literal["corners", "found"] = "corners"


@dataclass(frozen=True)
class PlacedDesign:
    """A print located without markers: the homography, the blur in pixels, and the light of paper and ink."""

    fit: PageFit
    blur_px: float
    light: FrameLight


def place_design(
    srgb: np.ndarray, corners: DesignCorners, rect_mm, design: np.ndarray, ink: np.ndarray
) -> PlacedDesign:
    """Locate a design, whose promised linear light is H×W×3 over `rect_mm` of the page, in a uint8 photograph; `ink`
    (3,) is the promised light of black.
    """
    corners_mm, middle_mm = rect_corners(rect_mm), (rect_mm[0] + rect_mm[2] / 2, rect_mm[1] + rect_mm[3] / 2)
    sigma_px = np.full(4, corners.sigma_px)
    fit = fit_points(corners_mm, corners.px, sigma_px)
    for _ in range(_ROUNDS):
        px_per_mm = local_scale(fit.px_from_mm, middle_mm)[0]
        cells = register(srgb, fit.px_from_mm, rect_mm, design, px_per_mm, 1.0)
        sure = cells.sigma_mm < cells.size_mm / 4  # False where NaN
        if sure.sum() < _LEAST_CELLS:
            break
        cells_px = apply_homography(fit.px_from_mm, (cells.middle_mm + cells.shift_mm)[sure])
        mm, px = np.concatenate([corners_mm, cells.middle_mm[sure]]), np.concatenate([corners.px, cells_px])
        sigmas = np.concatenate([sigma_px, np.hypot(cells.sigma_mm[sure] * px_per_mm, _CELL_NOISE_PX)])
        fit, before = fit_points(mm, px, sigmas, fit.px_from_mm), fit
        moved = apply_homography(fit.px_from_mm, corners_mm) - apply_homography(before.px_from_mm, corners_mm)
        if np.abs(moved).max() < _CONVERGED_PX:
            break
    return PlacedDesign(fit, *_blur_and_light(srgb, fit.px_from_mm, rect_mm, design, ink))


def _blur_and_light(srgb, px_from_mm, rect_mm, design, ink) -> tuple[float, FrameLight]:
    """Fit the blur in pixels of the photograph, and gain and veil of each channel, to the design's pixels."""
    middle_mm = rect_mm[0] + rect_mm[2] / 2, rect_mm[1] + rect_mm[3] / 2
    px_per_mm = local_scale(px_from_mm, middle_mm)[0]
    scale = min(px_per_mm, _MAX_SIDE_PX / min(rect_mm[2:]))
    part, to_part = crop_around(srgb, px_from_mm, rect_corners(rect_mm), 4)
    clipped = (part.max(-1, keepdims=True) >= CLIPPED_CODE).astype(np.float32)
    seen = rectify(np.dstack([LINEAR_FLOAT32_FROM_CODE[part], clipped]), to_part, rect_mm, scale)
    inner = np.s_[2:-2, 2:-2] if min(seen.shape[:2]) > 8 else np.s_[:]
    usable = seen[inner][..., 3] < 0.05
    share = 1 - float(usable.mean())
    if usable.sum() < 16:
        white = np.ones(3)
        return 0.0, FrameLight(white, white * ink, float(LUMINANCE @ (white - ink)), share)
    fits = []
    for blur in _BLURS_PX:
        sigma = blur / px_per_mm * design.shape[1] / rect_mm[2]
        printed = cv2.GaussianBlur(design, (0, 0), sigma) if sigma > 0.3 else design
        printed = resize_by_area(printed, rectified_px(rect_mm, scale))
        fits.append((*_gain_and_veil(printed[inner][usable], seen[inner][..., :3][usable]), blur))
    _, gain, veil, blur = min(fits, key=lambda fit: fit[0])
    paper, black = np.clip(gain + veil, 1e-3, 1.2), np.clip(veil + gain * ink, 0, 1.2)
    return blur, FrameLight(paper, black, float(np.dot(LUMINANCE, paper - black)), share)


def _gain_and_veil(printed: np.ndarray, seen: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Fit seen ≈ veil + gain · printed by channel to N×3 pixels, with less weight on what lies over the design; the
    mean absolute error comes first.
    """
    known, weight = printed.std(0) >= _LEAST_SPREAD, np.ones(len(seen))
    gain, veil, error = np.ones(3), np.zeros(3), np.zeros(len(seen))
    for _ in range(4):
        total = weight.sum()
        x, y = (weight @ values / total for values in (printed, seen))
        slope = weight @ ((printed - x) * (seen - y)) / np.maximum(weight @ (printed - x) ** 2, 1e-9)
        gain = np.where(known, np.maximum(slope, 1e-3), y / np.maximum(x, 1e-3))
        veil = np.where(known, y - gain * x, 0.0)
        error = np.abs(veil + gain * printed - seen).mean(1)
        weight = np.minimum(1, 2 * np.median(error) / np.maximum(error, 1e-6))
    return float(error.mean()), gain, veil
