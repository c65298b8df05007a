"""The surfaces that views show: the piece in millimeters, and the object with its textures.

In: a mesh, or a scene with a piece. Out: tensors on a device. The piece reaches a margin beyond its cut line, so that
pixels cut by its edge are found and can show their share of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
import torch
from torch import Tensor

from patchproof.base.color import linear_from_srgb
from patchproof.mesh.mesh import Mesh
from patchproof.mesh.surface_chart import grid_faces
from patchproof.render.atlas import atlas_layout, atlas_table
from patchproof.render.outlines import Edges, find_edges
from patchproof.render.texture import TexelLayout, texel_layout, texel_table
from patchproof.scene.interface import PieceScene

# A share of the piece's sides: half a pixel, the need, down to pieces of 7 pixels, or of 25 pixels at 75° of tilt.
MARGIN_SHARE = 0.1


@dataclass(frozen=True)
class PieceSurface:
    """The piece in the world: faces over `vertices` V×3, and per face corner F×3 its millimeters and normal."""

    vertices: Tensor
    faces: Tensor
    corner_mm: Tensor
    corner_normal: Tensor
    size_mm: tuple[float, float]


@dataclass(frozen=True)
class ObjectSurface:
    """The object: faces over `vertices`, and per face corner F×3×8 the values to interpolate: uv, color (vertex color
    times base color, linear) and normal.
    """

    vertices: Tensor
    faces: Tensor
    corners: Tensor
    material: Tensor
    textures_srgb: tuple[Tensor, ...]  # H×W×3 in [0, 1], one per material
    edges: Edges

    @cached_property
    def corner_uv(self) -> Tensor:
        """The texture coordinates alone, F×3×2."""
        return self.corners[..., :2].contiguous()

    @cached_property
    def layout(self) -> TexelLayout:
        """The positions of the texels of textures that may change."""
        return texel_layout(self._sizes_px, wrap=True, device=self.material.device)

    @cached_property
    def atlas(self) -> TexelLayout:
        """The positions of the texels of fixed textures."""
        return atlas_layout(self._sizes_px, self.material.device)

    @property
    def _sizes_px(self) -> list[tuple[int, int]]:
        return [(texture.shape[1], texture.shape[0]) for texture in self.textures_srgb]

    def texels(self, reduced: bool, fixed: bool) -> Tensor:
        """Return the `light_texels` of its textures: in their atlas if `fixed`, else in the changeable layout."""
        if (reduced, fixed) not in self._tables:
            self._tables[reduced, fixed] = light_texels(self.textures_srgb, reduced, self.atlas if fixed else None)
        return self._tables[reduced, fixed]

    @cached_property
    def _tables(self) -> dict[tuple[bool, bool], Tensor]:
        return {}


def light_texels(textures_srgb: Sequence[Tensor], reduced: bool, atlas: TexelLayout | None = None) -> Tensor:
    """Return the T×3 linear light of textures that repeat, their mip levels averaged as light or, `reduced`, as code
    values; differentiable except in an `atlas`.
    """
    table = partial(texel_table, wrap=True) if atlas is None else partial(atlas_table, layout=atlas)
    if reduced:
        return linear_from_srgb(table(list(textures_srgb)))
    return table([linear_from_srgb(texture) for texture in textures_srgb])


def object_surface(mesh: Mesh, device: torch.device) -> ObjectSurface:
    """Return the surface of a mesh with its textures."""
    base = np.array([material.base_color_linear for material in mesh.materials], np.float32)
    srgb = [material.texture_srgb for material in mesh.materials]
    textures = (torch.ones(1, 1, 3) if t is None else torch.tensor(t, dtype=torch.float32) / 255 for t in srgb)
    color = mesh.corner_color_linear * base[mesh.face_material][:, None]
    corners = np.concatenate([mesh.corner_uv, color, mesh.corner_normal], 2)
    arrays = mesh.vertices, mesh.faces, corners, mesh.face_material
    vertices, faces, corners, material = (torch.as_tensor(np.ascontiguousarray(a), device=device) for a in arrays)
    textures = tuple(texture.to(device) for texture in textures)
    return ObjectSurface(vertices, faces, corners, material, textures, find_edges(mesh, device))


def piece_surface(scene: PieceScene, device: torch.device) -> PieceSurface:
    """Return the surface of a scene's piece, continued straight beyond its border on all sides."""
    vertices, normals, piece_mm = scene.paper()
    width_mm, height_mm = piece_mm.max(0).tolist()
    size_mm = width_mm, height_mm
    columns, rows = (len(np.unique(piece_mm[:, i])) for i in range(2))
    grid = np.concatenate([vertices, normals, piece_mm], 1).reshape(rows, columns, 8)
    for axis, (side, count) in enumerate(zip(size_mm[::-1], (rows, columns), strict=True)):
        grid = _extend_grid(grid, axis, MARGIN_SHARE * side / (side / (count - 1)))
    rows, columns = grid.shape[:2]
    flat = torch.as_tensor(grid.reshape(-1, 8), device=device)
    faces = torch.as_tensor(grid_faces(columns, rows), device=device)
    at_corners = flat.float()[faces]
    return PieceSurface(flat[:, :3].contiguous(), faces, at_corners[..., 6:], at_corners[..., 3:6], size_mm)


def _extend_grid(grid: np.ndarray, axis: int, steps: float) -> np.ndarray:
    """Return the grid with one more row (or column) at either end, `steps` of its spacing away in a straight line."""
    grid = np.moveaxis(grid, axis, 0)
    before, after = grid[0] + steps * (grid[0] - grid[1]), grid[-1] + steps * (grid[-1] - grid[-2])
    return np.moveaxis(np.concatenate([before[None], grid, after[None]]), 0, axis)
