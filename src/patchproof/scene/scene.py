"""Load or make a scene of any kind: from a scene file, or from settings made in Python.

Each kind is built by its own module, which is imported only when a scene is of that kind: a card on a mesh needs
nothing of textures, bent paper, photographs or images.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from patchproof.base.errors import Refused
from patchproof.base.fingerprint import files_sha256, value_sha256
from patchproof.base.input import is_file
from patchproof.base.output import write_pictures
from patchproof.base.settings import SceneSettings, load_scene_settings, named_paths
from patchproof.base.validation import validate_model
from patchproof.channel.printer import load_printer
from patchproof.scene.interface import Scene, SceneSource

if TYPE_CHECKING:
    import trimesh


def load_scene(path: str | Path, seed: int | None = None) -> Scene:
    """Load the scene of a file; `seed` replaces that in the file.

    Raises:
        Refused: for a file that is missing, has unknown or contradicting settings, or names files that cannot be read.
    """
    path = Path(path)
    return build_scene(load_scene_settings(path), path.resolve().parent, seed)


def make_scene(
    settings: SceneSettings | Mapping[str, Any],
    mesh: "trimesh.Trimesh | trimesh.Scene | None" = None,
    base: str | Path = ".",
    seed: int | None = None,
) -> Scene:
    """Make a scene of settings in Python.

    Args:
        settings: `SceneSettings`, or a dictionary like a scene file's. Where a scene file names something, the
            dictionary may hold it: a Path for any path, a trimesh mesh as `object.mesh`, classifiers (or torch modules
            with `input_px` and `labels`) in `target.models`, and lists of uint8 H×W×3 sRGB arrays as `object.photos`,
            `object.images` or `background.images`; arrays are written as PNG files into a folder of `base` that is
            named after their bytes.
        mesh: the object, where `object.mesh` is "python:" and a word.
        base: folder that paths in the settings are relative to.
        seed: of all random draws, in place of `optimize.seed`.

    Raises:
        Refused: for settings that contradict each other, and files that cannot be read.
    """
    models: dict[str, Any] = {}
    if not isinstance(settings, SceneSettings):
        named, given_mesh, models = _replace_objects(settings, Path(base))
        settings = validate_model(SceneSettings, named, "the scene's settings")
        mesh = given_mesh if mesh is None else mesh
    glb: Any = None if mesh is None else mesh.export(file_type="glb")
    scene = build_scene(settings, Path(base), seed, mesh_glb=glb)
    return replace(scene, given_models=models) if models else scene


def _replace_objects(settings: Mapping[str, Any], base: Path) -> tuple[dict[str, Any], Any, dict[str, Any]]:
    """Return the settings with names in place of objects, the mesh if it was one of these, and the networks by name."""
    tables, mesh, models = _path_texts(settings), None, {}
    for key, name in (("object", "photos"), ("object", "images"), ("background", "images")):
        table = tables.get(key)
        if isinstance(table, dict) and isinstance(table.get(name), list | tuple):
            digest = hashlib.sha256(b"".join(np.ascontiguousarray(picture).tobytes() for picture in table[name]))
            folder = base.resolve() / f"pictures-{digest.hexdigest()[:12]}"  # named after their bytes
            table[name] = write_pictures(table[name], folder).name
    thing, target = tables.get("object"), tables.get("target")
    if isinstance(thing, dict) and hasattr(thing.get("mesh"), "export"):
        mesh, thing["mesh"] = thing["mesh"], "python:mesh"
    if isinstance(target, dict) and isinstance(target.get("models"), list | tuple):
        names = []
        for number, model in enumerate(target["models"]):
            is_named = isinstance(model, str | Path)
            names.append(str(model) if is_named else getattr(model, "name", f"python:network{number}"))
            if not is_named and names[-1] in models:
                raise Refused("networks with a name each in target.models", f"{names[-1]} twice", "name them apart")
            models |= {} if is_named else {names[-1]: model}
        target["models"] = names
    return tables, mesh, models


def _path_texts(value: Any) -> Any:
    """Copy tables, also nested ones, with the text of each Path in its place."""
    if isinstance(value, Mapping):
        return {key: _path_texts(each) for key, each in value.items()}
    return str(value) if isinstance(value, Path) else value


def build_scene(
    settings: SceneSettings,
    base: Path,
    seed: int | None = None,
    printed_sheet_id: str | None = None,
    mesh_glb: bytes | None = None,
) -> Scene:
    """Build the scene of settings with paths relative to `base`; `printed_sheet_id` is that of its print, if any."""
    seed = settings.optimize.seed if seed is None else seed
    module = import_module(f"patchproof.scene.{module_of(settings)}")
    scene = module.build(SceneSource(settings, base, seed, printed_sheet_id, mesh_glb))
    return replace(scene, inputs={**scene.inputs, **_fingerprints(scene)})


def _fingerprints(scene: Scene) -> dict[str, str]:
    """Return the fingerprints of the files that scenes of several kinds name, by settings key; `build` adds others."""
    found = {"printer.profile": load_printer(scene.settings.printer.profile, scene.base).sha256}
    if scene.camera is not None:
        found["camera.file"] = value_sha256(scene.camera.model_dump(mode="json"))
    paths = {key: path for key, path in named_paths(scene.settings, scene.base).items() if key not in scene.inputs}
    return found | {key: files_sha256([path]) for key, path in paths.items() if is_file(path)}


def module_of(settings: SceneSettings) -> str:
    """Return the module of this room whose `build` makes a scene of the kind that the settings state."""
    if settings.object.photos is not None:
        return "photo_scene"
    if settings.object.images is not None:
        return "image_scene"
    if settings.patch.kind != "patch":
        return "texture_scene"
    return "patch_scene"
