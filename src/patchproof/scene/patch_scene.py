"""A mesh with a piece on it, a flat card or bent (see `bent_scene`); or one whose piece has no place yet
(`patch.place = "auto"`), for which the optimizer searches a place.

In: settings. Out: a `PatchScene`, which knows its sheet id (a hash of settings and seed, fixed before optimizing), the
layout of the printed piece (the design and its markers, whose size follows from the views) and the piece's placement.
"""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from patchproof.base import geometry
from patchproof.base.errors import Refused
from patchproof.base.settings import SceneSettings
from patchproof.base.validation import Side
from patchproof.scene import interface
from patchproof.scene.conditions import Conditions
from patchproof.scene.interface import SCALE_VIEWS, PieceScene, Scene, SceneSource, refuse_without_place
from patchproof.scene.mesh_scene import MeshScene, camera_poses, load_bare
from patchproof.scene.placement import Placement, patch_frame, placement_advice, placement_method
from patchproof.sheets.markers import MARKER_MODULES
from patchproof.sheets.page import refuse_larger_than_page
from patchproof.sheets.piece import Piece, lay_out_piece, marker_size_mm, smallest_piece_mm
from patchproof.sheets.template import page_template

PiecePosition = tuple[float, float, float] | Side  # a point of the scene in millimeters, or the middle of a side


@dataclass(frozen=True)
class PatchScene(PieceScene, MeshScene):
    """An object with a piece on it."""

    placement: Placement
    unreadable: float
    EFFECT_TABLES = ("light", "printer", "camera")

    @classmethod
    def from_bare(cls, bare: MeshScene) -> Self:
        """Return the bare object with its piece at the settings' place; refused if it cannot lie there."""
        piece, placement, unreadable, notes = _place_piece(bare)
        return cls(**vars(bare) | {"piece": piece, "placement": placement, "unreadable": unreadable, "notes": notes})

    def placement_summary(self) -> dict[str, Any]:
        """Implement `Scene.placement_summary`."""
        names = ("size_mm", "family", "reason", "gap_mm", "gap_mean_mm", "overhang_share")
        return {name: getattr(self.placement, name) for name in names}

    def record(self) -> dict[str, Any]:
        """Return run.json's record of the piece and how well it fits."""
        fit = self.placement_summary()
        del fit["size_mm"]  # the record has it as piece_mm
        return super().record() | fit

    @property
    def unreadable_share(self) -> float:
        """The share of views in which a module of the piece's markers is under `PX_PER_MODULE`."""
        return self.unreadable

    @property
    def middle_mm(self) -> np.ndarray:
        """The middle of the piece in the world."""
        return self.placement.center_mm

    @property
    def normal(self) -> np.ndarray:
        """The direction that the piece's middle faces."""
        return self.placement.normal

    @property
    def is_flat(self) -> bool:
        """True if piece and lens are flat, so that photographs are homographies of the sheet."""
        return self.placement.is_flat and not (self.camera is not None and self.camera.has_distortion)

    def _laid_out(self) -> Self:
        return self.from_bare(self)

    def piece_homographies(self, conditions: Conditions, size_px: tuple[int, int]) -> np.ndarray:
        """Implement `PieceScene.piece_homographies`."""
        poses, plane = self.camera_from_print(conditions), self.placement.world_from_piece
        return geometry.plane_homography(self.matrix_px(size_px), poses, plane)

    def piece_px(self, conditions: Conditions, piece_mm: np.ndarray) -> np.ndarray:
        """Implement `PieceScene.piece_px`."""
        pose, world = self.camera_from_print(conditions)[0], self.placement.world(piece_mm)
        points = geometry.project(self.matrix_px(self.photo_px), pose, world)
        return points if self.camera is None else self.camera.distort_points(points, self.photo_px)

    def paper(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Implement `PieceScene.paper`."""
        return self.placement.vertices_mm, self.placement.normals, self.placement.piece_mm

    def piece_azimuth_deg(self, conditions: Conditions) -> np.ndarray:
        """Return N angles of the camera to the right of the piece's middle, beyond 90 if its face is turned away."""
        middle = np.array(self.placement.size_mm) / 2
        poses = self.camera_from_world(conditions) @ self.placement.world_from_piece
        return np.array([geometry.view_angles(pose, middle)[0] for pose in poses])

    def white_light(self, conditions: Conditions) -> np.ndarray:
        """Return N: the light on white paper at the piece's middle."""
        light = conditions.light
        return light.ambient + light.directional * self.cosines(light.light_azimuth_deg, light.light_elevation_deg)


@dataclass(frozen=True)
class UnplacedScene(MeshScene):
    """An object whose piece has no place yet; by itself, the bare object."""

    HAS_PLACE = False

    def description(self) -> str:
        """Describe the scene (see `Scene.description`)."""
        return f'{super().description()} with patch.place = "auto"'

    def settings_with_piece_at(self, position: PiecePosition, spin_deg: float) -> SceneSettings:
        """Return the settings of a scene file that gives this place and keeps the views."""
        keys = {"side": position} if isinstance(position, str) else {"at_mm": position}
        patch = {"place": "given", "spin_deg": spin_deg} | keys
        return self.settings.changed(patch=patch, view={"front": self.settings.patch.side})

    def with_piece_at(self, position: PiecePosition, spin_deg: float) -> PatchScene:
        """Return the scene with its piece at a place, its views unchanged; refused if the piece cannot hang there. It
        equals the scene of a file that gives this place.
        """
        return PatchScene.from_bare(self._identified(self.settings_with_piece_at(position, spin_deg), self.known))


def build(source: SceneSource) -> PatchScene | UnplacedScene:
    """Build the scene of settings that give a piece its place, or that of `patch.place = "auto"`."""
    bare = load_bare(source)
    return UnplacedScene(**vars(bare)) if source.settings.patch.place == "auto" else PatchScene.from_bare(bare)


def require_patch(scene: Scene, expected: str = "a scene with a patch on a mesh") -> PatchScene:
    """Return the scene as one with a piece that lies on a mesh; refused for any other."""
    if isinstance(scene, PatchScene):
        return scene
    refuse_without_place(scene)
    raise Refused(expected, scene.description(), 'name object.mesh, and leave patch.kind out or "patch"')


def require_unplaced(scene: Scene) -> UnplacedScene:
    """Return the scene as one whose piece has no place yet; refused for any other."""
    if isinstance(scene, UnplacedScene):
        return scene
    raise Refused('a scene with patch.place = "auto"', scene.description(), "set it, or use the place that it has")


def _place_piece(scene: MeshScene) -> tuple[Piece, Placement, float, tuple[str, ...]]:
    """Return the piece, its markers as large as views need, its placement, the share of unreadable views, notes."""
    settings, mesh, patch = scene.settings, scene.mesh, scene.settings.patch
    lay = placement_method(patch.bend)
    try:
        placement = lay(mesh, patch_frame(mesh, patch), patch.size_mm, patch.spin_deg)
    except Refused as refused:
        raise refused.with_advice(placement_advice(mesh, patch, lay, smallest_piece_mm())) from refused
    poses = camera_poses(scene, placement.center_mm, scene.draw("select", SCALE_VIEWS, 0).pose)
    scales = _smallest_scales(scene, placement, poses)
    if not (facing := scales[scales > 0]).size:
        got = f"{SCALE_VIEWS} views from behind it"
        raise Refused("views from which the patch can be seen", got, "turn azimuth_deg towards the patch")
    needed_mm = float(MARKER_MODULES * interface.PX_PER_MODULE / np.quantile(facing, 1 - interface.READABLE_SHARE))
    marker_mm = marker_size_mm(needed_mm, patch.size_mm) if settings.sheet.markers else 0.0
    piece = lay_out_piece(patch.size_mm, marker_mm, scene.sheet_id, "design", patch.bend)
    refuse_larger_than_page(page_template(settings.sheet.template), piece)  # before hours of optimizing
    notes = (*mesh.warnings, *scene.backgrounds.notes, *placement.warnings)
    if piece.markers and not placement.is_flat:  # paper is unrolled by all markers; on a card one tells the others
        from patchproof.scene.bent_scene import smallest_marker_scales

        scales = smallest_marker_scales(scene, placement, piece)
        # Corners have to fit a roll, to a share of its size: of pieces of 140 mm, 9 of 16 photographs did where 64 %
        # were readable, of 40 to 90 mm 26 of 168 where 21 to 100 % were.
        few = "few photographs of rolled paper under 100 mm can be measured: the others only count"
        notes += (few,) if min(patch.size_mm) < 100 else ()
    corners = placement.world(geometry.rect_corners((0, 0, *placement.size_mm)))
    pixels = geometry.project(scene.matrix_px(scene.photo_px), poses, corners)
    # with three corners of the piece or more, without which no sheet can be measured
    shown = ((pixels >= 0) & (pixels <= scene.photo_px)).all(2).sum(1) >= 3
    if shown.mean() < interface.READABLE_SHARE:
        advice = "raise view.fov_deg or view.distance_mm, or lower view.look_at_jitter"
        notes += (f"the piece lies beyond the edge of the picture in {1 - shown.mean():.0%} of photographs: {advice}",)
    too_small = scales * piece.module_mm < interface.PX_PER_MODULE * 0.999
    unreadable = float((too_small | ~shown).mean()) if piece.markers else 0.0
    if piece.markers and too_small.mean() > 1 - interface.READABLE_SHARE:
        advice = "narrow view.azimuth_deg and view.elevation_deg, or make the piece smaller"
        if needed_mm > marker_mm + 0.05:
            advice = f"view.distance_mm and camera.photo_px ask for {needed_mm:.1f} mm, and those for a piece of "
            advice += f"{smallest_piece_mm(needed_mm)} mm or more; come nearer, or take larger photographs"
        measurable = interface.measurable_text(unreadable, placement.family)
        notes += (f"{measurable}: others show markers of {marker_mm:.1f} mm too small: {advice}",)
    return piece, placement, unreadable, notes


def _smallest_scales(scene: MeshScene, card: Placement, poses: np.ndarray) -> np.ndarray:
    """Return px per mm at the card's middle, along the foreshortened direction, in each view; 0 from behind."""
    faces = (geometry.camera_centers(poses) - card.center_mm) @ card.normal > 0
    planes = geometry.plane_homography(scene.matrix_px(scene.photo_px), poses, card.world_from_piece)
    mean, tilt_deg = geometry.local_scale(planes, np.array(card.size_mm) / 2).T
    return np.where(faces, mean * np.sqrt(np.cos(np.radians(tilt_deg))), 0.0)
