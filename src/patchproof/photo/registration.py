"""Register the design's pixels in a photograph: how far they lie off, and where a print without markers lies.

Shifts. In: a photograph in which the sheet is flat, its homography, the linear light that was promised over a rectangle
of the page. Out: `Registration`: for each cell of a grid that has texture its shift, by the peak of the normalized
correlation of its luminance with the printed one, and the shift's uncertainty. The correlation does not depend on
brightness and contrast. A cell that is covered or glossy has no peak: NaN.

Source of a peak's uncertainty: Lucas and Kanade, An Iterative Image Registration Technique, IJCAI 1981; but errors of a
cell's light are not independent from pixel to pixel (other inks, a shadow), so they count as `_INDEPENDENT_ERRORS`.

A print without markers is located by its design's corners, named by a person or found by a search. They are a start:
the design's cells are registered round it, and all of them together with the corners give the homography, so that
corners may be off by 5 % of the design's side. The corners alone give it where too few cells have detail, and where the
cells disagree among each other and contradict the corners by little more. Without white paper and black ink of markers,
light is a gain and a veil per channel that take the promised cells to the photographed ones. A channel without contrast
leaves its veil unknown, which is taken as none.
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from patchproof.base.color import LUMINANCE
from patchproof.base.geometry import apply_homography, local_scale, rect_corners
from patchproof.photo.detect import LINEAR_FLOAT32_FROM_CODE, luminance
from patchproof.photo.quality import CLIPPED_CODE, FrameLight, gain_and_veil
from patchproof.photo.rectify import PageFit, coarsen, crop_around, fit_points, rectify

_CELLS = 8  # along the rectangle's shorter side
_MAX_SIDE_PX = 256  # of the shorter side: shifts are found to a tenth of such a pixel
_SEARCH_SHARE = 0.4  # of a cell, to either side
_RIM_SHARE = 1 / 6  # of a cell: texture there may be the edge of a neighbor, along which a shift is undetermined
_MIN_CORRELATION = 0.6
_MIN_TEXTURE = 0.02  # standard deviation of linear light
_INDEPENDENT_ERRORS = 16
_ROUNDS, _CONVERGED_PX = 3, 0.1  # of registration: cells are found within 5 % of the shorter side
_LEAST_CELLS = 8  # with a place of their own, to correct corners
_CELL_NOISE_PX = 0.05  # least standard deviation of a cell's place
# cells off by over a stated deviation, in the median, and over half of the corners' (other colors than promised shift
# smooth designs) move no corners by less than 2.5 times that
_DOUBTFUL_CELLS, _DOUBTFUL_SHARE, _DOUBTFUL_REACH = 1.0, 0.5, 2.5
_LIGHT_SIDE_PX = 192  # of the design's shorter side, where blur and light are read
_BLURS_PX = (0.0, 0.4, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0)


@dataclass(frozen=True)
class Registration:
    """For N cells with texture: middle and shift N×2 in page millimeters, and the shift's standard deviation N along
    its most uncertain direction; NaN where the photograph shows something else.
    """

    middle_mm: np.ndarray
    shift_mm: np.ndarray
    sigma_mm: np.ndarray
    size_mm: float  # side of a cell


def register(
    srgb: np.ndarray, px_from_mm: np.ndarray, rect_mm, design: np.ndarray, px_per_mm: float, blur_px: float
) -> Registration:
    """Measure the shifts of the cells of a uint8 photograph; `design` H×W×3 is linear light over the rectangle."""
    x, y, w, h = rect_mm
    scale = min(px_per_mm, _MAX_SIDE_PX / min(w, h))
    part, to_part = crop_around(srgb, px_from_mm, rect_corners(rect_mm), 4)
    light = rectify(luminance(part)[..., None], to_part, rect_mm, scale)
    height, width = light.shape[:2]
    light = light.reshape(height, width)
    design = design @ np.array(LUMINANCE, np.float32)
    printed = coarsen(design, (height, width), blur_px / px_per_mm / w * design.shape[1])
    size = max(8, round(min(width, height) / _CELLS))
    search = max(3, round(_SEARCH_SHARE * size))
    padded = cv2.copyMakeBorder(light, search, search, search, search, cv2.BORDER_REPLICATE)
    corners = [(top, left) for top in _cell_starts(height, size) for left in _cell_starts(width, size)]
    cells = np.stack([printed[top : top + size, left : left + size] for top, left in corners])
    rows = []
    for (top, left), cell, error in zip(corners, cells, _shift_per_error(cells), strict=True):
        if np.isfinite(error):
            window = padded[top : top + size + 2 * search, left : left + size + 2 * search]
            dx, dy, peak = _peak(cv2.matchTemplate(window, cell, cv2.TM_CCOEFF_NORMED))
            sigma = error * np.sqrt(1 / peak**2 - 1)
            rows.append([left + size / 2, top + size / 2, dx - search, dy - search, sigma])
    table = np.array(rows).reshape(-1, 5) / scale
    return Registration(table[:, :2] + [x, y], table[:, 2:4], table[:, 4], size / scale)


def _cell_starts(length: int, size: int) -> np.ndarray:
    return np.round(np.linspace(0, length - size, max(1, round(length / size)))).astype(int)


def _shift_per_error(cells: np.ndarray) -> np.ndarray:
    """The shift in pixels caused by a residual as large as the contrast of cells M×n×n; infinity without texture."""
    rim = round(_RIM_SHARE * cells.shape[1])
    inner = cells[:, rim:-rim, rim:-rim]
    contrast = cells.std((1, 2))
    slopes = np.stack([np.gradient(inner, axis=axis) for axis in (1, 2)], 1).reshape(len(cells), 2, -1)
    slopes -= slopes.mean(2, keepdims=True)
    least = np.linalg.eigvalsh(slopes @ slopes.transpose(0, 2, 1) / slopes.shape[2])[:, 0]
    plain = (np.minimum(contrast, inner.std((1, 2))) < _MIN_TEXTURE) | (least < 1e-9)
    return np.where(plain, np.inf, contrast / np.sqrt(np.maximum(least, 1e-9) * _INDEPENDENT_ERRORS))


def _peak(correlation: np.ndarray) -> tuple[float, float, float]:
    """x, y and height of the largest value, to a fraction of a pixel; NaN if it lies on the rim or is too low."""
    row, column = np.unravel_index(np.argmax(correlation), correlation.shape)
    rows, columns = correlation.shape
    height = float(np.clip(correlation[row, column], 1e-3, 0.9999))
    if not (0 < row < rows - 1 and 0 < column < columns - 1) or height < _MIN_CORRELATION:
        return np.nan, np.nan, np.nan
    c = correlation[row - 1 : row + 2, column - 1 : column + 2].astype(float)
    xx, yy = (2 * c[1, 1] - c[1, 2] - c[1, 0]), (2 * c[1, 1] - c[2, 1] - c[0, 1])
    dx, dy = (c[1, 2] - c[1, 0]) / 2 / max(xx, 1e-9), (c[2, 1] - c[0, 1]) / 2 / max(yy, 1e-9)
    return column + float(np.clip(dx, -0.5, 0.5)), row + float(np.clip(dy, -0.5, 0.5)), height


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
    """Locate a design, of promised light H×W×3 over `rect_mm` and black `ink` (3,), in a uint8 photograph."""
    corners_mm, middle_mm = rect_corners(rect_mm), (rect_mm[0] + rect_mm[2] / 2, rect_mm[1] + rect_mm[3] / 2)
    mm, px, sigmas = corners_mm, corners.px, np.full(4, corners.sigma_px)
    fit = named = fit_points(mm, px, sigmas)
    for _ in range(_ROUNDS):
        px_per_mm = float(local_scale(fit.px_from_mm, middle_mm)[0])
        cells = register(srgb, fit.px_from_mm, rect_mm, design, px_per_mm, 1.0)
        sure = cells.sigma_mm < cells.size_mm / 4  # False where NaN
        if sure.sum() < _LEAST_CELLS:
            break
        cells_px = apply_homography(fit.px_from_mm, (cells.middle_mm + cells.shift_mm)[sure])
        mm, px = np.concatenate([corners_mm, cells.middle_mm[sure]]), np.concatenate([corners.px, cells_px])
        sigmas = np.concatenate([sigmas[:4], np.hypot(cells.sigma_mm[sure] * px_per_mm, _CELL_NOISE_PX)])
        fit, before = fit_points(mm, px, sigmas, fit.px_from_mm), fit
        moved = apply_homography(fit.px_from_mm, corners_mm) - apply_homography(before.px_from_mm, corners_mm)
        if np.abs(moved).max() < _CONVERGED_PX:
            break
    if len(mm) > 4:
        off_px = np.linalg.norm(apply_homography(fit.px_from_mm, mm) - px, axis=1)
        error_px, errors = (float(np.median(off[4:])) for off in (off_px, off_px / sigmas))
        least_px = max(_DOUBTFUL_SHARE * corners.sigma_px, float(np.sqrt(np.mean(off_px[:4] ** 2))) / _DOUBTFUL_REACH)
        fit = named if errors > _DOUBTFUL_CELLS and error_px > least_px else fit
    return PlacedDesign(fit, *_blur_and_light(srgb, fit.px_from_mm, rect_mm, design, ink))


def _blur_and_light(srgb, px_from_mm, rect_mm, design, ink) -> tuple[float, FrameLight]:
    """Fit the blur in pixels of the photograph, and gain and veil of each channel, to the design's pixels."""
    middle_mm = rect_mm[0] + rect_mm[2] / 2, rect_mm[1] + rect_mm[3] / 2
    px_per_mm = float(local_scale(px_from_mm, middle_mm)[0])
    scale = min(px_per_mm, _LIGHT_SIDE_PX / min(rect_mm[2:]))
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
        printed = coarsen(design, seen.shape, blur / px_per_mm / rect_mm[2] * design.shape[1])
        fits.append((*gain_and_veil(printed[inner][usable], seen[inner][..., :3][usable]), blur))
    _, gain, veil, blur = min(fits, key=lambda fit: fit[0].mean())
    paper, black = np.clip(gain + veil, 1e-3, 1.2), np.clip(veil + gain * ink, 0, 1.2)
    return blur, FrameLight(paper, black, float(np.dot(LUMINANCE, paper - black)), share)
