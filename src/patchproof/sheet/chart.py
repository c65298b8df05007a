"""The page's colour chart: which colours, and where each one lies.

In: how many swatches and their grid. Out: (rectangle in page millimetres, sRGB) pairs. The colours are the 8 corners
of the RGB cube, an 8-step gray ramp (6 between black and white), 6 duplicates from which the noise of reading is
estimated, and a low-discrepancy filling of the cube. Their places are shuffled once and for all, so that a gradient
of light across the page is not mistaken for a colour. All values are whole steps of 1/255, so that every printer
driver gets the same numbers.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from patchproof.sheet.piece import hash_order
from patchproof.sheet.swatches import Srgb, SwatchRect
from patchproof.sheet.template import ChartGrid

CORNERS: tuple[Srgb, ...] = tuple((float(r), float(g), float(b)) for r, g, b in product((0, 1), repeat=3))
GRAYS: tuple[Srgb, ...] = tuple((v / 255,) * 3 for v in (36, 73, 109, 146, 182, 219))
DUPLICATES: tuple[Srgb, ...] = ((0.0,) * 3, (1.0,) * 3, GRAYS[1], GRAYS[4], (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
# the one of 200 that on 12 × 6 keeps duplicates 7 cells apart and all correlations of a channel with x or y below 0.1
SHUFFLE = "chart 184"


def chart_colors(count: int) -> list[Srgb]:
    """`count` sRGB colours, the fixed ones first, then Sobol's sequence (unscrambled, without its first point)."""
    from scipy.stats import qmc

    fixed = [*CORNERS, *GRAYS, *DUPLICATES]
    rest = max(count - len(fixed), 0)
    points = qmc.Sobol(3, scramble=False).random_base2(int(rest + 1).bit_length())[1 : rest + 1]
    filling = [tuple(float(v) for v in np.rint(point * 255) / 255) for point in points]
    return (fixed + filling)[:count]


def chart_swatches(grid: ChartGrid) -> tuple[SwatchRect, ...]:
    """The chart's swatches row by row, in page millimetres."""
    colors = chart_colors(grid.columns * grid.rows)
    order = hash_order(SHUFFLE, len(colors))
    pitch = grid.swatch_mm + grid.gap_mm
    (x, y), side = grid.corner_mm, grid.swatch_mm
    cells = product(range(grid.rows), range(grid.columns))
    return tuple(
        ((x + column * pitch, y + row * pitch, side, side), colors[index])
        for (row, column), index in zip(cells, order, strict=True)
    )
