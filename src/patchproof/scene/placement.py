"""Where the paper lies: a flat rigid card that touches the highest surface points under it.

In: a mesh (world mm), a named side or a point, a spin and the piece's size. Out: a `Card` with the piece's frame in the
world, and how well paper and surface agree: the gap below the card and the overhang beyond the object, in mm and
shares. A card wider or higher than the object's side, or with nothing under it, is refused. Left out here on purpose:
bent pieces.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from patchproof.scene.mesh import Mesh
from patchproof.settings import PatchSettings, Refused

GRID = 65  # heights are sampled on this many points along each edge of the card
LIFT_MM = 0.15  # the paper's own thickness, which also keeps it clear of the surface in the z-buffer
# Assumed: beyond this share of its shorter edge a card stands so far off the object that its shadow shows.
WARN_GAP_SHARE = 0.15
WARN_OVERHANG_SHARE = 0.02

_SIDES = {  # side: (up, normal); right is up × normal
    "+x": ((0, 1, 0), (1, 0, 0)),
    "-x": ((0, 1, 0), (-1, 0, 0)),
    "+y": ((0, 0, -1), (0, 1, 0)),
    "-y": ((0, 0, 1), (0, -1, 0)),
    "+z": ((0, 1, 0), (0, 0, 1)),
    "-z": ((0, 1, 0), (0, 0, -1)),
}


@dataclass(frozen=True)
class Card:
    """A flat piece: `world_from_piece` 4×4 (piece mm: x right, y down from its top-left corner, z into the object)."""

    world_from_piece: np.ndarray
    size_mm: tuple[float, float]
    gap_mm: float  # largest distance from card to surface where there is surface
    gap_mean_mm: float
    overhang_share: float  # of the card's area with no object under it
    warnings: tuple[str, ...] = ()

    def world(self, points_mm: np.ndarray) -> np.ndarray:
        """World millimetres N×3 of piece points N×2."""
        frame = self.world_from_piece
        return points_mm @ frame[:3, :2].T + frame[:3, 3]

    @property
    def normal(self) -> np.ndarray:
        """Unit vector out of the paper's face."""
        return -self.world_from_piece[:3, 2]

    @property
    def center_mm(self) -> np.ndarray:
        """The middle of the piece in the world."""
        return self.world(np.array([self.size_mm]) / 2)[0]


@dataclass(frozen=True)
class Frame:
    """Axes of the place a patch faces: unit vectors in the world, and the point the patch is centered at."""

    right: np.ndarray
    up: np.ndarray
    normal: np.ndarray
    origin_mm: np.ndarray
    extent_mm: tuple[float, float]  # the object's size along right and up


def patch_frame(mesh: Mesh, patch: PatchSettings) -> Frame:
    """The frame of the patch's side, or of the surface point nearest to `at_mm`."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    if patch.at_mm is None:
        up, normal = (np.array(v, float) for v in _SIDES[patch.side])
        right = np.cross(up, normal)
        middle = (low + high) / 2 + normal * (np.abs(normal) @ (high - low)) / 2
        origin = middle + patch.offset_mm[0] * right + patch.offset_mm[1] * up
    else:
        nearest, normal = _nearest_surface(mesh, np.array(patch.at_mm, float))
        level = np.array([0.0, 1, 0]) if abs(normal[1]) < 0.99 else np.array([0.0, 0, -1])
        right = np.cross(level, normal)
        right /= np.linalg.norm(right)
        up = np.cross(normal, right)
        origin = nearest + patch.offset_mm[0] * right + patch.offset_mm[1] * up
    spread = mesh.vertices @ np.stack([right, up], 1)
    extent = tuple(float(e) for e in np.ptp(spread, axis=0))
    return Frame(right, up, normal, origin, extent)


def place_card(mesh: Mesh, frame: Frame, size_mm: tuple[float, float], spin_deg: float) -> Card:
    """Lay a card of `size_mm` on the surface, its middle at the frame's origin; spin turns it clockwise as one faces
    it.
    """
    width, height = size_mm
    c, s = np.cos(np.radians(spin_deg)), np.sin(np.radians(spin_deg))
    right, up = c * frame.right - s * frame.up, s * frame.right + c * frame.up
    _refuse_larger_than_side(size_mm, abs(c), abs(s), frame.extent_mm)
    local = (mesh.vertices - frame.origin_mm) @ np.stack([right, up, frame.normal], 1)
    heights = _heights(local, mesh.faces, size_mm)
    seen = np.isfinite(heights)
    if not seen.any():
        raise Refused("a patch that lies on the object", "no surface under it", "change offset_mm or at_mm")
    inside = (np.abs(local[:, 0]) <= width / 2) & (np.abs(local[:, 1]) <= height / 2)
    # a surface behind the object's middle is its far side seen past an edge, not what the card rests on
    top = max(heights[seen].max(), local[inside, 2].max(initial=-np.inf))
    gaps = top - heights[seen]
    center = frame.origin_mm + frame.normal * (top + LIFT_MM)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = right, -up, -frame.normal
    pose[:3, 3] = center - right * width / 2 + up * height / 2
    gap, mean, overhang = float(gaps.max()), float(gaps.mean()), float(1 - seen.mean())
    return Card(pose, (width, height), gap, mean, overhang, _warnings(gap, overhang, size_mm))


def _refuse_larger_than_side(size_mm, c: float, s: float, extent_mm) -> None:
    """A card may not reach beyond the object's outline; 0.5 % of slack for rounded figures."""
    width, height = size_mm
    across, along = c * width + s * height, s * width + c * height
    if across > 1.005 * extent_mm[0] or along > 1.005 * extent_mm[1]:
        raise Refused(
            f"a piece no larger than the object's side ({extent_mm[0]:.0f} × {extent_mm[1]:.0f} mm)",
            f"{across:.0f} × {along:.0f} mm with its frame of markers",
            "make the patch smaller or choose a larger side",
        )


def _warnings(gap: float, overhang: float, size_mm) -> tuple[str, ...]:
    notes = []
    if gap > WARN_GAP_SHARE * min(size_mm):
        notes.append(
            f"the card stands up to {gap:.0f} mm ({gap / min(size_mm):.0%} of its shorter edge) off the surface"
        )
    if overhang > WARN_OVERHANG_SHARE:
        notes.append(f"{overhang:.0%} of the card overhangs the object")
    return tuple(notes)


def _heights(local: np.ndarray, faces: np.ndarray, size_mm) -> np.ndarray:
    """The highest surface above each point of a GRID×GRID net over the card, -inf → NaN where there is none.

    Each triangle visits the net points of its bounding box only, so that work follows what lies under the card.
    """
    width, height = size_mm
    step = np.array([width, height]) / (GRID - 1)
    corners = local[faces]
    xy = (corners[..., :2] + np.array([width, height]) / 2) / step  # net units
    low = np.maximum(np.ceil(xy.min(1)), 0).astype(np.int64)
    high = np.minimum(np.floor(xy.max(1)), GRID - 1).astype(np.int64)
    (a, b), (c, d) = (xy[:, 1] - xy[:, 0]).T, (xy[:, 2] - xy[:, 0]).T
    # a triangle seen edge-on covers nothing; its neighbors have its edges
    hit = np.flatnonzero((low <= high).all(1) & (np.abs(a * d - b * c) > 1e-9))
    low, high, xy, z = low[hit], high[hit], xy[hit], corners[hit, :, 2]
    across = high[:, 0] - low[:, 0] + 1
    cells = across * (high[:, 1] - low[:, 1] + 1)
    net = np.full(GRID * GRID, -np.inf)
    for part in np.array_split(np.arange(len(hit)), max(1, int(cells.sum() // 2_000_000))):
        owner = np.repeat(part, cells[part])
        k = np.arange(len(owner)) - np.repeat(np.cumsum(cells[part]) - cells[part], cells[part])
        x, y = low[owner, 0] + k % across[owner], low[owner, 1] + k // across[owner]
        weights = _barycentric(xy[owner], x, y)
        inside = (weights >= -1e-9).all(1)
        np.maximum.at(net, (y * GRID + x)[inside], (weights * z[owner]).sum(1)[inside])
    return np.where(np.isfinite(net), net, np.nan)


def _barycentric(triangle: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Barycentrics P×3 of points in triangles P×3×2 that have an area."""
    a, b, c = triangle[:, 0], triangle[:, 1], triangle[:, 2]
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    wb = ((x - a[:, 0]) * (c[:, 1] - a[:, 1]) - (y - a[:, 1]) * (c[:, 0] - a[:, 0])) / area
    wc = ((b[:, 0] - a[:, 0]) * (y - a[:, 1]) - (b[:, 1] - a[:, 1]) * (x - a[:, 0])) / area
    return np.stack([1 - wb - wc, wb, wc], 1)


def _nearest_surface(mesh: Mesh, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The surface point nearest to `point` and its face's unit normal."""
    from trimesh.triangles import closest_point, normals

    triangles = mesh.vertices[mesh.faces]
    found = closest_point(triangles, np.broadcast_to(point, (len(triangles), 3)))
    best = int(np.argmin(((found - point) ** 2).sum(1)))
    return found[best], normals(triangles[best : best + 1])[0][0]
