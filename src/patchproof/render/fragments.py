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

    `barycentric` P×3 and `depth` P (camera z, mm) are float32. `front` tells if the face shows its outside. The
    derivatives of the barycentrics are computed on request from `rank` P (into Q) and `slopes` 6×Q.
    """

    pixel: Tensor
    face: Tensor
    barycentric: Tensor
    depth: Tensor
    front: Tensor
    rank: Tensor
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
        return torch.add(self.face[:, None] * 3, torch.arange(3, device=self.face.device))

    @cached_property
    def barycentric_dx(self) -> Tensor:
        """P×3 float32: change of the barycentrics per pixel to the right."""
        return self._derivative(0)

    @cached_property
    def barycentric_dy(self) -> Tensor:
        """P×3 float32: change of the barycentrics per pixel down."""
        return self._derivative(1)

    def _derivative(self, axis: int) -> Tensor:
        # d(e_i / t) = (de_i - e_i/t · dt) / t
        first, second, total = (self.slopes[2 * i + axis].index_select(0, self.rank) for i in range(3))
        b, z = self.barycentric, self.depth
        first.addcmul_(b[:, 1], total, value=-1).mul_(z)
        second.addcmul_(b[:, 2], total, value=-1).mul_(z)
        return stack_columns(-(first + second), first, second)

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
