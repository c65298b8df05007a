"""Fit how the colors of this print differ from those that the promise's printer would have made.

In: the cells of a design in several photographs, as fine as each resolves, and the design as promised. Out: the print's
colors and what each photograph makes of its light (`channel.print_colors`), or None if the design's colors are too few
or too alike to fit them. All photographs show one print: light and noise differ from photo to photo, ink does not.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from patchproof.base.color import LUMINANCE
from patchproof.channel.print_colors import CellColors, ShownColors, added_terms, choose_cells, fit_ink_and_photos
from patchproof.evidence.surface import PromisedColors
from patchproof.photo.design_cells import cell_means
from patchproof.photo.quality import FrameLight

LEAST_CELLS = 30  # of a photograph: three for each coefficient of a channel
# Terms of cells that mix few colors have as few dimensions; of the sixth, the least share of the first's spread.
_LEAST_COLORS, _LEAST_SPREAD = 6, 1e-3
_ROUNDS = 3
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
