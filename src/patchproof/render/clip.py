"""Clip triangles that a picture cannot hold: at the near plane, and at a guard band far outside the picture.

In: corners in homogeneous pixel coordinates (x·z, y·z, z). Out: the remaining triangles, in pixels, and the faces they
belong to. Edges are always cut from their inside corner, so that faces with a common edge still share it afterwards.
"""

import torch
from torch import Tensor

GUARD_PX = 1 << 16  # faces are cut here, so that products of coordinates stay below 2^53 and float64 holds them exactly


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
