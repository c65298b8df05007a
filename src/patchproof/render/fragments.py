"""The input and output of rasterizing: `Cameras`, `Fragments`, and triangles clipped where a picture cannot hold them.

Edges are always cut from their inside corner, so that faces with a common edge still share it afterwards.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

GUARD_PX = 1 << 16  # faces are cut here, so that products of coordinates stay below 2^53 and float64 holds them exactly


@dataclass(frozen=True)
class Cameras:
    """N pinhole cameras (float64): `camera_from_world` N×4×4, `matrix_px` N×3×3; `size_px` is (width, height)."""

    camera_from_world: Tensor
    matrix_px: Tensor
    size_px: tuple[int, int]

    def __len__(self) -> int:
        return len(self.camera_from_world)

    def __getitem__(self, rows: slice) -> "Cameras":
        return Cameras(self.camera_from_world[rows], self.matrix_px[rows], self.size_px)


@dataclass(frozen=True)
class Fragments:
    """P covered pixels and the faces they see. `pixel` is (view·H + y)·W + x, ascending; `view` and `face` are indices.

    `barycentric` P×3 and `depth` P (camera z, mm) are float32. `front` tells if the face shows its outside. `rank` P
    leads to the Q faces that views see, `seen` Q; `slopes` 2×3×Q are the changes per pixel, to the right and down, of
    the second and the third barycentric and of 1, each over the depth, which are linear in a picture.
    """

    pixel: Tensor
    face: Tensor
    barycentric: Tensor
    depth: Tensor
    front: Tensor
    rank: Tensor
    seen: Tensor
    slopes: Tensor
    shape: tuple[int, int, int]  # views, height, width

    def __len__(self) -> int:
        return len(self.pixel)

    @cached_property
    def view(self) -> Tensor:
        """P: the view of each fragment."""
        return self.pixel // (self.shape[1] * self.shape[2])

    @cached_property
    def corner(self) -> Tensor:
        """P×3: the indices of the corners of each fragment's face in a list of all faces' corners."""
        out = torch.empty(len(self), 3, dtype=torch.int64, device=self.face.device)
        torch.mul(self.face, 3, out=out[:, 0])  # by columns, as in `stack_columns`
        for column in (1, 2):
            torch.add(out[:, 0], column, out=out[:, column])
        return out

    def derivatives(self, corner_values: Tensor, values: Tensor) -> list[Tensor]:
        """Return how values P×C change per pixel to the right and down, each P×C float32 (by columns in memory), if
        they are interpolated between `corner_values` F×3×C.
        """
        # v / z is linear in the picture, and so is 1 / z: v' = z ((v / z)' - v (1 / z)'). No fused operations: how they
        # round depends on a number's place in memory
        first, *others = corner_values.index_select(0, self.seen).unbind(1)
        derivatives = []
        for *slopes, total in self.slopes:
            plane = first.T * total
            for corner, slope in zip(others, slopes, strict=True):
                plane += (corner - first).T * slope
            at_fragments, total = plane.index_select(1, self.rank), total.index_select(0, self.rank)
            derivatives.append(at_fragments.sub_(values.T * total).mul_(self.depth).T)
        return derivatives

    def where(self, keep: Tensor) -> "Fragments":
        """Return the fragments for which `keep` (P, bool) is true."""
        index = keep.nonzero()[:, 0]
        names = ("pixel", "face", "barycentric", "depth", "front", "rank")
        return replace(self, **{name: getattr(self, name).index_select(0, index) for name in names})


def stack_columns(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Return P×3 float32; `torch.stack` takes four times as long for columns this narrow."""
    out = torch.empty(len(a), 3, device=a.device)
    out[:, 0], out[:, 1], out[:, 2] = a, b, c
    return out


def clip_triangles(corners: Tensor, near: float) -> tuple[Tensor, Tensor]:
    """Return the parts of T×3×3 faces before the near plane and in the guard band, in pixels, and their faces."""
    owner = corners.isfinite().all(-1).all(-1).nonzero()[:, 0]
    corners = corners[owner]
    bands = ([0.0, 0, 1], [1.0, 0, GUARD_PX], [-1.0, 0, GUARD_PX], [0.0, 1, GUARD_PX], [0.0, -1, GUARD_PX])
    for normal, offset in zip(corners.new_tensor(bands), [near, 0, 0, 0, 0], strict=True):
        corners, owner = _cut(corners, owner, corners @ normal - offset)
    return corners[..., :2] / corners[..., 2:], owner


def _cut(triangles: Tensor, owner: Tensor, distance: Tensor) -> tuple[Tensor, Tensor]:
    """Return the parts of T×3×3 triangles where `distance` T×3 is positive: none, one or two triangles each."""
    inside = distance > 0
    count = inside.sum(-1)
    # turn each triangle so that its odd corner out (the only one inside, or the only one outside) comes first
    odd = torch.where((count == 1)[:, None], inside, ~inside).to(torch.uint8).argmax(-1)
    order = (odd[:, None] + torch.arange(3, device=odd.device)) % 3
    rotated = triangles.gather(1, order[..., None].expand(-1, -1, 3))
    d = distance.gather(1, order)
    tips, quads, uncut = count == 1, count == 2, count == 3
    tip = torch.stack([rotated[tips, 0], _crossing(rotated, d, tips, 0, 1), _crossing(rotated, d, tips, 0, 2)], 1)
    p, q = _crossing(rotated, d, quads, 1, 0), _crossing(rotated, d, quads, 2, 0)
    quad = [torch.stack([p, rotated[quads, 1], rotated[quads, 2]], 1), torch.stack([p, rotated[quads, 2], q], 1)]
    return torch.cat([triangles[uncut], tip, *quad]), torch.cat([owner[m] for m in (uncut, tips, quads, quads)])


def _crossing(triangles: Tensor, d: Tensor, mask: Tensor, inside: int, outside: int) -> Tensor:
    """Return where edges meet the plane, always computed from the inside corner: faces with a common edge agree."""
    share = d[mask, inside] / (d[mask, inside] - d[mask, outside])
    return triangles[mask, inside] + share[:, None] * (triangles[mask, outside] - triangles[mask, inside])
