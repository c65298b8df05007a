"""Fit how the colors of this print differ from those that the promise's printer would have made.

In: the cells of a design in several photographs, as fine as each resolves, and the design as promised. Out: the print's
colors and what each photograph makes of its light (`channel.print_colors`), or None if the design's colors are too few
or too alike to fit them. All photographs show one print: light and noise differ from photo to photo, ink does not.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from patchproof.channel.print_colors import ShownColors, added_terms, choose_cells, fit_ink_and_photos
from patchproof.evidence.surface import PromisedColors
from patchproof.photo.design_cells import cell_means
from patchproof.photo.quality import FrameLight

LEAST_CELLS = 30  # of a photograph: three for each coefficient of a channel
# Terms of cells that mix few colors have as few dimensions; of the sixth, the least share of the first's spread.
_LEAST_COLORS, _LEAST_SPREAD = 6, 1e-3
_ROUNDS = 3


@dataclass(frozen=True)
class PhotographedDesign:
    """The design in one photograph: light of its cells h×w×3, NaN where unread, their blur in cells, paper and ink."""

    cells: np.ndarray
    blur_cells: float
    light: FrameLight


def fit_print(
    photos: Sequence[PhotographedDesign], promised: PromisedColors
) -> tuple[np.ndarray, list[ShownColors]] | None:
    """Fit the print's ink, for `add_ink`, and each photograph's colors.

    What all photographs share is print, but for the light on paper.
    """
    readable = [np.isfinite(photo.cells[1:-1, 1:-1]).all(-1).sum() for photo in photos]
    if not photos or min(readable) < LEAST_CELLS:
        return None
    maps = [*np.moveaxis(promised.design, -1, 0), *added_terms(promised.design)]
    read = []
    for photo in photos:
        means = cell_means(maps, photo.cells.shape, photo.blur_cells)
        read.append(choose_cells(photo.cells, means, photo.light.paper, photo.light.ink, promised.ink))
    rows = np.concatenate([cells.terms for cells in read])
    spread = np.linalg.svd(rows.T @ rows, compute_uv=False) ** 0.5
    if spread[_LEAST_COLORS - 1] < _LEAST_SPREAD * spread[0]:
        return None
    ink, terms = fit_ink_and_photos(read, _ROUNDS, shared_is_ink=True)
    return ink, [ShownColors.of_terms(t) for t in terms]
