"""The rasterizer against a slow per-pixel twin, laws of coverage, and the fragments of another rasterizer."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from patchproof import geometry
from patchproof.render import raster
from patchproof.render.raster import Cameras, rasterize

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
    """Every pixel tests every face: exact coverage with fractions of 1/256 px, depth by ray and plane in float64."""
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
            p, q, r = camera[face]
            normal = np.cross(q - p, r - p)
            for y in range(height):
                for x in range(width):
                    if all(inside(*edge, 256 * x + 128, 256 * y + 128) for edge in ((a, b), (b, c), (c, a))):
                        ray = np.linalg.inv(matrix) @ [x + 0.5, y + 0.5, 1]
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


def test_barycentric_derivatives_are_differences_of_barycentrics():
    vertices = torch.tensor([[-2.0, -1, 0], [2, -1, 1], [0, 2, -1]], dtype=torch.float64)
    views = cameras([[0.3, 0.2, 5.0]], (64, 64))
    fragments = rasterize(vertices, torch.tensor([[0, 1, 2]]), views, 0.01)
    at = {int(p): i for i, p in enumerate(fragments.pixel)}
    checked = 0
    for p, i in at.items():
        if p + 1 in at and p - 1 in at:
            j, k = at[p + 1], at[p - 1]
            difference = (fragments.barycentric[j] - fragments.barycentric[k]) / 2
            torch.testing.assert_close(fragments.barycentric_dx[i], difference, atol=2e-4, rtol=0)
            checked += 1
    assert checked > 100


@pytest.mark.parametrize("seed", range(4))
def test_a_closed_sphere_has_no_hole(seed):
    """Any ray through the sphere's inside must hit; silhouettes aside, the disk inside the outline is full."""
    vertices, faces = sphere(2)
    rng = np.random.default_rng(seed)
    for _ in range(60):
        eye = rng.normal(size=3)
        eye *= rng.uniform(1.5, 6) / np.linalg.norm(eye)
        fragments = rasterize(vertices, faces, cameras([eye]), 0.01)
        assert len(torch.unique(fragments.pixel)) == len(fragments.pixel)
        focal, distance = geometry.intrinsics(50, SIZE)[0, 0], np.linalg.norm(eye)
        radius = focal * 0.93 / math.sqrt(distance**2 - 0.93**2)  # a ball inside the faceted one
        y, x = np.mgrid[0 : SIZE[1], 0 : SIZE[0]] + 0.5
        disk = (x - SIZE[0] / 2) ** 2 + (y - SIZE[1] / 2) ** 2 < radius**2
        assert (picture(fragments, fragments.face).numpy()[0][disk] >= 0).all()


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


def test_culling_keeps_the_outside():
    vertices, faces = sphere()
    views = cameras([[0.0, 0, 4]])
    kept, culled = rasterize(vertices, faces, views, 0.01), rasterize(vertices, faces, views, 0.01, cull_back=True)
    assert bool(kept.front.all()) and kept.face.tolist() == culled.face.tolist()
    turned = rasterize(vertices, faces.flip(1), views, 0.01, cull_back=True)
    assert not turned.face.tolist() == kept.face.tolist() and bool(turned.front.all())


def test_chunks_do_not_change_the_picture(monkeypatch):
    vertices, faces = sphere()
    views = cameras([[2.0, 1, 2], [1.0, -3, 0.5]])
    whole = rasterize(vertices, faces, views, 0.01)
    monkeypatch.setattr(raster, "CHUNK", 64)
    parts = rasterize(vertices, faces, views, 0.01)
    assert whole.pixel.tolist() == parts.pixel.tolist() and whole.face.tolist() == parts.face.tolist()


@pytest.mark.parametrize("name", ["gz_suv", "teapot"])
def test_agrees_with_another_rasterizer(data, name):
    """PyTorch3D's fragments of the same views; both round, so pixels on an edge may differ and coincident faces may
    swap.
    """
    theirs = np.load(data / "reference" / f"{name}.npz")
    rotation, center = theirs["rotation"].astype(float), theirs["center"].astype(float)
    size = int(theirs["size_px"])
    poses = np.tile(np.eye(4), (len(rotation), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotation, -np.einsum("nij,nj->ni", rotation, center)
    matrix = geometry.intrinsics(float(theirs["fov_deg"]), (size, size))
    views = Cameras(torch.tensor(poses), torch.tensor(np.stack([matrix] * len(poses))), (size, size))
    vertices, faces = torch.tensor(theirs["vertices"]).double(), torch.tensor(theirs["faces"]).long()
    fragments = rasterize(vertices, faces, views, 1e-3 * float(np.ptp(theirs["vertices"])))
    ours = picture(fragments, fragments.face).numpy()
    same = ours == theirs["face"]
    assert same.mean() > 0.9995  # all pixels, edges and ties included
    on = same.reshape(-1)[fragments.pixel.numpy()]
    depth = theirs["depth"].reshape(-1)[fragments.pixel.numpy()][on]
    np.testing.assert_allclose(fragments.depth.numpy()[on], depth, rtol=1e-4)
    barycentric = theirs["barycentric"].reshape(-1, 3)[fragments.pixel.numpy()][on]
    assert np.quantile(np.abs(fragments.barycentric.numpy()[on] - barycentric), 0.999) < 1e-3
