"""The surfaces that views show: the piece in millimeters, and the object with its textures; look-ups in fixed textures.

In: a mesh, or a scene with a piece; per fragment the arguments of `texture.footprint`. Out: tensors on a device, and
the P×3 that fragments see. The piece reaches a margin beyond its cut line, so that pixels cut by its edge are found and
show their share of it. All mip levels of fixed textures lie in one picture (an atlas), each with a margin that
continues the texture farther than footprints reach. So torch's own look-up can take all taps, which takes half of the
time in views and three quarters in photographs.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial, reduce
from itertools import chain

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from patchproof.base.color import linear_from_srgb
from patchproof.mesh.mesh import Mesh
from patchproof.mesh.surface_chart import grid_faces
from patchproof.render.outlines import Edges, find_edges
from patchproof.render.texture import TexelLayout, mip_levels, tap_grids, texel_layout, texel_table
from patchproof.scene.interface import PieceScene

# Share of the piece's sides: the half pixel that is needed, for pieces of 7 pixels or more (25 pixels at 75° of tilt).
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
    """The object's faces; `corners` F×3×8: uv, color (vertex times base color, linear) and normal to interpolate."""

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
    table = texel_table if atlas is None else partial(atlas_table, layout=atlas)
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


MAX_TAPS = 4  # along a footprint's shorter side
# A grid of MAX_TAPS by twice as many, a texel apart, reaches 6 texels from its middle, or 9 if halving has dropped a
# row of three; a tap reaches one texel more.
_MARGIN = 10


def atlas_layout(sizes: Sequence[tuple[int, int]], device: torch.device | str = "cpu") -> TexelLayout:
    """Lay out textures of (width, height) on shelves, the highest first, coarser levels to the right of the finest."""
    chains = [[(max(w >> k, 1), max(h >> k, 1)) for k in range(max(w, h).bit_length())] for w, h in sizes]
    blocks = [_block(chain) for chain in chains]
    pitch = max(*(width for width, _ in blocks), int(sum(width * height for width, height in blocks) ** 0.5))
    depth, corner, shelf = max(map(len, chains)), (0, 0), 0
    table = [[(1, 1, 0)] * depth for _ in chains]
    for k in sorted(range(len(chains)), key=lambda k: -blocks[k][1]):
        width, height = blocks[k]
        if corner[0] + width > pitch:
            corner, shelf = (0, corner[1] + shelf), 0
        x, y = corner
        for level, (w, h) in enumerate(chains[k]):
            table[k][level] = w, h, (y + _MARGIN) * pitch + x + _MARGIN
            x, y = (x + w + 2 * _MARGIN, y) if level == 0 else (x, y + h + 2 * _MARGIN)
        corner, shelf = (corner[0] + width, corner[1]), max(shelf, height)
    levels = torch.tensor([len(chain) for chain in chains], device=device)
    return TexelLayout(torch.tensor(table, device=device).flatten(0, 1), levels, True, pitch)


def _block(chain: list[tuple[int, int]]) -> tuple[int, int]:
    """Return the width and height that a texture's levels take."""
    (width, height), *smaller = [(w + 2 * _MARGIN, h + 2 * _MARGIN) for w, h in chain]
    return width + max((w for w, _ in smaller), default=0), max(height, sum(h for _, h in smaller))


def atlas_table(textures: Sequence[Tensor], layout: TexelLayout) -> Tensor:
    """Return the T×3 texels of all mip levels of H×W×3 textures."""
    assert layout.pitch is not None
    places = layout.places.view(len(textures), -1, 3).tolist()
    lowest = max((first // layout.pitch) + height for rows in places for _, height, first in rows)
    table = textures[0].new_zeros(lowest + _MARGIN, layout.pitch, 3)
    for texture, rows in zip(textures, places, strict=True):
        for level, (w, h, first) in zip(mip_levels(texture), rows, strict=False):
            y, x = (corner - _MARGIN for corner in divmod(first, layout.pitch))
            down, across = (torch.arange(-_MARGIN, side + _MARGIN, device=table.device) % side for side in (h, w))
            table[y : y + len(down), x : x + len(across)] = level[:, down][:, :, across].permute(1, 2, 0)
    return table.flatten(0, 1)


def sample_atlas(
    layout: TexelLayout, texels: Tensor, texture: Tensor, uv: Tensor, uv_dx: Tensor, uv_dy: Tensor, taps: int
) -> Tensor:
    """Return the P×3 that fragments see in an atlas; arguments as in `texture.footprint`, `taps` at most MAX_TAPS."""
    assert layout.pitch is not None and taps <= MAX_TAPS
    picture = texels.view(1, -1, layout.pitch, 3).permute(0, 3, 1, 2)
    places, counts = _place_grids(layout, picture.shape[2], texture, uv, uv_dx, uv_dy, taps)
    if counts is None:
        return F.grid_sample(picture, torch.stack(places, 1)[None, None], align_corners=False)[0, :, 0].T
    order, grids = _group_by_grid(*counts)
    places = torch.stack([values.index_select(0, order) for values in places]).view(3, 2, 1, 1, -1)
    colors = texels.new_empty(len(order), 3)
    for columns, rows, begin, end in grids:
        middle, right, down = places[..., begin:end]
        across = right * _tap_offsets(columns, texels.device)[:, None]
        points = middle + across + down * _tap_offsets(rows, texels.device)[:, None, None]
        tap_colors = F.grid_sample(picture, points.flatten(1, 2).permute(1, 2, 0)[None], align_corners=False)[0]
        # added one after the other, because the rounding of `mean` depends on the number of fragments
        colors[begin:end] = reduce(torch.add, tap_colors.unbind(1)).T / (columns * rows)
    return torch.empty_like(colors).index_copy_(0, order, colors)


def _place_grids(
    layout: TexelLayout, height: int, texture: Tensor, uv: Tensor, uv_dx: Tensor, uv_dy: Tensor, taps: int
) -> tuple[list[Tensor], tuple[Tensor, Tensor] | None]:
    """Return each of P grids' middle (x, y) and steps (x, y) to the right and down between its taps, in half widths and
    heights of the picture from its middle, which the look-up takes; and the numbers of taps across and down. Of single
    taps the middle alone, and None.
    """
    assert layout.pitch is not None
    *sizes, first = layout.places.T.contiguous()
    finest, levels = texture * (len(first) // len(layout.levels)), layout.levels.index_select(0, texture)
    sides = list(zip(uv_dx.T, uv_dy.T, strict=True))
    extents = (size.float().index_select(0, finest) for size in sizes)
    x, y = ([side * extent for side in pair] for pair, extent in zip(sides, extents, strict=True))
    across, down = ((a * a).add_(b * b).sqrt_() for a, b in zip(x, y, strict=True))
    level, counts = tap_grids(across, down, levels, taps)
    middles, steps, place = [], [], finest + level
    corners = (first % layout.pitch) * (2 / layout.pitch) - 1, (first // layout.pitch) * (2 / height) - 1
    for axis, side_px in enumerate((layout.pitch, height)):
        size, corner = (table[axis].index_select(0, place) for table in (sizes, corners))
        extent = size * (2 / side_px)
        middles.append((uv[:, axis] - uv[:, axis].floor()).mul_(extent).add_(corner))
        if counts is not None:
            extent = extent.masked_fill(size == 1, 0)  # one texel: one color everywhere
            steps.append([side * extent / count for side, count in zip(sides[axis], counts, strict=True)])
    return [*middles, *chain.from_iterable(zip(*steps, strict=True))], counts


def _group_by_grid(across: Tensor, down: Tensor) -> tuple[Tensor, list[tuple[int, int, int, int]]]:
    """Sort footprints by grid, stably. Return that order, and each grid's (columns, rows, first, end) in it."""
    base = 1 << 7
    sorted_keys, order = (across * base + down).sort(stable=True)
    keys, sizes = sorted_keys.unique_consecutive(return_counts=True)
    grids, first = [], 0
    for key, size in torch.stack([keys, sizes]).T.tolist():
        grids.append((*divmod(key, base), first, first + size))
        first += size
    return order, grids


@lru_cache
def _tap_offsets(count: int, device: torch.device) -> Tensor:
    """Return the offsets of `count` taps, one apart round 0."""
    return torch.arange(count, device=device) - (count - 1) / 2
