"""Export the object with its textures as one GLB file for other programs.

In: a mesh and one uint8 sRGB texture per material. Out: glTF 2.0, in meters as its specification wants (the mesh is in
millimeters), y up, textures as lossless PNG inside, repeating. trimesh writes it; nothing in it depends on the time, so
the same textures give the same bytes. Surfaces are matte and visible from both sides, as in the renderer here. Left out
on purpose: lights and cameras. Material names are kept and may repeat; geometries are numbered.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from patchproof.base.color import codes_from_srgb
from patchproof.mesh.mesh import Mesh

_M_FROM_MM = 1e-3


def write_glb(mesh: Mesh, textures: Sequence[np.ndarray], path: str | Path) -> None:
    """Write `mesh` with `textures` (uint8 H×W×3, one per material, in place of the material's own) to a .glb file.

    Textures stand for the whole color: base colors are not written; corner colors other than 1 are, in 8 bits of light.
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
