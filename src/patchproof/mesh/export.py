"""Export the object with its textures, and the piece on it if there is one, as one GLB file for other programs.

In: a mesh, one uint8 sRGB texture per material, and the piece as a textured part. Out: glTF 2.0, in meters as its
specification wants (the mesh is in millimeters), y up, textures as lossless PNG inside, repeating. trimesh writes it;
nothing in it depends on the time, so the same textures give the same bytes. Surfaces are matte and visible from both
sides, as in the renderer here. Left out on purpose: lights and cameras. Material names are kept and may repeat;
geometries are numbered.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from patchproof.base.color import codes_from_srgb
from patchproof.mesh.mesh import Mesh, MeshPart

_M_FROM_MM = 1e-3


def write_glb(mesh: Mesh, textures: Sequence[np.ndarray], path: str | Path, piece: MeshPart | None = None) -> None:
    """Write `mesh` with `textures` (uint8 H×W×3, one per material, in place of the material's own) to a .glb file, with
    `piece` on it, if given, in a texture of its own.

    Textures stand for the whole color: base colors are not written; corner colors other than 1 are, in 8 bits of light.
    """
    import trimesh
    from trimesh.exchange.gltf import export_glb

    scene = trimesh.Scene()
    for index, (material, texture) in enumerate(zip(mesh.materials, textures, strict=True)):
        faces = np.flatnonzero(mesh.face_material == index)
        if len(faces):
            scene.add_geometry(_geometry(mesh, faces, material.name, texture), geom_name=f"{index}_{material.name}")
    if piece is not None:
        if piece.uv is None or piece.normals is None or piece.material.texture_srgb is None:
            raise ValueError("a part without a texture")
        arrays = piece.vertices, piece.faces, piece.normals, piece.uv
        scene.add_geometry(_textured(*arrays, piece.material.name, piece.material.texture_srgb), geom_name="piece")
    Path(path).write_bytes(export_glb(scene, include_normals=True))


def _geometry(mesh: Mesh, faces: np.ndarray, name: str, texture: np.ndarray):
    """Return some faces as a trimesh in which corners with equal values are one vertex."""
    arrays = mesh.vertices[mesh.faces], mesh.corner_normal, mesh.corner_uv, mesh.corner_color_linear
    corners = np.concatenate([array[faces].reshape(3 * len(faces), -1).astype(float) for array in arrays], axis=1)
    corners, index = np.unique(corners, axis=0, return_inverse=True)
    position, normal, uv, color = np.split(corners, [3, 6, 8], axis=1)
    return _textured(position, index.reshape(-1, 3), normal, uv, name, texture, color)


def _textured(vertices_mm, faces, normals, uv: np.ndarray, name: str, texture: np.ndarray, color: ArrayLike = 1.0):
    """Return a trimesh with a matte texture over coordinates V×2 with v down, multiplied by corner colors V×3."""
    import trimesh
    from PIL import Image
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    image = Image.fromarray(texture)
    material = PBRMaterial(name=name, baseColorTexture=image, metallicFactor=0.0, roughnessFactor=1.0, doubleSided=True)
    visual = TextureVisuals(uv=np.column_stack([uv[:, 0], 1 - uv[:, 1]]), material=material)
    if np.any(np.asarray(color) != 1):
        # trimesh always writes bytes
        visual.vertex_attributes["color"] = codes_from_srgb(np.insert(np.asarray(color), 3, 1.0, axis=1))
    return trimesh.Trimesh(vertices_mm * _M_FROM_MM, faces, vertex_normals=normals, visual=visual, process=False)
