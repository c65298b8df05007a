"""The rasterizer against a slow per-pixel twin, and laws of coverage, depth and batches."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from patchproof.base import geometry
from patchproof.render import raster
from patchproof.render.fragments import Cameras
from patchproof.render.raster import rasterize

SIZE = (40, 32)


def cameras(eyes, size=SIZE, fov_deg=50.0, shift_px=(0.0, 0.0)) -> Cameras:
    poses = np.stack([geometry.look_at(eye, np.zeros(3)) for eye in eyes])
    matrix = geometry.intrinsics(fov_deg, size)
    matrix[:2, 2] += shift_px
    return Cameras(torch.tensor(poses), torch.tensor(np.stack([matrix] * len(poses))), size)


def sphere(subdivisions=3, radius=1.0):
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return torch.tensor(ball.vertices), torch.tensor(ball.faces)


def slow_twin(vertices, faces, views: Cameras):
    """Every pixel tests every face whose bounding box it meets: exact coverage in integers of 1/256 px, depth by ray
    and plane in float64.
    """
    width, height = views.size_px
    found = -np.ones((len(views), height, width), np.int64)
    depth = np.full((len(views), height, width), np.inf)
    for n in range(len(views)):
        pose, matrix = views.camera_from_world[n].numpy(), views.matrix_px[n].numpy()
        camera = vertices.numpy() @ pose[:3, :3].T + pose[:3, 3]
        assert (camera[:, 2] > 0).all(), "the twin does not clip"
        image = camera @ matrix.T
        snapped = [[round(v * 256) for v in point[:2] / point[2]] for point in image]
        for index, face in enumerate(faces.tolist()):
            a, b, c = (snapped[k] for k in face)
            if (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) < 0:
                b, c = c, b
            xs, ys = zip(a, b, c, strict=True)
            for y in range(max(0, min(ys) // 256), min(height, max(ys) // 256 + 1)):
                for x in range(max(0, min(xs) // 256), min(width, max(xs) // 256 + 1)):
                    if all(inside(*edge, 256 * x + 128, 256 * y + 128) for edge in ((a, b), (b, c), (c, a))):
                        p, q, r = camera[face]
                        normal, ray = np.cross(q - p, r - p), np.linalg.inv(matrix) @ [x + 0.5, y + 0.5, 1]
                        z = np.float32(normal @ p / (normal @ ray))
                        if z < depth[n, y, x]:
                            depth[n, y, x], found[n, y, x] = z, index
    return found, depth


def inside(a, b, x, y) -> bool:
    """Python integers: exact. A center on the edge counts where the edge is a left or a top one."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    e = dx * (y - a[1]) - dy * (x - a[0])
    return e > 0 or (e == 0 and (dy < 0 or (dy == 0 and dx > 0)))


def picture(fragments, values, empty=-1):
    out = torch.full((math.prod(fragments.shape),), empty, dtype=values.dtype)
    out[fragments.pixel] = values
    return out.view(fragments.shape)


def test_every_pixel_as_the_slow_twin_has_it():
    generator = torch.Generator().manual_seed(3)
    vertices = torch.rand(60, 3, generator=generator, dtype=torch.float64) * 2 - 1
    faces = torch.randint(0, 60, (70, 3), generator=generator)
    views = cameras([[0.5, 0.8, 4.0], [-3.0, 1.0, 2.0]])
    fragments = rasterize(vertices, faces, views, 0.01)
    found, depth = slow_twin(vertices, faces, views)
    assert (found >= 0).sum() > 500
    np.testing.assert_array_equal(picture(fragments, fragments.face).numpy(), found)
    hit = found >= 0
    np.testing.assert_allclose(picture(fragments, fragments.depth).numpy()[hit], depth[hit], rtol=1e-6)


def test_barycentrics_land_on_the_pixel_center():
    vertices, faces = sphere()
    views = cameras([[0.3, 1.0, 3.0]], (200, 150))
    fragments = rasterize(vertices, faces, views, 0.01)
    points = (fragments.barycentric.double()[..., None] * vertices[faces[fragments.face]]).sum(1)
    pixels = geometry.project(views.matrix_px[0].numpy(), views.camera_from_world[0].numpy(), points.numpy())
    centers = np.stack([fragments.pixel % 200 + 0.5, fragments.pixel // 200 + 0.5], 1)
    np.testing.assert_allclose(pixels, centers, atol=1e-3)


def derivatives(fragments):
    """Of the barycentrics, P×3 each, which are 1 at one corner and 0 at the others."""
    count = int(fragments.seen.max()) + 1 if len(fragments) else 0
    return fragments.derivatives(torch.eye(3).expand(count, 3, 3), fragments.barycentric)


def test_barycentric_derivatives_are_differences_of_barycentrics():
    vertices = torch.tensor([[-2.0, -1, 0], [2, -1, 1], [0, 2, -1]], dtype=torch.float64)
    views = cameras([[0.3, 0.2, 5.0]], (64, 64))
    fragments = rasterize(vertices, torch.tensor([[0, 1, 2]]), views, 0.01)
    at = {int(p): i for i, p in enumerate(fragments.pixel)}
    checked, (along_x, _) = 0, derivatives(fragments)
    for p, i in at.items():
        if p + 1 in at and p - 1 in at:
            j, k = at[p + 1], at[p - 1]
            difference = (fragments.barycentric[j] - fragments.barycentric[k]) / 2
            torch.testing.assert_close(along_x[i], difference, atol=2e-4, rtol=0)
            checked += 1
    assert checked > 100


@pytest.fixture
def drawn(monkeypatch):
    """Every pixel of every face, before depth decides: what `rasterize` fills, hidden or not."""
    pixels = []
    fill = raster._fill

    def spy(nearest, length, pixel, *rest):
        owner = torch.repeat_interleave(length)
        pixels.append(pixel[owner] + torch.arange(len(owner)) - (length.cumsum(0) - length)[owner])
        fill(nearest, length, pixel, *rest)

    monkeypatch.setattr(raster, "_fill", spy)
    monkeypatch.setattr(raster, "CHUNK", 1 << 24)  # all views at once, so that pixels count from the first
    return pixels


@pytest.mark.parametrize("seed", range(4))
def test_a_closed_sphere_has_no_hole_and_no_pixel_twice(seed, drawn):
    """At 1,000 poses. A line through a closed convex surface enters once and leaves once."""
    vertices, faces = sphere(2)
    rng = np.random.default_rng(seed)
    eyes = rng.normal(size=(250, 3))
    eyes *= rng.uniform(1.5, 6, (250, 1)) / np.linalg.norm(eyes, axis=1, keepdims=True)
    views = cameras(eyes)
    fragments = rasterize(vertices, faces, views, 0.01)
    times = torch.bincount(torch.cat(drawn), minlength=250 * SIZE[0] * SIZE[1])
    assert set(times.tolist()) == {0, 2}
    assert fragments.pixel.tolist() == times.nonzero()[:, 0].tolist()
    focal, distance = geometry.intrinsics(50, SIZE)[0, 0], np.linalg.norm(eyes, axis=1)
    radius = focal * 0.93 / np.sqrt(distance**2 - 0.93**2)  # a ball inside the faceted one
    y, x = np.mgrid[0 : SIZE[1], 0 : SIZE[0]] + 0.5
    disk = (x - SIZE[0] / 2) ** 2 + (y - SIZE[1] / 2) ** 2 < radius[:, None, None] ** 2
    assert (times.view(fragments.shape).numpy()[disk] == 2).all() and disk.sum() > 10_000


def test_two_triangles_cover_each_pixel_of_their_square_once():
    """Front faces of one quad, drawn one at a time: their pixels are disjoint and together the square's."""
    corners = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=torch.float64)
    rng = np.random.default_rng(0)
    for _ in range(50):
        eye = rng.uniform([-1, -1, 2], [1, 1, 5])
        one, two = (
            set(rasterize(corners, torch.tensor([f]), cameras([eye]), 0.01).pixel.tolist())
            for f in ([0, 1, 2], [0, 2, 3])
        )
        both = set(rasterize(corners, torch.tensor([[0, 1, 2], [0, 2, 3]]), cameras([eye]), 0.01).pixel.tolist())
        assert not one & two and one | two == both


def test_moving_the_principal_point_by_whole_pixels_moves_the_picture():
    vertices, faces = sphere()
    a, b = (rasterize(vertices, faces, cameras([[1.0, 2, 3]], shift_px=shift), 0.01) for shift in ((0, 0), (3, -2)))
    first, second = picture(a, a.face), picture(b, b.face)
    torch.testing.assert_close(first[:, 2:, :-3], second[:, :-2, 3:], rtol=0, atol=0)


def test_cutting_at_the_near_plane_equals_rendering_the_visible_part():
    """A long triangle that starts behind the camera against the same one cut by hand at the near plane."""
    views = Cameras(torch.eye(4, dtype=torch.float64)[None], torch.tensor(geometry.intrinsics(60, SIZE))[None], SIZE)
    behind = torch.tensor([[-1.0, 1, -5], [1, 1, 10], [-3, 1.5, 10]], dtype=torch.float64)
    near = 0.5
    share = (near - behind[0, 2]) / (behind[1:, 2] - behind[0, 2])
    cut = behind[0] + share[:, None] * (behind[1:] - behind[0])
    visible = torch.stack([cut[0], behind[1], behind[2], cut[1]])
    whole = rasterize(behind, torch.tensor([[0, 1, 2]]), views, near)
    by_hand = rasterize(visible, torch.tensor([[0, 1, 2], [0, 2, 3]]), views, near)
    assert len(whole) > 100
    assert whole.pixel.tolist() == by_hand.pixel.tolist()
    torch.testing.assert_close(whole.depth, by_hand.depth, rtol=1e-6, atol=0)


def test_faces_behind_the_camera_or_without_numbers_are_not_drawn():
    views = cameras([[0.0, 0, 5]])
    behind = torch.tensor([[0.0, 0, 6], [1, 0, 7], [0, 1, 8]], dtype=torch.float64)
    broken = torch.tensor([[0.0, 0, 0], [math.nan, 0, 0], [0, 1, 0]], dtype=torch.float64)
    flat = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]], dtype=torch.float64)
    for vertices in (behind, broken, flat):
        assert len(rasterize(vertices, torch.tensor([[0, 1, 2]]), views, 0.01)) == 0


def test_a_huge_face_is_cut_at_the_guard_band_and_still_fills_the_picture():
    huge = torch.tensor([[-1e7, -1e7, 0], [1e7, -1e7, 0], [0, 2e7, 0]], dtype=torch.float64)
    fragments = rasterize(huge, torch.tensor([[0, 1, 2]]), cameras([[0.0, 0, 0.5]]), 1e-3)
    assert len(fragments) == SIZE[0] * SIZE[1]
    torch.testing.assert_close(fragments.depth, torch.full_like(fragments.depth, 0.5), rtol=1e-5, atol=0)


def test_equal_depths_go_to_the_lower_face_and_order_does_not_matter_otherwise():
    vertices, faces = sphere()
    views = cameras([[2.0, 1, 2]])
    twice = rasterize(vertices, torch.cat([faces, faces]), views, 0.01)
    assert int(twice.face.max()) < len(faces)
    order = torch.randperm(len(faces), generator=torch.Generator().manual_seed(0))
    plain, shuffled = rasterize(vertices, faces, views, 0.01), rasterize(vertices, faces[order], views, 0.01)
    assert order[shuffled.face].tolist() == plain.face.tolist()


def test_a_plane_in_front_wins_down_to_23_bits_and_then_ties_go_to_the_lower_face():
    """Two squares, the upper one listed last; gaps of 2^-23 and 2^-24 of the distance. Aslant, below that, rounding
    mixes them: a mesh with two skins has no order there, and every run shows the same mixture.
    """
    square = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=torch.float64)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])

    def upper_share(bits, eye):
        both = torch.cat([square, square + torch.tensor([0, 0, 4 * 2.0**-bits], dtype=torch.float64)])
        return float((rasterize(both, faces, cameras([eye]), 0.01).face >= 2).float().mean())

    assert upper_share(23, [0.0, 0, 4]) == upper_share(23, [2.0, 1, 3]) == 1
    assert upper_share(24, [0.0, 0, 4]) == 0 and 0 < upper_share(24, [2.0, 1, 3]) < 1
    assert upper_share(24, [2.0, 1, 3]) == upper_share(24, [2.0, 1, 3])


def test_chunks_do_not_change_the_picture(monkeypatch):
    vertices, faces = sphere()
    views = cameras([[2.0, 1, 2], [1.0, -3, 0.5]])
    whole = rasterize(vertices, faces, views, 0.01)
    monkeypatch.setattr(raster, "CHUNK", 64)
    parts = rasterize(vertices, faces, views, 0.01)
    assert whole.pixel.tolist() == parts.pixel.tolist() and whole.face.tolist() == parts.face.tolist()


def test_chunks_of_faces_and_views_do_not_change_the_picture(monkeypatch):
    vertices, faces = sphere()
    views = cameras([[2.0, 1, 2], [1.0, -3, 0.5], [0.0, 0, 9]])
    whole = rasterize(vertices, faces, views, 0.01)
    for chunk in (500, 3000):
        monkeypatch.setattr(raster, "CHUNK", chunk)
        assert_same(rasterize(vertices, faces, views, 0.01), whole)


def test_a_batch_of_cameras_equals_single_ones():
    vertices, faces = sphere()
    views = cameras([[2.0, 1, 2], [1.0, -3, 0.5], [0.0, 0, 9]])
    views.matrix_px[1, :2, 2] += 4.25
    batch = rasterize(vertices, faces, views, 0.01)
    for n in range(3):
        one = Cameras(views.camera_from_world[n : n + 1], views.matrix_px[n : n + 1], SIZE)
        part = batch.where(batch.view == n)
        single = rasterize(vertices, faces, one, 0.01)
        assert (part.pixel - n * SIZE[0] * SIZE[1]).tolist() == single.pixel.tolist()
        for name in ("face", "barycentric", "depth", "front"):
            assert torch.equal(getattr(part, name), getattr(single, name)), name
        assert all(map(torch.equal, derivatives(part), derivatives(single)))


def assert_same(one, other):
    for name in ("pixel", "view", "face", "barycentric", "depth", "front"):
        assert torch.equal(getattr(one, name), getattr(other, name)), name
    assert all(map(torch.equal, derivatives(one), derivatives(other)))


def test_a_run_is_repeated_to_the_bit_where_faces_coincide():
    vertices, faces = sphere()
    twice, views = torch.cat([faces, faces.roll(1, 1), faces.flip(1)]), cameras([[2.0, 1, 2]])
    assert_same(rasterize(vertices, twice, views, 0.01), rasterize(vertices, twice, views, 0.01))


@pytest.mark.parametrize("scale", [1.0, 1e6])
def test_slivers_and_far_from_the_origin_as_the_slow_twin_has_it(scale):
    """Needles around a common hub, shifted and scaled: coverage is as exact as the 1/256 pixel grid of the corners."""
    angles = torch.linspace(0, 2 * math.pi, 41, dtype=torch.float64)[:-1]
    rim = torch.stack([angles.cos(), angles.sin(), 0.2 * (7 * angles).sin()], 1)
    needles = torch.stack([rim, rim * 0.999 + 0.004 * rim.roll(1, 1)], 1).flatten(0, 1)
    vertices = torch.cat([torch.zeros(1, 3, dtype=torch.float64), needles]) * scale
    faces = torch.stack([torch.zeros(40), torch.arange(1, 81, 2), torch.arange(2, 82, 2)], 1).long()
    views = cameras([[0.4 * scale, 0.3 * scale, 2.6 * scale]])
    shift = torch.tensor([3.0, -2.0, 5.0], dtype=torch.float64) * scale
    views.camera_from_world[:, :3, 3] -= views.camera_from_world[:, :3, :3] @ shift
    found, depth = slow_twin(vertices + shift, faces, views)
    fragments = rasterize(vertices + shift, faces, views, 0.01 * scale)
    assert (found >= 0).sum() > 5
    np.testing.assert_array_equal(picture(fragments, fragments.face).numpy(), found)
    np.testing.assert_allclose(fragments.depth.numpy(), depth[found >= 0], rtol=1e-5)


def test_corners_on_pixel_centers_and_level_edges_as_the_slow_twin_has_it():
    """Corners on half pixels put centers on edges: only the fill rule decides."""
    generator = torch.Generator().manual_seed(5)
    vertices = torch.cat([torch.randint(0, 65, (50, 2), generator=generator) / 2.0, torch.ones(50, 1)], 1).double()
    faces = torch.randint(0, 50, (60, 3), generator=generator)
    identity = torch.eye(4, dtype=torch.float64)[None]
    for face in faces:
        views = Cameras(identity, identity[:, :3, :3], SIZE)
        found, _ = slow_twin(vertices, face[None], views)
        fragments = rasterize(vertices, face[None], views, 0.5)
        np.testing.assert_array_equal(picture(fragments, fragments.face).numpy(), found)
