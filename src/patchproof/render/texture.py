"""Textures with mip levels: find the texels that each fragment sees (`footprint`), and their color (`look_up`).

In: textures H×W×3 and, per fragment, uv (in textures, v down from the top-left) with its screen derivatives. Out: P×3.
A footprint depends on the view alone and serves every content of the texture. Only `look_up` backpropagates, and its
gradient reaches exactly the texels that were seen.

A pixel sees the mean over its footprint, the parallelogram that its sides span on the texture. `footprint` samples it
with a grid of bilinear taps at most a texel apart, on a mip level (exact box averages) coarse enough to limit their
number. Trilinear look-ups along the longer side (Feline, McCormack et al., 1999) left an optimized design 20 to 30 dB
from 16×16 samples per pixel, this grid 33 to 57. Left out on purpose: filters other than the pixel's own square.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import chain

import torch
from torch import Tensor
from torch.nn import functional as F

CHUNK = 1 << 15  # fragments whose taps are found at a time, 128 each at most


@dataclass(frozen=True)
class TexelLayout:
    """The positions of the mip levels of K textures in one T×3 table of texels.

    `places` (K·L)×3 holds each level's width, height and first texel; `levels` K, how many of the L a texture has.
    Beyond its last row and column follow the first ones if textures repeat (`wrap`), else the last again. Rows follow
    each other, or lie `pitch` texels apart in one picture (surfaces.py).
    """

    places: Tensor
    levels: Tensor
    wrap: bool
    pitch: int | None = None

    def place(self, texture: Tensor, level: Tensor | int) -> tuple[Tensor, Tensor]:
        """Return (width and height 2×P float, first texel P int32) of levels of textures."""
        row = texture * (len(self.places) // len(self.levels)) + level
        place = self.places.T.contiguous().index_select(1, row)
        return place[:2].float(), place[2].int()


@dataclass(frozen=True)
class Footprint:
    """The texels that P fragments see: L texels with their weights, those of fragment i from `first[i]` to before
    `first[i + 1]`.
    """

    texel: Tensor
    weight: Tensor
    first: Tensor

    def part(self, first: int, last: int) -> "Footprint":
        """Return the footprint of the fragments from `first` to before `last`."""
        low, high = torch.stack([self.first[first], self.first[last]]).tolist()
        return Footprint(self.texel[low:high], self.weight[low:high], self.first[first : last + 1] - low)

    @property
    def fragment(self) -> Tensor:
        """L: the fragment that sees each texel."""
        return torch.repeat_interleave(self.first.diff(), output_size=len(self.texel)).int()

    @cached_property
    def seen_by(self) -> "Footprint":
        """The same the other way round: the fragments, with their weights, that see each texel up to the last seen."""
        first = F.pad(torch.bincount(self.texel).cumsum(0, dtype=torch.int), (1, 0))
        order = self.texel.argsort(stable=True)
        return Footprint(self.fragment.index_select(0, order), self.weight.index_select(0, order), first)


def texel_layout(sizes: list[tuple[int, int]], wrap: bool, device: torch.device | str = "cpu") -> TexelLayout:
    """Return the layout for textures of (width, height) sizes; `wrap` repeats them, else the border texel continues."""
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
    levels = torch.tensor([max(size).bit_length() for size in sizes], device=device)
    return TexelLayout(torch.tensor(table, device=device).flatten(0, 1), levels, wrap)


def texel_table(textures: list[Tensor]) -> Tensor:
    """Return the T×3 texels of all mip levels of H×W×3 textures, in the order of `texel_layout`; differentiable."""
    levels = chain.from_iterable(map(mip_levels, textures))
    return torch.cat([level.flatten(1) for level in levels], 1).T.contiguous()


def mip_levels(texture: Tensor) -> Iterator[Tensor]:
    """Yield a texture H×W×3 as 3×H×W, its half, and so on down to one texel."""
    level = texture.permute(2, 0, 1)
    yield level
    for _ in range(max(texture.shape[:2]).bit_length() - 1):
        is_even = not (level.shape[1] % 2 or level.shape[2] % 2)  # the same, with a tenth of the operations
        level = F.avg_pool2d(level, 2) if is_even else _half_rows(_half_rows(level).mT).mT
        yield level


def _half_rows(level: Tensor) -> Tensor:
    """Return half the rows (rounded down, at least one), each the average of exactly the rows that it covers.

    Of 2m + 1 rows, row i of m covers two and 1/m; weights of Guthe and Heckbert, Non-Power-of-Two Mipmapping (2005).
    """
    rows = level.shape[1]
    if rows == 1:
        return level
    if rows % 2 == 0:
        return (level[:, 0::2] + level[:, 1::2]) / 2
    half = rows // 2
    i = torch.arange(half, dtype=level.dtype, device=level.device)[:, None]
    return ((half - i) * level[:, 0:-1:2] + half * level[:, 1::2] + (i + 1) * level[:, 2::2]) / rows


def footprint(
    layout: TexelLayout, texture: Tensor, uv: Tensor, uv_dx: Tensor, uv_dy: Tensor, taps: int, blocks: bool = False
) -> Footprint:
    """Return the footprint of P fragments on `texture` (P or 1, index into the layout); `uv_dx`, `uv_dy` P×2 are uv per
    pixel. There are at most `taps` along its shorter side and twice as many along the longer one; with `taps` = 1 there
    is one. Texels are points to interpolate between, or `blocks` of one color, like printed pixels.
    """
    uv, uv_dx, uv_dy = (values.T.contiguous() for values in (uv, uv_dx, uv_dy))
    size, _ = layout.place(texture, 0)
    spans = _lengths(uv_dx * size), _lengths(uv_dy * size)
    level, counts = tap_grids(*spans, layout.levels.index_select(0, texture), taps)
    columns, rows = counts or [torch.ones_like(level)] * 2
    size, corner = layout.place(texture, level)
    step_x, step_y, total = uv_dx * size / columns, uv_dy * size / rows, columns.int() * rows
    middle = uv * size - 0.5 - step_x * ((columns - 1) / 2) - step_y * ((rows - 1) / 2)  # of the first tap
    per_cell = 1 / _lengths(torch.stack([step_x, step_y])).clamp_(1e-6, 1)
    grids = torch.cat([middle, step_x, step_y, size, per_cell, torch.stack([columns, 1 / total])])
    first = F.pad(total.cumsum(0, dtype=torch.int), (1, 0))
    texel = torch.empty(int(first[-1]), 4, dtype=torch.int, device=uv.device)
    weight, done = torch.empty(texel.shape, device=uv.device), 0
    for start in range(0, len(total), CHUNK):
        part = slice(start, start + CHUNK)
        owner = torch.repeat_interleave(total[part])
        found = slice(done, done := done + len(owner))
        number = torch.arange(found.start, found.stop, device=uv.device) - first[part].index_select(0, owner)
        grid, corners = grids[:, part].index_select(1, owner), corner[part].index_select(0, owner)
        _write_taps(texel[found], weight[found], grid, number, corners, layout.wrap, blocks)
    return Footprint(texel.flatten(), weight.flatten(), 4 * first)


def tap_grids(across: Tensor, down: Tensor, levels: Tensor, taps: int) -> tuple[Tensor, tuple[Tensor, Tensor] | None]:
    """Return the mip level for each of P footprints, and the numbers of taps across and down; None for a single tap.
    `across` and `down` are the footprints' sizes in texels of the finest level.
    """
    max_taps = 2 * taps if taps > 1 else 1
    level = _levels(torch.minimum(across, down), torch.maximum(across, down), taps, max_taps).minimum(levels - 1)
    if max_taps == 1:
        return level, None
    texel_span = torch.exp2(-level.float())
    across, down = ((side * texel_span).ceil().clamp(1, max_taps).short() for side in (across, down))
    return level, (across, down)


def _lengths(vectors: Tensor) -> Tensor:
    x, y = vectors
    return (x * x).add_(y * y).sqrt_()


def _levels(shorter: Tensor, longer: Tensor, taps: int, max_taps: int) -> Tensor:
    """Return the finest level on which taps are at most a texel apart; a single tap may cover two texels."""
    reach = 2 if max_taps == 1 else 1
    coarse = torch.maximum(shorter / (reach * taps), longer / (reach * max_taps)).log2_().ceil_()
    return coarse.clamp_min_(0).long()


def _write_taps(
    texel: Tensor, weight: Tensor, grid: Tensor, number: Tensor, corner: Tensor, wrap: bool, blocks: bool
) -> None:
    """Write the texels and weights T×4 of taps with this `number` in their `grid` 12×T, whose level begins at the texel
    `corner`. A tap between points is bilinear. On blocks it is the mean over its cell, exactly if cell and blocks are
    parallel.
    """
    middle, step_x, step_y, size, per_cell = grid[:10].view(5, 2, -1)
    columns, mean = grid[10:]
    row = ((number + 0.5) / columns).floor_()
    position = middle + step_x * (number - row * columns) + step_y * row
    if wrap:
        position -= (position / size).floor_() * size
        low = torch.minimum(position.floor(), size - 1)  # rounding may leave a wrapped place at the size itself
    else:
        position = torch.minimum(position.clamp_min_(0), size - 1)
        low = position.floor()
    share = position.sub_(low)
    if blocks:
        share = ((share - 0.5) * per_cell).add_(0.5).clamp_(0, 1)
    width, right_and_below = size[0].int(), torch.where(low + 1 < size, 1, 1 - size if wrap else 0).int()
    (low_x, low_y), (x, y), (right, below) = low.int(), share, right_and_below
    above = low_y * width + low_x + corner
    for column, first in ((0, above), (2, above + below * width)):
        texel[:, column] = first
        torch.add(first, right, out=texel[:, column + 1])
    lower = y * mean
    for column, both in ((0, mean - lower), (2, lower)):
        other = both * x
        torch.sub(both, other, out=weight[:, column])
        weight[:, column + 1] = other


def look_up(footprint: Footprint, texels: Tensor) -> Tensor:
    """Return the P×3 that footprints see in a T×3 table; differentiable in `texels`."""
    return _LookUp.apply(texels, footprint)


class _LookUp(torch.autograd.Function):
    """A weighted gather. Its backward gathers, too, by texels: adding to them took three times as long."""

    @staticmethod
    def forward(ctx, texels: Tensor, footprint: Footprint) -> Tensor:
        ctx.footprint, ctx.texels = footprint, len(texels)
        return _weighted_sums(texels, footprint)

    @staticmethod
    def backward(ctx, *gradients: Tensor):
        seen = _weighted_sums(gradients[0].contiguous(), ctx.footprint.seen_by)
        return F.pad(seen, (0, 0, 0, ctx.texels - len(seen))), None


def _weighted_sums(table: Tensor, footprint: Footprint) -> Tensor:
    rows, weight, first = footprint.texel, footprint.weight.to(table.dtype), footprint.first
    return F.embedding_bag(rows, table, first, per_sample_weights=weight, mode="sum", include_last_offset=True)
