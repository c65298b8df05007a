"""Texture coordinates for faces that have none: every face gets its own area in one new texture.

In: a mesh and the faces to unwrap. Out: the same mesh, faces in the same order, with those faces on a new material
whose texture starts as their present appearance (base color, vertex colors, the texel they pointed at), at any
resolution. xatlas cuts and packs (charts at even density, 2 texels apart); the texels between charts take the nearest
chart's color, so that mip levels mix in no foreign colors. The same mesh gives the same bytes. Most meshes take
seconds; a rough scan of 80,000 faces took 80. Left out on purpose: seams placed by hand, and one atlas over several
textures.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from patchproof.base.color import codes_from_srgb, linear_from_srgb, srgb_from_linear
from patchproof.base.errors import Refused
from patchproof.mesh.mesh import Material, Mesh, position_numbers

_ROWS_AT_ONCE = 1 << 20  # about 300 MB of intermediate arrays
PADDING_TEXELS = 2  # between charts; in effect 3 stay free, so that rims of 1.5 texels on either side do not meet
# beyond this, float32 coordinates are coarser than a tenth of a texel of a 1024² texture
_FARTHEST_UV = 1000.0
# neighbors that xatlas takes for coplanar have a cosine within 1e-4 of 1; a chart 45 degrees off its mean is not flat
_FLAT_COSINE, _TURNED_COSINE = 1 - 2e-4, 0.7
_ATTEMPTS = 3


def coverage(corners: np.ndarray, size: tuple[int, int], grow: float = 0.0) -> np.ndarray:
    """Count the faces that cover each texel of a (width, height) texture, which repeats: int32 H×W. `corners` are F×3×2
    in texels. With `grow` = 0 a face covers a texel if its center lies in the face (on a common edge: in one of the
    two), else if its center is within `grow` of the face in both x and y: 0.5 gives every texel that the face touches,
    1.5 all that a bilinear look-up reads.
    """
    width, height = size
    steps = np.zeros((height, width + 1), np.int32)  # +1 where a run of texels starts, -1 where it has ended
    for _, row, start, stop in spans(corners, grow):
        row = row % height
        turns, rest = np.divmod(stop - start, width)
        start = start % width
        end = start + rest
        np.add.at(steps, (row, np.zeros_like(row)), turns.astype(np.int32) + (end > width))
        np.add.at(steps, (row, start), 1)
        np.add.at(steps, (row, np.where(end > width, end - width, end)), -1)
    return np.cumsum(steps, axis=1, dtype=np.int32, out=steps)[:, :width]


def texels_per_face(corners: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (how many texels of an H×W mask have their center in each of F faces, how many texels in all do)."""
    height, width = mask.shape
    cumulated = np.zeros((height, width + 1), np.int32)
    np.cumsum(mask, axis=1, out=cumulated[:, 1:])
    total, count = np.zeros(len(corners)), np.zeros(len(corners))
    for face, row, start, stop in spans(corners, 0.0):
        row = row % height
        ends = [x // width * cumulated[row, width] + cumulated[row, x % width] for x in (start, stop)]
        total += np.bincount(face, ends[1] - ends[0], len(corners))
        count += np.bincount(face, stop - start, len(corners))
    return total, count


def spans(corners: np.ndarray, grow: float) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Yield runs of texels (face, row, start, stop), integers of the unwrapped plane, in batches of bounded size."""
    corners = np.asarray(corners, float)
    low, high = corners[..., 1].min(1) - grow, corners[..., 1].max(1) + grow
    first, last = _center_at_or_after(low), _center_at_or_after(high)
    row_ends = np.cumsum(last - first)
    for begin in range(0, int(row_ends[-1]) if len(row_ends) else 0, _ROWS_AT_ONCE):
        number = np.arange(begin, min(begin + _ROWS_AT_ONCE, row_ends[-1]))
        face = np.searchsorted(row_ends, number, side="right")
        row = last[face] - row_ends[face] + number
        low_x, high_x = _extent(corners[face], row + 0.5, grow)
        start, stop = _center_at_or_after(low_x - grow), _center_at_or_after(high_x + grow)
        covered = stop > start
        yield face[covered], row[covered], start[covered], stop[covered]


def _extent(corners: np.ndarray, y: np.ndarray, grow: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and largest x of each triangle N×3×2 between y - grow and y + grow."""
    left, right = np.full(len(y), np.inf), np.full(len(y), -np.inf)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        a, b = corners[:, a], corners[:, b]
        # from the lower end, so that both faces at an edge find the same x
        swap = ((a[:, 1] > b[:, 1]) | ((a[:, 1] == b[:, 1]) & (a[:, 0] > b[:, 0])))[:, None]
        a, b = np.where(swap, b, a), np.where(swap, a, b)
        rise = b[:, 1] - a[:, 1]
        safe = np.where(rise > 0, rise, 1.0)
        t0 = np.where(rise > 0, np.clip((y - grow - a[:, 1]) / safe, 0, 1), 0.0)
        t1 = np.where(rise > 0, np.clip((y + grow - a[:, 1]) / safe, 0, 1), 1.0)
        x = np.stack([a[:, 0] + t * (b[:, 0] - a[:, 0]) for t in (t0, t1)])
        within = (a[:, 1] <= y + grow) & (b[:, 1] >= y - grow)
        left = np.where(within, np.minimum(left, x.min(0)), left)
        right = np.where(within, np.maximum(right, x.max(0)), right)
    return left, right


def _center_at_or_after(x: np.ndarray) -> np.ndarray:
    """Return the first texel whose center is not before x."""
    return np.ceil(x - 0.5).astype(np.int64)


def has_usable_uv(mesh: Mesh) -> np.ndarray:
    """Return which faces F have texture coordinates to paint on. All three corners at (0, 0) mean none, as do NaN and
    absurdly far ones; vertex colors without a texture need a new texture anyway.
    """
    uv = mesh.corner_uv
    with np.errstate(invalid="ignore"):
        usable = (np.abs(uv) <= _FARTHEST_UV).all((1, 2)) & (uv != 0).any((1, 2))
    plain = np.array([material.texture_srgb is None for material in mesh.materials])[mesh.face_material]
    return usable & ~(plain & (mesh.corner_color_linear != 1).any((1, 2)))


def unwrap(mesh: Mesh, faces: np.ndarray, texels: int) -> Mesh:
    """Put the chosen `faces` (bool F) on a new material with a texture about `texels` wide and high, which holds their
    whole color: corner colors are 1 afterwards. Materials left without faces are dropped.
    """
    uv, size = _make_atlas(mesh.vertices, mesh.faces[faces], texels)
    owners = np.unique(mesh.face_material[faces])
    name = mesh.materials[owners[0]].name if len(owners) == 1 else "unwrapped"
    texture = _bake(uv * size, _corner_colors(mesh, faces), size)
    corner_uv, corner_color = mesh.corner_uv.copy(), mesh.corner_color_linear.copy()
    corner_uv[faces], corner_color[faces] = uv, 1.0
    index = np.where(faces, len(mesh.materials), mesh.face_material)
    used_materials, face_material = np.unique(index, return_inverse=True)
    materials = (*mesh.materials, Material(name, (1.0, 1.0, 1.0), texture))
    used = {"face_material": face_material.reshape(-1), "materials": tuple(materials[i] for i in used_materials)}
    return replace(mesh, corner_uv=corner_uv, corner_color_linear=corner_color, **used)


def _make_atlas(vertices: np.ndarray, faces: np.ndarray, texels: int) -> tuple[np.ndarray, tuple[int, int]]:
    """Return (uv F×3×2, v down, (width, height) of the atlas); specks under 1e-7 of the object share a texel."""
    used_vertices, local_faces = np.unique(faces, return_inverse=True)
    points, local_faces = vertices[used_vertices], local_faces.reshape(-1, 3)
    # xatlas ignores edges under 1e-4 in any unit: at a length of 1000 that is 1e-7 of the object
    points = (points - points.min(0)) * (1000 / np.ptp(points, axis=0).max())
    group = _direction_groups(points, local_faces)
    uv, size = _pack(points, local_faces, group, texels)
    for _ in range(_ATTEMPTS - 1):
        overlapping = texels_per_face(uv * size, coverage(uv * size, size) > 1)[0] > 0
        if not overlapping.any():
            break
        group[overlapping] = group.max() + 1  # xatlas lets a chart fold over itself now and then: cut the folds out
        uv, size = _pack(points, local_faces, group, texels)
    return uv.astype(np.float32), size


def _pack(points: np.ndarray, faces: np.ndarray, group: np.ndarray, texels: int) -> tuple[np.ndarray, tuple[int, int]]:
    """Return (uv F×3×2, (width, height)) of one atlas in which no chart spans two of the groups F."""
    try:
        import xatlas
    except ModuleNotFoundError as error:
        remedy = 'pip install "patchproof[textures]", or give the mesh texture coordinates'
        expected = "the package xatlas, to unwrap a mesh without texture coordinates"
        raise Refused(expected, "no such package", remedy) from error
    atlas, packing = xatlas.Atlas(), xatlas.PackOptions()
    for index in np.unique(group):
        atlas.add_mesh(points.astype(np.float32), faces[group == index].astype(np.uint32))
    packing.resolution, packing.padding, packing.bilinear = texels, PADDING_TEXELS, True
    packing.max_chart_size = 2 * texels  # else a single needle makes a strip half a million texels long
    packing.rotate_charts = False  # its quarter turns swap the axes, which mirrors the chart
    atlas.generate(xatlas.ChartOptions(), packing)
    if not atlas.width or not atlas.height:
        raise Refused("a surface that can be unwrapped", f"{len(faces)} faces that cannot", "unwrap it by hand")
    uv, width, height = np.zeros((len(faces), 3, 2)), int(atlas.width), int(atlas.height)
    for order, index in enumerate(np.unique(group)):
        _, corners, points_uv = atlas[order]
        uv[group == index] = points_uv[corners]
    # a margin of half a padding, because textures wrap: the left rim has the right one for a neighbor
    padded = width + PADDING_TEXELS, height + PADDING_TEXELS
    return (uv * [width, height] + PADDING_TEXELS / 2) / padded, padded


def _direction_groups(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the groups of faces that xatlas must get as separate meshes: 0, or 1 to 27 by normal on fine smooth
    surfaces.

    xatlas joins neighbors whose normals are within 0.8 degrees into one flat chart, however far that leads, and crashes
    on a chart without a rim, such as a finely divided sphere. Cut by direction, no group turns that far.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    normal = np.cross(points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    place = position_numbers(points.astype(np.float32))[faces]
    edge = np.sort(np.concatenate([place[:, [0, 1]], place[:, [1, 2]], place[:, [2, 0]]]), axis=1)
    order = np.lexsort(edge.T)
    same = (np.diff(edge[order], axis=0) == 0).all(1)
    a, b = (order[1:][same] % len(faces), order[:-1][same] % len(faces))
    flat = (normal[a] * normal[b]).sum(1) > _FLAT_COSINE
    links = coo_matrix((np.ones(flat.sum()), (a[flat], b[flat])), shape=(len(faces),) * 2)
    chart = connected_components(links, directed=False)[1]
    mean = np.stack([np.bincount(chart, normal[:, axis]) for axis in range(3)], axis=1)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-300)
    turns = np.bincount(chart, (normal * mean[chart]).sum(1) < _TURNED_COSINE) > 0
    return np.where(turns[chart], 1 + np.rint(1.3 * normal + 1).astype(int) @ [1, 3, 9], 0)


def _corner_colors(mesh: Mesh, faces: np.ndarray) -> np.ndarray:
    """Return the present linear color F×3×3 of the chosen faces' corners."""
    color = mesh.corner_color_linear[faces].astype(float)
    owner, uv = mesh.face_material[faces], np.nan_to_num(mesh.corner_uv[faces], nan=0.0, posinf=0.0, neginf=0.0)
    for index in np.unique(owner):
        material, of_material = mesh.materials[index], owner == index
        color[of_material] *= material.base_color_linear
        if material.texture_srgb is not None:
            height, width, _ = material.texture_srgb.shape
            x, y = (np.floor(uv[of_material] * [width, height]).astype(np.int64) % [width, height]).transpose(2, 0, 1)
            color[of_material] *= linear_from_srgb(material.texture_srgb[y, x] / 255)
    return color


def _bake(corners: np.ndarray, colors_linear: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Paint corner colors F×3×3 at `corners` F×3×2 into a uint8 sRGB texture; the rest takes the nearest color."""
    from scipy.ndimage import distance_transform_edt

    width, height = size
    light, empty = np.zeros((height, width, 3)), np.ones((height, width), bool)
    for grow in (1.0, 0.0):  # rims first, so that a face keeps the texels inside it
        for face, row, start, stop in spans(corners, grow):
            length = stop - start
            column = np.arange(length.sum()) - np.repeat(np.cumsum(length) - length - start, length)
            face, row = np.repeat(face, length), np.repeat(row, length)
            weight = _barycentric(corners[face], np.stack([column, row], 1) + 0.5)
            row, column = row.clip(0, height - 1), column.clip(0, width - 1)
            light[row, column] = (weight[..., None] * colors_linear[face]).sum(1)
            empty[row, column] = False
    y, x = np.asarray(distance_transform_edt(empty, return_distances=False, return_indices=True))
    return codes_from_srgb(srgb_from_linear(light[y, x].clip(0, 1)))


def _barycentric(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the weights N×3 of points in triangles N×3×2; points outside are moved onto the triangle."""
    a, b, c = corners.transpose(1, 0, 2)
    (ux, uy), (vx, vy), (px, py) = (b - a).T, (c - a).T, (points - a).T
    area = ux * vy - uy * vx
    area = np.where(area == 0, np.inf, area)
    wb, wc = (px * vy - py * vx) / area, (ux * py - uy * px) / area
    weight = np.stack([1 - wb - wc, wb, wc], 1).clip(0, 1)
    return weight / weight.sum(1, keepdims=True)
