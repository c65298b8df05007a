"""A scene with a mesh: the object, the piece that hangs on it, and what is behind it, ready to be photographed.

In: settings. Out: `MeshScene`, which knows its sheet id (a hash of settings and seed, fixed before optimizing), the
layout of the printed piece (the design with its frame of markers; the marker size follows from the views), where the
piece lies, and the camera of every drawn view. Where the object's own texture is what changes, there is no piece.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from patchproof import geometry
from patchproof.channel import lens
from patchproof.channel.effects import Pose
from patchproof.mesh.load_mesh import load_mesh
from patchproof.mesh.mesh import Mesh
from patchproof.scene.backgrounds import Backgrounds, load_backgrounds
from patchproof.scene.bend import place_bent
from patchproof.scene.conditions import Conditions, draw
from patchproof.scene.placement import Frame, Placement, patch_frame, place_card
from patchproof.scene.resolution import PX_PER_MODULE, READABLE_SHARE, design_grid
from patchproof.scene.texture import Canvas, texture_canvas
from patchproof.settings import SceneSettings, identifying
from patchproof.sheets.page import largest_piece_mm
from patchproof.sheets.piece import MODULES, Piece, lay_out_piece, marker_size_mm, sheet_id
from patchproof.sheets.template import load_template
from patchproof.sheets.tiles import plan_tiles
from patchproof.strict import Refused, expand

_VIEWS_TRIED = 1024
CLEARANCE = 5e-3  # of the object's length between it and a camera: what is nearer than the near plane would vanish


@dataclass(frozen=True)
class MeshScene:
    """Everything a photograph depends on but what is optimized and the conditions."""

    settings: SceneSettings
    base: Path
    seed: int
    mesh: Mesh
    frame: Frame
    placement: Placement | None  # None, like `piece`, where there is only the object
    piece: Piece | None
    backgrounds: Backgrounds
    sheet_id: str
    unreadable_share: float  # of the views in which a marker's module is under PX_PER_MODULE
    warnings: tuple[str, ...]
    canvas: Canvas | None = None  # what of the object's own texture may change
    camera: lens.Camera | None = field(default=None)  # a calibrated one
    given_glb: bytes | None = None  # the mesh, where it was given in Python

    def draw(self, stream, n: int, seed: int | None = None, start: int = 0) -> Conditions:
        """Draws of one of the scene's streams, from the scene's own seed unless another is given."""
        return draw(self.settings, stream, n, self.seed if seed is None else seed, start)

    @property
    def length_mm(self) -> float:
        """The object's longest extent."""
        if self.settings.object.length_mm is None:
            raise ValueError("a mesh has a length")
        return self.settings.object.length_mm

    @property
    def middle_mm(self) -> np.ndarray:
        """The middle of the piece in the world; without one, of the side it would face."""
        return self.frame.origin_mm if self.placement is None else self.placement.center_mm

    def camera_from_world(self, conditions: Conditions) -> np.ndarray:
        """N×4×4 poses of the drawn cameras."""
        return camera_poses(self.settings, self.mesh, self.frame, self.middle_mm, conditions.pose)

    def camera_from_print(self, conditions: Conditions) -> np.ndarray:
        """N×4×4 from the world, with its piece at the sheet's own size, to cameras that see it as large as it was
        printed: all about the piece's middle is scaled, which keeps a card in its plane.
        """
        scales = [geometry.scaled_about(self.middle_mm, scale) for scale in conditions.pose.printed_scale]
        return self.camera_from_world(conditions) @ np.stack(scales)

    def matrix_px(self, size_px: tuple[int, int]) -> np.ndarray:
        """3×3 pinhole matrix of the scene's camera for a picture of this size."""
        if self.camera is not None:
            return lens.matrix_px(self.camera, size_px)
        return geometry.intrinsics(self.settings.view.fov_deg, size_px)

    def piece_homographies(self, conditions: Conditions, size_px: tuple[int, int]) -> np.ndarray:
        """N×3×3 from piece millimetres to pixels of the pinhole picture; of a bent piece, its tangent plane's."""
        matrix, plane = self.matrix_px(size_px), self.placement.world_from_piece
        return np.stack([geometry.plane_homography(matrix, pose, plane) for pose in self.camera_from_print(conditions)])

    def piece_azimuth_deg(self, conditions: Conditions) -> np.ndarray:
        """N angles of the camera to the right of the piece's middle, beyond 90 where its face is turned away."""
        middle = np.array(self.placement.size_mm) / 2
        poses = self.camera_from_world(conditions) @ self.placement.world_from_piece
        return np.array([geometry.view_angles(pose, middle)[0] for pose in poses])

    def white_light(self, conditions: Conditions) -> np.ndarray:
        """N: the light on white paper at the piece's middle, without lamps."""
        frame, light = self.frame, conditions.light
        toward = geometry.orbit(light.light_azimuth_deg, light.light_elevation_deg, frame.normal, frame.up)
        return light.ambient + light.directional * np.clip(toward @ self.placement.normal, 0, None)

    def closest_px_per_mm(self, size_px: tuple[int, int]) -> float:
        """Pixels per millimetre of the piece in the closest view."""
        nearest = self.settings.view.distance_mm[0]
        closest_mm = max(nearest - float(np.linalg.norm(self.middle_mm)), nearest / 4)
        return float(self.matrix_px(size_px)[0, 0]) / closest_mm

    def design_px(self, network_px: int) -> tuple[int, int]:
        """(width, height) of the design: no more pixels than the closest view at the network's size can show."""
        return design_grid(self.closest_px_per_mm((network_px, network_px)), self.piece.design_rect_mm[2:])


def load_mesh_scene(
    settings: SceneSettings, base: Path, seed: int, identity: str | None = None, given_glb: bytes | None = None
) -> MeshScene:
    """The scene with its mesh, piece (or canvas) and backgrounds; paths are relative to `base`."""
    settings_object, camera = settings.object, settings.camera
    mesh = load_mesh(expand(settings_object.mesh, base), settings_object.length_mm, settings_object.up, given_glb)
    own = {} if given_glb is None else {"mesh": hashlib.sha256(given_glb).hexdigest()}
    frame, identity = patch_frame(mesh, settings.patch), identity or sheet_id(identifying(settings) | own, seed)
    backgrounds = load_backgrounds(settings.background, base)
    calibrated = None if camera.file is None else lens.load_camera(camera.file, base, camera.photo_px)
    ground = {"settings": settings, "base": base, "seed": seed, "frame": frame, "backgrounds": backgrounds}
    ground |= {"sheet_id": identity, "camera": calibrated, "given_glb": given_glb}
    if settings.patch.kind != "patch":
        canvas = texture_canvas(mesh, settings.patch, base)
        notes = (*mesh.warnings, *canvas.warnings)
        return MeshScene(
            mesh=canvas.mesh, placement=None, piece=None, unreadable_share=0.0, warnings=notes, canvas=canvas, **ground
        )
    piece, placement, unreadable, notes = _hang(settings, mesh, frame, identity, calibrated)
    notes = (*mesh.warnings, *placement.warnings, *notes)
    return MeshScene(mesh=mesh, placement=placement, piece=piece, unreadable_share=unreadable, warnings=notes, **ground)


def _hang(
    settings: SceneSettings, mesh: Mesh, frame: Frame, identity: str, camera
) -> tuple[Piece, Placement, float, tuple[str, ...]]:
    """The piece with markers as large as the views need, and where it lies."""
    patch, place = settings.patch, place_bent if settings.patch.bend else place_card
    design_mm = (patch.width_mm, patch.height_mm)
    scales = _smallest_scales(settings, mesh, frame, place(mesh, frame, design_mm, patch.spin_deg), camera)
    if not len(scales):
        raise Refused("views from which the patch can be seen", "none", "turn azimuth_deg towards the patch's side")
    needed_mm = MODULES * PX_PER_MODULE / np.quantile(scales, 1 - READABLE_SHARE)
    template = load_template(settings.sheet.template)
    page_mm = largest_piece_mm(template)
    largest_mm = page_mm if patch.bend else tuple(min(a, b) for a, b in zip(frame.extent_mm, page_mm, strict=True))
    marker_mm = marker_size_mm(float(needed_mm), design_mm, largest_mm)
    piece = lay_out_piece(design_mm, marker_mm, identity, "design")
    if template.tiles is not None:
        plan_tiles(template, piece)  # refuses what no sheet could be made of, before hours of optimizing
    unreadable = float((scales * piece.module_mm < PX_PER_MODULE * 0.999).mean())
    placement = place(mesh, frame, piece.size_mm, patch.spin_deg)
    return piece, placement, unreadable, _unreadable_warning(unreadable, marker_mm)


def bare_scene(settings: SceneSettings, mesh: Mesh, backgrounds: Backgrounds) -> MeshScene:
    """An object with no piece on it, to be photographed as it is."""
    frame = patch_frame(mesh, settings.patch)
    seed = settings.optimize.seed
    return MeshScene(settings, Path(), seed, mesh, frame, None, None, backgrounds, "", 0.0, mesh.warnings)


def camera_poses(settings: SceneSettings, mesh: Mesh, frame: Frame, patch_mm, pose: Pose) -> np.ndarray:
    """`camera_from_world` N×4×4: on an orbit about what the camera looks at, azimuth 0 facing the patch's side."""
    center = np.zeros(3) if settings.view.look_at == "object" else np.asarray(patch_mm)
    targets = center + pose.look_at_offset * settings.object.length_mm
    directions = geometry.orbit(pose.azimuth_deg, pose.elevation_deg, frame.normal, frame.up)
    eyes = targets + pose.distance_mm[:, None] * directions
    _refuse_inside(mesh, eyes)
    return geometry.look_at(eyes, targets, pose.roll_deg, frame.up)


def _smallest_scales(settings: SceneSettings, mesh: Mesh, frame: Frame, card: Placement, camera) -> np.ndarray:
    """px per mm at the card's middle, along the foreshortened direction, over views that face it."""
    conditions = draw(settings, "select", _VIEWS_TRIED, 0)
    poses = camera_poses(settings, mesh, frame, card.center_mm, conditions.pose)
    photo_px = settings.camera.photo_px
    matrix = (
        geometry.intrinsics(settings.view.fov_deg, photo_px) if camera is None else lens.matrix_px(camera, photo_px)
    )
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
    near = CLEARANCE * float((high - low).max())
    inside = ((eyes > low - near) & (eyes < high + near)).all(1)
    if inside.any():
        raise Refused(
            f"cameras outside the object ({high[0] - low[0]:.0f} × {high[1] - low[1]:.0f} × {high[2] - low[2]:.0f} mm)",
            f"{inside.sum()} of {len(eyes)} views inside its bounding box or within {near:.2g} mm of it",
            "raise view.distance_mm",
        )


def _unreadable_warning(share: float, marker_mm: float) -> tuple[str, ...]:
    if share <= 1 - READABLE_SHARE:
        return ()
    return (f"markers of {marker_mm:.1f} mm, the largest that fit, will be unreadable in {share:.0%} of the views",)
