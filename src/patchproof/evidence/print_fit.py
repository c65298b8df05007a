"""Fit how the colors of this print differ from those that the promise's printer would have made.

In: the cells of a design in several photographs, as fine as each resolves, and the design as promised. Out: the print's
colors and what each photograph makes of its light (`channel.print_colors`), or None if the design's colors are too few
or too alike to fit them. All photographs show one print: light and noise differ from photo to photo, ink does not.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from patchproof.base.color import LUMINANCE
from patchproof.channel.print_colors import CellColors, ShownColors, added_terms, choose_cells, fit_ink_and_photos
from patchproof.evidence.surface import PromisedColors
from patchproof.photo.detect import LINEAR_FLOAT32_FROM_CODE
from patchproof.photo.quality import CLIPPED_CODE, FrameLight
from patchproof.photo.rectify import least_px_per_mm, rectify, resize_by_area
from patchproof.sheets.manifest import Rect

LEAST_CELLS = 30  # of a photograph: three for each coefficient of a channel
# Terms of cells that mix few colors have as few dimensions; of the sixth, the least share of the first's spread.
_LEAST_COLORS, _LEAST_SPREAD = 6, 1e-3
_ROUNDS = 3
_CELLS = (16, 96)  # least and most along the design's shorter side
_LEAST_CELL_PX = 2.0
_PIXEL_BLUR_PX = 0.7  # of a pixel's own area and of interpolating between pixels
_MOST_CLIPPED = 0.05  # of a cell's pixels
_LEAST_LIGHT = 0.3  # promised of cells that tell the light of paper where there is none


@dataclass(frozen=True)
class PhotographedDesign:
    """The design in one photograph: light of its cells h×w×3, NaN where unread, their blur in cells, paper and ink;
    `anchored` if paper and ink were seen beside it, not inferred from what was promised.
    """

    cells: np.ndarray
    blur_cells: float
    light: FrameLight
    anchored: bool = True

    @property
    def readable(self) -> int:
        """The number of cells that were read, without the rim."""
        return int(np.isfinite(self.cells[1:-1, 1:-1]).all(-1).sum())


def fit_print(
    photos: Sequence[PhotographedDesign], promised: PromisedColors
) -> tuple[np.ndarray, list[ShownColors]] | None:
    """Fit the print's ink, for `add_ink`, and each photograph's colors.

    What all photographs share is print, but for the light on paper.
    """
    read = choose_photo_cells(photos, promised)
    if read is None:
        return None
    ink, terms = fit_ink_and_photos(read, _ROUNDS)
    return ink, [ShownColors.of_terms(t) for t in terms]


def choose_photo_cells(photos: Sequence[PhotographedDesign], promised: PromisedColors) -> list[CellColors] | None:
    """Choose each photograph's cells for the fit; None if they are too few, or their colors too few or too alike."""
    if not photos or min(photo.readable for photo in photos) < LEAST_CELLS:
        return None
    maps = [*np.moveaxis(promised.design, -1, 0), *added_terms(promised.design)]
    read = []
    for photo in photos:
        means = cell_means(maps, photo.cells.shape, photo.blur_cells)
        light, ink = photo.light, promised.ink if photo.anchored else None
        paper = light.paper if photo.anchored else _paper_of_cells(photo.cells, means[..., :3], light.paper)
        read.append(choose_cells(photo.cells, means, paper, light.ink, ink))
    rows = np.concatenate([cells.terms for cells in read])
    spread = np.linalg.svd(rows.T @ rows, compute_uv=False) ** 0.5
    return None if spread[_LEAST_COLORS - 1] < _LEAST_SPREAD * spread[0] else read


def _paper_of_cells(seen: np.ndarray, promised: np.ndarray, paper: np.ndarray) -> np.ndarray:
    """Extrapolate light h×w×3 of cells over its promise to white: dot gain and dull inks darken what is not."""
    inner = np.isfinite(seen).all(-1)
    seen, promised, found = seen[inner], promised[inner], paper.copy()
    darkness = 1 - promised @ np.array(LUMINANCE)
    for channel in range(3):
        light = promised[:, channel] > _LEAST_LIGHT
        if light.sum() >= LEAST_CELLS:
            rows = np.column_stack([np.ones(light.sum()), 1 - promised[light, channel], darkness[light]])
            found[channel] = np.linalg.lstsq(rows, seen[light, channel] / promised[light, channel], rcond=None)[0][0]
    return np.clip(found, paper / 1.5, 1.5 * paper)


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
