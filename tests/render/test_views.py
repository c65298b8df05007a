"""Views: how much of each pixel the piece covers, what hides what, what can be lit anew, and where rendering ends."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
import trimesh
from conftest import SCENE
from PIL import Image
from tolerances import BY_TABLE, FLOAT32
from torch.nn.functional import avg_pool2d

from patchproof.base import geometry
from patchproof.base.errors import Refused
from patchproof.mesh.mesh import Material, MeshPart, mesh_from_parts
from patchproof.optimizer.problem import FIGURE_SAMPLING, set_problem
from patchproof.photo.detect import find_markers
from patchproof.render import photograph as photograph_module
from patchproof.render.fragments import Cameras
from patchproof.render.photograph import affected_windows, expose, photograph, shade
from patchproof.render.pixels import PHOTO_SAMPLING, ObjectTextures, PiecePicture, object_pixels
from patchproof.render.raster import rasterize
from patchproof.render.stage import set_stage
from patchproof.render.surfaces import object_surface
from patchproof.render.texture import look_up, texel_table
from patchproof.render.views import relight, relight_and_replace_background, render_views, split_views
from patchproof.scene.conditions import draw, with_values
from patchproof.scene.scene import load_scene
from patchproof.sheets.piece import marker_image

WHITE = PiecePicture.of(torch.ones(64, 64, 3))


def scene_of(folder, *changes):
    text = SCENE
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "scene.toml").write_text(text, encoding="utf-8")
    return load_scene(folder / "scene.toml")


def box_scene(folder, *changes, **more):
    """A cube of 300 mm with a patch of 164 mm on its flat side: nothing stands out beside the piece."""
    trimesh.creation.box((300, 300, 300)).export(folder / "box.ply")
    return scene_of(folder, ("primitive:carton", "box.ply"), ("_mm = 90", "_mm = 164"), *changes, **more)


def posed(scene, n=1, **values):
    """`n` draws with the middle of each range, at these values."""
    drawn = draw(scene.settings, "promise", n, scene.seed)
    still = {"roll_deg": 0, "elevation_deg": 0, "azimuth_deg": 0, "distance_mm": 700, "look_at_offset": 0}
    ink = {"dot_gain": 0, "density": 0, "chroma": 0, "veil": 0, "tone": 0}
    return with_values(drawn, **(still | ink | values))


def piece_of(scene, side=180):
    """Its markers, and middle gray between them."""
    image, reserved = marker_image(scene.piece, (side, side))
    return PiecePicture.of(torch.tensor(np.where(reserved[..., None], image, np.float32(0.5))))


def outline(scene, conditions, size_px):
    """Corners N×4×2 of the piece in pixels."""
    corners = geometry.rect_corners([0, 0, *scene.placement.size_mm])
    return np.stack([geometry.apply_homography(h, corners) for h in scene.piece_homographies(conditions, size_px)])


def area(corners):
    x, y = corners[..., 0], corners[..., 1]
    return np.abs((x * np.roll(y, -1, -1) - np.roll(x, -1, -1) * y).sum(-1)) / 2


def shares(seen, n, side):
    """The piece's share of each pixel, N×H×W."""
    picture = torch.zeros(n * side * side).index_copy(0, seen.piece.pixel, seen.piece.share[:, 0])
    return picture.view(n, side, side).double().numpy()


POSES = {"azimuth_deg": [0, 40, -55, 20], "elevation_deg": [0, 10, 0, 40], "roll_deg": [0, 25, -8, 45]}


@pytest.mark.parametrize("pixels", [10, 24, 90, 200])
def test_the_shares_sum_up_to_the_projected_area(tmp_path, pixels):
    """Pieces 10 to 200 px wide, turned by up to 55°; under 7 px, where the margin ends, within 2 %."""
    scene = box_scene(tmp_path)
    stage, conditions = set_stage(scene), posed(scene, 4, **POSES)
    focal = scene.matrix_px((1, 1))[0, 0]
    side = round(pixels * (700 - 150) / focal / scene.piece.size_mm[0])
    seen = render_views(stage, WHITE, conditions, (side, side))
    corners = outline(scene, conditions, (side, side))
    shortest = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=2).min(1)
    error = shares(seen, 4, side).sum((1, 2)) / area(corners) - 1
    assert (abs(error) < np.where(shortest >= 7, 0.005, 0.02)).all() and pixels * 0.35 < shortest.min()


def test_pixels_inside_are_whole_and_those_outside_are_none(tmp_path):
    scene = box_scene(tmp_path)
    conditions = posed(scene, 4, **POSES)
    share = shares(render_views(set_stage(scene), WHITE, conditions, (160, 160)), 4, 160)
    y, x = np.mgrid[:160, :160] + 0.5
    for corners, one in zip(outline(scene, conditions, (160, 160)), share, strict=True):
        polygon = corners.astype(np.float32)
        distance = np.array([cv2.pointPolygonTest(polygon, at, True) for at in zip(x.flat, y.flat, strict=True)])
        assert (one.flat[distance > 0.75] > 1 - FLOAT32).all() and (one.flat[distance < -1] == 0).all()
        assert (one.flat[abs(distance) < 0.2] < 1).all() and 0 <= one.min() and one.max() < 1 + FLOAT32


def camera_file(folder, **changes):
    """A pinhole of the scene's own field of view, or what `changes` say."""
    data = {"name": "c", "method": "assumed", "when": "never", "instrument": "none", "uncertainty": "none"}
    data |= {"image_px": [800, 600], "fx": 640.0, "fy": 640.0, "cx": 400.0, "cy": 300.0} | changes
    (folder / "camera.json").write_text(json.dumps(data), encoding="utf-8")
    return ("photo_px = [800, 600]", 'photo_px = [800, 600]\nfile = "camera.json"')


def test_another_principal_point_moves_the_picture(tmp_path):
    """By whole pixels every value moves; by a quarter of one the shares' weighted middle does."""
    seen, pictures = [], []
    for cx, cy in ((400, 300), (403, 298), (400.25, 299.5)):
        scene = box_scene(tmp_path, camera_file(tmp_path, cx=cx, cy=cy))
        conditions, stage = posed(scene, azimuth_deg=20, roll_deg=5), set_stage(scene)
        seen.append(render_views(stage, WHITE, conditions, (800, 600)))
        pictures.append(shade(seen[-1], WHITE))
    torch.testing.assert_close(pictures[1][:, :, :-2, 3:], pictures[0][:, :, 2:, :-3], atol=1e-3, rtol=0)
    middles = []
    for one in seen:
        pixel, share = one.piece.pixel.numpy(), one.piece.share[:, 0].double().numpy()
        middles.append(share @ np.stack([pixel % 800, pixel // 800], 1) / share.sum())
    np.testing.assert_allclose(middles[2] - middles[0], [0.25, -0.5], atol=0.01)


def test_what_the_object_hides_does_not_shine_through(tmp_path):
    """A cube from behind shows nothing of the piece; a ball from the side the back of what overhangs, and no print."""
    scene = box_scene(tmp_path)
    stage, conditions = set_stage(scene), posed(scene, 3, azimuth_deg=[180, 150, 120], elevation_deg=[0, 30, -30])
    seen = render_views(stage, WHITE, conditions, (128, 128))
    assert len(seen.piece.pixel) == len(seen.piece.back_pixel) == 0
    assert torch.equal(expose(seen, WHITE), photograph(stage, None, conditions, (128, 128)))
    trimesh.creation.icosphere(4, 150).export(tmp_path / "box.ply")
    ball = scene_of(tmp_path, ("primitive:carton", "box.ply"))
    conditions = posed(ball, 2, azimuth_deg=[110, 180])
    seen = render_views(set_stage(ball), WHITE, conditions, (128, 128))
    assert len(seen.piece.pixel) == 0
    back = seen.piece.back_share[seen.piece.back_pixel < 128 * 128].sum()
    assert 0 < float(back) == float(seen.piece.back_share.sum())  # the ball hides all of it at 180°


def the_same(one, other) -> bool:
    """Two records field by field, to the bit."""
    if isinstance(one, torch.Tensor):
        return torch.equal(one, other)
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(the_same, one, other))
    if hasattr(one, "__dataclass_fields__"):
        return all(the_same(getattr(one, name), getattr(other, name)) for name in one.__dataclass_fields__)
    return bool(np.array_equal(one, other)) if isinstance(one, np.ndarray) else one == other


@pytest.mark.parametrize("taps", [1, 3])
def test_views_seen_together_come_apart_as_if_each_had_been_seen_alone(tmp_path, taps):
    """To the bit, so that what a process sees ahead changes no design; one view sees the back of the overhanging
    piece, another nothing of it.
    """
    trimesh.creation.icosphere(2, 150).export(tmp_path / "ball.ply")
    scene = scene_of(tmp_path, ("primitive:carton", "ball.ply"), ("_mm = 90", "_mm = 150"))
    conditions = posed(scene, 5, azimuth_deg=[-60, -20, 110, 180, 30], distance_mm=900)
    stage, look = set_stage(scene), replace(PHOTO_SAMPLING, taps=taps)
    together = render_views(stage, WHITE, conditions, (64, 64), look)
    assert len(together.on_piece.back_pixel)
    for sizes in ([1] * 5, [2, 2, 1], [1, 4]):
        for part, last in zip(split_views(together, sizes), np.cumsum(sizes), strict=True):
            alone = render_views(stage, WHITE, conditions[last - len(part.conditions) : last], (64, 64), look)
            for name in ("background", "light", "object", "piece", "outlines"):
                assert the_same(getattr(part, name), getattr(alone, name)), name


def test_views_lit_anew_are_views_seen_anew(tmp_path):
    """To the bit, for the piece, the bare object and the object's textures."""
    scene = scene_of(tmp_path)
    stage, piece, poses, other = set_stage(scene), piece_of(scene), scene.draw("train", 3), scene.draw("select", 3)
    textures = ObjectTextures(stage.object.textures_srgb)
    there = replace(other, pose=poses.pose)
    elsewhere = replace(there, pose=replace(there.pose, background=other.pose.background))
    for shown in (piece, None, textures):
        laid_out = textures if shown is textures else piece
        seen = render_views(stage, laid_out, poses, (96, 96))
        before = expose(seen, shown)
        for again, anew in ((relight(seen, other), there), (relight_and_replace_background(seen, other), elsewhere)):
            pictures = expose(again, shown)
            assert torch.equal(pictures, expose(render_views(stage, laid_out, anew, (96, 96)), shown))
            assert not torch.equal(pictures, before)
        assert torch.equal(expose(seen, shown), before)


def test_the_back_of_a_piece_lies_in_its_window_too(tmp_path):
    """A bare object has none: pictures with and without a piece are alike everywhere else."""
    trimesh.creation.icosphere(2, 150).export(tmp_path / "ball.ply")
    scene = scene_of(tmp_path, ("primitive:carton", "ball.ply"), ("_mm = 90", "_mm = 150"))
    seen = render_views(
        set_stage(scene), WHITE, posed(scene, 3, azimuth_deg=[110, 100, -60], distance_mm=900), (96, 96)
    )
    assert len(seen.on_piece.back_pixel)
    differ = (expose(seen, WHITE) != expose(seen, None)).any(1)
    assert differ.flatten(1).any(1).all()
    for view, (left, top, right, bottom) in zip(differ, affected_windows(seen).tolist(), strict=True):
        view[top:bottom, left:right] = False
    assert not differ.any()


def test_where_it_is_not_known_what_a_design_changes_there_are_no_windows(tmp_path):
    lens = ("photo_px = [800, 600]", 'photo_px = [1600, 1200]\nfile = "phone"')
    for scene, known in ((scene_of(tmp_path), True), (scene_of(tmp_path, lens), False)):
        stage, drawn = set_stage(scene), posed(scene, 2, azimuth_deg=[0, 180])
        assert affected_windows(render_views(stage, None, drawn, (96, 96))) is None, "textures change the object"
        windows = affected_windows(render_views(stage, piece_of(scene), drawn, (96, 96)))
        assert (windows is not None) == known
        if known:
            assert windows[1].tolist() == [0, 0, 1, 1], "from behind nothing is seen of it"


def both_ways(monkeypatch, stage, shown, conditions, side):
    quick = photograph(stage, shown, conditions, (side, side))
    with monkeypatch.context() as patch:
        patch.setattr(photograph_module, "is_pointwise", lambda *arguments: False)
        return quick, photograph(stage, shown, conditions, (side, side))


def test_the_short_cut_is_the_long_way(tmp_path, monkeypatch):
    """Front, back and bare object; but for pixels that the piece's edge or an outline cuts, whose parts the short cut
    clips and mixes as they are in the end.
    """
    scene = scene_of(tmp_path)
    stage, piece = set_stage(scene), piece_of(scene)
    conditions = with_values(scene.draw("promise", 3), azimuth_deg=np.array([10.0, 160.0, -30.0]))
    seen = render_views(stage, piece, conditions, (192, 192))
    part, cut = seen.piece, torch.zeros(3 * 192 * 192, dtype=torch.bool)
    for pixel, share in ((part.pixel, part.share), (part.back_pixel, part.back_share)):
        cut[pixel] = share[:, 0] < 1 - FLOAT32
    for outlined in (seen, render_views(stage, None, conditions, (192, 192))):
        cut[outlined.outlines.pixel] = True
    whole = ~cut.view(3, 1, 192, 192).expand(3, 3, 192, 192)
    for shown in (None, piece):
        quick, slow = both_ways(monkeypatch, stage, shown, conditions, 192)
        torch.testing.assert_close(quick[whole], slow[whole], atol=1e-5, rtol=0)
        torch.testing.assert_close(quick, slow, atol=0.15, rtol=0)
    assert 0 < float(cut.float().mean()) < 0.04


def test_edges_in_small_pictures_are_those_of_reduced_photographs(tmp_path):
    """A black piece on a pale object: what reduces a photograph averages its code values, and so does an edge. Blending
    light there, as before the lens, is 0.09 off in the mean square.
    """
    scene = box_scene(tmp_path, ("[800, 600]", "[1600, 1200]"), ("[0.5, 0.5, 0.5]", "[0.9, 0.9, 0.9]"))
    stage, black = set_stage(scene), PiecePicture.of(torch.zeros(64, 64, 3))
    conditions = posed(scene, 2, azimuth_deg=[20, -40], roll_deg=[10, 45], blur_px=0, noise=0)
    share = shares(render_views(stage, black, conditions, (192, 192)), 2, 192)
    edge = torch.tensor((share > 0.02) & (share < 0.98))[:, None].expand(2, 3, 192, 192)
    small = photograph(stage, black, conditions, (192, 192))
    reduced = avg_pool2d(photograph(stage, black, conditions, (768, 768), jpeg=False), 4)
    assert float(((small - reduced)[edge] ** 2).mean().sqrt()) < 0.045


@pytest.mark.parametrize("mesh", ["primitive:carton", "primitive:mailbox"])
def test_an_object_shown_with_its_own_textures_is_the_bare_object(tmp_path, mesh):
    scene = scene_of(
        tmp_path, ("primitive:carton", mesh), ("width_mm = 90\nheight_mm = 90", "width_mm = 50\nheight_mm = 50")
    )
    stage, conditions = set_stage(scene), with_values(scene.draw("promise", 1), tone=0)
    for size in ((96, 96), (800, 600)):
        own = photograph(stage, ObjectTextures(stage.object.textures_srgb), conditions, size, jpeg=False)
        torch.testing.assert_close(own, photograph(stage, None, conditions, size, jpeg=False), atol=BY_TABLE, rtol=0)


def test_each_material_shows_its_own_texture():
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float), np.array([[0, 1, 2], [0, 2, 3]])
    colors = ((255, 0, 0), (0, 0, 255))
    parts = []
    for x, color in enumerate(colors):
        paint = Material(str(x), (1.0, 1.0, 1.0), np.full((4, 4, 3), color, np.uint8))
        parts.append(MeshPart(square[0] + [x, 0, 0], square[1], paint, square[0][:, :2], None, None))
    surface = object_surface(mesh_from_parts(parts, 100), torch.device("cpu"))
    pose = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))
    pose[:3, 3] = -pose[:3, :3] @ (surface.vertices.double().mean(0) + torch.tensor([0, 0, 200.0]))
    lens = torch.tensor([[80.0, 0, 32], [0, 80, 32], [0, 0, 1]], dtype=torch.float64)
    fragments = rasterize(surface.vertices, surface.faces, Cameras(pose[None], lens[None], (64, 64)), 1.0)
    seen = object_pixels(surface, fragments, PHOTO_SAMPLING, surface.texels(False, fixed=True))
    shown = torch.tensor(colors)[surface.material[fragments.face]] / 255
    assert shown.unique(dim=0).shape == (2, 3)
    torch.testing.assert_close(seen.color.T, shown, atol=BY_TABLE, rtol=0)


@pytest.mark.parametrize("line", ["motion_px = [20, 30]", 'file = "phone"', "blur_px = [3, 4]", "noise = [0.1, 0.2]"])
def test_each_term_of_the_camera_shows_and_lets_gradients_pass(tmp_path, line):
    plain, scene = scene_of(tmp_path), scene_of(tmp_path, ("[camera]", f"[camera]\n{line}"))
    piece = piece_of(plain, 64)
    srgb = piece.srgb.clone().requires_grad_()
    pictures = [
        photograph(set_stage(s), PiecePicture.of(srgb), s.draw("promise", 3), (192, 192)) for s in (plain, scene)
    ]
    shown = pictures[1].detach()
    assert bool(torch.isfinite(shown).all()) and -FLOAT32 < float(shown.min()) and float(shown.max()) < 1 + FLOAT32
    assert float((pictures[0].detach() - shown).abs().mean()) > 1e-3
    (gradient,) = torch.autograd.grad(pictures[1].mean(), srgb)
    assert bool(torch.isfinite(gradient).all()) and float(gradient.abs().max()) > 0


@pytest.mark.parametrize("k1", [None, -0.12, 0.1])
def test_a_lens_puts_the_markers_where_opencv_says(tmp_path, k1):
    """The shipped phone and two strong lenses; the piece towards a corner, where they bend."""
    if k1 is None:
        change = ("photo_px = [800, 600]", 'photo_px = [800, 600]\nfile = "phone"')
    else:
        change = camera_file(tmp_path, k1=k1, k2=0.02, p1=0.002)
    scene = box_scene(tmp_path, change)
    conditions = posed(scene, look_at_offset=[[0.35, 0.3, 0]], blur_px=0, noise=0, distance_mm=650)
    picture = photograph(set_stage(scene), piece_of(scene, 328), conditions, (800, 600), jpeg=False)
    pixels = np.ascontiguousarray((picture[0].permute(1, 2, 0) * 255).round().byte().numpy())
    found = find_markers(pixels, {marker.id for marker in scene.piece.markers}).corners_px
    camera, matrix = scene.camera, scene.matrix_px((800, 600))
    distortion = np.array([camera.k1, camera.k2, camera.p1, camera.p2, camera.k3])
    homography, moved = scene.piece_homographies(conditions, (800, 600))[0], 0.0
    assert len(found) == len(scene.piece.markers)
    for marker in scene.piece.markers:
        straight = geometry.apply_homography(homography, np.array(marker.corners_mm))
        unit = np.linalg.solve(matrix, np.concatenate([straight, np.ones((4, 1))], 1).T).T
        expected = cv2.projectPoints(unit, np.zeros(3), np.zeros(3), matrix, distortion)[0][:, 0]
        np.testing.assert_allclose(camera.distort_points(straight, (800, 600)), expected, atol=1e-3)
        np.testing.assert_allclose(found[marker.id], expected, atol=0.35)
        moved = max(moved, np.abs(expected - straight).max())
    assert moved > (0.5 if k1 is None else 4)


def test_a_face_seen_from_behind_is_lit_on_the_side_that_is_seen(tmp_path):
    """A sheet of paper beside a cube, whose outside looks away from the camera."""
    corners = [[200.0, -150, 0], [600, -150, 0], [600, 150, 0], [200, 150, 0]]
    sheet = trimesh.Trimesh(corners, [[0, 2, 1], [0, 3, 2]])
    trimesh.util.concatenate([trimesh.creation.box((300, 300, 300)), sheet]).export(tmp_path / "both.ply")
    scene = scene_of(tmp_path, ("primitive:carton", "both.ply"), ("_mm = 90", "_mm = 60"))
    views = render_views(set_stage(scene), None, posed(scene), (96, 96))
    column, (*_, toward) = views.object.pixel % 96, views.object.normal
    assert len(toward[column > 48]) > 300 and bool((toward[column > 48] > 0.9).all()), "the sheet"
    assert bool((toward > -0.1).all())


def test_a_camera_inside_the_object_is_refused_in_one_sentence(tmp_path):
    scene = box_scene(tmp_path)
    with pytest.raises(
        Refused, match=r"got 1 of 2 views inside its bounding box or within 1\.5 mm of it: raise view\.distance_mm\.$"
    ):
        render_views(set_stage(scene), WHITE, posed(scene, 2, distance_mm=[700, 100]), (64, 64))


def test_a_piece_seen_edge_on_is_not_there(tmp_path):
    """At 90° exactly its plane is a line; on either side of it a sliver, and never a NaN."""
    scene = box_scene(tmp_path)
    plane_mm = float(scene.placement.center_mm @ scene.placement.normal)
    at = np.degrees(np.arccos(plane_mm / 700)) + np.array([0, 1e-7, -1e-7, -0.01, 0.01])
    conditions = posed(scene, 5, azimuth_deg=at)
    srgb = WHITE.srgb.clone().requires_grad_()
    seen = render_views(set_stage(scene), WHITE, conditions, (128, 128))
    picture = expose(seen, PiecePicture.of(srgb))
    assert bool(torch.isfinite(picture).all()) and bool(torch.isfinite(seen.piece.share).all())
    assert shares(seen, 5, 128)[:3].sum() < 0.5
    (gradient,) = torch.autograd.grad(picture.sum(), srgb)
    assert bool(torch.isfinite(gradient).all())


def gradient_of(scene, size_px=128, **pose):
    """The gradient of a picture's sum to a 64×64 noise design, and the pixels that the piece covers."""
    noise = torch.rand(64, 64, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
    seen = render_views(set_stage(scene), WHITE, posed(scene, 1, **pose), (size_px, size_px))
    (gradient,) = torch.autograd.grad(expose(seen, PiecePicture.of(noise)).sum(), noise)
    assert bool(torch.isfinite(gradient).all())
    return gradient, float(seen.piece.share.sum())


@pytest.mark.parametrize(
    "pose", [{}, {"azimuth_deg": 60}, {"azimuth_deg": 75}, {"distance_mm": 200}, {"distance_mm": 152}]
)
def test_gradients_are_as_large_as_the_piece_is_seen_at_grazing_angles_and_near_the_camera(tmp_path, pose):
    """A gradient sums up to the pixels that show it and no more, from the front and where 164 mm are 1.5 px wide (75°;
    the plane is edge-on at 77.6°), and where one texel fills 5,000 pixels (2 mm away). The object's outline beside a
    sliver adds some.
    """
    gradient, share = gradient_of(box_scene(tmp_path), **pose)
    assert share > 50
    assert 0.9 < float(gradient.abs().sum()) / (3 * share) < 1.09


def test_a_piece_under_half_a_pixel_wide_has_no_gradient_and_too_near_a_camera_is_refused(tmp_path):
    scene = box_scene(tmp_path)
    gradient, share = gradient_of(scene, azimuth_deg=77)  # 0.4 px wide, between the pixels' centers
    assert share == 0 and not bool(gradient.any())
    assert gradient_of(scene, distance_mm=151.6)[1] == pytest.approx(128**2, rel=0.01)
    with pytest.raises(Refused, match=r"1 of 1 views inside .* or within 1\.5 mm of it"):
        gradient_of(scene, distance_mm=151.4)


@pytest.mark.parametrize("share", [1e-4, 1e-6])
def test_pictures_change_as_little_as_the_pose_does(tmp_path, share):
    """From 0.5 to 4 m, three octaves of mip levels: no level pops. Mean |Δ| per relative step of the distance is 0.07
    to 0.11.
    """
    stage, far = set_stage(box_scene(tmp_path)), np.geomspace(500, 4000, 48)
    srgb = torch.rand(256, 256, 3, generator=torch.Generator().manual_seed(0))
    noise = PiecePicture.of(srgb)
    a, b = (
        shade(render_views(stage, noise, posed(stage.scene, 48, distance_mm=far * k, azimuth_deg=30), (96, 96)), noise)
        for k in (1, 1 + share)
    )
    assert float((a - b).abs().mean()) < 0.3 * share


def test_an_object_of_one_pixel_still_renders(tmp_path):
    scene = box_scene(tmp_path)
    conditions = posed(scene, 2, distance_mm=[3.2e4, 3.2e6], azimuth_deg=10)
    picture = photograph(set_stage(scene), WHITE, conditions, (96, 96))
    plain = photograph(set_stage(scene), None, conditions, (96, 96))
    assert bool(torch.isfinite(picture).all())
    changed = (picture - plain).abs().amax(1)
    assert int((changed[0] > 1e-3).sum()) <= 4 and float(changed[1].max()) < 0.05


def first_hit(eyes, direction, triangles):
    """For each ray N×3 the least t > 0 at which eye + t · direction lies on a triangle (Möller and Trumbore, 1997)."""
    a, u, v = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    nearest = np.full(len(eyes), np.inf)
    for i, (eye, toward) in enumerate(zip(eyes, direction, strict=True)):
        p, s = np.cross(toward, v), eye - a
        q, volume = np.cross(s, u), (u * p).sum(1)
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y, t = (s * p).sum(1) / volume, q @ toward / volume, (q * v).sum(1) / volume
        nearest[i] = t[(x >= 0) & (y >= 0) & (x + y <= 1) & (t > 0)].min(initial=np.inf)
    return nearest


@pytest.mark.parametrize(("side", "family"), [(50, "cylinder"), (56, "cylinder")])
def test_a_bent_piece_is_hidden_where_the_mug_is_in_front(tmp_path, side, family):
    """Rays from the camera to what each pixel shows of the piece: what the mesh stops has next to no share."""
    scene = scene_of(
        tmp_path,
        ("primitive:carton", "primitive:mug"),
        ("length_mm = 300", "length_mm = 100"),
        ("width_mm = 90\nheight_mm = 90", f"width_mm = {side}\nheight_mm = {side}\nbend = true"),
        ("[500, 900]", "[250, 300]"),
        ('"+z"', '"-z"'),
    )
    assert scene.placement.family == family
    conditions = posed(scene, 5, azimuth_deg=[0, 60, 90, 120, 180], elevation_deg=[40, 10, 5, 0, 20], distance_mm=260)
    v, u = torch.meshgrid(*((torch.arange(256) + 0.5) / 256,) * 2, indexing="ij")
    where = PiecePicture.of(torch.stack([u, v, u], -1))
    seen = render_views(set_stage(scene), where, conditions, (128, 128))
    at = look_up(seen.piece.texels, texel_table([where.srgb]))[:, :2].numpy() * scene.placement.size_mm
    poses = scene.camera_from_world(conditions)[seen.piece.view.numpy()]
    eyes = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    points = scene.placement.world(at)
    reach = first_hit(eyes, points - eyes, scene.mesh.vertices[scene.mesh.faces])
    hidden = (1 - reach) * np.linalg.norm(points - eyes, axis=1) > 1.5
    share = seen.piece.share[:, 0].numpy()
    assert share[hidden].sum() < 0.005 * share.sum()
    # each view but the one from behind shows it
    per_view = np.bincount(seen.piece.view.numpy(), share, minlength=5)
    assert per_view[0] > 100 and per_view[4] < 1


def test_more_taps_of_an_object_s_texture_bring_views_nearer_to_reduced_photographs(tmp_path):
    """A picture of 1024 texels round a cube. One tap, which spans up to two texels, is the bluntest; what looks over
    less than a pixel is sharper.
    """
    cube = trimesh.creation.box((300, 300, 300))
    cube.unmerge_vertices()
    across = cube.vertices[:, 0] + cube.vertices[:, 1]
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3)).astype(np.uint8)
    picture = Image.fromarray(noise).resize((1024, 1024), Image.Resampling.BICUBIC)
    uv = np.stack([across / 600 + 0.5, cube.vertices[:, 2] / 300 + 0.5], 1)
    cube.visual = trimesh.visual.TextureVisuals(uv, image=picture)
    cube.export(tmp_path / "cube.glb")
    scene = scene_of(tmp_path, ("primitive:carton", "cube.glb"), ("[800, 600]", "[1600, 1200]"))
    stage, conditions = set_stage(scene), posed(scene, 2, azimuth_deg=[20, -40], blur_px=0, noise=0)
    reduced = avg_pool2d(photograph(stage, None, conditions, (768, 768), jpeg=False), 4)
    off = {}
    for taps in (1, 2, 4):
        view = expose(
            render_views(stage, None, conditions, (192, 192), replace(PHOTO_SAMPLING, taps=taps)), None, jpeg=False
        )
        off[taps] = float(((view - reduced) ** 2).mean().sqrt())
    assert off[4] < off[2] < 0.8 * off[1], off
    problem = set_problem(scene)
    textures = ObjectTextures(stage.object.textures_srgb)
    small, figure = (problem.see(textures, conditions, side).object.texels for side in (96, problem.figure_px))
    assert small.first.diff().max() == 4 < figure.first.diff().max(), (
        "views smaller than figures are looked at once a pixel"
    )


def test_fixed_textures_are_held_once(tmp_path):
    """In their atlas: the table that textures need which may change would take as much memory again."""
    scene = scene_of(tmp_path)
    stage = set_stage(scene)
    for shown in (piece_of(scene), None, ObjectTextures(stage.object.textures_srgb)):
        for size in ((96, 96), (400, 300)):
            photograph(stage, shown, scene.draw("promise", 1), size)
    assert {fixed for _, fixed in stage.object._tables} == {True}


def test_figures_look_at_a_piece_in_fewer_taps_than_photographs_and_see_nearly_the_same(tmp_path):
    problem = set_problem(scene_of(tmp_path))
    generator = torch.Generator().manual_seed(2)
    shown = PiecePicture.of(torch.rand(400, 400, 3, generator=generator))  # finer than any print: the worst case
    conditions, side = problem.scene.draw("promise", 2), (problem.figure_px,) * 2
    looks = FIGURE_SAMPLING, replace(FIGURE_SAMPLING, piece_taps=PHOTO_SAMPLING.piece_taps)
    few, many = (render_views(problem.stage, shown, conditions, side, look) for look in looks)
    of_few, of_many = (len(views.on_piece.texels.weight) for views in (few, many))
    assert of_few < 0.6 * of_many
    own = problem.see(shown, conditions, problem.figure_px).on_piece.texels
    assert len(own.weight) == of_few
    assert float((expose(few, shown) - expose(many, shown)).square().mean().sqrt()) < 0.01
