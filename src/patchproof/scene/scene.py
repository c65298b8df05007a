"""One door to scenes of all kinds: from a scene file, or settings made in Python.

Each kind is built by a module of its own, which is imported when a scene is of that kind and not before: a card on a
mesh needs nothing of textures, bent paper, photographs or images.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from patchproof.base.settings import SceneSettings, load_scene_settings
from patchproof.base.validation import validated
from patchproof.scene.interface import Scene, SceneSource

if TYPE_CHECKING:
    import trimesh


def load_scene(path: str | Path, seed: int | None = None, steps: int | None = None) -> Scene:
    """The scene of a file; `seed` and the `steps` of its optimization replace the file's own."""
    path = Path(path)
    settings = load_scene_settings(path)
    if steps is not None:
        settings = settings.changed(optimize={"steps": steps})
    return build_scene(settings, path.resolve().parent, seed)


def make_scene(
    settings: SceneSettings | dict[str, Any],
    mesh: trimesh.Trimesh | trimesh.Scene | None = None,
    base: str | Path = ".",
    seed: int | None = None,
) -> Scene:
    """The scene of settings made in Python (or of a dictionary like a scene file's), whose paths are relative to
    `base`; `mesh` is the object where the settings name it `python:` and a word.
    """
    if not isinstance(settings, SceneSettings):
        settings = validated(SceneSettings, settings, "the scene's settings")
    glb: Any = None if mesh is None else mesh.export(file_type="glb")
    return build_scene(settings, Path(base), seed, given_glb=glb)


def build_scene(
    settings: SceneSettings,
    base: Path,
    seed: int | None = None,
    printed_id: str | None = None,
    given_glb: bytes | None = None,
) -> Scene:
    """The scene of settings whose paths are relative to `base`; `printed_id` is the sheet id of its print, if any."""
    seed = settings.optimize.seed if seed is None else seed
    module = import_module(f"patchproof.scene.{module_of(settings)}")
    return module.build(SceneSource(settings, base, seed, printed_id, given_glb))


def module_of(settings: SceneSettings) -> str:
    """The module of this room whose `build` makes a scene of the kind that the settings state."""
    if settings.object.photos is not None:
        return "photo_scene"
    if settings.object.images is not None:
        return "image_scene"
    if settings.patch.kind != "patch":
        return "texture_scene"
    if settings.patch.place == "auto":
        return "open_scene"
    return "bent_scene" if settings.patch.bend else "patch_scene"
