"""The object from its six sides, with a ground line, a scale bar and the piece where it lies.

In: a scene with a mesh, with a piece on it or without. Out: `SideView`s, all at one scale, and the piece's gap and
stretch as colors. The sides are those that `patch.side` names; front and back are along z, since that is where glTF's
standard has them and where `object.up = "z"` turns the y of other programs to.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

import numpy as np

from patchproof.base.strict import Side
from patchproof.mesh.mesh import Mesh
from patchproof.render.stage import Stage
from patchproof.reprints.hung import straight_picture
from patchproof.scene.bend import STRETCH_LIMIT
from patchproof.scene.mesh_scene import MeshScene, needs_mesh
from patchproof.scene.patch_scene import PatchScene
from patchproof.scene.placement import Placement, gap_limit_mm, side_frame

SIDE_NAMES: dict[Side, str] = {
    "+z": "front",
    "-z": "back",
    "-x": "left",
    "+x": "right",
    "+y": "top",
    "-y": "bottom",
}
PICTURE_PX = 320
ROOM = 1.12  # of the largest extent
_BAR_SHARE = 0.35  # of the picture's width at most
# five colors of viridis, legible to the color-blind; and one that is none of them
RAMP = ((68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37))
NO_SURFACE = (230, 0, 90)


@dataclass(frozen=True)
class SideView:
    """The object seen straight from one side, a square of `PICTURE_PX`."""

    side: Side
    name: str
    picture: np.ndarray  # uint8
    ground_px: float | None  # row of the ground under an upright view
    bar_mm: float
    bar_px: float
    holds_piece: bool


def side_views(stage: Stage) -> tuple[SideView, ...]:
    """All six of a stage's object, front first, the piece colored by its gap."""
    scene = needs_mesh(stage.scene)
    half_mm = _half_mm(scene)
    bar_mm = round_length(2 * half_mm * _BAR_SHARE)
    return tuple(
        SideView(
            side=side,
            name=name,
            picture=_picture(stage, side, half_mm),
            ground_px=None
            if side[1] == "y"
            else PICTURE_PX * (0.5 - float(scene.mesh.vertices[:, 1].min()) / 2 / half_mm),
            bar_mm=bar_mm,
            bar_px=bar_mm / (2 * half_mm) * PICTURE_PX,
            holds_piece=isinstance(scene, PatchScene) and side_of(scene.placement.normal) == side,
        )
        for side, name in SIDE_NAMES.items()
    )


def side_of(direction: np.ndarray) -> Side:
    """The side that faces most nearly in a direction of the world."""
    axis = int(np.abs(direction).argmax())
    return get_args(Side)[2 * axis + int(direction[axis] < 0)]


def round_length(most_mm: float) -> float:
    """The largest 1, 2 or 5 times a power of ten that is no longer."""
    power = 10.0 ** np.floor(np.log10(most_mm))
    return float(power * max(step for step in (1, 2, 5) if step * power <= most_mm * (1 + 1e-9)))


def extent_mm(mesh: Mesh) -> tuple[float, float, float]:
    """Width, height and depth of the object as one faces its front."""
    width, height, depth = np.ptp(mesh.vertices, axis=0).tolist()
    return width, height, depth


def gap_colors(placement: Placement) -> np.ndarray:
    """uint8 N×N×3 over the piece: 0 to `gap_limit_mm` from dark to light, `NO_SURFACE` where nothing is under it."""
    colors = ramp(placement.gaps_mm / gap_limit_mm(placement.size_mm))
    colors[np.isnan(placement.gaps_mm)] = NO_SURFACE
    return colors


def stretch_colors(placement: Placement) -> np.ndarray:
    """uint8 N×N×3 over the piece: 0 to `STRETCH_LIMIT` from dark to light."""
    return ramp(placement.stretches / STRETCH_LIMIT)


def ramp(shares: np.ndarray) -> np.ndarray:
    """uint8 ...×3: colors of shares in [0, 1]; beyond, those of the ends."""
    stops = np.linspace(0, 1, len(RAMP))
    at = np.nan_to_num(shares)
    return np.stack([np.interp(at, stops, column) for column in np.array(RAMP, float).T], -1).round().astype(np.uint8)


def _half_mm(scene: MeshScene) -> float:
    reach = np.abs(scene.mesh.vertices).max()
    if isinstance(scene, PatchScene):
        reach = max(reach, np.abs(scene.placement.vertices_mm).max())
    return float(reach) * ROOM


def _picture(stage: Stage, side: Side, half_mm: float) -> np.ndarray:
    scene, colors = needs_mesh(stage.scene), None
    frame = side_frame(scene.mesh, side)
    if isinstance(scene, PatchScene) and (scene.placement.normals @ frame.normal).max() > 1e-6:
        colors = gap_colors(scene.placement)
    return straight_picture(stage, frame, np.array([half_mm, half_mm]), PICTURE_PX, colors)
