"""Cut polygons into triangles that cover them, concave ones too.

In: polygons as vertex numbers, and the vertices. Out: triangles with the polygon's orientation. Convex polygons become
fans; of others, ears are cut off (Meisters, Polygons have ears, 1975) in the plane of two axes in which they are
largest. Left out on purpose: outlines that cross themselves, which are cut somehow.
"""

import numpy as np

from patchproof.base.errors import Refused

_MOST_CORNERS = 1000  # of a concave polygon: cutting n corners takes n² steps


def triangulate(corners: np.ndarray, lengths: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Return the triangles F×3 of polygons in their order. `corners` are their vertices' numbers, one polygon after the
    other, and `lengths` how many each has (3 or more). Refused: concave polygons of more than 1000 corners.
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
