"""Textures that nothing changes, read at once: no numbers of texels are kept, as what is learned needs them.

In: textures H×W×3 that repeat, and per fragment what `texture.footprint` takes. Out: the P×3 that they see, in the
same taps. All mip levels lie in one picture, each with a margin that goes on as the texture does and is wider than
footprints reach, so that taps need not be wrapped and the library's own look-up takes them all: in half of the time in
views, in three quarters in photographs.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from itertools import chain

import torch
from torch import Tensor
from torch.nn import functional as F

from patchproof.render.texture import TexelLayout, footprint, group_by_grid, look_up, mip_levels, tap_grids, tap_offsets

MOST_TAPS = 4  # along a footprint's shorter side
# A grid of MOST_TAPS by twice as many, a texel apart, reaches 6 texels from its middle; where halving has lost a row of
# three, 9; and a tap one texel more.
_MARGIN = 10


def atlas_layout(sizes: Sequence[tuple[int, int]], device: torch.device | str = "cpu") -> TexelLayout:
    """The layout for textures of (width, height) sizes: the finest level on the left, the others below each other on
    its right, and textures on shelves, the highest first.
    """
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
    """Width and height that a texture's levels take."""
    (width, height), *smaller = [(w + 2 * _MARGIN, h + 2 * _MARGIN) for w, h in chain]
    return width + max((w for w, _ in smaller), default=0), max(height, sum(h for _, h in smaller))


def atlas_table(textures: Sequence[Tensor], where: TexelLayout) -> Tensor:
    """The T×3 texels of all mip levels of H×W×3 textures."""
    assert where.pitch is not None
    places = where.places.view(len(textures), -1, 3).tolist()
    lowest = max((first // where.pitch) + height for rows in places for _, height, first in rows)
    table = textures[0].new_zeros(lowest + _MARGIN, where.pitch, 3)
    for texture, rows in zip(textures, places, strict=True):
        for level, (width, height, first) in zip(mip_levels(texture), rows, strict=False):
            y, x = (corner - _MARGIN for corner in divmod(first, where.pitch))
            down, across = (
                torch.arange(-_MARGIN, side + _MARGIN, device=table.device) % side for side in (height, width)
            )
            table[y : y + len(down), x : x + len(across)] = level[down][:, across]
    return table.flatten(0, 1)


def sample_atlas(
    where: TexelLayout, texels: Tensor, texture: Tensor, uv: Tensor, uv_dx: Tensor, uv_dy: Tensor, taps: int
) -> Tensor:
    """The P×3 that fragments see in an atlas; arguments as `texture.footprint` has them, with `taps` up to MOST_TAPS.
    A single tap is found by its texels' numbers, in as much time.
    """
    assert where.pitch is not None and taps <= MOST_TAPS
    if taps == 1:
        return look_up(footprint(where, texture, uv, uv_dx, uv_dy, taps), texels)
    picture = texels.view(1, -1, where.pitch, 3).permute(0, 3, 1, 2)
    places, counts = _placed(where, picture.shape[2], texture, uv, uv_dx, uv_dy, taps)
    order, grids = group_by_grid(*counts)
    places = torch.stack([values.index_select(0, order) for values in places]).view(3, 2, 1, 1, -1)
    seen = texels.new_empty(len(order), 3)
    for columns, rows, begin, end in grids:
        middle, right, down = places[..., begin:end]
        across = right * tap_offsets(columns, texels.device)[:, None]
        at = middle + across + down * tap_offsets(rows, texels.device)[:, None, None]
        taken = F.grid_sample(picture, at.flatten(1, 2).permute(1, 2, 0)[None], align_corners=False)[0]
        # one after the other: `mean` rounds as the number of fragments has it
        seen[begin:end] = reduce(torch.add, taken.unbind(1)).T / (columns * rows)
    return torch.empty_like(seen).index_copy_(0, order, seen)


def _placed(
    where: TexelLayout, height: int, texture: Tensor, uv: Tensor, uv_dx: Tensor, uv_dy: Tensor, taps: int
) -> tuple[list[Tensor], tuple[Tensor, Tensor]]:
    """The middle (x, y) of each of P grids, the steps (x, y) to the right and down between its taps, all as the look-up
    has them, in half widths and heights of the picture from its own middle; and how many taps go across and down.
    """
    assert where.pitch is not None
    *sizes, first = where.places.T.contiguous()
    corners, whole = (first % where.pitch, first // where.pitch), (where.pitch, height)
    finest, levels = texture * (len(first) // len(where.levels)), where.levels.index_select(0, texture)
    sides = [(right.contiguous(), down.contiguous()) for right, down in zip(uv_dx.T, uv_dy.T, strict=True)]
    extents = (size.float().index_select(0, finest) for size in sizes)
    x, y = ([side * extent for side in pair] for pair, extent in zip(sides, extents, strict=True))
    across, down = ((a * a + b * b).sqrt() for a, b in zip(x, y, strict=True))
    level, counts = tap_grids(across, down, levels, taps)
    assert counts is not None
    middles, steps = [], []
    for axis in range(2):
        size, corner = (table[axis].float().index_select(0, finest + level) for table in (sizes, corners))
        at = uv[:, axis] * size - 0.5
        middles.append((at - (at / size).floor() * size + corner + 0.5) * (2 / whole[axis]) - 1)
        per_texel = (size * (2 / whole[axis])).masked_fill(size == 1, 0)  # of one color, where taps may reach far
        steps.append([side * per_texel / count for side, count in zip(sides[axis], counts, strict=True)])
    return [*middles, *chain.from_iterable(zip(*steps, strict=True))], counts
