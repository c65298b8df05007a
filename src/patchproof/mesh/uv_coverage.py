"""Count texels that faces cover: triangles in UV space are drawn onto the texture's own grid.

In: corners F×3×2 in texels (u times width, v times height; any integer, since textures wrap). Out: the number of faces
that cover each texel, or the number of a mask's texels that each face shows. With `grow` = 0 a texel counts if its
center lies in the face, and two faces that share an edge never count it twice; with `grow` = g it counts if its center
is within g of the face in both x and y: 0.5 gives every texel that the face touches, 1.5 one more, which is all that a
bilinear look-up reads. Left out on purpose: area-weighted coverage.
"""

from collections.abc import Iterator

import numpy as np

_ROWS_AT_ONCE = 1 << 20  # about 300 MB of intermediate arrays


def coverage(corners: np.ndarray, size: tuple[int, int], grow: float = 0.0) -> np.ndarray:
    """Count the faces, of F, that cover each texel of a (width, height) texture: int32 H×W; wraps count."""
    width, height = size
    steps = np.zeros((height, width + 1), np.int32)  # +1 where a run of texels starts, -1 where it has ended
    for _, row, start, stop in spans(corners, grow):
        row = row % height
        turns, rest = np.divmod(stop - start, width)
        start = start % width
        end = start + rest
        np.add.at(steps, (row, np.zeros_like(row)), turns.astype(np.int32) + (end > width))
        np.add.at(steps, (row, start), 1)
        np.add.at(steps, (row, np.where(end > width, end - width, end)), -1)
    return np.cumsum(steps, axis=1, dtype=np.int32, out=steps)[:, :width]


def texels_per_face(corners: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (how many texels of an H×W mask have their center in each of F faces, how many texels in all do)."""
    height, width = mask.shape
    cumulated = np.zeros((height, width + 1), np.int32)
    np.cumsum(mask, axis=1, out=cumulated[:, 1:])
    total, count = np.zeros(len(corners)), np.zeros(len(corners))
    for face, row, start, stop in spans(corners, 0.0):
        row = row % height
        ends = [x // width * cumulated[row, width] + cumulated[row, x % width] for x in (start, stop)]
        total += np.bincount(face, ends[1] - ends[0], len(corners))
        count += np.bincount(face, stop - start, len(corners))
    return total, count


def spans(corners: np.ndarray, grow: float) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Yield runs of texels (face, row, start, stop), integers of the unwrapped plane, in batches of bounded size."""
    corners = np.asarray(corners, float)
    low, high = corners[..., 1].min(1) - grow, corners[..., 1].max(1) + grow
    first, last = _center_at_or_after(low), _center_at_or_after(high)
    row_ends = np.cumsum(last - first)
    for begin in range(0, int(row_ends[-1]) if len(row_ends) else 0, _ROWS_AT_ONCE):
        number = np.arange(begin, min(begin + _ROWS_AT_ONCE, row_ends[-1]))
        face = np.searchsorted(row_ends, number, side="right")
        row = last[face] - row_ends[face] + number
        low_x, high_x = _extent(corners[face], row + 0.5, grow)
        start, stop = _center_at_or_after(low_x - grow), _center_at_or_after(high_x + grow)
        covered = stop > start
        yield face[covered], row[covered], start[covered], stop[covered]


def _extent(corners: np.ndarray, y: np.ndarray, grow: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and largest x of each triangle N×3×2 between y - grow and y + grow."""
    left, right = np.full(len(y), np.inf), np.full(len(y), -np.inf)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        a, b = corners[:, a], corners[:, b]
        # from the lower end, so that both faces at an edge find the same x
        swap = ((a[:, 1] > b[:, 1]) | ((a[:, 1] == b[:, 1]) & (a[:, 0] > b[:, 0])))[:, None]
        a, b = np.where(swap, b, a), np.where(swap, a, b)
        rise = b[:, 1] - a[:, 1]
        safe = np.where(rise > 0, rise, 1.0)
        t0 = np.where(rise > 0, np.clip((y - grow - a[:, 1]) / safe, 0, 1), 0.0)
        t1 = np.where(rise > 0, np.clip((y + grow - a[:, 1]) / safe, 0, 1), 1.0)
        x = np.stack([a[:, 0] + t * (b[:, 0] - a[:, 0]) for t in (t0, t1)])
        within = (a[:, 1] <= y + grow) & (b[:, 1] >= y - grow)
        left = np.where(within, np.minimum(left, x.min(0)), left)
        right = np.where(within, np.maximum(right, x.max(0)), right)
    return left, right


def _center_at_or_after(x: np.ndarray) -> np.ndarray:
    """Return the first texel whose center is not before x."""
    return np.ceil(x - 0.5).astype(np.int64)
