"""Measure the shift of the design's pixels from their places by a photograph's homography, which fits markers only.

In: a photograph in which the sheet is flat, its homography, the linear light that was promised over a rectangle of the
page. Out: `Registration`: for each cell of a grid that has texture its shift, by the peak of the normalized correlation
of its luminance with the printed one, and the shift's uncertainty. The correlation does not depend on a cell's
brightness and contrast, which print, light and camera change. A cell that is covered or glossy has no peak: NaN.

Source of a peak's uncertainty: Lucas and Kanade, An Iterative Image Registration Technique, IJCAI 1981; but errors of a
cell's light are not independent from pixel to pixel (other inks, a shadow), so they count as `_INDEPENDENT_ERRORS`.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from patchproof.base.color import LUMINANCE
from patchproof.base.geometry import rect_corners
from patchproof.photo.detect import luminance
from patchproof.photo.rectify import crop_around, rectify, resize_by_area

_CELLS = 8  # along the rectangle's shorter side
_MAX_SIDE_PX = 256  # of the shorter side: shifts are found to a tenth of such a pixel
_SEARCH_SHARE = 0.4  # of a cell, to either side
_RIM_SHARE = 1 / 6  # of a cell: texture there may be the edge of a neighbor, along which a shift is undetermined
_MIN_CORRELATION = 0.6
_MIN_TEXTURE = 0.02  # standard deviation of linear light
_INDEPENDENT_ERRORS = 16


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
    printed, sigma_px = design @ np.array(LUMINANCE, np.float32), float(blur_px / px_per_mm * design.shape[1] / w)
    printed = cv2.GaussianBlur(printed, (0, 0), sigma_px) if sigma_px > 0.3 else printed
    printed = resize_by_area(printed, (width, height))
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
