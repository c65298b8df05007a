"""Where rendering breaks down: each case has a clear result, and a bad face leaves the others as they are."""

from __future__ import annotations

import ctypes
import math
import sys
import time
from pathlib import Path

import pytest
import torch

from patchproof.base.errors import Refused
from patchproof.base.input import run_in_child
from patchproof.render import raster
from patchproof.render.fragments import Cameras
from patchproof.render.raster import rasterize
from test_raster import SIZE, assert_same, cameras, derivatives, sphere


def triangle(*corners):
    return torch.tensor(corners, dtype=torch.float64), torch.tensor([[0, 1, 2]])


def assert_sound(fragments):
    for values in (fragments.depth, fragments.barycentric, *derivatives(fragments)):
        assert bool(values.isfinite().all())
    assert bool((fragments.depth > 0).all())


def test_from_inside_every_pixel_sees_the_inner_side():
    vertices, faces = sphere()
    fragments = rasterize(vertices, faces, cameras([[0.1, 0.2, 0.3]]), 0.01)
    assert len(fragments) == SIZE[0] * SIZE[1] and not bool(fragments.front.any())
    assert_sound(fragments)


def test_a_camera_in_the_surface_sees_the_rest_of_it():
    vertices, faces = sphere()
    fragments = rasterize(vertices, faces, cameras([vertices[7].tolist()]), 0.01)
    assert len(fragments) > 0.99 * SIZE[0] * SIZE[1]  # it looks inward; only faces nearer than 0.01 are cut away
    assert_sound(fragments)


def test_an_edge_on_face_is_not_drawn_or_flat_and_finite():
    level = triangle([-1.0, 0, 1], [1.0, 0, 1], [0.0, 0, -1])
    assert len(rasterize(*level, cameras([[0.0, 0, 5]]), 0.01)) == 0
    # 2,000 faces in planes through the eye to 1e-4, depth 4 to 6: a snap may open them by 1/256 pixel
    generator = torch.Generator().manual_seed(0)
    angle = torch.rand(2000, 1, generator=generator, dtype=torch.float64) * 2 * math.pi
    along, up = (torch.rand(2000, 3, generator=generator, dtype=torch.float64) * 2 - 1 for _ in range(2))
    aside = torch.randn(2000, 3, generator=generator, dtype=torch.float64) * 1e-4
    x, y = along * angle.cos() - aside * angle.sin(), along * angle.sin() + aside * angle.cos()
    vertices, faces = torch.stack([x, y, up], -1).view(-1, 3), torch.arange(6000).view(-1, 3)
    fragments = rasterize(vertices, faces, cameras([[0.0, 0, 5]], (400, 400)), 0.01)
    assert 100 < len(fragments) < 20_000  # of some 500,000 that the lines run through
    assert_sound(fragments)
    assert bool(((fragments.depth > 3.9) & (fragments.depth < 6.3)).all())
    assert float(fragments.barycentric.abs().max()) < 1.2


def test_a_face_through_the_camera_center_does_no_harm():
    vertices, faces = sphere()
    eye = torch.tensor([0.0, 0, 4], dtype=torch.float64)
    views = cameras([eye.tolist()])
    plain = rasterize(vertices, faces, views, 0.01)
    through = torch.stack([eye, eye + torch.tensor([0.3, 0.7, -3.0]), eye + torch.tensor([-0.2, 0.1, -2.0])])
    both = rasterize(
        torch.cat([vertices, through]), torch.cat([faces, len(vertices) + torch.tensor([[0, 1, 2]])]), views, 0.01
    )
    assert_sound(both)
    other = both.where(both.face < len(faces))
    lost = set(plain.pixel.tolist()) - set(other.pixel.tolist())
    assert len(lost) <= 3 and set(other.pixel.tolist()) <= set(plain.pixel.tolist())


@pytest.mark.parametrize(("distance", "pixels"), [(60.0, 1), (1000.0, 1), (1e6, 0)])
def test_an_object_of_a_pixel_or_less_takes_the_pixel_whose_center_it_covers(distance, pixels):
    """1.1, 0.07 and 0.00007 pixels across; what is smaller than 1/256 pixel vanishes."""
    vertices, faces = sphere(2)
    assert len(rasterize(vertices, faces, cameras([[0.0, 0, distance]]), 0.01)) == 0  # it lies between four centers
    on_a_center = cameras([[0.0, 0, distance]], shift_px=(0.5, 0.5))
    fragments = rasterize(vertices, faces, on_a_center, 0.01)
    assert len(fragments) == pixels and bool(((fragments.depth - distance).abs() < 1.01).all())
    assert_sound(fragments)


@pytest.mark.parametrize(
    "bad",
    [
        [[math.nan, 0, 0], [1, 0, 0], [0, 1, 0]],
        [[math.inf, 0, 0], [1, 0, 0], [0, 1, 0]],
        [[math.nan] * 3] * 3,
        [[0.5, 0.5, 2]] * 3,
        [[0.0, 0, 2], [0.0, 0, 2], [1.0, 1, 2]],
        [[1e308, 0, 0], [0, 1e308, 0], [0, 0, -1e308]],
    ],
    ids=["nan", "inf", "all nan", "a point", "two corners", "overflow"],
)
def test_a_bad_face_leaves_the_others_as_they_are(bad):
    vertices, faces = sphere()
    views = cameras([[2.0, 1, 2], [0.0, 0, 4]])
    plain = rasterize(vertices, faces, views, 0.01)
    more = torch.cat([vertices, torch.tensor(bad, dtype=torch.float64)])
    both = rasterize(more, torch.cat([faces, len(vertices) + torch.tensor([[0, 1, 2]])]), views, 0.01)
    assert_same(both, plain)


def test_a_vertex_at_a_kilometer_is_drawn_to_the_horizon():
    """A floor 300 below the camera out to 1e6: rows below the horizon see it at z = 300 f / (y - horizon)."""
    views = Cameras(
        torch.eye(4, dtype=torch.float64)[None],
        torch.tensor([[[40.0, 0, 20], [0, 40, 16], [0, 0, 1]]], dtype=torch.float64),
        SIZE,
    )
    floor = triangle([-1e6, 300, -1e6], [1e6, 300, -1e6], [0, 300, 1e6])
    fragments = rasterize(*floor, views, 1.0)
    y = fragments.pixel // SIZE[0]
    assert set(y.tolist()) == set(range(16, SIZE[1]))
    torch.testing.assert_close(fragments.depth, 300 * 40 / (y + 0.5 - 16).float(), rtol=1e-5, atol=0)
    assert_sound(fragments)


def test_a_center_that_a_snap_puts_beyond_the_horizon_is_far_and_finite():
    """The horizon lies 1e-4 pixel below the centers of row 16, and the floor's far edge snaps onto them."""
    matrix = torch.tensor([[[40.0, 0, 20], [0, 40, 16.5 + 1e-4], [0, 0, 1]]], dtype=torch.float64)
    views = Cameras(torch.eye(4, dtype=torch.float64)[None], matrix, SIZE)
    fragments = rasterize(*triangle([-1e9, 300, 1e9], [1e9, 300, 1e9], [0, 300, 50]), views, 1.0)
    first_row = fragments.where(fragments.pixel // SIZE[0] == 16)
    assert len(first_row) == SIZE[0] and bool((first_row.depth <= 2.001e9).all())
    assert_sound(fragments)


def test_two_million_faces_in_bounded_time_and_memory():
    """A grid of 1000×1000 squares; one view of 128 pixels."""
    side = 1000
    step = torch.linspace(-1, 1, side + 1, dtype=torch.float64)
    y, x = torch.meshgrid(step, step, indexing="ij")
    vertices = torch.stack([x, y, 0.1 * (9 * x).sin()], -1).reshape(-1, 3)
    corner = (torch.arange(side)[:, None] * (side + 1) + torch.arange(side)).flatten()
    squares = torch.stack([corner, corner + 1, corner + side + 2, corner + side + 1], 1)
    faces = torch.cat([squares[:, [0, 1, 2]], squares[:, [0, 2, 3]]])
    start = time.perf_counter()
    fragments = rasterize(vertices, faces, cameras([[0.0, 0, 1.5]], (128, 128)), 0.01)
    assert len(faces) == 2_000_000 and len(fragments) == 128 * 128
    assert time.perf_counter() - start < 20  # 0.2 s on an idle core
    assert_sound(fragments)


def test_more_faces_than_a_key_holds_are_refused():
    faces = torch.zeros(1, 3, dtype=torch.int64).expand(1 << 29, 3)
    with pytest.raises(Refused, match="Expected at most 536870911 faces, got 536870912: render the mesh in parts"):
        rasterize(torch.zeros(1, 3), faces, cameras([[0.0, 0, 4]]), 0.01)


def test_the_last_face_that_a_key_holds_is_told_from_the_one_before(monkeypatch):
    """With keys of 3 bits for the face: 7 faces, the last of which is seen."""
    monkeypatch.setattr(raster, "_FACE_MASK", 7)
    vertices, _ = triangle([-1.0, -1, 0], [1.0, -1, 0], [0.0, 1, 0])
    faces = torch.tensor([[0, 0, 0]] * 6 + [[0, 1, 2]])
    fragments = rasterize(vertices, faces, cameras([[0.0, 0, 4]]), 0.01)
    assert len(fragments) > 50 and set(fragments.face.tolist()) == {6}


def test_nothing_to_draw_gives_no_fragments():
    vertices, faces = sphere()
    views = cameras([[0.0, 0, 4]])
    none = Cameras(views.camera_from_world[:0], views.matrix_px[:0], SIZE)
    assert len(rasterize(vertices, faces, none, 0.01)) == 0
    empty = rasterize(vertices, faces[:0], views, 0.01)
    assert len(empty) == 0 and empty.shape == (1, SIZE[1], SIZE[0]) and derivatives(empty)[0].shape == (0, 3)
    assert len(rasterize(vertices[:0], faces[:0], views, 0.01)) == 0
    assert len(empty.where(empty.front)) == 0


def test_five_full_pictures_of_a_megapixel_stay_below_400_megabytes():
    """In a process of its own: 5.2 million fragments of 41 bytes, and chunks."""
    if not sys.platform.startswith("linux"):
        pytest.skip("peak memory is read from Linux's /proc")
    pose, matrix = torch.eye(4, dtype=torch.float64), torch.tensor([[512.0, 0, 512], [0, 512, 512], [0, 0, 1]])
    views = Cameras(pose.expand(5, 4, 4), matrix.double().expand(5, 3, 3), (1024, 1024))
    corners = torch.tensor([[-1.0, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], dtype=torch.float64)

    def peak_kb() -> int:
        lines = Path("/proc/self/status").read_text().splitlines()
        return int(next(line for line in lines if line.startswith("VmHWM")).split()[1])

    def drawn() -> tuple[int, int]:
        before = peak_kb()  # a fork's peak begins at what it has
        count = len(rasterize(corners, torch.tensor([[0, 1, 2], [0, 2, 3]]), views, 0.1))
        return count, (peak_kb() - before) // 1024

    ctypes.CDLL(None).malloc_trim(0)  # memory that other tests freed would not count
    count, peak_mb = run_in_child(drawn)
    assert count == 5 * 1024**2
    assert 200 < peak_mb < 400  # 311 measured, the fragments alone are 205
