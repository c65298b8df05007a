"""The page's color chart: its colors and their places.

In: the number of swatches and their grid. Out: (rectangle in page millimeters, sRGB) pairs. The colors are the 8
corners of the RGB cube, an 8-step gray ramp (6 between black and white), 6 duplicates for estimating measurement noise,
and a low-discrepancy sample of the cube. Their places are shuffled in a fixed order, so that a gradient of light across
the page is not mistaken for a color. All values are multiples of 1/255, so that every printer driver gets the same
numbers.
"""

from itertools import product

import numpy as np

from patchproof.sheets.piece import hash_order
from patchproof.sheets.rects import Srgb, SwatchRect
from patchproof.sheets.template import ChartGrid

CORNERS: tuple[Srgb, ...] = tuple((float(r), float(g), float(b)) for r, g, b in product((0, 1), repeat=3))
GRAYS: tuple[Srgb, ...] = tuple((v / 255, v / 255, v / 255) for v in (36, 73, 109, 146, 182, 219))
DUPLICATES: tuple[Srgb, ...] = (CORNERS[0], CORNERS[7], GRAYS[1], GRAYS[4], (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
# (columns, rows): the one of 200 shuffles that keeps duplicates far apart (4 to 7 cells) and correlations of a channel
# with x or y low (below 0.1 on 12 × 6, at most 0.15). Other grids use that of 12 × 6.
SHUFFLE_NUMBERS = {(12, 6): 184, (8, 12): 19, (16, 6): 81, (12, 4): 80, (6, 8): 172}

_BITS = 32  # of the integers in Sobol's sequence


def chart_colors(count: int) -> list[Srgb]:
    """`count` sRGB colors: the fixed ones, then Sobol's sequence (unscrambled, without its first point)."""
    fixed = [*CORNERS, *GRAYS, *DUPLICATES]
    points = sobol(max(count - len(fixed), 0) + 1)[1:]
    samples = [(r, g, b) for r, g, b in (np.rint(points * 255) / 255).tolist()]
    return (fixed + samples)[:count]


def sobol(count: int) -> np.ndarray:
    """The first `count` points (count×3) of Sobol's sequence in the unit cube, exact below 2^32 points.

    Each point differs from the previous one by the direction numbers of the lowest zero bit of its number (Antonov and
    Saleev, 1979); these are Joe and Kuo's (2008) for the first three dimensions. scipy.stats.qmc has the same sequence,
    but imports all of scipy.stats.
    """
    first, second, third = [1, 1], [1, 3], [1, 3]
    while len(first) < _BITS:
        first.append(1)
        second.append(second[-1] << 1 ^ second[-1])  # polynomial x + 1
        third.append(third[-1] << 1 ^ third[-2] << 2 ^ third[-2])  # polynomial x² + x + 1
    shifts = np.arange(_BITS - 1, -1, -1)[:, None]
    directions = np.array([first, second, third]).T << shifts
    points = np.zeros((count, 3), np.int64)
    for number in range(1, count):
        lowest_zero = (~(number - 1) & number).bit_length() - 1
        points[number] = points[number - 1] ^ directions[lowest_zero]
    return points / 2**_BITS


def chart_swatches(grid: ChartGrid) -> tuple[SwatchRect, ...]:
    """The chart's swatches (rectangle in page millimeters, sRGB), row by row."""
    colors = chart_colors(grid.columns * grid.rows)
    order = hash_order(f"chart {SHUFFLE_NUMBERS.get((grid.columns, grid.rows), 184)}", len(colors))
    pitch = grid.swatch_mm + grid.gap_mm
    (x, y), side = grid.corner_mm, grid.swatch_mm
    cells = product(range(grid.rows), range(grid.columns))
    rects = ((x + column * pitch, y + row * pitch, side, side) for row, column in cells)
    return tuple(zip(rects, (colors[index] for index in order), strict=True))
