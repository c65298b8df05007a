"""Smooth outlines: the share of a pixel at the object's outlines that its neighbors' surfaces cover.

In: the object's edges, cameras, and the depth at each pixel. Out: `Outlines`, which mix finished pictures. If a visible
edge passes between the centers of two neighboring pixels, each takes as much of the other's color as the edge cuts off
it, exactly for a straight edge. This extends Laine et al., Modular primitives for high-performance differentiable
rendering, 2020: each edge is walked, so that faces smaller than a pixel work as well. No pixel needs a second sample.
Edges are found once per mesh: those that show in every view (rims, and creases or changes of color between faces of
which one has no texture) and those that show when one of their faces is turned away. Corners at one position are one.

Left out on purpose: things thinner than a pixel that no pixel center sees; creases between two textured faces, because
textures continue smoothly across most of them (a textured car was farther from 3×3 samples with them).
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from patchproof.base.color import linear_from_srgb, srgb_from_linear
from patchproof.mesh.mesh import Mesh, position_numbers
from patchproof.render.fragments import Cameras
from patchproof.render.raster import CHUNK, homogeneous, index_ranges, rank_values

CREASE_DEG = 10.0  # between normals: below it light changes by a sixth at most
_COLOR_STEP = 0.02  # of linear light
# In pixels at an edge's depth. An edge HIDDEN_PX farther than both of its pixels see is hidden; if one of them sees
# CREASE_GAP_PX farther than a crease, another edge ends the surface there.
HIDDEN_PX, CREASE_GAP_PX = 1.0, 8.0


@dataclass(frozen=True)
class Edges:
    """Edges of a mesh: `ends` E×2 vertices and `faces` E×2 (one face twice at a rim); `always` E: seen from every side;
    `reversed` E: both faces run along it the same way, so that their fronts disagree. `planes` F×4 float64: a face's
    outside is where (x, y, z, 1) times its plane is positive.
    """

    ends: Tensor
    faces: Tensor
    always: Tensor
    reversed: Tensor
    planes: Tensor


def find_edges(mesh: Mesh, device: torch.device | str = "cpu") -> Edges:
    """Find the edges of a mesh and put them on a device."""
    place = position_numbers(mesh.vertices)[mesh.faces]
    first, second = place.ravel(), place[:, [1, 2, 0]].ravel()
    key = np.minimum(first, second) * (len(mesh.vertices) + 1) + np.maximum(first, second)
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.r_[True, np.diff(key[order]) != 0])
    count = np.diff(np.r_[starts, len(order)])
    one, other = order[starts[count == 2]], order[starts[count == 2] + 1]
    # a rim has one face; an edge of more than two faces counts as a rim of each
    rim = order[np.repeat(count != 2, count)]
    same_way = first[one] == first[other]
    always = np.r_[_has_jump(mesh, one, other, same_way), np.ones(len(rim), bool)]
    one, other = np.r_[one, rim], np.r_[other, rim]
    ends = np.stack([mesh.faces.ravel()[one], mesh.faces.ravel()[_next_corner(one)]], 1)
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    planes = np.concatenate([normal, -(normal * a).sum(1, keepdims=True)], 1)
    arrays = (ends, np.stack([one, other], 1) // 3, always, np.r_[same_way, np.zeros(len(rim), bool)], planes)
    return Edges(*(torch.as_tensor(array, device=device) for array in arrays))


def _next_corner(corner: np.ndarray) -> np.ndarray:
    """Return the next corner of the same face."""
    return corner // 3 * 3 + (corner + 1) % 3


def _has_jump(mesh: Mesh, one: np.ndarray, other: np.ndarray, same_way: np.ndarray) -> np.ndarray:
    """Return at which edges the appearance jumps because the normals or colors of their two faces do."""
    textured = np.array([material.texture_srgb is not None for material in mesh.materials])
    base = np.array([material.base_color_linear for material in mesh.materials])
    color = (mesh.corner_color_linear * base[mesh.face_material][:, None]).reshape(-1, 3)
    normal, faces = mesh.corner_normal.reshape(-1, 3), (one // 3, other // 3)
    jumps = np.zeros(len(one), bool)
    # two faces that agree on their front run along an edge in opposite directions
    other_corners = (np.where(same_way, other, _next_corner(other)), np.where(same_way, _next_corner(other), other))
    for near, far in zip((one, _next_corner(one)), other_corners, strict=True):
        cosine = np.where(same_way, -1, 1) * (normal[near] * normal[far]).sum(1)
        jumps |= (cosine < np.cos(np.radians(CREASE_DEG))) | (np.abs(color[near] - color[far]).max(1) > _COLOR_STEP)
    textured_sides = [textured[mesh.face_material[face]] for face in faces]
    return (jumps | (textured_sides[0] != textured_sides[1])) & ~(textured_sides[0] & textured_sides[1])


@dataclass(frozen=True)
class Outlines:
    """U pixels at outlines: each keeps `remaining` U×1 of its color, and pixel number `target` S among them gets
    `share` S×1 of the color at `source` S.
    """

    pixel: Tensor
    remaining: Tensor
    target: Tensor
    source: Tensor
    share: Tensor

    def part(self, views: range, pixels: int) -> "Outlines":
        """Return those of some views, of `pixels` pixels each, equal to the outlines of these views alone."""
        first = views.start * pixels
        low, high = torch.searchsorted(self.pixel, self.pixel.new_tensor([first, views.stop * pixels])).tolist()
        rows = ((self.target >= low) & (self.target < high)).nonzero()[:, 0]
        target, source = self.target.index_select(0, rows) - low, self.source.index_select(0, rows) - first
        share = self.share.index_select(0, rows)
        return Outlines(self.pixel[low:high] - first, self.remaining[low:high], target, source, share)

    def smooth(self, image: Tensor, by_code: bool) -> Tensor:
        """Mix the shares of pixels by rows; light `by_code` is mixed as code values. Differentiable."""
        if not len(self.pixel):
            return image
        if not by_code:
            return _Mix.apply(image, self)
        at_pixel, at_source = (srgb_from_linear(image.index_select(0, index)) for index in (self.pixel, self.source))
        return image.index_copy(0, self.pixel, linear_from_srgb(self.mix(at_pixel, at_source)))

    def mix(self, at_pixel: Tensor, at_source: Tensor) -> Tensor:
        """Mix U×3 values at `pixel` with S×3 values at `source`."""
        return (at_pixel * self.remaining).index_add_(0, self.target, at_source * self.share)


class _Mix(torch.autograd.Function):
    """Mixes values as they are. The library's own gradient of this goes five times over the whole picture."""

    @staticmethod
    def forward(ctx, image: Tensor, shares: Outlines) -> Tensor:
        ctx.shares = shares
        at_pixel, at_source = image.index_select(0, shares.pixel), image.index_select(0, shares.source)
        return image.index_copy(0, shares.pixel, shares.mix(at_pixel, at_source))

    @staticmethod
    def backward(ctx, *gradients: Tensor):
        (gradient,), shares = gradients, ctx.shares
        at_outlines = gradient.index_select(0, shares.pixel)
        passed = gradient.index_copy(0, shares.pixel, at_outlines * shares.remaining)
        return passed.index_add_(0, shares.source, at_outlines.index_select(0, shares.target) * shares.share), None


@torch.no_grad()
def find_outlines(
    edges: Edges, vertices: Tensor, cameras: Cameras, eye_mm: Tensor, depth_mm: Tensor, covered: Tensor, near_mm: float
) -> Outlines:
    """Find the outlines of N views from `eye_mm` N×3, whose pixels N·H·W see `depth_mm` far (infinity: no object).
    There are none between two pixels that only the piece covers (`covered`).
    """
    views_at_once = max(1, CHUNK // max(len(vertices), len(edges.ends), len(edges.planes)))
    sides: list[list[tuple[Tensor, ...]]] = [[], []]
    for view in range(0, len(cameras), views_at_once):
        batch = slice(view, view + views_at_once)
        ends, view_of, crease = _visible_ends(edges, vertices, cameras[batch], eye_mm[batch], near_mm)
        for axis, side in enumerate(sides):
            side.append(_crossings(*ends, view_of + view, crease, cameras.size_px, axis))
    target, source, share = [], [], []
    for crossings, step in zip(sides, (1, cameras.size_px[0]), strict=True):
        pixel, crease, place, slope, inverse = (torch.cat(part) for part in zip(*crossings, strict=True))
        beside = pixel + step
        far_mm = torch.maximum(depth_mm.index_select(0, pixel), depth_mm.index_select(0, beside))
        depth_gap_px = (far_mm * inverse - 1) * cameras.matrix_px[0, 0, 0]
        visible = (depth_gap_px > -HIDDEN_PX) & ~(crease & (depth_gap_px > CREASE_GAP_PX))
        both_covered = covered.index_select(0, pixel) & covered.index_select(0, beside)
        selected = (visible & ~both_covered).nonzero()[:, 0]
        pixel, beside, place, slope = (part.index_select(0, selected) for part in (pixel, beside, place, slope))
        # the rim of small faces may cross several times between two pixels: take the mean of its shares
        counts = torch.zeros_like(depth_mm).index_add_(0, pixel, torch.ones_like(pixel, dtype=depth_mm.dtype))
        counts = counts.index_select(0, pixel)
        target += [pixel, beside]
        source += [beside, pixel]
        share += [(_cut_off(distance, slope) / counts).float() for distance in (place, 1 - place)]
    pixel, index = rank_values(torch.cat(target), len(depth_mm))
    shares = torch.cat(share)
    total = shares.new_zeros(len(pixel)).index_add_(0, index, shares)
    shares = shares / total.clamp_min(1).index_select(0, index)
    return Outlines(pixel, (1 - total).clamp_min(0)[:, None], index, torch.cat(source), shares[:, None])


def _cut_off(distance: Tensor, slope: Tensor) -> Tensor:
    """Return the share of a pixel beyond an edge that passes its center at this distance, from 0 to 1 along the axis
    that it crosses more directly, and moves by `slope`, up to 1, along the other.
    """
    reach = ((1 + slope) / 2 - distance).clamp_min(0)
    return torch.where(reach < slope, reach * reach / (2 * slope), (0.5 - distance).clamp_min(0))


def _visible_ends(
    edges: Edges, vertices: Tensor, cameras: Cameras, eye_mm: Tensor, near_mm: float
) -> tuple[tuple[Tensor, Tensor], Tensor, Tensor]:
    """Return (x px, y px, 1/mm) 3×S of both ends of edges that may show, their views, and which are only creases."""
    x, y, z, offset = edges.planes.T
    # written out, because the rounding of a matrix product depends on its size
    front = eye_mm[:, :1] * x + eye_mm[:, 1:2] * y + eye_mm[:, 2:] * z + offset > 0
    one, other = (front.index_select(1, face) for face in edges.faces.T)
    ends_surface = (one ^ other ^ edges.reversed) | (edges.faces[:, 0] == edges.faces[:, 1])
    view, edge = (ends_surface | edges.always).nonzero().unbind(1)
    crease = ~ends_surface[view, edge]
    points = homogeneous(vertices.double(), cameras).flatten(1)
    a, b = (points.index_select(1, view * len(vertices) + end.index_select(0, edge)) for end in edges.ends.T)
    in_front = (torch.maximum(a[2], b[2]) > near_mm).nonzero()[:, 0]
    a, b = a.index_select(1, in_front), b.index_select(1, in_front)
    return (_cut(a, b, near_mm), _cut(b, a, near_mm)), view.index_select(0, in_front), crease.index_select(0, in_front)


def _cut(end: Tensor, other: Tensor, near_mm: float) -> Tensor:
    """Return the end in pixels, or the point at which the edge from it passes the near plane."""
    share = ((near_mm - end[2]) / (other[2] - end[2])).where(end[2] < near_mm, torch.zeros_like(end[2]))
    x, y, z = end + share * (other - end)
    return torch.stack([x / z, y / z, 1 / z])


def _crossings(
    a: Tensor, b: Tensor, view: Tensor, crease: Tensor, size_px: tuple[int, int], axis: int
) -> tuple[Tensor, ...]:
    """Find where edges pass between the centers of a pixel and the next one along x (`axis` 0) or y, for the edges that
    run more across that axis. Return the pixel, if it is at a crease, the position between the centers from 0 to 1, how
    much that moves from line to line, and 1/mm there.
    """
    along = 1 - axis
    extent = (b - a).abs()
    steeper = (extent[1] >= extent[0] if axis == 0 else extent[1] < extent[0]).nonzero()[:, 0]
    a, b = a.index_select(1, steeper), b.index_select(1, steeper)
    view, crease = view.index_select(0, steeper), crease.index_select(0, steeper)
    is_reversed = a[along] > b[along]
    a, b = torch.where(is_reversed, b, a), torch.where(is_reversed, a, b)
    first, end = ((point[along] - 0.5).ceil().clamp(0, size_px[along]).long() for point in (a, b))
    owner = torch.repeat_interleave(end - first)
    line = index_ranges(end - first, first, owner)
    a, b = a.index_select(1, owner), b.index_select(1, owner)
    per_line = (b - a) / (b[along] - a[along])
    point_at_line = a + (line + 0.5 - a[along]) * per_line
    share = point_at_line[axis] - 0.5
    first_center = share.floor()
    inside = ((first_center >= 0) & (first_center < size_px[axis] - 1)).nonzero()[:, 0]
    values = (owner, line, first_center, share - first_center, per_line[axis].abs(), point_at_line[2])
    owner, line, first_center, share, slope, inverse = (value.index_select(0, inside) for value in values)
    x, y = (first_center.long(), line) if axis == 0 else (line, first_center.long())
    width, height = size_px
    pixel = (view.index_select(0, owner) * height + y) * width + x
    return pixel, crease.index_select(0, owner), share, slope, inverse
