"""The kinds of scene behind one door.

In: a scene file, or settings made in Python. Out: a `Scene`, of a mesh, of photographs or of images. Whoever needs a
piece, a mesh or pictures narrows it here and nowhere else.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import trimesh

from patchproof.base.settings import SceneSettings, load_scene_settings
from patchproof.base.strict import Refused, validated
from patchproof.mesh.load_mesh import glb_of
from patchproof.scene.flat import FlatScene
from patchproof.scene.image_scene import load_image_scene
from patchproof.scene.interface import PieceScene as PieceScene
from patchproof.scene.interface import Scene as Scene
from patchproof.scene.mesh_scene import MeshScene, TextureScene
from patchproof.scene.patch_scene import OpenScene, PatchScene, load_mesh_scene
from patchproof.scene.photo_scene import load_photo_scene


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


def needs_piece(scene: Scene, do: str = "take object.glb and textures from the run") -> PieceScene:
    """The scene as one with a printed piece; refused where there is only the object's own texture."""
    if isinstance(scene, PieceScene):
        return scene
    _refuse_open(scene)
    raise Refused("a run of a patch", "one of the object's own texture", do)


def needs_texture(scene: Scene) -> TextureScene:
    """The scene as one whose object's own texture may change; refused of any other."""
    if isinstance(scene, TextureScene):
        return scene
    _refuse_open(scene)
    raise Refused("a scene of the object's own texture", "one of a patch", 'set patch.kind = "texture"')


def needs_mesh(scene: Scene, expected: str = "a scene with a mesh", do: str = "name object.mesh") -> MeshScene:
    """The scene as one with a mesh; refused of pictures."""
    if isinstance(scene, MeshScene):
        return scene
    raise Refused(expected, "one of pictures", do)


def needs_patch(scene: Scene, expected: str = "a scene with a patch on a mesh") -> PatchScene:
    """The scene as one with a piece that lies on a mesh; refused of any other."""
    if isinstance(scene, PatchScene):
        return scene
    _refuse_open(scene)
    raise Refused(expected, scene.description(), 'name object.mesh, and leave patch.kind out or "patch"')


def needs_open(scene: Scene) -> OpenScene:
    """The scene as one whose piece has no place yet; refused of any other."""
    if isinstance(scene, OpenScene):
        return scene
    raise Refused(
        'a scene with patch.place = "auto"', scene.description(), "ask for it, or use the place that is given"
    )


def needs_pictures(scene: Scene) -> FlatScene:
    """The scene as one of pictures; refused where there is a mesh."""
    if isinstance(scene, FlatScene):
        return scene
    raise Refused("a scene of pictures", "one with a mesh", "name object.photos or object.images")


def _refuse_open(scene: Scene) -> None:
    if isinstance(scene, OpenScene):
        do = "choose one with choose_place, or give one"
        raise Refused("a scene whose piece has its place", 'patch.place = "auto"', do)
