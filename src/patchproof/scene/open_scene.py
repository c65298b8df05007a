"""A mesh whose piece has no place yet: `patch.place = "auto"`, for which the optimizer searches it."""

from __future__ import annotations

from dataclasses import dataclass

from patchproof.base.errors import Refused
from patchproof.base.settings import SceneSettings, SearchSettings
from patchproof.scene.bent_scene import BentScene
from patchproof.scene.interface import Scene, SceneSource
from patchproof.scene.mesh_scene import MeshScene, load_bare
from patchproof.scene.patch_scene import PatchScene, PiecePosition


@dataclass(frozen=True)
class UnplacedScene(MeshScene):
    """An object whose piece has no place yet; by itself, the bare object."""

    HAS_PLACE = False

    def description(self) -> str:
        """As in `Scene.description`."""
        return f'{super().description()} with patch.place = "auto"'

    def given(self, at: PiecePosition, spin_deg: float) -> SceneSettings:
        """The settings of a scene file that gives this place itself and keeps the views."""
        where = {"side": at} if isinstance(at, str) else {"at_mm": at}
        patch = {"place": "given", "search": SearchSettings(), "spin_deg": spin_deg} | where
        return self.settings.changed(patch=patch, view={"front": self.settings.patch.side})

    def at(self, at: PiecePosition, spin_deg: float) -> PatchScene:
        """The scene with its piece at a place, its views as they were; refused where the piece cannot hang there. It is
        the one of a file that gives this place itself.
        """
        kind = BentScene if self.settings.patch.bend else PatchScene
        return kind.on(self._identified(self.given(at, spin_deg), self.known))


def build(source: SceneSource) -> UnplacedScene:
    """The scene of settings whose `patch.place` is "auto"."""
    return UnplacedScene(**vars(load_bare(source)))


def require_unplaced(scene: Scene) -> UnplacedScene:
    """The scene as one whose piece has no place yet; refused of any other."""
    if isinstance(scene, UnplacedScene):
        return scene
    raise Refused(
        'a scene with patch.place = "auto"', scene.description(), "ask for it, or use the place that is given"
    )
