"""Smooth outlines: beside finer pictures and areas known in closed form, what they leave alone, and where they end."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from torch.nn.functional import avg_pool2d

from patchproof.base import geometry
from patchproof.base.color import srgb_from_linear
from patchproof.mesh.mesh import Material, MeshPart, mesh_from_parts
from patchproof.render import outlines as module
from patchproof.render.fragments import Cameras
from patchproof.render.outlines import find_edges, find_outlines
from patchproof.render.photograph import shade
from patchproof.render.raster import rasterize
from patchproof.render.stage import set_stage
from patchproof.render.views import render_views
from test_views import WHITE, box_scene, posed, scene_of

SIDE = 96
EYES = [[0.0, 0, 700], [300, 250, 600], [-500, -100, 500]]
BOARD = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])


def box():
    return trimesh.creation.box((300, 200, 250))


def torus():
    return trimesh.creation.torus(100, 30, 48, 24)


def ball(finer):
    return trimesh.creation.icosphere(finer, 150)


def part(shape, gray=0.8, texture=None):
    return MeshPart(shape.vertices, shape.faces, Material("m", (gray,) * 3, texture))


def board(width_mm, height_mm, x_mm=0.0, gray=0.8, texture=None):
    """Two faces, seen from z."""
    corners = BOARD * [width_mm, height_mm, 1] + [x_mm, 0, 0]
    return part(trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]]), gray, texture)


def drawn(parts, side=SIDE, eyes=EYES, roll_deg=0.0):
    """Of views, N×side×side: the jagged picture, lit from the first eye on black, and the smooth one; the outlines."""
    parts = parts if isinstance(parts, list) else [part(parts)]
    size = np.ptp(np.concatenate([p.vertices for p in parts]), axis=0).max()
    mesh = mesh_from_parts(parts, float(size))
    poses = np.stack([geometry.look_at(eye, np.zeros(3), roll_deg) for eye in eyes])
    matrix = np.stack([geometry.intrinsics(40.0, (side, side))] * len(poses))
    views = Cameras(torch.tensor(poses), torch.tensor(matrix), (side, side))
    vertices, faces = torch.tensor(mesh.vertices), torch.tensor(mesh.faces)
    seen = rasterize(vertices, faces, views, 1.0)
    nearest = torch.full((math.prod(seen.shape),), torch.inf)
    nearest[seen.pixel] = seen.depth
    light = torch.tensor(mesh.corner_normal[:, 0] @ np.array([0.2, 0.5, 0.8])).abs() * 0.5 + 0.3
    gray = torch.tensor([m.base_color_linear[0] for m in mesh.materials])[torch.tensor(mesh.face_material)]
    image = torch.zeros(len(nearest), 3)
    image[seen.pixel] = (light * gray).float()[seen.face][:, None]
    none = torch.zeros_like(nearest, dtype=torch.bool)
    found = find_outlines(find_edges(mesh), vertices, views, torch.tensor(eyes), nearest, none, 1.0)
    smooth = found.smooth(image, by_code=False)
    jagged, smooth = (p[:, 0].view(len(eyes), side, side) for p in (image, smooth))
    return jagged, smooth, found


def finer(parts, times=16, **more):
    return avg_pool2d(drawn(parts, SIDE * times, **more)[0], times)


def rms(difference):
    return float((difference**2).mean().sqrt())


@pytest.mark.parametrize(
    ("shape", "times", "most"), [(box(), 16, 0.1), (torus(), 8, 0.25), (ball(2), 8, 0.2), (ball(6), 8, 0.15)]
)
def test_pictures_are_nearer_to_the_mean_of_a_finer_one(shape, times, most):
    """The last has 80,000 faces on some 3,000 pixels; the torus steps at each of its faces, lit by them, many by less
    than what is taken for a crease.
    """
    jagged, smooth, _ = drawn(shape)
    reference = finer(shape, times)
    assert rms(smooth - reference) < most * rms(jagged - reference)


@pytest.mark.parametrize(("photo_px", "averaged"), [("[1600, 1200]", srgb_from_linear), ("[96, 96]", torch.clone)])
def test_light_is_averaged_in_photographs_and_code_values_in_what_stands_for_a_reduced_one(
    tmp_path, photo_px, averaged
):
    scene = box_scene(tmp_path, ("[800, 600]", photo_px))
    stage, conditions = set_stage(scene), posed(scene, 2, azimuth_deg=[25, -40], elevation_deg=[15, 30])
    bare = lambda side: render_views(stage, None, conditions, (side, side))  # noqa: E731
    reference = avg_pool2d(averaged(shade(bare(8 * SIDE), None)), 8)
    views = bare(SIDE)
    jagged = views.bare.view(2, SIDE, SIDE, 3).permute(0, 3, 1, 2)
    off = [rms(averaged(p) - reference) for p in (jagged, shade(views, None))]
    assert off[1] < 0.25 * off[0], off


@pytest.mark.parametrize("width_mm", np.linspace(250, 256, 7))
@pytest.mark.parametrize("roll_deg", [0, 3, 20, 45])
def test_a_board_covers_its_own_area(width_mm, roll_deg):
    """In whatever part of a pixel it ends, at any angle; but for its corners each pixel has its exact share."""
    parts = [board(width_mm, 200)]
    jagged, smooth, _ = drawn(parts, eyes=EYES[:1], roll_deg=roll_deg)
    area = width_mm * 200 * (geometry.intrinsics(40.0, (SIDE, SIDE))[0, 0] / 700) ** 2
    covered = float(smooth.sum() / jagged.max())
    assert covered == pytest.approx(area, rel=0.001)
    times = 8 if roll_deg else 16  # rows of samples lie along a level edge
    reference = finer(parts, times, eyes=EYES[:1], roll_deg=roll_deg)
    assert rms(smooth - reference) < 0.2 * rms(jagged - reference)


def test_edges_behind_a_surface_leave_it_alone():
    """A ball inside a box: the box's pictures are those without it."""
    alone, both = (drawn(parts)[1] for parts in ([part(box())], [part(box()), part(ball(3).apply_scale(0.6))]))
    assert torch.equal(alone, both)


NOISE = np.random.default_rng(0).integers(0, 256, (16, 16, 3)).astype(np.uint8)


@pytest.mark.parametrize(
    ("grays", "textures", "is_one"),
    [
        ((0.2, 0.8), (None, None), True),
        ((0.5, 0.5), (None, None), False),
        ((0.5, 0.5), (NOISE, None), True),
        ((0.5, 0.5), (NOISE, NOISE), False),
    ],
)
def test_a_step_of_color_on_a_plane_is_an_outline_but_between_textures(grays, textures, is_one):
    halves = [board(150, 200, x, *look) for x, look in zip((-75, 75), zip(grays, textures, strict=True), strict=True)]
    _, _, found = drawn(halves, eyes=EYES[:1], roll_deg=5)
    middle = (found.pixel % SIDE - SIDE / 2).abs() < 8
    between = ((found.pixel[middle] // SIDE - SIDE / 2).abs() < 15).sum()
    assert (between > 20) if is_one else (between == 0)


def test_no_outline_lies_between_pixels_that_the_piece_covers(tmp_path):
    """A card on a ball seen from the side: the ball's outline behind it is hidden."""
    trimesh.creation.icosphere(4, 150).export(tmp_path / "ball.ply")
    scene = scene_of(tmp_path, ("primitive:carton", "ball.ply"), ("_mm = 90", "_mm = 164"))
    seen = render_views(set_stage(scene), WHITE, posed(scene, 2, azimuth_deg=[0, 60]), (SIDE, SIDE))
    whole = torch.zeros(2 * SIDE * SIDE, dtype=torch.bool)
    whole[seen.piece.pixel] = seen.piece.share[:, 0] > 0.999
    mixed = whole[seen.outlines.pixel].index_select(0, seen.outlines.target) & whole[seen.outlines.source]
    assert len(seen.outlines.pixel) > 100 and not mixed.any()


def test_outlines_are_the_same_alone_and_in_any_company(monkeypatch):
    """To the bit, so that what a worker is dealt changes nothing."""
    _, _, together = drawn(torus())
    for view, eye in enumerate(EYES):
        _, _, alone = drawn(torus(), eyes=[eye])
        own, source = (which // SIDE**2 == view for which in (together.pixel, together.source))
        assert torch.equal(together.pixel[own] - view * SIDE**2, alone.pixel)
        assert torch.equal(together.remaining[own], alone.remaining) and torch.equal(
            together.share[source], alone.share
        )
    monkeypatch.setattr(module, "CHUNK", 1)
    for name, part_of in vars(drawn(torus())[2]).items():
        assert torch.equal(part_of, getattr(together, name))


@pytest.mark.parametrize("by_code", [False, True])
def test_gradients_pass_outlines_as_finite_differences_do(by_code):
    """Along 20 random directions, in float64: where outlines mix, where they take from, and where there are none."""
    shares, generator = drawn(torus(), eyes=EYES[:1])[2], torch.Generator().manual_seed(0)
    wide = replace(shares, remaining=shares.remaining.double(), share=shares.share.double())
    image, wanted = 0.1 + 0.9 * torch.rand(2, SIDE * SIDE, 3, generator=generator, dtype=torch.float64)
    image.requires_grad_()
    (gradient,) = torch.autograd.grad((wide.smooth(image, by_code) * wanted).sum(), image)
    for _ in range(20):
        step = 1e-5 * torch.randn(image.shape, generator=generator, dtype=torch.float64)
        ahead, behind = ((wide.smooth(image.detach() + s, by_code) * wanted).sum() for s in (step, -step))
        assert float(ahead - behind) / 2 == pytest.approx(float((gradient * step).sum()), rel=1e-4, abs=1e-7)


def test_a_rod_is_right_down_to_a_pixel_s_width_and_wrong_below():
    """What no pixel's center sees has no outline: there more samples would see what these do not."""
    px_mm = 700 / geometry.intrinsics(40.0, (SIDE, SIDE))[0, 0]
    off = {}
    for width_px in (4, 2, 1.1, 0.5):
        _, smooth, _ = drawn([board(width_px * px_mm, 300)], eyes=EYES[:1], roll_deg=3)
        off[width_px] = abs(float((smooth[0, 30:66] / 0.56).sum(1).mean()) / width_px - 1)
    assert max(off[4], off[2], off[1.1]) < 0.05 and off[0.5] > 0.1, off


def test_edges_that_reach_behind_the_camera_are_cut():
    """A beam from before the camera to beside it, and the camera inside of it."""
    beam = trimesh.creation.box((40, 40, 3000))
    outside, inside = [60.0, 50, 1300], [0.0, 0, 1300]
    jagged, smooth, found = drawn(beam, eyes=[outside, inside])
    reference = finer(beam, eyes=[outside])
    assert rms(smooth[:1] - reference) < 0.25 * rms(jagged[:1] - reference) and bool(torch.isfinite(smooth).all())
    assert (found.remaining >= 0).all() and (found.share >= 0).all()
