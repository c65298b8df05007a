"""The surface under a piece, described over a chart: a plane or a cylinder beside it.

In: triangles (world mm) and a `SurfaceChart`. Out: heights of the surface over a grid of piece points, cast along the
chart's normals, and the point where a line meets the surface. The cast is exact for flat triangles, also over a curved
chart: each triangle visits the grid points of its box on the chart, and each visit is one line-triangle intersection
(Möller and Trumbore, 1997). Triangles need not be joined, closed or oriented.
"""

from dataclasses import dataclass

import numpy as np

from patchproof.base.errors import Refused
from patchproof.base.geometry import cross, dot

_CHUNK = 500_000  # line-triangle pairs held at a time, about 150 MB


@dataclass(frozen=True)
class SurfaceChart:
    """A cylinder beside the surface, with coordinates in millimeters: s across its axis, t along it, h outwards.

    `axes` 3×3 has the rows across, along and normal at the origin (right-handed); `curvature` is 1/mm, 0 for a plane,
    negative if it bulges away from the normal. `right` is the piece's right in (s, t).
    """

    origin_mm: np.ndarray
    axes: np.ndarray
    curvature: float
    right: np.ndarray

    @property
    def turn(self) -> np.ndarray:
        """The 2×2 rows of the piece's right and up in (s, t)."""
        return np.array([self.right, [-self.right[1], self.right[0]]])

    def local(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the (s, t, h) of world points ...×3; s lies within half a turn of the origin."""
        local = ((points_mm - self.origin_mm).reshape(-1, 3) @ self.axes.T).reshape(points_mm.shape)
        if (k := self.curvature) == 0:
            return local
        x, t, z = np.moveaxis(local, -1, 0)
        # h + k h²/2 = k (x² + z²)/2 + z =: f, solved so that it holds for k → 0
        f = k * (x**2 + z**2) / 2 + z
        h = 2 * f / (1 + np.sqrt(np.maximum(1 + 2 * k * f, 0)))
        return np.stack([np.arctan2(k * x, 1 + k * z) / k, t, h], -1)

    def cartesian(self, s: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return points ...×3 at height 0 and unit normals, both along `axes` from the origin."""
        angle = self.curvature * np.asarray(s, float)
        normal = np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], -1)
        # sin(k s)/k and (cos(k s) - 1)/k
        x, z = s * np.sinc(angle / np.pi), -np.sin(angle / 2) * s * np.sinc(angle / 2 / np.pi)
        return np.stack([x, np.broadcast_to(t, x.shape), z], -1), normal

    def world(self, s: np.ndarray, t: np.ndarray, h: np.ndarray) -> np.ndarray:
        """Return the world points ...×3 of chart coordinates."""
        point, normal = self.cartesian(s, t)
        return (point + np.asarray(h)[..., None] * normal) @ self.axes + self.origin_mm


def piece_grid(size_mm: tuple[float, float], n: int) -> np.ndarray:
    """Return n·n×2 piece points by rows from the top: millimeters right and up from the piece's middle."""
    width, height = size_mm
    across, along = np.meshgrid(np.linspace(-width / 2, width / 2, n), np.linspace(height / 2, -height / 2, n))
    return np.stack([across.ravel(), along.ravel()], 1)


def grid_faces(columns: int, rows: int) -> np.ndarray:
    """Return two triangles per cell of a grid by rows from the top, counter-clockwise as one faces it."""
    a = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1, 1)
    return np.concatenate([a + np.array([0, columns, columns + 1]), a + np.array([0, columns + 1, 1])])


def surface_heights(
    chart: SurfaceChart, triangles: np.ndarray, size_mm, n: int, window=(-np.inf, np.inf)
) -> np.ndarray:
    """Return the highest surface h within `window` over n·n points of the piece; NaN where there is none."""
    points, normals = chart.cartesian(*(piece_grid(size_mm, n) @ chart.turn).T)
    triangle, low, across, cells = _visits(chart, triangles, size_mm, n)
    corners = (triangles[triangle] - chart.origin_mm) @ chart.axes.T
    highest = np.full(n * n, -np.inf)
    for part in np.array_split(np.arange(len(triangle)), max(1, int(cells.sum() // _CHUNK))):
        k = np.arange(cells[part].sum()) - np.repeat(np.cumsum(cells[part]) - cells[part], cells[part])
        row = np.repeat(part, cells[part])
        index = (low[row, 1] + k // across[row]) * n + low[row, 0] + k % across[row]
        h, hit = _cast(points[index], normals[index], corners[row])
        # a hit beyond the axis belongs to the far side
        hit &= (h >= window[0]) & (h <= window[1]) & (1 + chart.curvature * h > 0)
        np.maximum.at(highest, index[hit], h[hit])
    return np.where(np.isfinite(highest), highest, np.nan)


def _boxes(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and the highest coordinates F×D of triangles F×3×D, twice as fast as `min(1)` does."""
    a, b, c = triangles.swapaxes(0, 1)
    return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)


def edge_points(triangles: np.ndarray, step_mm: float) -> np.ndarray:
    """Return points P×3 along all edges, corners included, at most `step_mm` apart."""
    start, along = triangles.reshape(-1, 3), (np.roll(triangles, -1, 1) - triangles).reshape(-1, 3)
    count = np.maximum(np.ceil(np.linalg.norm(along, axis=1) / step_mm), 1).astype(np.int64)
    edge = np.repeat(np.arange(len(count)), count)
    share = (np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)) / count[edge]
    return start[edge] + share[:, None] * along[edge]


def surface_point(triangles: np.ndarray, origin_mm: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return where the line through `origin_mm` along the last of `axes` first meets triangles; refused if never."""
    corners = (triangles - origin_mm) @ axes.T
    low, high = _boxes(corners[..., :2])
    near = corners[((low <= 0) & (high >= 0)).all(1)]
    h, hit = _cast(np.zeros((1, 3)), np.array([[0.0, 0, 1]]), near)
    if not hit.any():
        raise Refused("a patch that lies on the object", "no surface under its middle", "change offset_mm or at_mm")
    return origin_mm + h[hit][np.abs(h[hit]).argmin()] * axes[2]


def _visits(chart: SurfaceChart, triangles: np.ndarray, size_mm, n: int):
    """Return the grid points under triangles' boxes: (triangle, first column and row, columns, points) each."""
    local = chart.local(triangles)[..., :2]
    shifts, surrounds_axis = [0.0], np.zeros(len(triangles), bool)
    if chart.curvature:
        around = 2 * np.pi / abs(chart.curvature)
        local[..., 0] -= around * np.round((local[..., 0] - local[:, :1, 0]) / around)
        # seen from the axis a triangle spans less than half a turn, unless it surrounds the axis
        surrounds_axis = np.ptp(local[..., 0], axis=1) > around / 2
        local[surrounds_axis, :2, 0] = [-around, around]
        shifts = [-around, 0.0, around]
    low, high = _boxes(local)
    middle, half = (low + high) / 2, (high - low) / 2 + 1e-9
    step, radius, rows = np.array(size_mm) / (n - 1), np.hypot(*size_mm) / 2, []
    for shift in shifts:
        # a triangle around the axis covers all of the circumference without a shift
        moved = middle + np.array([shift, 0])
        owner = np.flatnonzero((np.abs(moved) <= half + radius).all(1) & ~(surrounds_axis & bool(shift)))
        center = moved[owner] @ chart.turn.T * [1, -1] + np.array(size_mm) / 2
        reach = half[owner] @ np.abs(chart.turn).T
        low = np.clip(np.ceil((center - reach) / step), 0, n).astype(np.int64)
        high = np.clip(np.floor((center + reach) / step), -1, n - 1).astype(np.int64)
        visits = (low <= high).all(1)
        rows.append((owner[visits], low[visits], (high - low + 1)[visits]))
    owner, low, counts = (np.concatenate(column) for column in zip(*rows, strict=True))
    return owner, low, counts[:, 0], counts.prod(1)


def _cast(points: np.ndarray, directions: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how far along its direction each line meets its triangle, and whether it does. Edges belong to both sides
    with a tolerance of 1e-6 of a triangle, which closes the cracks of float32 files.
    """
    a, edges = corners[:, 0], corners[:, 1:] - corners[:, :1]
    along, offsets, edge_b, edge_c = ([*vectors.T] for vectors in (directions, points - a, edges[:, 0], edges[:, 1]))
    p = cross(along, edge_c)
    det = dot(edge_b, p)
    # a triangle seen edge-on covers nothing; its neighbors have its edges
    flat = np.abs(det) <= 1e-12 * np.sqrt(dot(edge_b, edge_b) * dot(edge_c, edge_c))
    det = np.where(flat, 1.0, det)
    q = cross(offsets, edge_b)
    b, c = dot(offsets, p) / det, dot(along, q) / det
    return dot(edge_c, q) / det, ~flat & (b >= -1e-6) & (c >= -1e-6) & (b + c <= 1 + 1e-6)
