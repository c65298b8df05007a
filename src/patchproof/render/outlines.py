"""Smooth outlines: how much of a pixel at the object's outlines its neighbors' surfaces cover.

In: the object's edges, cameras, and how far each pixel sees. Out: `Outlines`, which mix finished pictures. Where a
visible edge passes between the centers of two neighboring pixels, each takes as much of the other's color as the edge
cuts off it, exactly for a straight edge (after Laine et al., Modular primitives for high-performance differentiable
rendering, 2020, who move the border between two pixels along their centers alone, and search edges from the pixels;
here each edge is walked, so that faces smaller than a pixel do as well). What is shown, the piece too, needs no second
sample. Left out on purpose: what is thinner than a pixel and seen by no center.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from patchproof.base.color import linear_from_srgb, srgb_from_linear
from patchproof.render.edges import Edges
from patchproof.render.fragments import Cameras
from patchproof.render.raster import CHUNK, homogeneous, index_ranges, ranked

# In pixels at an edge's depth: so much farther than both of its pixels see it is hidden, and where one of them sees so
# much farther than a crease, another edge is what ends the surface there.
HIDDEN_PX, APART_PX = 1.0, 8.0


@dataclass(frozen=True)
class Outlines:
    """U pixels that neighbors share: `own` U×1 is what is left of each; `share` S×1 goes to the pixels `source`, of
    the U-th numbered `of`.
    """

    pixel: Tensor
    own: Tensor
    of: Tensor
    source: Tensor
    share: Tensor

    def part(self, views: range, pixels: int) -> Outlines:
        """Those of some views, of so many pixels each, as if no others had been seen."""
        first = views.start * pixels
        low, high = torch.searchsorted(self.pixel, self.pixel.new_tensor([first, views.stop * pixels])).tolist()
        of = ((self.of >= low) & (self.of < high)).nonzero()[:, 0]
        source, share = self.source.index_select(0, of) - first, self.share.index_select(0, of)
        return Outlines(
            self.pixel[low:high] - first, self.own[low:high], self.of.index_select(0, of) - low, source, share
        )

    def smooth(self, image: Tensor, by_code: bool) -> Tensor:
        """Pixels by rows, with their shares mixed; of light `by_code`, as code values. Differentiable."""
        if not len(self.pixel):
            return image
        if not by_code:
            return _Mixed.apply(image, self)
        own, other = (srgb_from_linear(image.index_select(0, index)) for index in (self.pixel, self.source))
        return image.index_copy(0, self.pixel, linear_from_srgb(self.mixed(own, other)))

    def mixed(self, own: Tensor, other: Tensor) -> Tensor:
        """U×3 of the values at `pixel` and S×3 of those at `source`."""
        return (own * self.own).index_add_(0, self.of, other * self.share)


class _Mixed(torch.autograd.Function):
    """Shares of values as they are. The library's own gradient of the same goes five times over the whole picture."""

    @staticmethod
    def forward(ctx, image: Tensor, shares: Outlines) -> Tensor:
        ctx.shares = shares
        own, other = image.index_select(0, shares.pixel), image.index_select(0, shares.source)
        return image.index_copy(0, shares.pixel, shares.mixed(own, other))

    @staticmethod
    def backward(ctx, *gradients: Tensor):
        (gradient,), shares = gradients, ctx.shares
        at_outlines = gradient.index_select(0, shares.pixel)
        passed = gradient.index_copy(0, shares.pixel, at_outlines * shares.own)
        return passed.index_add_(0, shares.source, at_outlines.index_select(0, shares.of) * shares.share), None


@torch.no_grad()
def find_outlines(
    edges: Edges,
    vertices: Tensor,
    cameras: Cameras,
    eye_mm: Tensor,
    nearest_mm: Tensor,
    covered: Tensor,
    near_mm: float,
) -> Outlines:
    """The outlines of N views from `eye_mm` N×3, whose pixels N·H·W see `nearest_mm` far (infinity: no object). Between
    two pixels that the piece has `covered` alone there are none.
    """
    at_once = max(1, CHUNK // max(len(vertices), len(edges.ends), len(edges.planes)))
    sides: list[list[tuple[Tensor, ...]]] = [[], []]
    for view in range(0, len(cameras), at_once):
        some = slice(view, view + at_once)
        ends, of, crease = _visible_ends(edges, vertices, cameras[some], eye_mm[some], near_mm)
        for axis, side in enumerate(sides):
            side.append(_crossings(*ends, of + view, crease, cameras.size_px, axis))
    target, source, share = [], [], []
    for crossings, step in zip(sides, (1, cameras.size_px[0]), strict=True):
        pixel, crease, place, slope, inverse = (torch.cat(part) for part in zip(*crossings, strict=True))
        beside = pixel + step
        far = torch.maximum(nearest_mm.index_select(0, pixel), nearest_mm.index_select(0, beside))
        beyond_px = (far * inverse - 1) * cameras.matrix_px[0, 0, 0]
        seen = (beyond_px > -HIDDEN_PX) & ~(crease & (beyond_px > APART_PX))
        alone = covered.index_select(0, pixel) & covered.index_select(0, beside)
        kept = (seen & ~alone).nonzero()[:, 0]
        pixel, beside, place, slope = (part.index_select(0, kept) for part in (pixel, beside, place, slope))
        # the rim of small faces may go to and fro between two pixels: the mean of its shares
        times = torch.zeros_like(nearest_mm).index_add_(0, pixel, torch.ones_like(pixel, dtype=nearest_mm.dtype))
        times = times.index_select(0, pixel)
        target += [pixel, beside]
        source += [beside, pixel]
        share += [(_cut_off(distance, slope) / times).float() for distance in (place, 1 - place)]
    pixel, of = ranked(torch.cat(target), len(nearest_mm))
    shares = torch.cat(share)
    total = shares.new_zeros(len(pixel)).index_add_(0, of, shares)
    shares = shares / total.clamp_min(1).index_select(0, of)
    return Outlines(pixel, (1 - total).clamp_min(0)[:, None], of, torch.cat(source), shares[:, None])


def _cut_off(distance: Tensor, slope: Tensor) -> Tensor:
    """The share of a pixel beyond an edge that passes its center at this distance, from 0 to 1 along the axis that it
    crosses more directly, and moves by `slope`, up to 1, along the other.
    """
    reach = ((1 + slope) / 2 - distance).clamp_min(0)
    return torch.where(reach < slope, reach * reach / (2 * slope), (0.5 - distance).clamp_min(0))


def _visible_ends(
    edges: Edges, vertices: Tensor, cameras: Cameras, eye_mm: Tensor, near_mm: float
) -> tuple[tuple[Tensor, Tensor], Tensor, Tensor]:
    """(x px, y px, 1/mm) 3×S of both ends of edges that may show, cut at the near plane, in whose view they are, and
    whether they only crease a surface there.
    """
    x, y, z, offset = edges.planes.T
    # written out: a matrix product rounds as its size has it
    front = eye_mm[:, :1] * x + eye_mm[:, 1:2] * y + eye_mm[:, 2:] * z + offset > 0
    one, other = (front.index_select(1, face) for face in edges.faces.T)
    ends_surface = (one ^ other ^ edges.reversed) | (edges.faces[:, 0] == edges.faces[:, 1])
    view, edge = (ends_surface | edges.always).nonzero().unbind(1)
    crease = ~ends_surface[view, edge]
    points = homogeneous(vertices.double(), cameras).flatten(1)
    a, b = (points.index_select(1, view * len(vertices) + end.index_select(0, edge)) for end in edges.ends.T)
    before = (torch.maximum(a[2], b[2]) > near_mm).nonzero()[:, 0]
    a, b = a.index_select(1, before), b.index_select(1, before)
    return (_cut(a, b, near_mm), _cut(b, a, near_mm)), view.index_select(0, before), crease.index_select(0, before)


def _cut(end: Tensor, other: Tensor, near_mm: float) -> Tensor:
    """The end in pixels, or where the edge from it passes the near plane."""
    onward = ((near_mm - end[2]) / (other[2] - end[2])).where(end[2] < near_mm, torch.zeros_like(end[2]))
    x, y, z = end + onward * (other - end)
    return torch.stack([x / z, y / z, 1 / z])


def _crossings(
    a: Tensor, b: Tensor, view: Tensor, crease: Tensor, size_px: tuple[int, int], axis: int
) -> tuple[Tensor, ...]:
    """Where edges pass between the centers of a pixel and the next one along x (`axis` 0) or y, of the edges that run
    more across it: the pixel, whether at a crease, the place between the centers from 0 to 1, how much that moves from
    line to line, and 1/mm there.
    """
    along = 1 - axis
    extent = (b - a).abs()
    chosen = (extent[1] >= extent[0] if axis == 0 else extent[1] < extent[0]).nonzero()[:, 0]
    a, b = a.index_select(1, chosen), b.index_select(1, chosen)
    view, crease = view.index_select(0, chosen), crease.index_select(0, chosen)
    turned = a[along] > b[along]
    a, b = torch.where(turned, b, a), torch.where(turned, a, b)
    first, end = ((point[along] - 0.5).ceil().clamp(0, size_px[along]).long() for point in (a, b))
    owner = torch.repeat_interleave(end - first)
    line = index_ranges(end - first, first, owner)
    a, b = a.index_select(1, owner), b.index_select(1, owner)
    per_line = (b - a) / (b[along] - a[along])
    at = a + (line + 0.5 - a[along]) * per_line
    place = at[axis] - 0.5
    before = place.floor()
    inside = ((before >= 0) & (before < size_px[axis] - 1)).nonzero()[:, 0]
    values = (owner, line, before, place - before, per_line[axis].abs(), at[2])
    owner, line, before, place, slope, inverse = (value.index_select(0, inside) for value in values)
    x, y = (before.long(), line) if axis == 0 else (line, before.long())
    width, height = size_px
    pixel = (view.index_select(0, owner) * height + y) * width + x
    return pixel, crease.index_select(0, owner), place, slope, inverse
