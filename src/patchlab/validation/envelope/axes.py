"""Axes of an operating envelope: tilt, distance, light, camera, paper and print, one number each.

In: a scene. Out: `AXES`: for every axis its unit and the sweep from an easy to a hard end that suits the scene; drawn
conditions (`conditions_at`) and the scene (`scene_at`) at a point. Everything that a point does not name stays as
drawn, so that points of a sweep differ in nothing else.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from patchproof.base.errors import Refused
from patchproof.mesh.surface_chart import grid_faces, piece_grid
from patchproof.scene.bent_scene import PIECE_GRID
from patchproof.scene.conditions import Conditions, with_values
from patchproof.scene.interface import Scene
from patchproof.scene.patch_scene import require_patch
from patchproof.scene.placement import Placement

SweepPoint = Mapping[str, float]
"""Values by axis; all others are as drawn, or as the run has them."""

AxisEnds = Callable[[Scene], tuple[float, float]]


@dataclass(frozen=True)
class Axis:
    """One quantity from easy to hard: `ends` are (easy, hard); steps multiply if `ratio`, else they add."""

    title: str
    unit: str
    ends: AxisEnds
    ratio: bool = False
    needs_mesh: bool = True

    def values(self, easy: float, hard: float, points: int) -> np.ndarray:
        """Evenly spaced values from easy to hard, geometrically if `ratio`."""
        return np.geomspace(easy, hard, points) if self.ratio else np.linspace(easy, hard, points)


def _distances(scene: Scene) -> tuple[float, float]:
    """From the scene's nearest distance to where a marker's module is two thirds of a pixel."""
    patch, nearest = require_patch(scene), scene.settings.view.distance_mm[0]
    far = 1.5 * patch.focal_px * patch.piece.module_mm
    return nearest, max(far, 2 * nearest)


def _radii(scene: Scene) -> tuple[float, float]:
    width, _ = require_patch(scene).placement.size_mm
    return 8 * width, 0.35 * width


def _pixels(share: float) -> Callable[[Scene], float]:
    return lambda scene: share * min(scene.settings.camera.photo_px)


AXES: dict[str, Axis] = {
    "tilt": Axis("tilt", "° off the patch's axis", lambda scene: (0.0, 88.0)),
    "distance": Axis("distance", "mm", _distances, ratio=True),
    "blur": Axis(
        "blur",
        "px (sigma)",
        lambda scene: (_pixels(1 / 3000)(scene), _pixels(1 / 30)(scene)),
        ratio=True,
        needs_mesh=False,
    ),
    "darkness": Axis("darkness", "stops under", lambda scene: (0.0, 9.0), needs_mesh=False),
    # noise as strong as white still leaves an answer, since networks downscale photographs; 16 hides the demo's truck
    "noise": Axis("noise", "of white", lambda scene: (0.02, 16.0), ratio=True, needs_mesh=False),
    "jpeg": Axis("JPEG", "quality", lambda scene: (95.0, 1.0), ratio=True, needs_mesh=False),
    "hidden": Axis("hidden corners", "quarters", lambda scene: (0.0, 4.0), needs_mesh=False),
    "curl": Axis("curl", "mm radius", _radii, True),
    "gap": Axis("gap behind", "mm", lambda scene: (0.0, round((scene.settings.object.length_mm or 0) / 3))),
    "mismatch": Axis("print mismatch", "× other printer", lambda scene: (0.0, 6.0), needs_mesh=False),
    "size": Axis("patch size", "× its own", lambda scene: (1.0, 0.1), ratio=True),
}
PAPER_AXES = ("curl", "gap")  # axes that change the piece or its place on the object


def is_possible(scene: Scene, name: str) -> bool:
    """True if this scene can be photographed at other values of the axis."""
    if not scene.HAS_OBJECT:
        return not AXES[name].needs_mesh
    return name != "curl" or require_patch(scene).placement.is_flat


def conditions_at(conditions: Conditions, point: SweepPoint) -> Conditions:
    """Conditions with camera and light at the point."""
    for axis, value in point.items():
        if axis == "tilt":
            conditions = _tilt_cameras(conditions, value)
        elif axis == "darkness":
            conditions = with_values(conditions, exposure_ev=-value)
        elif axis == "size":
            conditions = with_values(conditions, printed_scale=value * conditions.pose.printed_scale)
        elif axis in _FIELD_OF_AXIS:
            conditions = with_values(conditions, **{_FIELD_OF_AXIS[axis]: value})
    return conditions


_FIELD_OF_AXIS = {"distance": "distance_mm", "blur": "blur_px", "noise": "noise", "jpeg": "jpeg"}


def scene_at(scene: Scene, point: SweepPoint) -> Scene:
    """The scene with its piece moved off the surface, or curled, as the point says."""
    if not point.keys() & PAPER_AXES:
        return scene
    scene = require_patch(scene)
    placement = scene.placement
    if "curl" in point:
        placement = _curl_card(placement, point["curl"])
    if "gap" in point:
        off, frame = point["gap"] * placement.normal, placement.world_from_piece.copy()
        frame[:3, 3] += off
        placement = replace(placement, vertices_mm=placement.vertices_mm + off, world_from_piece=frame)
    return replace(scene, placement=placement)


def _tilt_cameras(conditions: Conditions, tilt_deg: float) -> Conditions:
    """Move each camera to this angle off the side's axis, in its former direction."""
    azimuth, elevation = np.radians(conditions.pose.azimuth_deg), np.radians(conditions.pose.elevation_deg)
    right, up = np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
    toward = np.arctan2(up, right)
    tilt = np.radians(tilt_deg)
    right, up = np.sin(tilt) * np.cos(toward), np.sin(tilt) * np.sin(toward)
    elevation = np.degrees(np.arcsin(up.clip(-1, 1)))
    azimuth = np.degrees(np.arctan2(right, np.cos(tilt)))
    return with_values(conditions, azimuth_deg=azimuth, elevation_deg=elevation)


def _curl_card(card: Placement, radius_mm: float) -> Placement:
    """Curl the left and right edges of a flat card off the object, on a cylinder that touches it along its middle.

    Nothing is fitted to the surface, and no gap is refused: badly glued paper does this.
    """
    if not card.is_flat:
        raise Refused("a flat card to curl", f"a piece on a {card.family}", "leave out bend")
    across, inward = card.world_from_piece[:3, [0, 2]].T
    points, width = piece_grid(card.size_mm, PIECE_GRID) * [1, -1] + np.array(card.size_mm) / 2, card.size_mm[0]
    scale = float(np.linalg.norm(across))  # a print may be larger than its millimeters say
    angle = (points[:, :1] - width / 2) * scale / radius_mm
    flat = np.concatenate([width / 2 + radius_mm / scale * np.sin(angle), points[:, 1:]], 1)
    offsets = radius_mm * (1 - np.cos(angle)) * inward
    normals = -np.sin(angle) * across / scale - np.cos(angle) * inward
    curled = replace(
        card, vertices_mm=card.world(flat) - offsets, faces=grid_faces(PIECE_GRID, PIECE_GRID), normals=normals
    )
    return replace(curled, family="curled", piece_mm=points, reason=f"curled to a radius of {radius_mm:.0f} mm")
