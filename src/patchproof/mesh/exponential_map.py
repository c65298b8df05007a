"""The exponential map of a smooth surface: where a sheet's points lie when its straight lines become geodesics.

In: a surface given as heights over a chart, and the directions of the sheet's right and up at its middle. Out: the
chart coordinates of sheet points, and the stretch of the laid grid against the flat one. Distances from the middle are
preserved; across them lengths change by K r²/6 at distance r, where the Gaussian curvature is K (do Carmo, Differential
Geometry of Curves and Surfaces, 1976, section 4-6). On a cylinder (a constant height) the map is exactly the unrolling.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.polynomial import polynomial

from patchproof.mesh.surface_chart import SurfaceChart

_STEPS = 24  # Runge-Kutta steps of a geodesic: its length has an error below 1e-6 even over a radian


@dataclass(frozen=True)
class SmoothSurface:
    """A surface over a chart; its height is Σ coefficients[i, j] (s/scale)^i (t/scale)^j."""

    chart: SurfaceChart
    coefficients: np.ndarray
    scale_mm: float

    def height(self, s: np.ndarray, t: np.ndarray, ds: int = 0, dt: int = 0) -> np.ndarray:
        """Return the height in mm, or its derivative of orders `ds` and `dt`, up to the second."""
        c = self._derivatives[ds, dt]
        return polynomial.polyval2d(s / self.scale_mm, t / self.scale_mm, c) / self.scale_mm ** (ds + dt)

    @cached_property
    def _derivatives(self) -> dict[tuple[int, int], np.ndarray]:
        """Coefficients of the height's derivatives, kept because a geodesic needs them hundreds of times."""
        by_s = [polynomial.polyder(self.coefficients, ds, axis=0) for ds in range(3)]
        return {(ds, dt): polynomial.polyder(by_s[ds], dt, axis=1) for ds in range(3) for dt in range(3 - ds)}

    def tangents(self, s: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the surface point's derivatives N×3 by s and by t, in the chart's across, along and normal."""
        return _tangents(self.chart.curvature, self.height(s, t), self.height(s, t, 1, 0), self.height(s, t, 0, 1))

    def points_and_normals(self, s: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return world points N×3 and unit normals N×3."""
        n = np.cross(*self.tangents(s, t))
        _, outward = self.chart.cartesian(s, t)
        across = np.cross([0.0, 1, 0], outward)
        local = n[..., :1] * across + n[..., 1:2] * [0.0, 1, 0] + n[..., 2:] * outward
        local /= np.linalg.norm(local, axis=-1, keepdims=True)
        return self.chart.world(s, t, self.height(s, t)), local @ self.chart.axes

    def raise_by(self, by_mm: float) -> "SmoothSurface":
        """Return the surface moved outward along the chart's normals."""
        coefficients = self.coefficients.copy()
        coefficients[0, 0] += by_mm
        return replace(self, coefficients=coefficients)


def exponential_map(surface: SmoothSurface, offsets_mm: np.ndarray, right: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the (s, t) N×2 of sheet points N×2 in mm from the sheet's middle, which lies over the chart's origin.

    `right` and `up` of the middle are orthogonal unit vectors in the world, tangent to the surface over the chart's
    origin.
    """
    by_s, by_t = surface.tangents(np.zeros(1), np.zeros(1))
    basis = np.concatenate([by_s, by_t]) @ surface.chart.axes  # 2×3
    speed = offsets_mm @ (np.stack([right, up]) @ np.linalg.pinv(basis))
    st = np.zeros_like(speed)
    for _ in range(_STEPS):  # the classic fourth-order step; the total time is 1
        dt = 1 / _STEPS
        a1 = _geodesic_acceleration(surface, st, speed)
        a2 = _geodesic_acceleration(surface, st + dt / 2 * speed, speed + dt / 2 * a1)
        a3 = _geodesic_acceleration(surface, st + dt / 2 * (speed + dt / 2 * a1), speed + dt / 2 * a2)
        a4 = _geodesic_acceleration(surface, st + dt * (speed + dt / 2 * a2), speed + dt * a3)
        st = st + dt * speed + dt**2 / 6 * (a1 + a2 + a3)
        speed = speed + dt / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
    return st


def grid_stretch(surface: SmoothSurface, st: np.ndarray, size_mm: tuple[float, float], n: int) -> np.ndarray:
    """Return n×n: the largest relative change of length at the points of a sheet's grid that lies at `st`."""
    step = np.array(size_mm) / (n - 1)
    grid = st.reshape(n, n, 2)
    by_row, by_column = (np.asarray(np.gradient(grid, step[1 - axis], axis=axis, edge_order=2)) for axis in (0, 1))
    change = np.stack([by_column, by_row], -2).reshape(-1, 2, 2) @ np.stack(surface.tangents(*st.T), 1)
    return np.abs(np.linalg.svd(change, compute_uv=False) - 1).max(1).reshape(n, n)


def _geodesic_acceleration(surface: SmoothSurface, st: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Return a geodesic's acceleration in (s, t), which keeps its acceleration in space normal to the surface."""
    (s, t), (vs, vt), k = st.T, speed.T, surface.chart.curvature
    height, hs, ht = surface.height(s, t), surface.height(s, t, 1, 0), surface.height(s, t, 0, 1)
    across = 2 * k * hs * vs**2 + 2 * k * ht * vs * vt
    outward = (surface.height(s, t, 2, 0) - k * (1 + k * height)) * vs**2
    outward = outward + 2 * surface.height(s, t, 1, 1) * vs * vt + surface.height(s, t, 0, 2) * vt**2
    basis = np.stack(_tangents(k, height, hs, ht), 1)  # N×2×3
    force = basis[:, :, 0] * across[:, None] + basis[:, :, 2] * outward[:, None]
    return -np.linalg.solve(basis @ basis.transpose(0, 2, 1), force[..., None])[..., 0]


def _tangents(k: float, height: np.ndarray, by_s: np.ndarray, by_t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return tangents N×3 by s and by t over a chart of curvature `k`, of a height and its derivatives."""
    zero = np.zeros(np.shape(height))
    return np.stack([1 + k * height, zero, by_s], -1), np.stack([zero, zero + 1, by_t], -1)
