"""The object from all around, for a page that turns it by a slider.

In: a stage with a mesh, and what is printed on the piece. Out: `Turn`s, pictures from a ring of directions, all at one
scale, seen from far away in even light. A piece on top is looked down at, one below looked up at.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from patchproof.app.begin.sides import ROOM
from patchproof.base.geometry import UP, orbit
from patchproof.render.stage import Stage
from patchproof.reprints.hung import straight_picture
from patchproof.scene.mesh_scene import needs_mesh
from patchproof.scene.patch_scene import PatchScene
from patchproof.scene.placement import Frame

STEP_DEG = 15
PICTURE_PX = 320  # along the longer side: 24 take 0.8 s, at 400 px 1.1 s of a preview's 4.5
_ABOVE_DEG, _STEEPEST_DEG = 20.0, 55.0


@dataclass(frozen=True)
class Turn:
    """The object seen from `azimuth_deg` to the right of the side that the piece or the scene's front is on; the
    picture is uint8 H×W×3.
    """

    azimuth_deg: int
    picture: np.ndarray


def turntable(stage: Stage, on_piece: np.ndarray | None) -> tuple[Turn, ...]:
    """The ring from 180 degrees down to -165, so that what faces the camera moves to the right from one to the next;
    `on_piece` (uint8 h×w×3) is shown on the piece of a scene that has one.
    """
    scene = needs_mesh(stage.scene)
    x, y, z = scene.normal
    front = np.array([x, 0.0, z]) if np.hypot(x, z) > 1e-3 else np.array([0.0, 0.0, 1.0])
    slope_deg = float(np.degrees(np.arcsin(np.clip(y, -1, 1))))
    elevation_deg = float(np.clip(_ABOVE_DEG + slope_deg, -_STEEPEST_DEG, _STEEPEST_DEG))
    azimuths = range(180, -180, -STEP_DEG)
    frames = [_frame(orbit(azimuth, elevation_deg, front), scene.frame) for azimuth in azimuths]
    points = scene.mesh.vertices
    if isinstance(scene, PatchScene):  # a piece may go beyond the object
        points = np.concatenate([points, scene.placement.vertices_mm])
    half_mm = np.max([np.abs(points @ np.stack([f.right, f.up], 1)).max(0) for f in frames], axis=0)
    return tuple(
        Turn(azimuth, straight_picture(stage, frame, half_mm * ROOM, PICTURE_PX, on_piece))
        for azimuth, frame in zip(azimuths, frames, strict=True)
    )


def _frame(toward: np.ndarray, like: Frame) -> Frame:
    """The upright frame that faces a direction."""
    right = np.cross(UP, toward)
    right /= np.linalg.norm(right)
    return Frame(right, np.cross(toward, right), toward, like.origin_mm, like.extent_mm)
