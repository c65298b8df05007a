"""Closed solids from rings of points: lathe, tube, prism and box, as mesh parts with normals and texture coordinates.

In: millimeters, y up, and an sRGB color. Out: parts wound counter-clockwise seen from outside, every face with three
vertices of its own, so that normals and texture coordinates may jump between faces. Sides that bend by less than the
crease angle shade smoothly. Texture coordinates are cylindrical on lathe and tube (caps: the disc inscribed in the
texture) and planar on prism and box (each face direction sees the texture upright, once over the part). Left out on
purpose: booleans; parts may run into one another, and the z-buffer resolves that.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from patchproof.base.color import linear_from_srgb
from patchproof.mesh.mesh import Material, MeshPart

AROUND = 24  # corners of a round cross-section: 15° each, below the crease, so that sides shade smoothly
CREASE_DEG = 40.0


def loft(rings: Sequence[np.ndarray], name: str, srgb: Sequence[float], planar: bool = False) -> MeshPart:
    """Join rings K×3, counter-clockwise about their direction, to a surface; 1×3 at both ends closes it."""
    grid = np.stack([np.broadcast_to(ring, (max(map(len, rings)), 3)) for ring in rings])
    rows, columns = grid.shape[:2]
    v = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(grid, axis=0), axis=2).mean(1))])
    v = 1 - v / v[-1]
    triangles, uv = [], []
    for i, j in np.ndindex(rows - 1, columns):
        a, b, c, d = (i, j), (i, j + 1), (i + 1, j + 1), (i + 1, j)
        below, above = len(rings[i]) == 1, len(rings[i + 1]) == 1  # a fan about a pole has one triangle, not two
        for triangle in [(a, b, c)] * (not below) + [(a, c, d)] * (not above):
            triangles.append([grid[m, n % columns] for m, n in triangle])
            cap = below or above
            uv.append([_pole_uv(rings, m, n) if cap else (n / columns, v[m]) for m, n in triangle])
    corners = np.array(triangles)
    normals = _corner_normals(corners)
    uv = _planar_uv(corners) if planar else np.array(uv)
    red, green, blue = linear_from_srgb(np.clip(np.asarray(srgb, float), 0, 1)).tolist()
    material = Material(name, (red, green, blue))
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    return MeshPart(corners.reshape(-1, 3), faces, material, uv.reshape(-1, 2), normals.reshape(-1, 3))


def lathe(profile: Sequence[tuple[float, float]], name: str, srgb, around: int = AROUND) -> MeshPart:
    """Turn a profile of (radius, height) about y; it starts and ends at radius 0, with the outside on its right."""
    angle = np.arange(around) * 2 * np.pi / around
    circle = np.stack([np.cos(angle), 0 * angle, -np.sin(angle)], 1)
    up = np.array([0.0, 1.0, 0.0])
    return loft([(circle if r > 0 else circle[:1]) * r + up * y for r, y in profile], name, srgb)


def tube(points: Sequence[Sequence[float]], radius: ArrayLike, name: str, srgb, around: int = 12) -> MeshPart:
    """Return a round tube along N×3 points with flat ends; `radius` is one number or one per point."""
    path = np.asarray(points, float)
    radii = np.broadcast_to(np.asarray(radius, float), len(path))
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    angle = np.arange(around)[:, None] * 2 * np.pi / around
    rings, e1 = [path[:1]], np.cross(along[0], np.eye(3)[np.abs(along[0]).argmin()])
    for point, direction, r in zip(path, along, radii, strict=True):
        e1 = e1 - direction * (e1 @ direction)  # parallel transport, without twist
        e1 = e1 / np.linalg.norm(e1)
        rings.append(point + r * (np.cos(angle) * e1 + np.sin(angle) * np.cross(direction, e1)))
    return loft([*rings, path[-1:]], name, srgb)


def prism(outline: ArrayLike, x0: float, x1: float, name: str, srgb) -> MeshPart:
    """Extend an outline of (z, y), in either direction and star-shaped about its middle, from x0 to x1."""
    z, y = np.asarray(outline, float).T
    if np.sum(z * np.roll(y, -1) - y * np.roll(z, -1)) > 0:  # seen from +x, z runs to the left
        z, y = z[::-1], y[::-1]

    def ring(x: float, z, y) -> np.ndarray:
        return np.stack([np.full_like(z, x), y, z], 1)

    middle = z.mean(keepdims=True), y.mean(keepdims=True)
    return loft([ring(x0, *middle), ring(x0, z, y), ring(x1, z, y), ring(x1, *middle)], name, srgb, planar=True)


def box(size: tuple[float, float, float], bottom_middle: tuple[float, float, float], name: str, srgb) -> MeshPart:
    """Return a box of (x, y, z) extents; `bottom_middle` is where it stands."""
    dx, dy, dz = size
    outline = [(-dz / 2, 0), (-dz / 2, dy), (dz / 2, dy), (dz / 2, 0)]
    return translate_part(prism(outline, -dx / 2, dx / 2, name, srgb), bottom_middle)


def translate_part(part: MeshPart, offset: Sequence[float]) -> MeshPart:
    """Return the part, shifted."""
    return replace(part, vertices=part.vertices + np.asarray(offset, float))


def rotate_part(part: MeshPart, axis: int, degrees: float) -> MeshPart:
    """Return the part, rotated about the world's x, y or z (`axis` 0, 1, 2), counter-clockwise seen from its tip."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    matrix = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix[i, i], matrix[i, j], matrix[j, i], matrix[j, j] = c, -s, s, c
    normals = None if part.normals is None else part.normals @ matrix.T
    return replace(part, vertices=part.vertices @ matrix.T, normals=normals)


def _pole_uv(rings, row: int, column: int) -> tuple[float, float]:
    """Return texture coordinates on a cap: the cap's disc is inscribed in the texture."""
    if len(rings[row]) == 1:
        return 0.5, 0.5
    angle = 2 * np.pi * column / len(rings[row])
    return 0.5 + 0.5 * np.cos(angle), 0.5 + 0.5 * np.sin(angle)


def _corner_normals(corners: np.ndarray) -> np.ndarray:
    """Return F×3×3 unit normals: means, by angle, over the faces at a point that bend less than the crease."""
    from scipy.sparse import csr_matrix

    unit = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    scale = np.ptp(corners.reshape(-1, 3), axis=0).max()
    point = np.unique(np.round(corners.reshape(-1, 3) / scale, 7), axis=0, return_inverse=True)[1].reshape(-1)
    at_point = csr_matrix((np.ones(len(point)), (np.arange(len(point)), point)))
    first, second = (at_point @ at_point.T).nonzero()
    near = (unit[first // 3] * unit[second // 3]).sum(1) > np.cos(np.radians(CREASE_DEG))
    edge = np.roll(corners, -1, 1) - corners
    edge /= np.linalg.norm(edge, axis=2, keepdims=True)
    angle = np.arccos(np.clip(-(edge * np.roll(edge, 1, 1)).sum(2), -1, 1)).reshape(-1, 1)
    total = np.zeros((len(point), 3))
    np.add.at(total, first[near], (angle * unit.repeat(3, 0))[second[near]])
    return (total / np.linalg.norm(total, axis=1, keepdims=True)).reshape(-1, 3, 3)


def _planar_uv(corners: np.ndarray) -> np.ndarray:
    """Return F×3×2: faces see the texture along the axis nearest to their normal, upright, once per part."""
    x, y, z = np.moveaxis((corners - corners.min((0, 1))) / np.ptp(corners, axis=(0, 1)), 2, 0)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axis = np.abs(normal).argmax(1)
    sign = np.take_along_axis(normal, axis[:, None], 1) > 0
    u = np.select([(axis == 0)[:, None], (axis == 1)[:, None]], [np.where(sign, 1 - z, z), x], np.where(sign, x, 1 - x))
    v = np.where((axis == 1)[:, None], np.where(sign, z, 1 - z), 1 - y)
    return np.stack([u, v], 2)
