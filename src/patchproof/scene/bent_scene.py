"""A mesh with a piece of paper that follows its surface (`patch.bend`)."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from patchproof.base import geometry
from patchproof.base.errors import Refused
from patchproof.scene.bend import place_bent, placement_method
from patchproof.scene.interface import SCALE_VIEWS, Scene, SceneSource
from patchproof.scene.mesh_scene import MeshScene, camera_poses, load_bare
from patchproof.scene.patch_scene import PatchScene
from patchproof.scene.placement import Placement, PlacementMethod, patch_frame
from patchproof.scene.tape_measure import TapeMeasurement, measure_tapes
from patchproof.sheets.piece import Piece


@dataclass(frozen=True)
class BentScene(PatchScene):
    """An object with a piece that bends along its surface; on a flat surface, that is a card, too."""

    LAY: ClassVar[PlacementMethod] = staticmethod(place_bent)

    def tape_measurements(self) -> tuple[TapeMeasurement, ...]:
        """Implement `PatchScene.tape_measurements`."""
        facing = patch_frame(self.mesh, self.settings.patch).normal
        return () if self.placement.is_flat else measure_tapes(self.mesh, self.placement, facing)


def build(source: SceneSource) -> BentScene:
    """Build the scene of settings that give a piece of bent paper its place."""
    return BentScene.from_bare(load_bare(source))


def placement_with_other_bend(scene: Scene) -> tuple[Placement | None, str | None]:
    """Return (the piece's placement with `patch.bend` the other way round, a sentence that compares it).

    The placement is None if it is refused or would be the same card; both are None if there is no surface to lie on.
    """
    if not isinstance(scene, PatchScene):
        return None, None
    patch, placement = scene.settings.patch, scene.placement
    lay, flag = placement_method(not patch.bend), str(not patch.bend).lower()
    try:
        other = lay(scene.mesh, patch_frame(scene.mesh, patch), scene.piece.size_mm, patch.spin_deg)
    except Refused as refused:
        return None, f"bend = {flag} is refused. {refused}"
    if other.family == placement.family:
        return None, f"bend = {flag} would be a card, too: leave bend out"
    gaps = f"{other.gap_mean_mm:.2f} mm off the surface on average, here {placement.gap_mean_mm:.2f} mm"
    return other, f"bend = {flag} would be a {other.family} (stretch {other.stretch:.2%}), {gaps}"


def bent_notes(placement: Placement) -> tuple[str, ...]:
    """Warn of bent paper that is rarely measured. Corners on rolled paper have to fit a roll, to a share of its size:
    of pieces of 140 mm, 9 of 16 photographs did where 64 % were readable, of 40 to 90 mm 26 of 168 where 21 to 100 %
    were; of paper bent in two directions 0 of 63.
    """
    if placement.family == "exponential":
        return ("hardly any photograph can be measured: paper that bends in two directions only counts",)
    few = "few photographs of rolled paper under 100 mm can be measured: the others only count"
    return (few,) if placement.family == "cylinder" and min(placement.size_mm) < 100 else ()


def smallest_marker_scales(scene: MeshScene, placement: Placement, piece: Piece) -> np.ndarray:
    """Return the px per mm of each view at the worst marker, along the foreshortened direction; 0 from behind."""
    middles_mm = np.array([np.mean(marker.corners_mm, 0) for marker in piece.markers])
    vertices = np.linalg.norm(placement.piece_mm - middles_mm[:, None], axis=2).argmin(1)
    poses = camera_poses(scene, placement.center_mm, scene.draw("select", SCALE_VIEWS, 0).pose)
    rays = geometry.camera_centers(poses)[:, None] - placement.world(middles_mm)
    distances = np.linalg.norm(rays, axis=2)
    cosines = (rays * placement.normals[vertices]).sum(2) / distances
    return (scene.matrix_px(scene.photo_px)[0, 0] * cosines.clip(0) / distances).min(1)
