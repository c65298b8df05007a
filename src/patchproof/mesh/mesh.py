"""Triangle meshes of objects, in millimeters.

In: parts, read by `load_mesh` or made by code. Out: one triangle list in the scene's frame with per-corner texture
coordinates, normals and colors, and warnings that state assumptions. Faces that cannot be drawn (NaN corners, no area)
are left out; size and center are those of the faces that are drawn. Left out on purpose: closed surfaces. A renderer
needs no inside, so open, non-manifold and loose triangles will do.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from patchproof.base.errors import Refused

MOST_FACES = 20_000_000  # a scan of a building has fewer
_MOST_CORNERS = 1000  # of a concave polygon: cutting n corners takes n² steps


@dataclass(frozen=True, eq=False)
class Material:
    """A base color in linear light and, if there is one, a texture as uint8 H×W×3 sRGB; the two multiply as light."""

    name: str
    base_color_linear: tuple[float, float, float]
    texture_srgb: np.ndarray | None = None


@dataclass(frozen=True)
class MeshPart:
    """Triangles of one material, which `mesh_from_parts` joins. Arrays are per vertex; None for no values."""

    vertices: np.ndarray  # V×3, any unit, world axes (y up)
    faces: np.ndarray  # F×3 integers, counter-clockwise seen from outside
    material: Material
    uv: np.ndarray | None = None  # V×2, u right, v down from the texture's top-left
    normals: np.ndarray | None = None  # V×3, any length
    colors_linear: np.ndarray | None = None  # V×3


@dataclass(frozen=True)
class Mesh:
    """A triangle list; the color of a point is texture (as light) · base color · corner color."""

    vertices: np.ndarray  # float64 V×3: mm, right-handed, y up, origin at the bounding box's center
    faces: np.ndarray  # int64 F×3, counter-clockwise seen from outside
    corner_uv: np.ndarray  # float32 F×3×2: u right, v down from the texture's top-left (wraps); 0 where none
    corner_normal: np.ndarray  # float32 F×3×3 unit: the file's if it has them, else the face's
    corner_color_linear: np.ndarray  # float32 F×3×3; 1 where none
    face_material: np.ndarray  # int64 F, into materials
    materials: tuple[Material, ...]
    warnings: tuple[str, ...] = ()  # of assumptions, and of faces that are left out
    files: tuple[Path, ...] = ()  # that it was read from: the mesh, its materials, textures and buffers

    @cached_property
    def ends_mm(self) -> tuple[np.ndarray, np.ndarray]:
        """The lowest and highest corner of the bounding box."""
        return self.vertices.min(0), self.vertices.max(0)

    def triangles_near(self, vertex_mm: np.ndarray, reach_mm: float) -> np.ndarray:
        """Return triangles F×3×3 in their order, without those that cannot come within a reach of a thing that lies
        `vertex_mm` V from each vertex.
        """
        return self.vertices[self.faces[(vertex_mm <= reach_mm + self._longest_edge_mm)[self.faces].any(1)]]

    @cached_property
    def _longest_edge_mm(self) -> float:
        a, b, c = (self.vertices[corner] for corner in self.faces.T)
        return max(float(np.linalg.norm(edge, axis=1).max()) for edge in (b - a, c - b, a - c))


def mesh_from_parts(parts: Sequence[MeshPart], length_mm: float, warnings: Sequence[str] = ()) -> Mesh:
    """Join parts, which may share materials, into one centered mesh with the longest extent `length_mm`. Faces with NaN
    or infinite corners or without area are left out with a warning; refused if none remains.
    """
    vertices, faces, owner = _join(parts)
    finite = np.all(np.isfinite(vertices), axis=1)
    has_finite_corners = finite[faces].all(1)
    # everything is first divided by the largest coordinate, so that neither 1e-200 nor 1e300 over- or underflows
    size = np.abs(vertices[faces[has_finite_corners]]).max(initial=0.0)
    unit = np.where(finite[:, None], vertices, 0.0) / (size or 1.0)
    normals, has_area = _face_normals(unit, faces)
    drawn = has_finite_corners & has_area
    if not drawn.any():
        corners_are_nan = len(faces) > 0 and not has_finite_corners.any()
        got = f"{len(faces)} faces " + ("with NaN or infinite corners" if corners_are_nan else "without area")
        raise Refused("a mesh whose faces have an area", got, "export the object again")
    warnings = list(warnings)
    if not has_finite_corners.all():
        warnings.append(f"{np.count_nonzero(~has_finite_corners)} faces with NaN or infinite corners are left out")
    if np.any(has_finite_corners & ~has_area):
        warnings.append(f"{np.count_nonzero(has_finite_corners & ~has_area)} faces without area are left out")
    of_parts = np.split(normals, np.cumsum([len(part.faces) for part in parts])[:-1])
    corners = [_corner_arrays(part, face_normals) for part, face_normals in zip(parts, of_parts, strict=True)]
    uv, corner_normals, colors = (np.concatenate(array)[drawn] for array in zip(*corners, strict=True))
    used_vertices, drawn_faces = np.unique(faces[drawn], return_inverse=True)
    drawn_points = unit[used_vertices]
    low, high = drawn_points.min(0), drawn_points.max(0)
    materials = {material: i for i, material in enumerate(dict.fromkeys(part.material for part in parts))}
    index = np.array([materials[part.material] for part in parts])
    vertices = (drawn_points - (low + high) / 2) * (length_mm / (high - low).max())
    arrays = (vertices, drawn_faces.reshape(-1, 3), uv, corner_normals, colors, index[owner[drawn]])
    return Mesh(*arrays, tuple(materials), tuple(warnings))


def _join(parts: Sequence[MeshPart]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return all vertices, all faces as indices into them, and the part that each face belongs to."""
    starts = np.cumsum([0] + [len(part.vertices) for part in parts])
    vertices = np.concatenate([np.asarray(part.vertices, float) for part in parts])
    faces = np.concatenate([np.asarray(part.faces, np.int64) + s for part, s in zip(parts, starts, strict=False)])
    return vertices, faces, np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts])


def _face_normals(unit: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit normals F×3, and which faces have an area, for coordinates within [-1, 1]."""
    a, b, c = (unit[faces[:, i]] for i in range(3))
    cross = np.cross(b - a, c - a)
    doubled_area = np.linalg.norm(cross, axis=1)
    edge = np.maximum(np.linalg.norm(b - a, axis=1), np.linalg.norm(c - a, axis=1))
    # collinear points give a cross product of rounding only: a few 1e-16 of the coordinates, times an edge
    has_area = doubled_area > 1e-14 * edge
    return cross / np.where(has_area, doubled_area, 1.0)[:, None], has_area


def _corner_arrays(part: MeshPart, face_normals: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (uv F×3×2, normals F×3×3, colors F×3×3) of a part's corners, float32."""
    count = len(part.faces)
    uv = np.zeros((count, 3, 2), np.float32)
    if part.uv is not None:
        uv[:] = part.uv[part.faces]
    normals = np.repeat(face_normals[:, None].astype(np.float32), 3, axis=1)
    if part.normals is not None:
        length = np.linalg.norm(part.normals, axis=1)
        good = np.isfinite(length) & (length > 0)
        directions = part.normals / np.where(good, length, 1.0)[:, None]
        normals = np.where(good[part.faces][..., None], directions[part.faces].astype(np.float32), normals)
    colors = np.ones((count, 3, 3), np.float32)
    if part.colors_linear is not None:
        colors[:] = part.colors_linear[part.faces]
    return uv, normals, colors


def transform_part(part: MeshPart, transform: np.ndarray) -> MeshPart:
    """Return a part moved by `transform` 3×4; a mirror, which turns triangles inside out, reverses their corners."""
    rotation = transform[:, :3]
    with np.errstate(invalid="ignore", over="ignore"):
        sign = -1 if np.linalg.det(rotation) < 0 else 1
        # normals turn by the inverse transpose up to a factor, as cofactors, so that flattening works
        cofactors = sign * np.cross(rotation[[1, 2, 0]], rotation[[2, 0, 1]])
        vertices = part.vertices @ rotation.T + transform[:, 3]
        normals = None if part.normals is None else part.normals @ cofactors.T
    return replace(part, vertices=vertices, faces=part.faces[:, ::sign], normals=normals)


def position_numbers(vertices: np.ndarray) -> np.ndarray:
    """Return V: the same number for all vertices V×3 at the same position."""
    order = np.lexsort(vertices.T)
    is_new = np.r_[False, (np.diff(vertices[order], axis=0) != 0).any(1)]
    numbers = np.empty(len(vertices), np.int64)
    numbers[order] = is_new.cumsum()
    return numbers


def triangulate(corners: np.ndarray, lengths: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Return the triangles F×3 of polygons in their order. `corners` are their vertices' numbers, one polygon after the
    other, and `lengths` how many each has (3 or more). Convex polygons become fans; of others, ears are cut off
    (Meisters, Polygons have ears, 1975) in the plane of two axes in which they are largest; outlines that cross
    themselves are cut somehow. Refused: concave polygons of more than 1000 corners.
    """
    starts, faces, owners = lengths.cumsum() - lengths, [], []
    for size in np.unique(lengths):
        numbers = np.flatnonzero(lengths == size)
        polygons = corners[starts[numbers, None] + np.arange(size)]
        faces.append((polygons if size == 3 else _cut(polygons, vertices)).reshape(-1, 3))
        owners.append(np.repeat(numbers, size - 2))
    return np.concatenate(faces)[np.argsort(np.concatenate(owners), kind="stable")]


def _cut(polygons: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Return the triangles N×(S-2)×3 of polygons N×S."""
    size = polygons.shape[1]
    with np.errstate(invalid="ignore", over="ignore"):
        points = vertices[polygons] - vertices[polygons[:, :1]]
        normal = np.cross(points, np.roll(points, -1, axis=1)).sum(1)  # Newell's: twice the area
        edges = np.roll(points, -1, axis=1) - points
        turns = np.einsum("fik,fk->fi", np.cross(np.roll(edges, 1, axis=1), edges), normal)
        concave = np.flatnonzero((turns < -1e-9 * (normal**2).sum(1, keepdims=True)).any(1))
    if size > _MOST_CORNERS and len(concave):
        got = f"one of {size}"
        raise Refused(f"concave polygons of at most {_MOST_CORNERS} corners", got, "export the mesh as triangles")
    first = turns[concave].argmin(1)[:, None]  # a concave quad is a fan round that corner
    polygons[concave] = np.take_along_axis(polygons[concave], (first + np.arange(size)) % size, axis=1)
    fans = polygons[:, [[0, i, i + 1] for i in range(1, size - 1)]]
    for i in concave if size > 4 else ():
        x, y = np.delete(vertices[polygons[i]], np.abs(normal[i]).argmax(), axis=1).T
        fans[i] = polygons[i][_ears(x - x[0], y - y[0])]
    return fans


def _ears(x: np.ndarray, y: np.ndarray) -> list[list[int]]:
    """Return the triangles of an outline in the plane; where no corner is an ear, one is cut off all the same."""
    left, triangles, last = list(range(len(x))), [], 0
    sign = np.sign(np.roll(x, 1) @ y - np.roll(y, 1) @ x)

    def turn(a: int, b: int, c) -> np.ndarray:
        return sign * ((x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a]))

    def is_ear(k: int) -> bool:
        a, b, c = left[k - 1], left[k], left[(k + 1) % len(left)]
        inside = np.minimum(np.minimum(turn(a, b, left), turn(b, c, left)), turn(c, a, left)) >= 0
        is_corner = np.any([(x[left] == x[i]) & (y[left] == y[i]) for i in (a, b, c)], axis=0)
        return bool(turn(a, b, c) > 0 and np.all(is_corner | ~inside))

    while len(left) > 3:  # on from the last ear
        last = next((k for k in [*range(last, len(left)), *range(last)] if is_ear(k)), 0)
        triangles.append([left[last - 1], left[last], left[(last + 1) % len(left)]])
        left.pop(last)
    return [*triangles, left]
