"""A mesh whose piece has no place yet: `patch.place = "auto"`, for which the optimizer searches a place."""

from dataclasses import dataclass

from patchproof.base.errors import Refused
from patchproof.base.settings import SceneSettings
from patchproof.scene.bent_scene import BentScene
from patchproof.scene.interface import Scene, SceneSource
from patchproof.scene.mesh_scene import MeshScene, load_bare
from patchproof.scene.patch_scene import PatchScene, PiecePosition


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
        scene_type = BentScene if self.settings.patch.bend else PatchScene
        return scene_type.from_bare(self._identified(self.settings_with_piece_at(position, spin_deg), self.known))


def build(source: SceneSource) -> UnplacedScene:
    """Build the scene of settings with `patch.place = "auto"`."""
    return UnplacedScene(**vars(load_bare(source)))


def require_unplaced(scene: Scene) -> UnplacedScene:
    """Return the scene as one whose piece has no place yet; refused for any other."""
    if isinstance(scene, UnplacedScene):
        return scene
    remedy = "set it, or use the place that the scene has"
    raise Refused('a scene with patch.place = "auto"', scene.description(), remedy)
