"""Triangles cut where a picture cannot hold them: at the near plane, and at a guard band far outside of it.

In: corners in homogeneous pixel coordinates (x·z, y·z, z). Out: the triangles that are left, in pixels, and whose they
are. Edges are always cut from their inside corner, so that faces with a common edge still share it afterwards.
"""

from __future__ import annotations

import torch
from torch import Tensor

GUARD_PX = 1 << 16  # faces are cut here, so that products of coordinates stay below 2^53 and float64 holds them exactly


def clip_triangles(corners: Tensor, near: float) -> tuple[Tensor, Tensor]:
    """The parts before the near plane and within the guard band of T×3×3 faces: triangles in pixels, and whose."""
    owner = corners.isfinite().all(-1).all(-1).nonzero()[:, 0]
    corners = corners[owner]
    bands = ([0.0, 0, 1], [1.0, 0, GUARD_PX], [-1.0, 0, GUARD_PX], [0.0, 1, GUARD_PX], [0.0, -1, GUARD_PX])
    for normal, offset in zip(corners.new_tensor(bands), [near, 0, 0, 0, 0], strict=True):
        corners, owner = _cut(corners, owner, corners @ normal - offset)
    return corners[..., :2] / corners[..., 2:], owner


def _cut(triangles: Tensor, owner: Tensor, distance: Tensor) -> tuple[Tensor, Tensor]:
    """The parts of T×3×3 triangles where `distance` T×3 is positive: none, one or two triangles each."""
    inside = distance > 0
    count = inside.sum(-1)
    # turn each triangle so that its odd corner out (the only one inside, or the only one outside) comes first
    odd = torch.where((count == 1)[:, None], inside, ~inside).to(torch.uint8).argmax(-1)
    order = (odd[:, None] + torch.arange(3, device=odd.device)) % 3
    turned = triangles.gather(1, order[..., None].expand(-1, -1, 3))
    d = distance.gather(1, order)
    tips, quads, whole = count == 1, count == 2, count == 3
    tip = torch.stack([turned[tips, 0], _crossing(turned, d, tips, 0, 1), _crossing(turned, d, tips, 0, 2)], 1)
    p, q = _crossing(turned, d, quads, 1, 0), _crossing(turned, d, quads, 2, 0)
    quad = [torch.stack([p, turned[quads, 1], turned[quads, 2]], 1), torch.stack([p, turned[quads, 2], q], 1)]
    return torch.cat([triangles[whole], tip, *quad]), torch.cat([owner[m] for m in (whole, tips, quads, quads)])


def _crossing(turned: Tensor, d: Tensor, which: Tensor, inside: int, outside: int) -> Tensor:
    """Where edges meet the plane, always reckoned from the inside corner: faces with a common edge agree."""
    share = d[which, inside] / (d[which, inside] - d[which, outside])
    return turned[which, inside] + share[:, None] * (turned[which, outside] - turned[which, inside])
