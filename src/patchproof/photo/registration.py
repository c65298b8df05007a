"""How far the design's own pixels lie from where a photograph's homography has them: markers know only themselves.

In: a photograph in which the sheet is flat, its homography, the linear light that was promised over a rectangle of the
page. Out: `Registration`: for each cell of a grid that has texture its shift, by the peak of the normalized correlation
of its luminance with what was printed there, and how sure that is. The correlation does not mind what print, light and
camera did to a cell's brightness and contrast. What covers a cell, or gloss on it, leaves no peak: NaN.

Source of a peak's uncertainty: Lucas and Kanade, An Iterative Image Registration Technique, IJCAI 1981; but errors of a
cell's light are not independent from pixel to pixel (other inks, a shadow), so they count as `_INDEPENDENT` values.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from patchproof.base.color import LUMINANCE
from patchproof.base.geometry import rect_corners
from patchproof.photo.detect import luminance
from patchproof.photo.rectify import crop_around, rectify, resize_by_area

_CELLS = 8  # along the rectangle's shorter side
_FINEST_PX = 256  # of the shorter side: shifts are found to a tenth of such a pixel
_SEARCH = 0.4  # of a cell to either side
_RIM = 1 / 6  # of a cell: texture there may be a neighbor's edge, which moves freely along itself
_LEAST_AGREEMENT = 0.6
_LEAST_TEXTURE = 0.02  # standard deviation of linear light
_INDEPENDENT = 16


@dataclass(frozen=True)
class Registration:
    """By cell with texture: its middle and shift N×2 in page millimeters, the shift's standard deviation along its
    vaguest direction; NaN where the photograph shows something else.
    """

    middle_mm: np.ndarray
    shift_mm: np.ndarray
    sigma_mm: np.ndarray


def register(
    srgb: np.ndarray, px_from_mm: np.ndarray, rect_mm, design: np.ndarray, px_per_mm: float, blur_px: float
) -> Registration:
    """Shifts of the cells of an uint8 photograph; `design` H×W×3 is linear light over the rectangle."""
    x, y, w, h = rect_mm
    finer = min(px_per_mm, _FINEST_PX / min(w, h))
    part, to_part = crop_around(srgb, px_from_mm, rect_corners(rect_mm), 4)
    light = rectify(luminance(part)[..., None], to_part, rect_mm, finer)
    height, width = light.shape[:2]
    light = light.reshape(height, width)
    printed = _blurred(design @ np.array(LUMINANCE, np.float32), blur_px / px_per_mm * design.shape[1] / w)
    printed = resize_by_area(printed, (width, height))
    size = max(8, round(min(width, height) / _CELLS))
    reach = max(3, round(_SEARCH * size))
    around = cv2.copyMakeBorder(light, reach, reach, reach, reach, cv2.BORDER_REPLICATE)
    starts = [(top, left) for top in _starts(height, size) for left in _starts(width, size)]
    cells = np.stack([printed[top : top + size, left : left + size] for top, left in starts])
    rows = []
    for (top, left), cell, vague in zip(starts, cells, _vagueness(cells), strict=True):
        if np.isfinite(vague):
            window = around[top : top + size + 2 * reach, left : left + size + 2 * reach]
            dx, dy, peak = _peak(cv2.matchTemplate(window, cell, cv2.TM_CCOEFF_NORMED))
            sigma = vague * np.sqrt(1 / peak**2 - 1)
            rows.append([left + size / 2, top + size / 2, dx - reach, dy - reach, sigma])
    table = np.array(rows).reshape(-1, 5) / finer
    return Registration(table[:, :2] + [x, y], table[:, 2:4], table[:, 4])


def _blurred(image: np.ndarray, sigma_px: float) -> np.ndarray:
    return cv2.GaussianBlur(image, (0, 0), float(sigma_px)) if sigma_px > 0.3 else image


def _starts(length: int, size: int) -> np.ndarray:
    return np.round(np.linspace(0, length - size, max(1, round(length / size)))).astype(int)


def _vagueness(cells: np.ndarray) -> np.ndarray:
    """Pixels that a shift is off for a residual as large as the contrast of cells M×n×n; infinity without texture."""
    rim = round(_RIM * cells.shape[1])
    inner = cells[:, rim:-rim, rim:-rim]
    contrast = cells.std((1, 2))
    slopes = np.stack([np.gradient(inner, axis=axis) for axis in (1, 2)], 1).reshape(len(cells), 2, -1)
    slopes -= slopes.mean(2, keepdims=True)
    least = np.linalg.eigvalsh(slopes @ slopes.transpose(0, 2, 1) / slopes.shape[2])[:, 0]
    plain = (np.minimum(contrast, inner.std((1, 2))) < _LEAST_TEXTURE) | (least < 1e-9)
    return np.where(plain, np.inf, contrast / np.sqrt(np.maximum(least, 1e-9) * _INDEPENDENT))


def _peak(correlation: np.ndarray) -> tuple[float, float, float]:
    """x, y and height of the largest value, to a fraction of a pixel; NaN where it lies on the rim or is too low."""
    row, column = np.unravel_index(np.argmax(correlation), correlation.shape)
    rows, columns = correlation.shape
    height = float(np.clip(correlation[row, column], 1e-3, 0.9999))
    if not (0 < row < rows - 1 and 0 < column < columns - 1) or height < _LEAST_AGREEMENT:
        return np.nan, np.nan, np.nan
    c = correlation[row - 1 : row + 2, column - 1 : column + 2].astype(float)
    xx, yy = (2 * c[1, 1] - c[1, 2] - c[1, 0]), (2 * c[1, 1] - c[2, 1] - c[0, 1])
    dx, dy = (c[1, 2] - c[1, 0]) / 2 / max(xx, 1e-9), (c[2, 1] - c[0, 1]) / 2 / max(yy, 1e-9)
    return column + float(np.clip(dx, -0.5, 0.5)), row + float(np.clip(dy, -0.5, 0.5)), height
