"""A scene with a mesh and its background, ready to be photographed: the camera of every drawn view.

By itself a `MeshScene` is the bare object; `patch_scene` and `bent_scene` put a piece on it, `texture_scene` paints it.
"""

import hashlib
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np

from patchproof.base import geometry
from patchproof.base.errors import Refused
from patchproof.base.fingerprint import files_sha256
from patchproof.base.validation import expand_path
from patchproof.channel.effects import Pose
from patchproof.channel.object_box import hull_points, project_box
from patchproof.mesh.load_mesh import load_mesh
from patchproof.mesh.mesh import Mesh
from patchproof.scene.backgrounds import Backgrounds, background_files, load_backgrounds
from patchproof.scene.conditions import Conditions, Stream
from patchproof.scene.interface import SCALE_VIEWS, Scene, SceneSource, SceneTerm
from patchproof.scene.placement import SurfaceFrame, view_frame

# A camera's least distance from the object, of its length: surfaces nearer than the near plane would vanish.
CLEARANCE_SHARE = 5e-3


@dataclass(frozen=True)
class MeshScene(Scene):
    """An object with a mesh before its backgrounds; by itself, with nothing on it."""

    mesh: Mesh
    frame: SurfaceFrame  # from which the azimuths of cameras and lights count
    backgrounds: Backgrounds

    HAS_OBJECT = True
    LEARNS_TEXTURE: ClassVar[bool] = False  # True if the object's own texture changes
    TERMS = (SceneTerm("lens distortion", "camera.file"),)
    OMITTED = (
        "cast shadows: a 10 mm ledge along the top of a 110 mm patch takes 4 % of its light, 9 % at the 95 % point",
        "(computed for the default ranges, see channel/camera); interreflection; "
        "curl: paper is as flat or bent as stated",
    )
    EFFECT_TABLES = ("light", "camera")

    def draw(self, stream: Stream, n: int, seed: int | None = None, start: int = 0, per_session: int = 1) -> Conditions:
        """Draw like `Scene.draw`, with the backgrounds of the stream."""
        conditions = super().draw(stream, n, seed, start, per_session)
        background = conditions.pose.background.copy()
        background[:, 0] = self.backgrounds.choose_for_stream(stream, background[:, 0])
        return replace(conditions, pose=replace(conditions.pose, background=background))

    def description(self) -> str:
        """Return how many faces the mesh has."""
        return f"a mesh of {len(self.mesh.faces)} faces"

    def placement_summary(self) -> dict[str, Any]:
        """Implement `Scene.placement_summary`: the texture covers the object."""
        reason = "the object's own texture is the design"
        return {"family": "texture", "size_mm": self.frame.extent_mm, "reason": reason}

    @property
    def length_mm(self) -> float:
        """The object's longest extent."""
        if self.settings.object.length_mm is None:
            raise ValueError("a mesh needs object.length_mm")
        return self.settings.object.length_mm

    @property
    def middle_mm(self) -> np.ndarray:
        """The middle of the piece in the world; without a piece, of the side it would face."""
        return self.frame.origin_mm

    @property
    def normal(self) -> np.ndarray:
        """The direction that the middle faces."""
        return self.frame.normal

    @property
    def focal_px(self) -> float:
        """The focal length of whole photographs."""
        return float(self.matrix_px(self.photo_px)[0, 0])

    def without(self, term: SceneTerm) -> Self | None:
        """Return the scene without its lens's distortion; None if there is none."""
        if self.camera is None or not self.camera.has_distortion:
            return None
        return replace(self, camera=self.camera.changed(k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0))

    def camera_from_world(self, conditions: Conditions) -> np.ndarray:
        """Return the N×4×4 poses of the drawn cameras."""
        return camera_poses(self, self.middle_mm, conditions.pose)

    def camera_from_print(self, conditions: Conditions) -> np.ndarray:
        """Return N×4×4 from the world with its piece at the sheet's size to cameras that see it at its printed size."""
        return self.camera_from_world(conditions) @ self.printed_from_sheet(conditions)

    def printed_from_sheet(self, conditions: Conditions) -> np.ndarray:
        """Return N×4×4 scalings about the piece's middle by the print's scale, which keep a card in its plane."""
        return geometry.scaling_about(self.middle_mm, conditions.pose.printed_scale)

    def matrix_px(self, size_px: tuple[int, int]) -> np.ndarray:
        """Return the 3×3 pinhole matrix of the scene's camera for a picture of this size."""
        if self.camera is not None:
            return self.camera.matrix_px(size_px)
        return geometry.intrinsics(self.settings.view.fov_deg, size_px)

    def pictures(self, conditions: Conditions, size_px: tuple[int, int]) -> np.ndarray:
        """Implement `Scene.pictures`: the backgrounds."""
        choices = conditions.pose.background
        return np.stack([self.backgrounds.picture(choice, self.photo_px, size_px) for choice in choices])

    def boxes(self, conditions: Conditions) -> np.ndarray:
        """Implement `Scene.boxes` for the whole mesh."""
        side_px = min(self.photo_px)
        size_px = side_px, side_px
        matrix_px, poses = self.matrix_px(size_px), self.camera_from_world(conditions)
        boxes = [project_box(self.outermost_mm, pose, matrix_px, size_px, self.camera) for pose in poses]
        return np.stack(boxes) / side_px

    @cached_property
    def outermost_mm(self) -> np.ndarray:
        """P×3 points of the mesh that decide its box in any view."""
        return hull_points(self.mesh.vertices)

    def cosines(self, azimuth_deg: np.ndarray, elevation_deg: np.ndarray) -> np.ndarray:
        """Return N cosines between the normal and directions, 0 from behind."""
        toward = geometry.orbit(azimuth_deg, elevation_deg, self.frame.normal, self.frame.up)
        return np.clip(toward @ self.normal, 0, None)

    def closest_px_per_mm(self, size_px: tuple[int, int]) -> float:
        """Return the pixels per millimeter of the piece in the closest view."""
        nearest = self.settings.view.distance_mm[0]
        closest_mm = max(nearest - float(np.linalg.norm(self.middle_mm)), nearest / 4)
        return float(self.matrix_px(size_px)[0, 0]) / closest_mm

    def px_per_mm(self, size_px: tuple[int, int], shorter: bool = False) -> np.ndarray:
        """Implement `Scene.px_per_mm` at the object's middle."""
        return self.matrix_px(size_px)[0, 0] / self.draw("select", SCALE_VIEWS, 0).pose.distance_mm


def require_mesh(scene: Scene, expected: str = "a scene with a mesh", do: str = "name object.mesh") -> MeshScene:
    """Return the scene as one with a mesh; refused for scenes made of pictures."""
    if isinstance(scene, MeshScene):
        return scene
    raise Refused(expected, "a scene of pictures", do)


def load_bare(source: SceneSource) -> MeshScene:
    """Load the object of a scene's settings, with nothing on it."""
    settings, base, mesh_glb = source.settings, source.base, source.mesh_glb
    settings_object, camera = settings.object, settings.camera
    if settings_object.mesh is None or settings_object.length_mm is None:
        raise ValueError("a scene with a mesh needs object.mesh and object.length_mm")
    mesh = load_mesh(expand_path(settings_object.mesh, base), settings_object.length_mm, settings_object.up, mesh_glb)
    backgrounds = load_backgrounds(settings.background, base)
    pictures, inputs = background_files(settings.background, base), {}
    known = {} if mesh_glb is None else {"mesh": hashlib.sha256(mesh_glb).hexdigest()}
    if mesh.files or known:
        inputs["object.mesh"] = files_sha256(mesh.files) if mesh.files else known["mesh"]
    if pictures:
        inputs["background.images"] = files_sha256(pictures, whole=False)
    identity, frame = source.sheet_id(known), view_frame(mesh, settings)
    lens = None
    if camera.file is not None:
        from patchproof.channel.lens import load_camera  # most photographs are of cameras that nobody calibrated

        lens = load_camera(camera.file, base, camera.photo_px)
    more: dict[str, Any] = {"known": known, "mesh_glb": mesh_glb, "inputs": inputs, "camera": lens}
    more["notes"] = (*mesh.warnings, *backgrounds.notes)
    return MeshScene(settings, base, source.seed, identity, mesh, frame, backgrounds, **more)


def camera_poses(scene: MeshScene, patch_mm: np.ndarray, pose: Pose) -> np.ndarray:
    """Return `camera_from_world` N×4×4 on an orbit about the target, azimuth 0 facing the scene's front."""
    center, frame = np.zeros(3) if scene.settings.view.look_at == "object" else patch_mm, scene.frame
    targets = center + pose.look_at_offset * scene.length_mm
    directions = geometry.orbit(pose.azimuth_deg, pose.elevation_deg, frame.normal, frame.up)
    eyes = targets + pose.distance_mm[:, None] * directions
    low, high = scene.mesh.ends_mm
    clearance_mm = CLEARANCE_SHARE * float((high - low).max())
    inside = ((eyes > low - clearance_mm) & (eyes < high + clearance_mm)).all(1)
    if inside.any():
        size = " × ".join(f"{side_mm:.0f}" for side_mm in high - low)
        got = f"{inside.sum()} of {len(eyes)} views inside its bounding box or within {clearance_mm:.2g} mm of it"
        raise Refused(f"cameras outside the object ({size} mm)", got, "raise view.distance_mm")
    return geometry.look_at(eyes, targets, pose.roll_deg, frame.up)
