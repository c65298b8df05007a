"""Load a mesh by its name: a file, a procedural object (`primitives`), or a mesh given in Python; write one as GLB.

In: a path of an OBJ (with MTL), GLB, glTF, PLY or STL file, `primitive:NAME` or `python:NAME`, and the object's longest
extent. Out: a `Mesh` in the scene's frame, with warnings about what is not shown as declared (`declarations.csv`).
Refused: a file that cannot be parsed, and a missing or broken texture. Textures larger than any photograph shows are
reduced. A mesh in memory goes through GLB, so that it equals what its run's folder will hold.

For other programs, trimesh writes glTF 2.0: in meters as its specification wants, y up, textures as lossless PNG
inside, repeating. The same textures give the same bytes. Surfaces are matte and visible from both sides, as in the
renderer here. Material names may repeat; geometries are numbered. Left out on purpose: lights and cameras.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Literal

import numpy as np

from patchproof.base.color import codes_from_srgb
from patchproof.base.errors import Refused
from patchproof.base.input import is_file, run_within_seconds
from patchproof.base.resample import downscale
from patchproof.mesh.mesh import Material, Mesh, MeshPart, mesh_from_parts, transform_part

if TYPE_CHECKING:
    from patchproof.mesh.assets import Assets

PYTHON_PREFIX = "python:"

# Larger textures are reduced: 8192 × 8192 took 4 GB and 5 s to set up, more detail than any photograph shows.
LARGEST_TEXTURE_PX = 4096
_M_FROM_MM = 1e-3
_Y_UP_FROM_Z_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
SECONDS = 40.0  # of processor time to read a mesh, and more for long files, of which text takes longest:
_BYTES_PER_SECOND = 500_000
FORMATS = {".obj": "obj", ".glb": "gltf", ".gltf": "gltf", ".ply": "ply", ".stl": "stl"}
_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def load_mesh(path: str | Path, length_mm: float, up: Literal["y", "z"] = "z", mesh_glb: bytes | None = None) -> Mesh:
    """Load a file, `primitive:NAME` or the GLB given for `python:NAME` as a mesh with the longest extent `length_mm`.
    `up = "z"` turns (x, y, z) into (x, z, -y), except for primitives, which are y up. Refused if nothing can be drawn
    or a texture is missing.
    """
    if str(path).startswith("primitive:"):
        from patchproof.mesh import primitives

        mesh = primitives.build(str(path).removeprefix("primitive:"), 0)
        return replace(mesh, vertices=mesh.vertices * (length_mm / np.ptp(mesh.vertices, axis=0).max()))
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
    reduced, warnings = dict[Material, Material](), []
    for material in dict.fromkeys(part.material for part in parts):
        texture = material.texture_srgb
        if texture is not None and max(texture.shape[:2]) > LARGEST_TEXTURE_PX:
            reduced[material] = replace(material, texture_srgb=(small := downscale(texture, LARGEST_TEXTURE_PX)))
            old_size, new_size = (f"{pixels.shape[1]} × {pixels.shape[0]}" for pixels in (texture, small))
            warnings.append(f"the texture of {old_size} of {material.name} is reduced to {new_size}")
    return [replace(part, material=reduced.get(part.material, part.material)) for part in parts], warnings


def read_parts(path: Path, world_from_file: np.ndarray) -> tuple[list[MeshPart], list[str], list[Path]]:
    """Read every placed geometry with faces, turned by `world_from_file` 3×3. Returns the parts, warnings, and the
    files that were read.
    """
    if not is_file(path) or not path.stat().st_size:  # some files of the system are empty, and never end
        raise Refused("a mesh file", f"no file at {path}, or an empty one", "check the path")
    kind = FORMATS.get(path.suffix.lower())
    if kind is None:
        raise Refused(f"a mesh file ({', '.join(FORMATS)})", path.name, "export the mesh in one of these formats")
    from patchproof.mesh.assets import Assets

    try:
        assets = Assets(path)
        read = read_stl if kind == "stl" else getattr(import_module(f"patchproof.mesh.{kind}"), f"read_{kind}")
        parts = run_within_seconds(SECONDS + len(assets.data) / _BYTES_PER_SECOND, lambda: read(assets))
        world_from_file = np.column_stack([world_from_file, np.zeros(3)])
        parts = [transform_part(part, world_from_file) for part in parts if len(part.faces)]
        if not parts:
            raise Refused("a mesh with faces", f"no face in {path.name}", "export the object as triangles")
        for part in parts:
            if part.faces.min() < 0 or part.faces.max() >= len(part.vertices):
                got, last = f"{part.faces.min()} to {part.faces.max()} in {path.name}", len(part.vertices) - 1
                raise Refused(f"faces that name vertices 0 to {last}", got, "export the mesh again")
        return parts, [*assets.warnings], assets.files
    except Refused:
        raise
    except Exception as error:  # broken files raise many types of error
        got = f"{path.name} that cannot be read ({f'{type(error).__name__}: {error}'[:120]})"
        raise Refused(f"a mesh as {path.suffix[1:].upper()}", got, "export it again") from error


def read_stl(assets: "Assets") -> list[MeshPart]:
    """Read an STL file, text or binary, as one part without its colors, which programs write in different ways."""
    data = assets.data
    if len(data) >= 84 and len(data) == 84 + _FACET.itemsize * int.from_bytes(data[80:84], "little"):
        facets = np.frombuffer(data, _FACET, offset=84)
        corners = facets["corners"].reshape(-1, 3).astype(float)
        if facets["attribute"].any() or b"COLOR=" in data[:80]:
            assets.say("colors in the STL file are left out")
    elif b"endsolid" in data.lower():
        rows = re.findall(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", data.lower())
        corners = np.array([[*map(float, row)] for row in rows]).reshape(-1, 3)
    else:
        raise ValueError("neither text nor of the size that it states")
    return [MeshPart(corners, np.arange(len(corners)).reshape(-1, 3), assets.gray())]


def write_glb(mesh: Mesh, textures: Sequence[np.ndarray], path: str | Path) -> None:
    """Write `mesh` with `textures` (uint8 H×W×3, one per material) to a .glb file. They stand for the whole color, so
    base colors are not written; corner colors other than 1 are, in 8 bits of light.
    """
    import trimesh
    from trimesh.exchange.gltf import export_glb

    scene = trimesh.Scene()
    for index, (material, texture) in enumerate(zip(mesh.materials, textures, strict=True)):
        faces = np.flatnonzero(mesh.face_material == index)
        if len(faces):
            scene.add_geometry(_geometry(mesh, faces, material.name, texture), geom_name=f"{index}_{material.name}")
    Path(path).write_bytes(export_glb(scene, include_normals=True))


def _geometry(mesh: Mesh, faces: np.ndarray, name: str, texture: np.ndarray):
    """Return some faces as a trimesh with a matte texture, in which corners with equal values are one vertex."""
    import trimesh
    from PIL import Image
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    arrays = mesh.vertices[mesh.faces], mesh.corner_normal, mesh.corner_uv, mesh.corner_color_linear
    corners = np.concatenate([array[faces].reshape(3 * len(faces), -1).astype(float) for array in arrays], axis=1)
    corners, index = np.unique(corners, axis=0, return_inverse=True)
    position, normal, uv, color = np.split(corners, [3, 6, 8], axis=1)
    image = Image.fromarray(texture)
    material = PBRMaterial(name=name, baseColorTexture=image, metallicFactor=0.0, roughnessFactor=1.0, doubleSided=True)
    visual = TextureVisuals(uv=np.column_stack([uv[:, 0], 1 - uv[:, 1]]), material=material)
    if np.any(color != 1):
        # trimesh always writes bytes
        visual.vertex_attributes["color"] = codes_from_srgb(np.insert(color, 3, 1.0, axis=1))
    faces = index.reshape(-1, 3)
    return trimesh.Trimesh(position * _M_FROM_MM, faces, vertex_normals=normal, visual=visual, process=False)
