"""Average a printed design's colors over cells as fine as a photograph resolves.

In: a photograph's light, its homography, or maps over the design. Out: the means over a grid of cells, of the
photograph and of the maps blurred as the photograph is.
"""

from collections.abc import Iterable

import cv2
import numpy as np

from patchproof.photo.detect import LINEAR_FLOAT32_FROM_CODE
from patchproof.photo.quality import CLIPPED_CODE
from patchproof.photo.rectify import least_px_per_mm, rectify, resize_by_area
from patchproof.sheets.manifest import Rect

_CELLS = (16, 96)  # least and most along the design's shorter side
_LEAST_CELL_PX = 2.0
_PIXEL_BLUR_PX = 0.7  # of a pixel's own area and of interpolating between pixels
_MOST_CLIPPED = 0.05  # of a cell's pixels


def design_cells(srgb: np.ndarray, px_from_mm: np.ndarray, rect_mm: Rect, blur_px: float) -> tuple[np.ndarray, float]:
    """Read the light of the cells h×w×3 at `rect_mm` in an uint8 photograph, NaN where clipped; and the photograph's
    blur in cells.
    """
    px_per_mm, side_mm = least_px_per_mm(px_from_mm, rect_mm), min(rect_mm[2:])
    cells_per_mm = float(np.clip(side_mm * px_per_mm / max(_LEAST_CELL_PX, 2 * blur_px), *_CELLS)) / side_mm
    cells = rectify(LINEAR_FLOAT32_FROM_CODE[srgb], px_from_mm, rect_mm, cells_per_mm).astype(float)
    full = (srgb.max(-1, keepdims=True) >= CLIPPED_CODE).astype(np.float32)
    clipped = rectify(full, px_from_mm, rect_mm, cells_per_mm).reshape(cells.shape[:2]) > _MOST_CLIPPED
    blur_cells = float(np.hypot(blur_px, _PIXEL_BLUR_PX)) * cells_per_mm / px_per_mm
    return np.where(clipped[..., None], np.nan, cells), blur_cells


def cell_means(maps: Iterable[np.ndarray], shape: tuple[int, ...], blur_cells: float) -> np.ndarray:
    """Blur maps H×W of the design and average them to h×w cells, h×w×N."""
    height, width = shape[:2]
    means = []
    for fine in maps:  # one at a time: OpenCV averages four channels at most
        fine = resize_by_area(np.ascontiguousarray(fine), (2 * width, 2 * height))
        if blur_cells > 0.15:
            fine = cv2.GaussianBlur(fine, (0, 0), 2 * blur_cells, borderType=cv2.BORDER_REPLICATE)
        means.append(resize_by_area(fine, (width, height)))
    return np.stack(means, -1).astype(float)
