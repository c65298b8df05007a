"""A z-buffer rasterizer in plain torch: which face does each pixel center see, and where on that face.

In: faces in world millimetres and a batch of pinhole cameras. Out: `Fragments`, one per covered pixel, with
perspective-correct barycentrics, camera depth and what texture filtering needs. Visibility is hard and carries no
gradient: shape is never optimized.

Triangles become row spans, spans become fragments, and depth is settled by one integer minimum per pixel, so that work
follows what is covered. Coverage is exact: corners are snapped to 1/256 pixel and the edge functions of Pineda (1988)
are evaluated on integers held in float64 with the top-left rule, hence two triangles that share an edge never both take
a pixel and never leave one out. Depth and barycentrics come from the unsnapped face in 2D homogeneous form (Olano and
Greer, 1997), which stays well-defined for faces that reach behind the camera; such faces are cut at the near plane, not
dropped. Where depths are equal to float32 the lower face index wins. Left out on purpose: transparency.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

SUBPIXELS = 256  # corners snap to this fraction of a pixel
GUARD_PX = 1 << 16  # faces are cut here, so that edge functions stay below 2^53 and float64 holds them exactly
CHUNK = 1 << 22  # rows or fragments held at a time; bounds memory to some hundred MB
_NOTHING = torch.iinfo(torch.int64).max
_FACE_BITS = (1 << 31) - 1  # a key is 31 bits of depth over 31 bits of face index; the sign stays 0


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


@dataclass(frozen=True)
class Fragments:
    """What P covered pixels see. `pixel` is (view·H + y)·W + x, ascending; `view` and `face` are indices.

    `barycentric` P×3 and `depth` P (camera z, mm) are float32. `barycentric_dx`, `_dy` P×3: change per pixel to the
    right, down. `front` tells whether the face shows its outside.
    """

    pixel: Tensor
    view: Tensor
    face: Tensor
    barycentric: Tensor
    barycentric_dx: Tensor
    barycentric_dy: Tensor
    depth: Tensor
    front: Tensor
    shape: tuple[int, int, int]  # views, height, width

    def __len__(self) -> int:
        return len(self.pixel)

    def where(self, keep: Tensor) -> Fragments:
        """The fragments where `keep` (P, bool) is true."""
        fields = (
            self.pixel,
            self.view,
            self.face,
            self.barycentric,
            self.barycentric_dx,
            self.barycentric_dy,
            self.depth,
            self.front,
        )
        return Fragments(*(field[keep] for field in fields), self.shape)


def rasterize(vertices: Tensor, faces: Tensor, cameras: Cameras, near_mm: float, cull_back: bool = False) -> Fragments:
    """The nearest face at every pixel center of every camera.

    `vertices` V×3 (world mm), `faces` F×3 (counter-clockwise seen from outside). Faces nearer than `near_mm` are cut
    there.
    """
    width, height = cameras.size_px
    pose, matrix = cameras.camera_from_world.double(), cameras.matrix_px.double()
    camera = vertices.double() @ pose[:, :3, :3].transpose(1, 2) + pose[:, None, :3, 3]
    # homogeneous pixel coordinates: (x·z, y·z, z); everything below is linear in them
    corners = (camera @ matrix.transpose(1, 2))[:, faces]
    planes, det = _planes(corners)
    nearest = torch.full((len(cameras) * height * width,), _NOTHING, device=vertices.device)
    usable = (corners[..., 2] > near_mm).any(-1) & (det != 0) & det.isfinite()
    if cull_back:
        usable &= det < 0
    target = usable.flatten().nonzero()[:, 0]  # view · F + face
    triangles, owner = _clipped(corners.flatten(0, 1)[target], near_mm)
    target = target[owner]
    rows, total = planes.flatten(0, 1), planes.sum(-2).flatten(0, 1)
    inverse_depth = total / det.flatten()[:, None]  # 1/z = row · (x, y, 1)
    for triangle_chunk, index in _setup(triangles, (width, height)):
        spans = _spans(*triangle_chunk, width)
        _fill(nearest, spans, target[index], inverse_depth, len(faces), (width, height))
    pixel = (nearest != _NOTHING).nonzero()[:, 0]
    return _resolve(pixel, nearest[pixel] & _FACE_BITS, rows, det.flatten(), (len(cameras), height, width))


def _planes(corners: Tensor) -> tuple[Tensor, Tensor]:
    """Per face the rows e_i with e_i · (x, y, 1) ∝ barycentric i, N×F×3×3, and the determinant of its corners, N×F."""
    a, b, c = corners.unbind(-2)
    bc = torch.linalg.cross(b, c)
    planes = torch.stack([bc, torch.linalg.cross(c, a), torch.linalg.cross(a, b)], -2)
    return planes, (a * bc).sum(-1)


def _clipped(corners: Tensor, near: float) -> tuple[Tensor, Tensor]:
    """Triangles T×3×2 in pixels, cut at the near plane and, where they are huge, at the guard band; and whose face they
    are.
    """
    z = corners[..., 2]
    reach = corners[..., :2].abs().amax(-1)
    plain = ((z > near) & (reach < GUARD_PX * z)).all(-1)
    owner = torch.arange(len(corners), device=corners.device)
    rest, rest_owner = corners[~plain], owner[~plain]
    one = corners.new_tensor
    half_spaces = [one([0, 0, 1.0])] + [
        one(row) for row in ([1.0, 0, GUARD_PX], [-1.0, 0, GUARD_PX], [0, 1.0, GUARD_PX], [0, -1.0, GUARD_PX])
    ]
    for normal, offset in zip(half_spaces, [near, 0, 0, 0, 0], strict=True):
        rest, rest_owner = _cut(rest, rest_owner, rest @ normal - offset)
    triangles = torch.cat([corners[plain], rest])
    return triangles[..., :2] / triangles[..., 2:], torch.cat([owner[plain], rest_owner])


def _cut(triangles: Tensor, owner: Tensor, distance: Tensor) -> tuple[Tensor, Tensor]:
    """The parts of T×3×3 triangles where `distance` T×3 is positive: none, one or two triangles each."""
    inside = distance > 0
    count = inside.sum(-1)
    # turn each triangle so that its odd corner out (the only one inside, or the only one outside) comes first
    odd = torch.where((count == 1)[:, None], inside, ~inside).to(torch.uint8).argmax(-1)
    order = (odd[:, None] + torch.arange(3, device=odd.device)) % 3
    turned = triangles.gather(1, order[..., None].expand(-1, -1, 3))
    d = distance.gather(1, order)
    one, two = count == 1, count == 2
    tip = torch.stack([turned[one, 0], _crossing(turned, d, one, 0, 1), _crossing(turned, d, one, 0, 2)], 1)
    p, q = _crossing(turned, d, two, 1, 0), _crossing(turned, d, two, 2, 0)
    quad = [torch.stack([p, turned[two, 1], turned[two, 2]], 1), torch.stack([p, turned[two, 2], q], 1)]
    whole = count == 3
    return torch.cat([triangles[whole], tip, *quad]), torch.cat([owner[whole], owner[one], owner[two], owner[two]])


def _crossing(turned: Tensor, d: Tensor, which: Tensor, inside: int, outside: int) -> Tensor:
    """Where edges meet the plane, always reckoned from the inside corner: faces with a common edge agree."""
    share = d[which, inside] / (d[which, inside] - d[which, outside])
    return turned[which, inside] + share[:, None] * (turned[which, outside] - turned[which, inside])


def _setup(triangles: Tensor, size_px: tuple[int, int]):
    """Snapped triangles of one orientation that can hold a pixel center, in chunks of bounded row count, with their
    indices.
    """
    snapped = (triangles * SUBPIXELS).round()
    low, high = snapped.amin(1), snapped.amax(1)
    first = ((low - SUBPIXELS // 2) / SUBPIXELS).ceil().clamp_min(0)
    last = ((high - SUBPIXELS // 2) / SUBPIXELS).floor().minimum(triangles.new_tensor(size_px) - 1)
    edge_a, edge_b = snapped[:, 1] - snapped[:, 0], snapped[:, 2] - snapped[:, 0]
    area = edge_a[:, 0] * edge_b[:, 1] - edge_a[:, 1] * edge_b[:, 0]
    index = ((first <= last).all(-1) & (area != 0)).nonzero()[:, 0]
    snapped = torch.where((area[index] < 0)[:, None, None], snapped[index].flip(1), snapped[index])
    rows = torch.stack([first[index, 1], last[index, 1] - first[index, 1] + 1], 1).long()
    for part in _chunks(rows[:, 1]):
        yield (snapped[part], rows[part]), index[part]


def _fill(nearest: Tensor, spans, target: Tensor, inverse_depth: Tensor, faces: int, size_px: tuple[int, int]) -> None:
    """Settle the nearest face of every pixel that these spans cover."""
    width, height = size_px
    triangle, y, x0, count = spans
    of = target[triangle]
    view, face = of // faces, of % faces
    first_pixel = (view * height + y) * width + x0
    a, b, c = inverse_depth.index_select(0, of).unbind(-1)
    first_inverse = a * (x0 + 0.5) + b * (y + 0.5) + c
    for part in _chunks(count):
        lengths = count[part]
        owner = torch.repeat_interleave(lengths)
        step = torch.arange(len(owner), device=owner.device) - (lengths.cumsum(0) - lengths).index_select(0, owner)
        depth = 1 / (first_inverse[part].index_select(0, owner) + a[part].index_select(0, owner) * step)
        # float bits of positive numbers order like the numbers; slivers may extrapolate to nonsense, kept positive
        bits = depth.clamp_(1e-30, 1e30).float().view(torch.int32).long()
        key = bits.bitwise_left_shift_(31).bitwise_or_(face[part].index_select(0, owner))
        nearest.scatter_reduce_(0, first_pixel[part].index_select(0, owner).add_(step), key, "amin")


def _spans(snapped: Tensor, rows: Tensor, width: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(triangle, y, first x, length) of every row of pixel centers inside the triangles.

    A center at k + ½ lies inside when dx·(Y - a_y) - dy·(256k + 128 - a_x) ≥ t for all edges, t = 0 on top and left
    edges, else 1. All terms are integers below 2^53, so that a float64 quotient has the right floor.
    """
    triangle = torch.repeat_interleave(torch.arange(len(rows), device=rows.device), rows[:, 1])
    start = rows[:, 1].cumsum(0) - rows[:, 1]
    y = rows[triangle, 0] + torch.arange(len(triangle), device=rows.device) - start[triangle]
    center_y = (y * SUBPIXELS + SUBPIXELS // 2).double()
    x0, x1 = torch.zeros_like(center_y), torch.full_like(center_y, width - 1)
    half = SUBPIXELS // 2
    for i, j in ((0, 1), (1, 2), (2, 0)):
        a, b = snapped[:, i], snapped[:, j]
        dx, dy = (b - a).unbind(-1)
        threshold = 1 - ((dy < 0) | ((dy == 0) & (dx > 0))).double()
        # the part of the inequality that a row does not change, per triangle
        fixed = -dx * a[:, 1] - threshold - dy * (half - a[:, 0])
        slope = dy[triangle]
        n = dx[triangle] * center_y + fixed[triangle]
        bound = n / (SUBPIXELS * slope)
        x1 = torch.where(slope > 0, torch.minimum(x1, bound.floor()), x1)
        x0 = torch.where(slope < 0, torch.maximum(x0, bound.ceil()), x0)
        x1 = torch.where((slope == 0) & (n < 0), -1.0, x1)
    keep = (x0 <= x1).nonzero()[:, 0]
    first = x0[keep].long()
    return triangle[keep], y[keep], first, x1[keep].long() - first + 1


def _resolve(pixel: Tensor, face: Tensor, rows: Tensor, det: Tensor, shape: tuple[int, int, int]) -> Fragments:
    """Barycentrics, their screen derivatives and depth at the pixels' winning faces."""
    views, height, width = shape
    view, y, x = pixel // (height * width), pixel // width % height, pixel % width
    of = view * (len(rows) // views) + face
    e_dx, e_dy, e_0 = rows.index_select(0, of).unbind(-1)  # e(x, y) = e_dx x + e_dy y + e_0, P×3 each
    e = e_dx * (x + 0.5)[:, None] + e_dy * (y + 0.5)[:, None] + e_0
    scale = 1 / (e[:, 0] + e[:, 1] + e[:, 2])  # 1 / Σe
    barycentric = (e * scale[:, None]).float()
    # d(e/Σe) = de/Σe - e/Σe · Σde/Σe
    d = [(k * scale[:, None]).float() for k in (e_dx, e_dy)]
    dx, dy = (k - barycentric * (k[:, 0] + k[:, 1] + k[:, 2])[:, None] for k in d)
    volume = det.index_select(0, of)
    return Fragments(pixel, view, face, barycentric, dx, dy, (volume * scale).float(), volume < 0, shape)


def _chunks(sizes: Tensor):
    """Slices over `sizes` whose sums stay below CHUNK, or hold one item."""
    ends = sizes.cumsum(0)
    start, done = 0, 0
    while start < len(sizes):
        stop = int(torch.searchsorted(ends, done + CHUNK, right=True))
        stop = max(stop, start + 1)
        yield slice(start, stop)
        start, done = stop, int(ends[stop - 1])
