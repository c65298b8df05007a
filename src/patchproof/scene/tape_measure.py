"""Tape measurements beside a bent piece: from the middle of each edge straight along the surface to the first feature
that one can feel with a finger.

In: a mesh, the piece's placement, and the direction from which one looks. Out: up to four `TapeMeasurement`s. They run
in planes along the line of sight and so look straight; the surface that one sees there is its nearest line, so that
shells within others, cracks and overlapping parts of a mesh do not matter. A tape ends at an edge, where it turns by
more than `EDGE_DEG` within a finger's breadth, or at the outline. Left out on purpose: the surface behind the outline.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from patchproof.mesh.mesh import Mesh
from patchproof.scene.placement import Placement

Edge = Literal["top", "bottom", "left", "right"]
EDGE_DEG = 40.0
_STEPS = 3000  # along the object's longest extent
_FINGER_MM, _FINGER_SHARE = 1.0, 0.006  # of the object's extent; the larger counts; thinner ridges are no edges
_END_SHARE = 0.02  # of the object's height: an end this near to its top or its ground counts as there
_MAX_GAP_SHARE = 0.06  # of the piece's shorter edge: twice what bent paper may stand off on average
_MIN_VISIBLE_SHARE = 0.3  # of a direction's length: a tape cannot follow one that is more foreshortened
_VERTICAL_COSINE = 0.7  # a tape that runs this much up or down ends at the top or on the ground


@dataclass(frozen=True)
class TapeMeasurement:
    """A length from the middle of a piece's edge to a feature that can be found on the object."""

    edge: Edge
    length_mm: float  # along the surface
    end: str
    points_mm: np.ndarray  # N×3 in the world, from the piece on


def measure_tapes(mesh: Mesh, piece: Placement, normal: np.ndarray) -> tuple[TapeMeasurement, ...]:
    """Measure from each edge of the piece whose middle can be seen from far away along `normal`; y is up."""
    width, height = piece.size_mm
    right, down = piece.world_from_piece[:3, :2].T
    directions: tuple[tuple[Edge, tuple[float, float], np.ndarray], ...] = (
        ("top", (width / 2, 0.0), -down),
        ("bottom", (width / 2, height), down),
        ("left", (0.0, height / 2), -right),
        ("right", (width, height / 2), right),
    )
    found = (_measure(mesh, piece, edge, middle_mm, along, normal) for edge, middle_mm, along in directions)
    return tuple(tape for tape in found if tape is not None)


def _measure(
    mesh: Mesh, piece: Placement, edge: Edge, middle_mm: tuple[float, float], along: np.ndarray, normal: np.ndarray
) -> TapeMeasurement | None:
    """Measure from an edge's middle in the piece's direction `along`, as one sees it; None if nothing is found."""
    start, along = piece.world(np.array([middle_mm]))[0], along - (along @ normal) * normal
    if np.linalg.norm(along) < _MIN_VISIBLE_SHARE:
        return None
    along = along / np.linalg.norm(along)
    length = float(np.ptp(mesh.vertices, axis=0).max())
    step, finger_mm = length / _STEPS, max(_FINGER_MM, _FINGER_SHARE * length)
    finger = max(round(finger_mm / step), 2)
    rotated = (mesh.vertices - start) @ np.stack([np.cross(normal, along), along, normal]).T
    h = profile(rotated[mesh.faces], step, -finger)
    gaps = np.flatnonzero(np.isnan(h[finger:]))
    end = finger + int(gaps[0] if len(gaps) else len(h) - finger) - 1
    if end <= finger or not abs(h[finger]) < _MAX_GAP_SHARE * min(piece.size_mm):
        return None  # the piece's edge lies beyond the outline, or there is nothing under it
    stop = _edge(h[: end + 1], finger, step)
    path = np.arange(finger, (end if stop is None else stop) + 1)
    points = start + (path - finger)[:, None] * step * along + h[path][:, None] * normal
    low, high = mesh.vertices[:, 1].min(), mesh.vertices[:, 1].max()
    tolerance, y = _END_SHARE * (high - low), points[-1, 1]
    if along[1] > _VERTICAL_COSINE and y > high - tolerance:
        end_name = "to the top"
    elif along[1] < -_VERTICAL_COSINE and y < low + tolerance:
        end_name = "to the ground"
    else:
        end_name = "to the outline" if stop is None else "to an edge"
    return TapeMeasurement(edge, float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum()), end_name, points)


def profile(triangles: np.ndarray, step: float, first: int) -> np.ndarray:
    """Return the highest z of triangles F×3×3 at x = 0, y = step × (first, first + 1, ...); NaN where none is."""
    corners = triangles + np.array([1e-9, 0.0, 0.0])  # a corner on the plane would belong to no side
    beyond = corners[..., 0] > 0
    a = corners[beyond.any(1) & ~beyond.all(1)]
    b = np.roll(a, -1, axis=1)
    cut = (a[..., 0] > 0) != (b[..., 0] > 0)  # two of a triangle's three edges
    share = a[cut][:, 0] / (a[cut][:, 0] - b[cut][:, 0])
    ends = (a[cut] + share[:, None] * (b[cut] - a[cut]))[:, 1:].reshape(-1, 2, 2)  # K×2×(y, z)
    (y0, z0), (y1, z1) = np.take_along_axis(ends, np.argsort(ends[..., :1], axis=1), axis=1).transpose(1, 2, 0)
    low = np.maximum(np.ceil(y0 / step).astype(int), first)
    count = np.maximum(np.floor(y1 / step).astype(int) - low + 1, 0)
    owner = np.repeat(np.arange(len(low)), count)
    index = low[owner] + np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    if not len(index):
        return np.full(1, np.nan)
    slope = (z1 - z0) / np.where(y1 > y0, y1 - y0, 1.0)
    highest = np.full(index.max() - first + 1, -np.inf)
    np.maximum.at(highest, index - first, z0[owner] + slope[owner] * (index * step - y0[owner]))
    return np.where(np.isfinite(highest), highest, np.nan)


def _edge(h: np.ndarray, finger: int, step: float) -> int | None:
    """Return the first index after `finger` at which the line turns sharply; None if it does not."""
    chords = np.degrees(np.arctan2(h[finger:] - h[:-finger], finger * step))
    turn = np.abs(chords[finger:] - chords[:-finger])  # at finger, finger + 1, ...
    sharp = np.flatnonzero(turn > EDGE_DEG)
    if not len(sharp):
        return None
    within = turn[sharp[0] : sharp[0] + finger]
    return finger + int(sharp[0] + within.argmax())
