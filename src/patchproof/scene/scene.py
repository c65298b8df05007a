"""The three kinds of scene behind one door.

In: a scene file. Out: a `MeshScene` (an object with a mesh), a `PhotoScene` (photographs of the object with a blank
sheet on it) or an `ImageScene` (a folder of images). All answer the same questions: draws of conditions, the piece and
where it lies in each view; `render` photographs any of them.
"""

from __future__ import annotations

from pathlib import Path

import trimesh

from patchproof.mesh.load_mesh import glb_of
from patchproof.scene.image_scene import ImageScene, load_image_scene
from patchproof.scene.mesh_scene import MeshScene, load_mesh_scene
from patchproof.scene.photo_scene import PhotoScene, load_photo_scene
from patchproof.settings import SceneSettings, load_scene_settings

Scene = MeshScene | PhotoScene | ImageScene


def load_scene(path: str | Path, seed: int | None = None) -> Scene:
    """The scene of a file; `seed` replaces the file's own."""
    path = Path(path)
    return build_scene(load_scene_settings(path), path.resolve().parent, seed)


def make_scene(
    settings: SceneSettings,
    mesh: trimesh.Trimesh | trimesh.Scene | None = None,
    base: str | Path = ".",
    seed: int | None = None,
) -> Scene:
    """The scene of settings made in Python, whose paths are relative to `base`; `mesh` is the object where the settings
    name it `python:` and a word.
    """
    return build_scene(settings, Path(base), seed, given_glb=None if mesh is None else glb_of(mesh))


def build_scene(
    settings: SceneSettings,
    base: Path,
    seed: int | None = None,
    identity: str | None = None,
    given_glb: bytes | None = None,
) -> Scene:
    """The scene of settings whose paths are relative to `base`; `identity` is the sheet id that it was printed with."""
    seed = settings.optimize.seed if seed is None else seed
    if settings.object.photos is not None:
        return load_photo_scene(settings, base, seed, identity)
    if settings.object.images is not None:
        return load_image_scene(settings, base, seed, identity)
    return load_mesh_scene(settings, base, seed, identity, given_glb)
