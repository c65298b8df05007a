"""Load a mesh by its name: a file (`mesh_file`), a procedural object (`primitives`), or a mesh given in Python.

In: a path, `primitive:NAME` or `python:NAME`, and the object's longest extent. Out: a `Mesh` in the scene's frame.
Textures larger than any photograph shows are reduced. A mesh in memory goes through GLB and the reader of files, so
that it equals what its run's folder will hold.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import numpy as np

from patchproof.base.errors import Refused
from patchproof.base.resample import downscale
from patchproof.mesh.mesh import Material, Mesh, MeshPart, mesh_from_parts

PYTHON_PREFIX = "python:"

# Larger textures are reduced: 8192 × 8192 took 4 GB and 5 s to set up, more detail than any photograph shows.
LARGEST_TEXTURE_PX = 4096
_Y_UP_FROM_Z_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def load_mesh(path: str | Path, length_mm: float, up: Literal["y", "z"] = "z", mesh_glb: bytes | None = None) -> Mesh:
    """Load the mesh of a file, of `primitive:NAME`, or of the GLB given for `python:NAME`, with its longest extent
    `length_mm`.

    `up = "z"` turns (x, y, z) into (x, z, -y); primitives are y up already. Refused if nothing can be drawn or a
    texture that the file names is missing.
    """
    if str(path).startswith("primitive:"):
        from patchproof.mesh import primitives

        mesh = primitives.build(str(path).removeprefix("primitive:"), 0)
        return replace(mesh, vertices=mesh.vertices * (length_mm / np.ptp(mesh.vertices, axis=0).max()))
    from patchproof.mesh.mesh_file import read_parts

    with TemporaryDirectory() as folder:
        if is_given := str(path).startswith(PYTHON_PREFIX):
            if mesh_glb is None:
                raise Refused("a mesh for python:", f"{path} without one", "pass it: make_scene(settings, mesh=...)")
            path = Path(folder) / "given.glb"
            path.write_bytes(mesh_glb)
        parts, warnings, files = read_parts(Path(path), _Y_UP_FROM_Z_UP if up == "z" else np.eye(3))
    parts, reductions = _reduce_textures(parts)
    mesh = mesh_from_parts(parts, length_mm, (*warnings, *reductions))
    return replace(mesh, files=() if is_given else tuple(dict.fromkeys(files)))


def _reduce_textures(parts: Sequence[MeshPart]) -> tuple[list[MeshPart], list[str]]:
    """Reduce textures to at most LARGEST_TEXTURE_PX a side; return the parts and warnings about larger textures."""
    reduced_materials: dict[Material, Material] = {}
    warnings = []
    for material in dict.fromkeys(part.material for part in parts):
        texture = material.texture_srgb
        if texture is not None and max(texture.shape[:2]) > LARGEST_TEXTURE_PX:
            small = downscale(texture, LARGEST_TEXTURE_PX)
            reduced_materials[material] = replace(material, texture_srgb=small)
            old_size, new_size = (f"{pixels.shape[1]} × {pixels.shape[0]}" for pixels in (texture, small))
            warnings.append(f"the texture of {old_size} of {material.name} is reduced to {new_size}")
    return [replace(part, material=reduced_materials.get(part.material, part.material)) for part in parts], warnings
