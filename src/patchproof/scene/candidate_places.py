"""Candidate places for a piece, spread evenly over an object's surface.

In: an `UnplacedScene`. Out: `CandidatePlace`s for `UnplacedScene.with_piece_at`. Points are sampled evenly over the
surface (the same for the same seed) and left out if hardly any view faces them. From each, the piece is moved until one
level part of the surface lies under it, and placed there as at a given place. A piece that is refused, overhangs or
stands off too far is no candidate. Left out on purpose: objects in front of a place, which the networks will show.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import get_args

import numpy as np

from patchproof.base.errors import Refused
from patchproof.base.geometry import camera_centers
from patchproof.base.validation import Side
from patchproof.mesh.surface_chart import SurfaceChart, piece_grid, surface_heights
from patchproof.scene import placement
from patchproof.scene.patch_scene import PiecePosition, UnplacedScene
from patchproof.scene.placement import Placement, SurfaceFrame, spun_axes

MIN_DISTANCE_SHARE = 0.5  # of the piece's shorter edge, between two candidates
_POOL_DISTANCE_SHARE, _POOL = 0.25, 96  # between points to try, and their greatest number
_SAMPLE_DISTANCE_SHARE, _SAMPLES = 1 / 16, 100_000  # between points that stand for the surface, and their number
_VIEWS, _FACING_SHARE, _FACING_COSINE = 64, 0.2, 0.26  # at least a fifth of the views, less than 75° from the normal
_NET, _MOVES = 17, 4  # points along each edge under which a place is leveled, and the greatest number of moves
_COARSE_OVERHANG = 0.07  # of these points: one row of 17 may just miss the edge
_SAME_SIDE_COSINE = 0.97  # of 15°: a point that is moved onto a face with another direction is no candidate


@dataclass(frozen=True)
class CandidatePlace:
    """A place for the piece, as the keys `at_mm` (or `side`) and `spin_deg` say it, and its placement there."""

    at: PiecePosition
    spin_deg: float
    placement: Placement


@dataclass(frozen=True)
class PlaceFinder:
    """Finds places for a piece on an object's surface."""

    scene: UnplacedScene

    def candidates(self, most: int) -> tuple[CandidatePlace, ...]:
        """Return up to `most` places, one spin each, as far apart as their number allows; refused if there is none."""
        candidates = list(self.places())
        middles = np.array([spot.placement.center_mm for spot in candidates])
        normals = np.array([spot.placement.normal for spot in candidates])
        first = range(max(len(self._sides), 1))
        indices = _spread(middles, normals, min(self.size_mm), MIN_DISTANCE_SHARE, most, first)
        return tuple(candidates[i] for i in indices)

    def places(self) -> Iterator[CandidatePlace]:
        """Find places, one spin each: those in the middles of sides first; refused at the end if there was none."""
        yield from self._sides
        found = bool(self._sides)
        for frame in self._frames_to_try:  # upright if that fits, else a quarter turned
            if spot := next(filter(None, (self._candidate_near(frame, spin) for spin in self._spins[:2])), None):
                found = True
                yield spot
        if not found:
            expected = f"a place for a piece of {self.size_mm[0]:.0f} × {self.size_mm[1]:.0f} mm that views face"
            remedy = "make it smaller or let it bend, in a scene file (patchproof keys), or check the object's length"
            raise Refused(expected, f"{len(self._frames_to_try)} places at which it does not fit", remedy)

    @cached_property
    def _sides(self) -> list[CandidatePlace]:
        """The middles of sides, where a piece hangs by default."""
        frames = ((side, self._frame_at(side)) for side in get_args(Side))
        seen = ((side, f) for side, f in frames if self._facing(f.origin_mm[None], f.normal[None])[0] >= _FACING_SHARE)
        return [spot for side, frame in seen if (spot := self._candidate(side, frame, 0.0))]

    def other_spins(self, spot: CandidatePlace) -> tuple[CandidatePlace, ...]:
        """Return about the same place with the other spins that fit there."""
        frame = self._frame_at(spot.at)
        turns = (self._candidate_near(frame, spin) for spin in self._spins if spin != spot.spin_deg)
        return tuple(turn for turn in turns if turn is not None)

    @property
    def size_mm(self) -> tuple[float, float]:
        """The piece's size."""
        return self.scene.settings.patch.size_mm

    @property
    def _spins(self) -> tuple[float, ...]:
        """Spins that differ: a design may be drawn upside down, and on a square sideways, too."""
        width, height = self.size_mm
        return (0.0, 45.0) if np.isclose(width, height) else (0.0, 90.0, 45.0, 135.0)

    def _facing(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Return M shares of the views that face the points M×3."""
        rays = (eye - points for eye in self._eyes)
        cosines = [(ray * normals).sum(1) / np.linalg.norm(ray, axis=1) for ray in rays]
        return (np.array(cosines) > _FACING_COSINE).mean(0)

    def _candidate_near(self, frame: SurfaceFrame, spin_deg: float) -> CandidatePlace | None:
        """Return the piece near a frame's origin; None if it does not fit."""
        level_mm = self._move_to_level(frame, spin_deg)
        if level_mm is None:
            return None
        x, y, z = (round(value, 1) + 0.0 for value in level_mm.tolist())  # to tenths of a millimeter, for a scene file
        at_mm = (x, y, z)
        frame_there = self._frame_at(at_mm)
        if frame_there.normal @ frame.normal < _SAME_SIDE_COSINE:
            return None
        return self._candidate(at_mm, frame_there, spin_deg)

    def _candidate(self, at: PiecePosition, frame: SurfaceFrame, spin_deg: float) -> CandidatePlace | None:
        """Return the piece at a frame; None if it stands off or overhangs."""
        lay = placement.placement_method(self.scene.settings.patch.bend)
        piece = placement.place_if_close(self.scene.mesh, frame, self.size_mm, spin_deg, lay)
        return None if piece is None else CandidatePlace(at, spin_deg, piece)

    def _move_to_level(self, frame: SurfaceFrame, spin_deg: float) -> np.ndarray | None:
        """Move the frame's origin until the surface under the piece is as high as its middle; None if that fails."""
        right, up = spun_axes(frame, spin_deg)
        reach = float(np.hypot(*self.size_mm)) / 2
        near = self.scene.mesh.triangles_near(np.abs(self.scene.mesh.vertices - frame.origin_mm).max(1), 2 * reach)
        points, middle = piece_grid(self.size_mm, _NET), _NET**2 // 2
        origin = frame.origin_mm
        for _ in range(_MOVES):
            chart = SurfaceChart(origin, np.stack([right, up, frame.normal]), 0.0, np.array([1.0, 0.0]))
            surface = surface_heights(chart, near, self.size_mm, _NET, (-reach, reach))
            level = np.abs(surface - surface[middle]) <= placement.gap_limit_mm(self.size_mm)
            lies_under = np.isfinite(surface) if self.scene.settings.patch.bend else level
            if lies_under.mean() >= 1 - _COARSE_OVERHANG:
                return origin + surface[middle] * frame.normal
            if not level.any():
                return None
            # a missing strip along one edge moves the mean of the other points by half of its width
            x, y = 2 * points[level].mean(0)
            origin = origin + x * right + y * up
        return None

    def _frame_at(self, position: PiecePosition) -> SurfaceFrame:
        """Return the frame of a piece at a position."""
        return placement.patch_frame(self.scene.mesh, self.scene.settings_with_piece_at(position, 0.0).patch)

    @cached_property
    def _eyes(self) -> np.ndarray:
        """Positions of the cameras of `_VIEWS` views, which tell how many views face a point."""
        return camera_centers(self.scene.camera_from_world(self.scene.draw("train", _VIEWS)))

    @cached_property
    def _triangles(self) -> np.ndarray:
        return self.scene.mesh.vertices[self.scene.mesh.faces]

    @cached_property
    def _samples(self) -> tuple[np.ndarray, np.ndarray]:
        """Points M×3 evenly over the surface, and their faces' normals M×3."""
        a, b, c = self._triangles.transpose(1, 0, 2)
        cross = np.cross(b - a, c - a)
        doubled = np.linalg.norm(cross, axis=1)
        apart_mm = _SAMPLE_DISTANCE_SHARE * min(self.size_mm)
        count = int(np.clip(doubled.sum() / 2 / apart_mm**2, 1000, _SAMPLES))
        rng = np.random.default_rng(self.scene.seed)
        share = (np.arange(count) + rng.random(count)) / count
        face = np.searchsorted(np.cumsum(doubled) / doubled.sum(), share).clip(max=len(doubled) - 1)
        u, v = rng.random((2, count, 1))
        u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
        return a[face] + u * (b - a)[face] + v * (c - a)[face], (cross / doubled[:, None])[face]

    @cached_property
    def _frames_to_try(self) -> tuple[SurfaceFrame, ...]:
        """Frames of the points to try, starting next to the middle of the scene's front."""
        points, normals = self._samples
        visible = self._facing(points, normals) >= _FACING_SHARE
        points, normals = points[visible], normals[visible]
        if not len(points):
            return ()
        first = int(np.linalg.norm(points - self.scene.frame.origin_mm, axis=1).argmin())
        indices = _spread(points, normals, min(self.size_mm), _POOL_DISTANCE_SHARE, _POOL, [first])
        return tuple(placement.surface_frame(self.scene.mesh, points[i], normals[i]) for i in indices)


def _spread(
    points_mm: np.ndarray, normals: np.ndarray, edge_mm: float, min_distance: float, most: int, first: Sequence[int]
) -> list[int]:
    """Choose at most `most` of the points, each as far as possible from those before and at least `min_distance` edges
    away; a surface that faces the other way counts as an edge away.
    """
    rows = np.concatenate([points_mm, normals * edge_mm / 2], 1)
    indices = list(first)
    distance = np.min([np.linalg.norm(rows - rows[i], axis=1) for i in indices], 0)
    while len(indices) < most and distance.max() >= min_distance * edge_mm:
        indices.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(rows - rows[indices[-1]], axis=1))
    return indices
