"""A scene: the object, the piece that hangs on it, and what is behind it, ready to be photographed.

In: a scene file. Out: `MeshScene`, which knows its sheet id (a hash of settings and seed, fixed before optimizing), the
layout of the printed piece (the design with its frame of markers; the marker size follows from the views), where the
card lies, and the camera of every drawn view.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from patchproof import geometry
from patchproof.scene.backgrounds import Backgrounds, load_backgrounds
from patchproof.scene.conditions import Conditions, draw
from patchproof.scene.mesh import Mesh, load_mesh
from patchproof.scene.placement import Card, Frame, patch_frame, place_card
from patchproof.settings import Refused, SceneSettings, expand, load_scene_settings
from patchproof.sheet.page import largest_piece_mm
from patchproof.sheet.piece import Piece, lay_out_piece, marker_size_mm, sheet_id
from patchproof.sheet.template import load_template

PX_PER_MODULE = 2.5  # a marker is read from about here on: 45 of 48 at 2.7 px with a blur of 0.7 px
READABLE_SHARE = 0.95  # of the views should show markers at least that large
MODULES = 7  # of a DICT_5X5 marker with its border, along one side
_VIEWS_TRIED = 1024

# Texels per pixel of the closest view at the network's size: finer ones average out before any network sees them.
_DESIGN_OVERSAMPLING = 1.5
_DESIGN_PX = (32, 512)


@dataclass(frozen=True)
class MeshScene:
    """Everything a photograph depends on but the design and the conditions."""

    settings: SceneSettings
    base: Path
    seed: int
    mesh: Mesh
    frame: Frame
    card: Card | None  # None, like `piece`, where there is only the object
    piece: Piece | None
    backgrounds: Backgrounds
    sheet_id: str
    unreadable_share: float  # of the views in which a marker's module is under PX_PER_MODULE
    warnings: tuple[str, ...]

    def draw(self, stream, n: int, seed: int | None = None, start: int = 0) -> Conditions:
        """Draws of one of the scene's streams, from the scene's own seed unless another is given."""
        return draw(self.settings, stream, n, self.seed if seed is None else seed, start)

    def camera_from_world(self, conditions: Conditions) -> np.ndarray:
        """N×4×4 poses of the drawn cameras."""
        patch_mm = self.frame.origin_mm if self.card is None else self.card.center_mm
        return camera_poses(self.settings, self.mesh, self.frame, patch_mm, conditions)

    def matrix_px(self, size_px: tuple[int, int]) -> np.ndarray:
        """3×3 pinhole matrix of the scene's camera for a picture of this size."""
        return geometry.intrinsics(self.settings.view.fov_deg, size_px)

    def piece_homographies(self, conditions: Conditions, size_px: tuple[int, int]) -> np.ndarray:
        """N×3×3 from piece millimetres to pixels."""
        matrix, card = self.matrix_px(size_px), self.card.world_from_piece
        return np.stack([geometry.plane_homography(matrix, pose, card) for pose in self.camera_from_world(conditions)])

    def design_px(self, network_px: int) -> tuple[int, int]:
        """(width, height) of the design: no more pixels than the closest view at the network's size can show."""
        view, patch = self.settings.view, self.settings.patch
        closest = max(view.distance_mm[0] - np.linalg.norm(self.card.center_mm), view.distance_mm[0] / 4)
        px_per_mm = network_px / (2 * closest * math.tan(math.radians(view.fov_deg) / 2)) * _DESIGN_OVERSAMPLING
        low, high = _DESIGN_PX
        scale = np.clip(
            px_per_mm, low / min(patch.width_mm, patch.height_mm), high / max(patch.width_mm, patch.height_mm)
        )
        return tuple(max(8, round(side * scale / 8) * 8) for side in (patch.width_mm, patch.height_mm))


def load_scene(path: str | Path, seed: int | None = None) -> MeshScene:
    """A scene file with its mesh, card, piece and backgrounds; `seed` replaces the file's own."""
    path = Path(path)
    return build_scene(load_scene_settings(path), path.resolve().parent, seed)


def build_scene(settings: SceneSettings, base: Path, seed: int | None = None) -> MeshScene:
    """The scene of settings whose paths are relative to `base`."""
    seed = settings.optimize.seed if seed is None else seed
    mesh = load_mesh(expand(settings.object.mesh, base), settings.object.length_mm, settings.object.up)
    patch = settings.patch
    frame = patch_frame(mesh, patch)
    design_mm = (patch.width_mm, patch.height_mm)
    bare = place_card(mesh, frame, design_mm, patch.spin_deg)
    scales = _smallest_scales(settings, mesh, frame, bare)
    if not len(scales):
        raise Refused("views from which the patch can be seen", "none", "turn azimuth_deg towards the patch's side")
    needed_mm = MODULES * PX_PER_MODULE / np.quantile(scales, 1 - READABLE_SHARE)
    identity = sheet_id(settings.model_dump(mode="json"), seed)
    page_mm = largest_piece_mm(load_template(settings.sheet.template))
    largest_mm = (min(frame.extent_mm[0], page_mm[0]), min(frame.extent_mm[1], page_mm[1]))
    marker_mm = marker_size_mm(float(needed_mm), design_mm, largest_mm)
    piece = lay_out_piece(design_mm, marker_mm, identity, "design")
    card = place_card(mesh, frame, piece.size_mm, patch.spin_deg)
    unreadable = float((scales * piece.module_mm < PX_PER_MODULE * 0.999).mean())
    backgrounds = load_backgrounds(settings.background, base)
    warnings = (*mesh.warnings, *card.warnings, *_unreadable_warning(unreadable, marker_mm))
    return MeshScene(settings, base, seed, mesh, frame, card, piece, backgrounds, identity, unreadable, warnings)


def bare_scene(settings: SceneSettings, mesh: Mesh, backgrounds: Backgrounds) -> MeshScene:
    """An object with no piece on it, to be photographed as it is."""
    frame = patch_frame(mesh, settings.patch)
    return MeshScene(
        settings, Path(), settings.optimize.seed, mesh, frame, None, None, backgrounds, "", 0.0, mesh.warnings
    )


def camera_poses(settings: SceneSettings, mesh: Mesh, frame: Frame, patch_mm, conditions: Conditions) -> np.ndarray:
    """`camera_from_world` N×4×4: on an orbit about what the camera looks at, azimuth 0 facing the patch's side."""
    center = np.zeros(3) if settings.view.look_at == "object" else np.asarray(patch_mm)
    targets = center + conditions.look_at_offset * settings.object.length_mm
    directions = geometry.orbit(conditions.azimuth_deg, conditions.elevation_deg, frame.normal, frame.up)
    eyes = targets + conditions.distance_mm[:, None] * directions
    _refuse_inside(mesh, eyes)
    return np.stack(
        [
            geometry.look_at(eye, target, roll, frame.up)
            for eye, target, roll in zip(eyes, targets, conditions.roll_deg, strict=True)
        ]
    )


def _smallest_scales(settings: SceneSettings, mesh: Mesh, frame: Frame, card: Card) -> np.ndarray:
    """px per mm at the card's middle, along the foreshortened direction, over views that face it."""
    conditions = draw(settings, "select", _VIEWS_TRIED, 0)
    poses = camera_poses(settings, mesh, frame, card.center_mm, conditions)
    matrix = geometry.intrinsics(settings.view.fov_deg, settings.camera.photo_px)
    scales = []
    for pose in poses:
        eye = -pose[:3, :3].T @ pose[:3, 3]
        if (eye - card.center_mm) @ card.normal <= 0:
            continue
        homography = geometry.plane_homography(matrix, pose, card.world_from_piece)
        mean, tilt = geometry.local_scale(homography, np.array(card.size_mm) / 2)
        scales.append(mean * math.sqrt(math.cos(math.radians(tilt))))
    return np.array(scales)


def _refuse_inside(mesh: Mesh, eyes: np.ndarray) -> None:
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    inside = ((eyes > low) & (eyes < high)).all(1)
    if inside.any():
        raise Refused(
            f"cameras outside the object ({high[0] - low[0]:.0f} × {high[1] - low[1]:.0f} × {high[2] - low[2]:.0f} mm)",
            f"{inside.sum()} of {len(eyes)} views inside its bounding box",
            "raise view.distance_mm",
        )


def _unreadable_warning(share: float, marker_mm: float) -> tuple[str, ...]:
    if share <= 1 - READABLE_SHARE:
        return ()
    return (f"markers of {marker_mm:.1f} mm, the largest that fit, will be unreadable in {share:.0%} of the views",)
