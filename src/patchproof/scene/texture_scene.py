"""A scene in which the object's own texture is optimized, whole or under a mask; nothing hangs on it."""

from dataclasses import dataclass

from patchproof.scene.canvas import Canvas, texture_canvas
from patchproof.scene.interface import SceneSource
from patchproof.scene.mesh_scene import MeshScene, load_bare


@dataclass(frozen=True)
class TextureScene(MeshScene):
    """An object of which some texels may change."""

    canvas: Canvas
    LEARNS_TEXTURE = True

    def object_canvas(self) -> Canvas:
        """Implement `Scene.object_canvas`."""
        return self.canvas


def build(source: SceneSource) -> TextureScene:
    """Build the scene of settings whose `patch.kind` is "texture" or "masked"."""
    bare = load_bare(source)
    canvas = texture_canvas(bare.mesh, source.settings.patch, source.base)
    fields = {"mesh": canvas.mesh, "canvas": canvas, "notes": (*bare.notes, *canvas.warnings)}
    return TextureScene(**vars(bare) | fields)
