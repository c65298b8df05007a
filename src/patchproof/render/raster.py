"""A z-buffer rasterizer in plain torch: find the face that each pixel center sees, and the point on that face.

In: faces in world millimeters and a batch of pinhole cameras. Out: `Fragments`, one per covered pixel, with
perspective-correct barycentrics, camera depth and the derivatives for texture filtering. Visibility is hard and carries
no gradient: shape is never optimized.

Triangles are split into trapezoids, row spans and fragments, and depth is resolved by one integer maximum per pixel, so
that work grows with the covered area. Coverage is exact: corners are snapped to 1/256 pixel, and the ends of spans are
computed from integers that float64 holds exactly, in one canonical direction of each edge. Hence two triangles that
share an edge never both take a pixel and never leave one out; a center on an edge belongs to the face on its right or,
on level edges, below it (the top-left rule of Pineda, 1988). Depth and barycentrics come from the unsnapped face in 2D
homogeneous form (Olano and Greer, 1997), which holds behind the camera, too; faces are cut at the near plane, not
dropped. If depths are equal to 24 bits, the lower face index wins. Left out on purpose: transparency.
"""

import math
from dataclasses import replace

import torch
from torch import Tensor

from patchproof.base.errors import Refused
from patchproof.base.geometry import cross, dot
from patchproof.render.fragments import GUARD_PX, Cameras, Fragments, clip_triangles, stack_columns

SUBPIXELS = 256  # corners snap to this fraction of a pixel
# Faces, rows or fragments held at a time. Sixteen views of 20k faces took 1.9 times as long with 2^20, whose
# temporaries do not fit the cache; the temporaries take about 100 MB.
CHUNK = 1 << 18
_FACE_BITS = 29  # a key is a float64 of 1/z whose lower bits hold the face; 23 bits of the mantissa remain
_FACE_MASK = (1 << _FACE_BITS) - 1
_X_BITS = 26  # a snapped corner is one integer, y above x, both from -2^25 up
_X_MASK, _OFFSET = (1 << _X_BITS) - 1, 1 << (_X_BITS - 1)


@torch.no_grad()
def rasterize(vertices: Tensor, faces: Tensor, cameras: Cameras, near_mm: float) -> Fragments:
    """Find the nearest face at every pixel center of every camera.

    `vertices` V×3 (world mm), `faces` F×3 (counter-clockwise seen from outside). Faces nearer than `near_mm` are cut
    there; faces with a corner that is not finite are not drawn. Refused beyond 2^29 - 1 faces.
    """
    if len(faces) > _FACE_MASK:
        raise Refused(f"at most {_FACE_MASK} faces", str(len(faces)), "render the mesh in parts")
    width, height = cameras.size_px
    shape, vertices = (len(cameras), height, width), vertices.double()
    views_at_once = max(1, CHUNK // max(len(vertices), len(faces), 1))
    groups = range(0, len(cameras), views_at_once)
    nearest = torch.zeros(math.prod(shape), dtype=torch.int64, device=faces.device)
    for view in groups:
        keys = nearest[view * height * width : (view + views_at_once) * height * width]
        _write_keys(keys, homogeneous(vertices, cameras[view : view + views_at_once]), faces, cameras.size_px, near_mm)
    fragments = _allocate(nearest, shape)
    del nearest
    seen, slopes = [fragments.seen], [fragments.slopes]
    for view in groups:
        points = homogeneous(vertices, cameras[view : view + views_at_once])
        ends = fragments.pixel.new_tensor([view, view + views_at_once]) * (height * width)
        first, last = torch.searchsorted(fragments.pixel, ends).tolist()
        for start in range(first, last, CHUNK):
            part = slice(start, min(start + CHUNK, last))
            fragments.rank[part] = sum(map(len, seen))
            for found, one in zip((seen, slopes), _resolve(fragments, part, points, faces, view, near_mm), strict=True):
                found.append(one)
    return replace(fragments, seen=torch.cat(seen), slopes=torch.cat(slopes, 2))


def homogeneous(vertices: Tensor, cameras: Cameras) -> Tensor:
    """Return 3×N×V homogeneous pixels (x·z, y·z, z), written out: a matrix product's rounding depends on its size."""
    x, y, z = vertices.T
    matrix = cameras.matrix_px.double() @ cameras.camera_from_world.double()[:, :3]  # K [R t]
    m = matrix.transpose(0, 1)[..., None]
    return m[:, :, 0] * x + m[:, :, 1] * y + m[:, :, 2] * z + m[:, :, 3]


def _write_keys(nearest: Tensor, points: Tensor, faces: Tensor, size_px: tuple[int, int], near: float) -> None:
    """Write into `nearest` the greatest key at each of N·H·W pixels, 0 for a pixel without a face."""
    width, height = size_px
    snapped = _snap(points.flatten(1), near)
    for start in range(0, len(faces), CHUNK):
        block = faces[start : start + CHUNK]
        index = _corner_index(points, block)
        owner, corners = _triangles(points.flatten(1), snapped, index, size_px, near)
        (_, _, plane), _ = _planes(_take_corners(points, [i.index_select(0, owner) for i in index]), near)
        first_pixel = owner // len(block) * (height * width)
        face_key = _FACE_MASK - start - owner % len(block)  # the lower face has the greater key
        trapezoids = _trapezoids(corners, height)
        owners = [t.repeat(2) for t in (*plane, first_pixel, face_key)]
        for part in _chunks(trapezoids[1]):
            _fill(nearest, *_spans([t[part] for t in trapezoids], [t[part] for t in owners], width))


def _corner_index(points: Tensor, faces: Tensor) -> list[Tensor]:
    """Return the indices of each face's first, second and third corner among N·V points; N·F each."""
    _, views, count = points.shape
    offset = torch.arange(views, device=faces.device)[:, None] * count
    return [(offset + column).flatten() for column in faces.unbind(1)]


def _take_corners(points: Tensor, index: list[Tensor]) -> list[list[Tensor]]:
    """Return (x·z, y·z, z) of faces' three corners, one axis at a time: torch is several times slower on all."""
    return [[axis.index_select(0, i) for axis in points.flatten(1)] for i in index]


def _snap(points: Tensor, near: float) -> Tensor:
    """Return N·V corners on the 1/256 pixel grid, each one integer; -1 if a face must be cut or left out."""
    x, y, z = points
    plain = (z > near) & (torch.maximum(x.abs(), y.abs()) < GUARD_PX * z)
    return _pack(x / z, y / z).masked_fill_(~plain, -1)


def _pack(x: Tensor, y: Tensor) -> Tensor:
    x, y = (x * SUBPIXELS).round_(), (y * SUBPIXELS).round_()
    return (y * (1 << _X_BITS) + x + ((_OFFSET << _X_BITS) + _OFFSET)).nan_to_num_(0, 0, 0).long()  # below 2^53: exact


def _unpack(corner: Tensor) -> tuple[Tensor, Tensor]:
    return (corner & _X_MASK) - _OFFSET, (corner >> _X_BITS) - _OFFSET


def _center(snapped: Tensor, limit: int) -> Tensor:
    """Return the first pixel whose center is at or after a snapped coordinate, within 0..limit."""
    return (snapped + (SUBPIXELS // 2 - 1)).bitwise_right_shift_(8).clamp_(0, limit)  # 2^8 = SUBPIXELS


def _triangles(points: Tensor, snapped: Tensor, index: list[Tensor], size_px: tuple[int, int], near: float):
    """Return snapped triangles that may hold a pixel center, and their faces among N·F; cut ones come last."""
    a, b, c = corners = [snapped.index_select(0, i) for i in index]
    holds = a >= 0
    for axis, limit in zip(zip(*(_unpack(corner) for corner in corners), strict=True), size_px, strict=True):
        low, high = _extent(*axis)
        holds &= _center(low, limit) < _center(high, limit)
    to_clip = torch.minimum(torch.minimum(a, b), c) < 0
    owner = (holds & ~to_clip).nonzero()[:, 0]
    corners = [corner.index_select(0, owner) for corner in corners]
    to_clip = to_clip.nonzero()[:, 0]
    if len(to_clip):
        unclipped = torch.stack([points.index_select(1, i.index_select(0, to_clip)).T for i in index], 1)
        triangles, parent = clip_triangles(unclipped, near)
        cut = _pack(*triangles.unbind(-1)).unbind(1)
        owner = torch.cat([owner, to_clip[parent]])
        corners = [torch.cat(pair) for pair in zip(corners, cut, strict=True)]
    return owner, corners


def _extent(a: Tensor, b: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    return torch.minimum(torch.minimum(a, b), c), torch.maximum(torch.maximum(a, b), c)


def _planes(corners: list[list[Tensor]], near: float) -> tuple[list[list[Tensor]], Tensor]:
    """Return planes e with e · (x, y, 1) = b/z for the second and third barycentric b and for b = 1, and the signed
    volume, negative from outside. A face whose horizon passes within 1/25 pixel is seen edge-on, and snapping may turn
    it over: it is drawn flat at its mean 1/z.
    """
    a, b, c = corners
    total = cross([q - p for p, q in zip(a, b, strict=True)], [q - p for p, q in zip(a, c, strict=True)])
    volume = dot(a, total)
    planes = [[e / volume for e in plane] for plane in (cross(c, a), cross(a, b), total)]
    inverse = [1 / corner[2].clamp_min(near) for corner in corners]
    steepness = planes[2][0].abs() + planes[2][1].abs()
    edge_on = ~(steepness < 25 * _extent(*inverse)[1])  # true also where the volume is 0
    if edge_on.any():
        third = (inverse[0] + inverse[1] + inverse[2]) / 9
        flat = ((0.0, 0.0, third), (0.0, 0.0, third), (0.0, 0.0, 3 * third))
        pairs = (zip(*pair, strict=True) for pair in zip(flat, planes, strict=True))
        planes = [[torch.where(edge_on, f, e) for f, e in pair] for pair in pairs]
    return planes, volume


def _trapezoids(corners: list[Tensor], height: int) -> list[Tensor]:
    """Return the upper and the lower part of each triangle: first row, row count, its long and its short edge."""
    a, b, c = corners
    top, bottom = _extent(a, b, c)
    top, middle, bottom = (_unpack(corner) for corner in (top, a + b + c - top - bottom, bottom))
    rows = [_center(corner[1], height) for corner in (top, middle, bottom)]
    short = [torch.cat(pair) for pair in zip(_edge(top, middle), _edge(middle, bottom), strict=True)]
    first, count = torch.cat(rows[:2]), torch.cat([rows[1] - rows[0], rows[2] - rows[1]])
    return [first, count, *(t.repeat(2) for t in _edge(top, bottom)), *short]


def _edge(upper: tuple[Tensor, Tensor], lower: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Return integers (n, k, d) < 2^53: row y's first center right of or on the edge is pixel ceil((n + k y) / d)."""
    (ax, ay), (bx, by) = upper, lower
    dx, dy, half = bx - ax, by - ay, SUBPIXELS // 2
    return ((ax - half) * dy - dx * (ay - half)).double(), (dx * SUBPIXELS).double(), (dy * SUBPIXELS).double()


def _spans(trapezoids: list[Tensor], owners: list[Tensor], width: int) -> tuple[Tensor, ...]:
    """Return for each row of trapezoids: pixel count, first pixel, 1/z there, its change per pixel, face key."""
    first, count, *edges = trapezoids
    owner = torch.repeat_interleave(count)
    row = index_ranges(count, first, owner)
    y = row.double()
    n, k, d, *short = (t.index_select(0, owner) for t in edges)
    x0, x1 = (n.addcmul_(k, y).div_(d).ceil_().clamp_(0, width) for n, k, d in ((n, k, d), short))
    length = (x1 - x0).abs_().long()
    keep = length.nonzero()[:, 0]
    owner, row, length = (t.index_select(0, keep) for t in (owner, row, length))
    x = torch.minimum(x0, x1).index_select(0, keep)
    a, b, c, first_pixel, face_key = (t.index_select(0, owner) for t in owners)
    inverse = c + a * (x + 0.5) + b * (row + 0.5)
    return length, first_pixel + row * width + x.long(), inverse, a, face_key


def index_ranges(count: Tensor, first: Tensor, owner: Tensor) -> Tensor:
    """Return first, first + 1, ... for each owner, `count` of them."""
    shift = first - count.cumsum(0) + count
    return torch.arange(len(owner), device=owner.device).add_(shift.index_select(0, owner))


def _fill(nearest: Tensor, length: Tensor, pixel: Tensor, inverse: Tensor, slope: Tensor, face_key: Tensor) -> None:
    """Write the nearest face of every pixel of these spans."""
    for part in _chunks(length):
        count, first = length[part], pixel[part]
        owner = torch.repeat_interleave(count)
        step = index_ranges(count, torch.zeros_like(count), owner)
        value = inverse[part].index_select(0, owner).addcmul_(slope[part].index_select(0, owner), step)
        # the bits of positive floats order like the numbers; beyond its horizon a face counts as far away
        key = value.clamp_min_(1e-30).view(torch.int64).bitwise_and_(~_FACE_MASK)
        key.bitwise_or_(face_key[part].index_select(0, owner))
        nearest.scatter_reduce_(0, step.add_(first.index_select(0, owner)), key, "amax")


def _allocate(nearest: Tensor, shape: tuple[int, int, int]) -> Fragments:
    """Return fragments with their pixels and faces, and memory for the rest: joining pieces would need it twice."""
    pixel = nearest.nonzero()[:, 0]
    face = nearest.index_select(0, pixel).bitwise_and_(_FACE_MASK).neg_().add_(_FACE_MASK)
    depth, front = (torch.empty_like(pixel, dtype=dtype) for dtype in (torch.float32, torch.bool))
    barycentric, rank, seen = depth.new_empty(len(pixel), 3), torch.empty_like(pixel), pixel[:0]
    return Fragments(pixel, face, barycentric, depth, front, rank, seen, depth.new_empty(2, 3, 0), shape)


def _resolve(
    fragments: Fragments, part: slice, points: Tensor, faces: Tensor, view0: int, near: float
) -> tuple[Tensor, Tensor]:
    """Fill in one part of the fragments, all within the views of `points`; return the faces seen and their slopes."""
    _, height, width = fragments.shape
    position = fragments.pixel[part].double()
    row = (position / width).floor_()
    view = (row / height).floor_()
    x, y = position.sub_(row, alpha=width).add_(0.5), row.sub_(view, alpha=height).add_(0.5)
    pair = view.long().sub_(view0).mul_(len(faces)).add_(fragments.face[part])
    owner, rank = rank_values(pair, points.shape[1] * len(faces))
    corners = _take_corners(points, [i.index_select(0, owner) for i in _corner_index(points, faces)])
    planes, volume = _planes(corners, near)
    second, third, inverse = (_at_center(plane, rank, x, y) for plane in planes)
    # a center may lie up to 1/362 pixel outside the unsnapped face, where the plane may be far away near its horizon
    deepest = torch.stack([corner[2].max() for corner in corners]).max()
    z = inverse.clamp_min_(0.5 / deepest).clamp_max_(1 / near).reciprocal_()
    second, third = second.mul_(z), third.mul_(z)
    fragments.barycentric[part] = stack_columns(1 - second - third, second, third)
    fragments.depth[part] = z
    fragments.front[part] = (volume < 0).index_select(0, rank)
    fragments.rank[part] += rank
    slopes = torch.stack([plane[axis] for axis in range(2) for plane in planes]).float()
    return owner % len(faces), slopes.view(2, 3, -1)


def rank_values(values: Tensor, limit: int) -> tuple[Tensor, Tensor]:
    """Return the distinct values below `limit`, ascending, and each value's index among them; `unique` would sort."""
    present = torch.zeros(limit, dtype=torch.bool, device=values.device).index_fill_(0, values, True)
    distinct = present.nonzero()[:, 0]
    rank = torch.empty(limit, dtype=torch.int64, device=values.device)
    rank[distinct] = torch.arange(len(distinct), device=values.device)
    return distinct, rank.index_select(0, values)


def _at_center(plane: list[Tensor], rank: Tensor, x: Tensor, y: Tensor) -> Tensor:
    a, b, c = (t.index_select(0, rank) for t in plane)
    return c.addcmul_(a, x).addcmul_(b, y)


def _chunks(sizes: Tensor):
    """Yield slices over `sizes` whose sums stay below CHUNK, or that hold one item."""
    ends = sizes.cumsum(0)
    start, done = 0, 0
    if len(sizes) and int(ends[-1]) <= CHUNK:  # one synchronization with the device, not two for each slice
        yield slice(0, len(sizes))
        return
    while start < len(sizes):
        stop = int(torch.searchsorted(ends, done + CHUNK, right=True))
        stop = max(stop, start + 1)
        yield slice(start, stop)
        start, done = stop, int(ends[stop - 1])
