"""What a tape measure says beside a bent piece: from the middle of each of its edges straight on along the surface, to
the first thing that one can find with a finger.

In: a mesh, where the piece lies on it, and from where one looks. Out: `TapeMeasurement`s, up to four. They run in planes along
the line of sight, and so look straight; what one sees of the surface there is its nearest line, so that shells within
others, cracks and overlapping parts of a mesh do not matter. A tape ends at an edge, where it turns by more than
`EDGE_DEG` within a finger's breadth, or at the outline. Left out on purpose: what lies behind the outline.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from patchproof.mesh.mesh import Mesh
from patchproof.scene.placement import Placement

Edge = Literal["top", "bottom", "left", "right"]
EDGE_DEG = 40.0
_STEPS = 3000  # along the object's longest extent
_FINGER_MM, _FINGER_SHARE = 1.0, 0.006  # the larger counts; thinner ridges are no edges
_END_SHARE = 0.02  # of the object's height: so near to its top or its ground is there
_UNDER_SHARE = 0.06  # of the piece's shorter edge: twice what bent paper may stand off on average
_ASKEW = 0.3  # of a direction's length: what is left of it is too short to lay a tape by
_UPRIGHT = 0.7  # a tape that runs this much up or down ends at the top or on the ground


@dataclass(frozen=True)
class TapeMeasurement:
    """From the middle of a piece's edge to something that can be found."""

    edge: Edge
    length_mm: float  # along the surface
    end: str
    points_mm: np.ndarray  # N×3 in the world, from the piece on


def tapes(mesh: Mesh, laid: Placement, normal: np.ndarray) -> tuple[TapeMeasurement, ...]:
    """A tape from each edge of the piece whose middle can be seen from far away along `normal`; y is up."""
    width, height = laid.size_mm
    right, down = laid.world_from_piece[:3, :2].T
    ways: tuple[tuple[Edge, tuple[float, float], np.ndarray], ...] = (
        ("top", (width / 2, 0.0), -down),
        ("bottom", (width / 2, height), down),
        ("left", (0.0, height / 2), -right),
        ("right", (width, height / 2), right),
    )
    laid_out = (_tape(mesh, laid, edge, laid.world(np.array([at]))[0], along, normal) for edge, at, along in ways)
    return tuple(tape for tape in laid_out if tape is not None)


def _tape(
    mesh: Mesh, laid: Placement, edge: Edge, start: np.ndarray, along: np.ndarray, normal: np.ndarray
) -> TapeMeasurement | None:
    """The tape from `start` on, to where the piece's own direction `along` leads as one sees it."""
    along = along - (along @ normal) * normal
    if np.linalg.norm(along) < _ASKEW:
        return None
    along = along / np.linalg.norm(along)
    length = float(np.ptp(mesh.vertices, axis=0).max())
    step, finger_mm = length / _STEPS, max(_FINGER_MM, _FINGER_SHARE * length)
    finger = max(round(finger_mm / step), 2)
    seen = (mesh.vertices - start) @ np.stack([np.cross(normal, along), along, normal]).T
    h = profile(seen[mesh.faces], step, -finger)
    rest = np.flatnonzero(np.isnan(h[finger:]))
    end = finger + int(rest[0] if len(rest) else len(h) - finger) - 1
    if end <= finger or not abs(h[finger]) < _UNDER_SHARE * min(laid.size_mm):
        return None  # the piece's edge lies beyond the outline, or on nothing
    stop = _edge(h[: end + 1], finger, step)
    path = np.arange(finger, (end if stop is None else stop) + 1)
    points = start + (path - finger)[:, None] * step * along + h[path][:, None] * normal
    low, high = mesh.vertices[:, 1].min(), mesh.vertices[:, 1].max()
    near, y = _END_SHARE * (high - low), points[-1, 1]
    if along[1] > _UPRIGHT and y > high - near:
        name = "to the top"
    elif along[1] < -_UPRIGHT and y < low + near:
        name = "to the ground"
    else:
        name = "to the outline" if stop is None else "to an edge"
    return TapeMeasurement(edge, float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum()), name, points)


def profile(triangles: np.ndarray, step: float, first: int) -> np.ndarray:
    """The highest z of triangles F×3×3 over x = 0, at y = step × (first, first + 1, ...); NaN where there is none."""
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
    """The first place after `finger` where the line turns sharply; None where there is none."""
    chords = np.degrees(np.arctan2(h[finger:] - h[:-finger], finger * step))
    turn = np.abs(chords[finger:] - chords[:-finger])  # at finger, finger + 1, ...
    sharp = np.flatnonzero(turn > EDGE_DEG)
    if not len(sharp):
        return None
    within = turn[sharp[0] : sharp[0] + finger]
    return finger + int(sharp[0] + within.argmax())
