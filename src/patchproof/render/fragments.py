"""The input and output of rasterizing: `Cameras`, `Fragments`."""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor


@dataclass(frozen=True)
class Cameras:
    """N pinhole cameras: `camera_from_world` N×4×4 and `matrix_px` N×3×3, float64, for pictures of `size_px` (width,
    height).
    """

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
