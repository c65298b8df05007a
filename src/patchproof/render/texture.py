"""Textures with mip levels: where each fragment looks (`Footprint`) and what it sees there (`look_up`).

In: textures H×W×3 in linear light and, per fragment, uv (textures, v down from the top-left) with its screen
derivatives. Out: P×3 linear light. A footprint depends on the view alone, so one footprint serves every content that
the texture takes while it is optimized; `look_up` is the only step that backpropagates, and its gradient reaches each
texel that was seen and no other.

Filtering: mip levels by box averages, trilinear, and up to `taps` samples along the longer axis of the pixel's
footprint, the scheme of Feline (McCormack et al., 1999) in its simplest form. Left out on purpose: elliptical weights.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

# Longest footprint that is still filtered along its axis: beyond 4:1 (about 75° of tilt) it blurs instead.
TAPS = 4


@dataclass(frozen=True)
class Layout:
    """Where the mip levels of K textures lie in one T×3 table of texels: sizes and offsets K×L, number of levels K."""

    width: Tensor
    height: Tensor
    offset: Tensor
    levels: Tensor
    texels: int
    wrap: bool


@dataclass(frozen=True)
class Footprint:
    """Texels and weights, P×J each, whose weighted sum is what P fragments see."""

    texel: Tensor
    weight: Tensor


def layout(sizes: list[tuple[int, int]], wrap: bool, device: torch.device | str = "cpu") -> Layout:
    """The layout for textures of (width, height) sizes; `wrap` repeats them, else the border texel goes on."""
    depth = max(max(size).bit_length() for size in sizes)
    table, offset = [], 0
    for width, height in sizes:
        levels = []
        for level in range(depth):
            w, h = max(width >> level, 1), max(height >> level, 1)
            levels.append((w, h, offset))
            if level < max(width, height).bit_length():
                offset += w * h
        table.append(levels)
    w, h, o = torch.tensor(table, device=device).unbind(-1)
    levels = torch.tensor([max(size).bit_length() for size in sizes], device=device)
    return Layout(w, h, o, levels, offset, wrap)


def texel_table(textures: list[Tensor]) -> Tensor:
    """The T×3 texels of all mip levels of H×W×3 textures, in the order of `layout`; differentiable."""
    parts = []
    for level in textures:
        for k in range(max(level.shape[:2]).bit_length()):
            if k:
                level = _halved(_halved(level).transpose(0, 1)).transpose(0, 1)
            parts.append(level.flatten(0, 1))
    return torch.cat(parts)


def _halved(level: Tensor) -> Tensor:
    """Half the rows (rounded down, at least one), each the average of exactly what it covers.

    Of 2m + 1 rows, row i of m covers two and 1/m; weights of Guthe and Heckbert, Non-Power-of-Two Mipmapping (2005).
    Averages over whole rows instead would stretch a texture by up to half a row at either end.
    """
    rows = len(level)
    if rows == 1:
        return level
    if rows % 2 == 0:
        return (level[0::2] + level[1::2]) / 2
    half = rows // 2
    i = torch.arange(half, dtype=level.dtype, device=level.device)[:, None, None]
    return ((half - i) * level[0:-1:2] + half * level[1::2] + (i + 1) * level[2::2]) / rows


def footprint(where: Layout, texture: Tensor, uv: Tensor, uv_dx: Tensor, uv_dy: Tensor, taps: int = TAPS) -> Footprint:
    """What P fragments of `texture` (P, index into the layout) see; `uv_dx`, `uv_dy` P×2: uv change per pixel."""
    size = torch.stack([where.width[texture, 0], where.height[texture, 0]], -1).float()
    along_x, along_y = uv_dx * size, uv_dy * size  # texels per pixel
    length_x, length_y = along_x.norm(dim=-1), along_y.norm(dim=-1)
    major = torch.where((length_x >= length_y)[:, None], uv_dx, uv_dy)
    longest = torch.maximum(length_x, length_y).clamp_min(1e-9)
    area = (along_x[:, 0] * along_y[:, 1] - along_x[:, 1] * along_y[:, 0]).abs()
    lod = torch.maximum(area / longest, longest / taps).clamp_min(1e-9).log2()
    lod = lod.clamp_min(0).minimum((where.levels[texture] - 1).float())
    low = lod.floor().long()
    high = (low + 1).minimum(where.levels[texture] - 1)
    texels, weights = [], []
    for tap in range(taps):
        at = uv + major * ((tap + 0.5) / taps - 0.5)
        for level, share in ((low, 1 - (lod - low)), (high, lod - low)):
            texel, weight = _bilinear(where, texture, level, at)
            texels.append(texel)
            weights.append(weight * (share / taps)[:, None])
    return Footprint(torch.cat(texels, 1), torch.cat(weights, 1))


def look_up(seen: Footprint, texels: Tensor) -> Tensor:
    """The P×3 light that footprints see in a T×3 table; differentiable in `texels`."""
    return _LookUp.apply(texels, seen.texel, seen.weight)


class _LookUp(torch.autograd.Function):
    """A weighted gather. The library's own backward of the same sum took six times longer (2 cores, 75k × 8)."""

    @staticmethod
    def forward(ctx, texels: Tensor, index: Tensor, weight: Tensor) -> Tensor:
        ctx.save_for_backward(index, weight)
        ctx.texels = len(texels)
        return F.embedding_bag(index, texels, per_sample_weights=weight.to(texels.dtype), mode="sum")

    @staticmethod
    def backward(ctx, gradient: Tensor):
        index, weight = ctx.saved_tensors
        spread = (weight.to(gradient.dtype)[..., None] * gradient[:, None]).flatten(0, 1)
        return gradient.new_zeros(ctx.texels, 3).index_add_(0, index.flatten(), spread), None, None


def _bilinear(where: Layout, texture: Tensor, level: Tensor, uv: Tensor) -> tuple[Tensor, Tensor]:
    """The four texels round uv and their weights, P×4."""
    width, height = where.width[texture, level], where.height[texture, level]
    x, y = uv[:, 0] * width - 0.5, uv[:, 1] * height - 0.5
    x0, y0 = x.floor(), y.floor()
    fx, fy = x - x0, y - y0
    columns, rows = torch.stack([x0, x0 + 1], 1).long(), torch.stack([y0, y0 + 1], 1).long()
    width, height = width[:, None], height[:, None]
    if where.wrap:
        columns, rows = columns % width, rows % height
    else:
        columns, rows = columns.clamp_min(0).minimum(width - 1), rows.clamp_min(0).minimum(height - 1)
    texel = where.offset[texture, level][:, None] + torch.cat(
        [rows[:, :1] * width + columns, rows[:, 1:] * width + columns], 1
    )
    weight = torch.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], 1)
    return texel, weight
