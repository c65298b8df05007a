"""Where on an object a piece can lie: places all over its surface, evenly spread.

In: an `UnplacedScene`, whose `patch.search` says what is wanted. Out: `CandidatePlace`s, each good for `OpenScene.at`. Points are
sampled evenly over the surface (the same ones for the same seed) and left out where hardly any view faces them. From
each, the piece is moved until one level part of the surface lies under it, and laid down there as a given piece is.
What is refused, overhangs, stands too far off or lies on what is to be kept free is no place.
Left out on purpose: what stands before a place. The networks will tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import get_args

import numpy as np

from patchproof.base.errors import Refused
from patchproof.base.geometry import camera_centers
from patchproof.base.validation import Side
from patchproof.mesh.surface_chart import SurfaceChart, piece_grid, surface_heights, triangles_near
from patchproof.scene.bend import placement_method
from patchproof.scene.canvas import select_faces
from patchproof.scene.fitting import place_if_close
from patchproof.scene.open_scene import UnplacedScene
from patchproof.scene.patch_scene import PiecePosition
from patchproof.scene.placement import (
    WARN_OVERHANG_SHARE,
    Placement,
    SurfaceFrame,
    gap_limit_mm,
    patch_frame,
    spun_axes,
    surface_frame,
)

MIN_DISTANCE_SHARE = 0.5  # of the piece's shorter edge between two places
_POOL_APART, _POOL = 0.25, 96  # the same between points that are tried, and how many at most
_SAMPLES_APART, _SAMPLES = 1 / 16, 100_000  # and between those that stand for the surface
_VIEWS, _FACING_SHARE, _FACING_COSINE = 64, 0.2, 0.26  # a fifth of the views at least, less than 75° from the normal
_NET, _MOVES = 17, 4  # points along each edge under which a place is leveled, and how often the piece is moved
_COARSE_OVERHANG = 0.07  # of these points: one row of 17 may just miss the edge
_SAME_SIDE = 0.97  # cosine of 15°: a point that is moved onto what faces elsewhere is no place


@dataclass(frozen=True)
class CandidatePlace:
    """A place for the piece, as the keys `at_mm` (or `side`) and `spin_deg` say it, and how it lies there."""

    at: PiecePosition
    spin_deg: float
    placement: Placement


@dataclass(frozen=True)
class PlaceFinder:
    """An object's surface, where a piece looks for a place."""

    scene: UnplacedScene

    def spots(self, most: int) -> tuple[CandidatePlace, ...]:
        """At most `most` places, one spin each, at least `MIN_DISTANCE_SHARE` from each other and as far as their number allows;
        refused where there is none.
        """
        sides = [spot for side in get_args(Side) if (spot := self._middle_of(side)) is not None]
        fitting = sides + [spot for frame in self._tried if (spot := self._first(frame)) is not None]
        if not fitting:
            expected = f"a place for a piece of {self.size_mm[0]:.0f} × {self.size_mm[1]:.0f} mm that views face"
            do = "make it smaller, let it bend, or ask less of patch.search"
            raise Refused(expected, "none", do)
        middles = np.array([spot.placement.center_mm for spot in fitting])
        normals = np.array([spot.placement.normal for spot in fitting])
        first = range(max(len(sides), 1))
        return tuple(fitting[i] for i in _spread(middles, normals, min(self.size_mm), MIN_DISTANCE_SHARE, most, first))

    def turned(self, spot: CandidatePlace) -> tuple[CandidatePlace, ...]:
        """About the same place with the other spins that fit there."""
        frame = self._frame_at(spot.at)
        turns = (self._fitting(frame, spin) for spin in self._spins if spin != spot.spin_deg)
        return tuple(turn for turn in turns if turn is not None)

    @property
    def size_mm(self) -> tuple[float, float]:
        """The piece's."""
        return self.scene.settings.patch.size_mm

    @property
    def _spins(self) -> tuple[float, ...]:
        """Turns that differ: a design may be drawn upside down, and on a square sideways, too."""
        width, height = self.size_mm
        if self.scene.settings.patch.search.upright:
            return (0.0,)
        return (0.0, 45.0) if np.isclose(width, height) else (0.0, 90.0, 45.0, 135.0)

    def _middle_of(self, side: Side) -> CandidatePlace | None:
        """The middle of a side that views face, where a piece hangs by default; how far off, only `gap_mm` limits."""
        frame, patch = self._frame_at(side), self.scene.settings.patch
        if self._facing(frame.origin_mm[None], frame.normal[None])[0] < _FACING_SHARE:
            return None
        gap_mm = np.inf if patch.search.gap_mm is None else patch.search.gap_mm
        return self._spot(side, frame, 0.0, gap_mm, 1.0)

    def _facing(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """M shares of the views that face the points M×3."""
        rays = (eye - points for eye in self._eyes)
        cosines = [(ray * normals).sum(1) / np.linalg.norm(ray, axis=1) for ray in rays]
        return (np.array(cosines) > _FACING_COSINE).mean(0)

    def _first(self, frame: SurfaceFrame) -> CandidatePlace | None:
        """The piece near a frame's origin, upright if it fits so, else a quarter turned."""
        return next((spot for spin in self._spins[:2] if (spot := self._fitting(frame, spin)) is not None), None)

    def _fitting(self, frame: SurfaceFrame, spin_deg: float) -> CandidatePlace | None:
        """The piece near a frame's origin; None where it does not fit."""
        middle = self._leveled(frame, spin_deg)
        if middle is None:
            return None
        x, y, z = (round(value, 1) + 0.0 for value in middle.tolist())  # what a person would write down
        at_mm = (x, y, z)
        there = self._frame_at(at_mm)
        if there.normal @ frame.normal < _SAME_SIDE:
            return None
        return self._spot(at_mm, there, spin_deg, self._gap_mm, WARN_OVERHANG_SHARE)

    def _spot(
        self, at: PiecePosition, frame: SurfaceFrame, spin_deg: float, gap_mm: float, overhang_share: float
    ) -> CandidatePlace | None:
        """The piece at a frame; None where it does not lie within these bounds, or on what is to be kept free."""
        lay = placement_method(self.scene.settings.patch.bend)
        laid = place_if_close(self.scene.mesh, frame, self.size_mm, spin_deg, lay, gap_mm, overhang_share)
        return None if laid is None or self._touches_forbidden(laid) else CandidatePlace(at, spin_deg, laid)

    def _leveled(self, frame: SurfaceFrame, spin_deg: float) -> np.ndarray | None:
        """The frame's origin, moved until what lies under the piece is as high as its middle; None where that fails."""
        right, up = spun_axes(frame, spin_deg)
        reach = float(np.hypot(*self.size_mm)) / 2
        near, points, middle = (
            triangles_near(self._triangles, frame.origin_mm, 2 * reach),
            piece_grid(self.size_mm, _NET),
            _NET**2 // 2,
        )
        origin = frame.origin_mm
        for _ in range(_MOVES):
            chart = SurfaceChart(origin, np.stack([right, up, frame.normal]), 0.0, np.array([1.0, 0.0]))
            surface = surface_heights(chart, near, self.size_mm, _NET, (-reach, reach))
            level = np.abs(surface - surface[middle]) <= self._gap_mm
            lies = np.isfinite(surface) if self.scene.settings.patch.bend else level
            if lies.mean() >= 1 - _COARSE_OVERHANG:
                return origin + surface[middle] * frame.normal
            if not level.any():
                return None
            # what a strip along one edge lacks moves the mean of the rest by half of its width
            x, y = 2 * points[level].mean(0)
            origin = origin + x * right + y * up
        return None

    def _frame_at(self, at: PiecePosition) -> SurfaceFrame:
        """The frame that a piece at a point has."""
        return patch_frame(self.scene.mesh, self.scene.given(at, 0.0).patch)

    @property
    def _gap_mm(self) -> float:
        return self.scene.settings.patch.search.gap_mm or gap_limit_mm(self.size_mm)

    @cached_property
    def _eyes(self) -> np.ndarray:
        """Where the cameras of the views stand that are asked what they face."""
        return camera_centers(self.scene.camera_from_world(self.scene.draw("train", _VIEWS)))

    @cached_property
    def _triangles(self) -> np.ndarray:
        return self.scene.mesh.vertices[self.scene.mesh.faces]

    @cached_property
    def _samples(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points M×3 evenly over the surface, their faces' normals M×3 and numbers M."""
        a, b, c = self._triangles.transpose(1, 0, 2)
        cross = np.cross(b - a, c - a)
        doubled = np.linalg.norm(cross, axis=1)
        apart_mm = _SAMPLES_APART * min(self.size_mm)
        count = int(np.clip(doubled.sum() / 2 / apart_mm**2, 1000, _SAMPLES))
        rng = np.random.default_rng(self.scene.seed)
        share = (np.arange(count) + rng.random(count)) / count
        face = np.searchsorted(np.cumsum(doubled) / doubled.sum(), share).clip(max=len(doubled) - 1)
        u, v = rng.random((2, count, 1))
        u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
        points = a[face] + u * (b - a)[face] + v * (c - a)[face]
        return points, (cross / doubled[:, None])[face], face

    @cached_property
    def _tried(self) -> tuple[SurfaceFrame, ...]:
        """Frames of the points that are tried, the one next to the middle of the scene's front first."""
        points, normals, _ = self._samples
        faced = self._facing(points, normals) >= _FACING_SHARE
        points, normals = points[faced], normals[faced]
        if not len(points):
            return ()
        first = int(np.linalg.norm(points - self.scene.frame.origin_mm, axis=1).argmin())
        edge_mm = min(self.size_mm)
        chosen = _spread(points, normals, edge_mm, _POOL_APART, _POOL, [first])
        return tuple(surface_frame(self.scene.mesh, points[i], normals[i]) for i in chosen)

    @cached_property
    def _forbidden(self) -> np.ndarray:
        """Which of the sampled points are to be kept free."""
        search = self.scene.settings.patch.search
        faces = select_faces(self.scene.mesh, search.keep_off, search.keep_off_faces, self.scene.base)
        return faces[self._samples[2]]

    def _touches_forbidden(self, laid: Placement) -> bool:
        """Whether a point of the piece lies nearest to one that is to be kept free, of those that face as it does."""
        from scipy.spatial import KDTree

        points, normals, _ = self._samples
        below = normals @ laid.normal > 0
        if not (self._forbidden & below).any():
            return False
        paper = laid.world(piece_grid(self.size_mm, _NET) * [1, -1] + np.array(self.size_mm) / 2)
        return bool(self._forbidden[below][KDTree(points[below]).query(paper)[1]].any())


def _spread(
    points_mm: np.ndarray, normals: np.ndarray, edge_mm: float, apart: float, most: int, first: Sequence[int]
) -> list[int]:
    """At most `most` of the points, each as far as can be from those before, `apart` edges at least; what faces the
    other way is as far as an edge.
    """
    rows = np.concatenate([points_mm, normals * edge_mm / 2], 1)
    chosen = list(first)
    distance = np.min([np.linalg.norm(rows - rows[i], axis=1) for i in chosen], 0)
    while len(chosen) < most and distance.max() >= apart * edge_mm:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(rows - rows[chosen[-1]], axis=1))
    return chosen
