"""Scenes: what is read, what is refused, and photographs that agree with the geometry they claim."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from conftest import SCENE

from patchproof.base import geometry
from patchproof.base.errors import Refused
from patchproof.channel.printer import identity_printer
from patchproof.render.photograph import expose, photograph
from patchproof.render.pixels import PiecePicture
from patchproof.render.stage import PrintedPiece, set_stage
from patchproof.render.views import render_views
from patchproof.scene.conditions import with_values
from patchproof.scene.interface import Scene
from patchproof.scene.scene import load_scene, make_scene
from patchproof.sheets.markers import MARKER_MODULES
from patchproof.sheets.piece import marker_image, with_ids

QUIET = """
exposure_ev = [0, 0]
white_balance = 0
blur_px = [0, 0]
noise = [0, 0]
"""


def scene_of(tmp_path, text):
    path = tmp_path / "scene.toml"
    path.write_text(text, encoding="utf-8")
    return load_scene(path)


def piece_of(scene, design_px=(180, 180)):
    """Its markers, and middle gray between them."""
    image, reserved = marker_image(scene.piece, design_px)
    return PiecePicture.of(torch.tensor(np.where(reserved[..., None], image, np.float32(0.5))))


def test_a_scene_knows_its_piece_card_and_id(scene_file):
    scene = load_scene(scene_file)
    assert scene.placement.size_mm == scene.piece.size_mm
    assert scene.piece.size_mm == scene.settings.patch.size_mm == (90, 90) and len(scene.piece.markers) == 4
    assert load_scene(scene_file).sheet_id == scene.sheet_id != load_scene(scene_file, seed=1).sheet_id


def test_markers_follow_from_the_views(tmp_path):
    """Twice the distance needs markers twice as large, until they would leave the design too little."""
    near = scene_of(tmp_path, SCENE.replace("[500, 900]", "[400, 450]"))
    far = scene_of(tmp_path, SCENE.replace("[500, 900]", "[4000, 9000]"))
    assert near.piece.module_mm * MARKER_MODULES < far.piece.module_mm * MARKER_MODULES
    assert near.unreadable_share <= 0.05 < far.unreadable_share
    assert far.piece.marker_mm == pytest.approx(19.5)  # 0.29 × 90 = 26.1 mm for a corner; (26.1 - 1) × 7/9 = 19.52
    assert any("can be measured: others show markers of 19.5 mm too small" in warning for warning in far.warnings)


def test_views_that_cut_the_piece_off_are_said_to_be_unreadable(tmp_path):
    text = SCENE.replace("[500, 900]", "[400, 450]")
    whole, close = (scene_of(tmp_path, text.replace("[view]", f"[view]\nfov_deg = {fov}")) for fov in (40, 5))
    assert whole.unreadable_share <= 0.05 and not any("beyond the edge" in each for each in whole.warnings)
    assert close.unreadable_share > 0.9  # 5 degrees at 450 mm show 39 mm of the piece's 90
    (warning,) = [each for each in close.warnings if "beyond the edge of the picture in" in each]
    assert "100% of photographs: raise view.fov_deg" in warning


def test_the_outer_markers_of_bent_paper_turn_away_before_its_middle_does():
    """Paper over 100° of a can: from 60° to a side its far markers face 110° away, its middle is seen."""
    can = trimesh.creation.cylinder(40, 120, sections=48)

    def around_can(azimuth_deg: list[float]) -> Scene:
        settings = {
            "object": {"mesh": can, "length_mm": 120},
            "patch": {"width_mm": 70, "height_mm": 70, "bend": True},
            "target": {"label": "mug", "models": ["builtin"]},
            "view": {"distance_mm": [300, 310], "azimuth_deg": azimuth_deg, "elevation_deg": [0, 5]},
            "background": {"color": [0, 0, 0]},
            "camera": {"photo_px": [4000, 3000]},
        }
        return make_scene(settings)

    front, side = around_can([-10, 10]), around_can([50, 60])
    assert front.unreadable_share == 0 and side.unreadable_share == 1
    few = "few photographs of rolled paper under 100 mm can be measured: the others only count"
    assert front.warnings[-1] == side.warnings[-2] == few and side.warnings[-1].startswith("at most 0% of photographs")


def test_another_template_is_the_scene_made_for_it_and_nothing_is_loaded_again(tmp_path, monkeypatch):
    scene = scene_of(tmp_path, SCENE)
    made = scene_of(tmp_path, SCENE + '\n[sheet]\ntemplate = "letter"\n')
    monkeypatch.setattr("patchproof.scene.mesh_scene.load_mesh", None)
    changed = scene.with_template("letter")
    assert scene.with_template("a4") is scene and changed.mesh is scene.mesh
    assert changed.settings == made.settings and changed.sheet_id == made.sheet_id != scene.sheet_id
    assert changed.piece == made.piece and changed.warnings == made.warnings
    assert np.array_equal(changed.placement.vertices_mm, made.placement.vertices_mm)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("width_mm = 90", "widht_mm = 90", r'got "patch.widht_mm": did you mean "width_mm"'),
        ("length_mm = 300", "length_mm = nan", r"length_mm.*nan.*finite"),
        ("[-40, 40]", "[40, -40]", r"low <= high"),
        ("width_mm = 90", "width_mm = 900", r"Expected a piece no larger"),
        (
            "height_mm = 90",
            "height_mm = 38.9",
            r"piece of at least 39 mm, which has room for 8 mm markers, got 90 × 38\.9 mm",
        ),
        (
            "height_mm = 90",
            'height_mm = 120\n[sheet]\ntemplate = "label_102x152"',
            r"at most 97\.6 × 97\.6 mm on this page, got 90 × 120 mm",
        ),
        ('"primitive:carton"', '"no_such.glb"', r"no_such\.glb"),
        ('"primitive:carton"', '"primitive:cartoon"', r'did you mean "carton"'),
        ("[500, 900]", "[50, 90]", r"cameras outside the object"),
        ("[-40, 40]", "[180, 180]", r"views from which the patch can be seen"),
        ("[view]", "[veiw]", r'did you mean "view"'),
        ("color = [0.5, 0.5, 0.5]", 'images = "nowhere"', r"folder of pictures.*nowhere"),
        (
            "color = [0.5, 0.5, 0.5]",
            'images = "${NO_SUCH_VARIABLE}"',
            r"environment variable NO_SUCH_VARIABLE",
        ),
        ("steps = 3", "steps = 0", r"optimize\.steps"),
    ],
)
def test_what_cannot_be_is_refused_in_one_sentence(tmp_path, old, new, sentence):
    assert old in SCENE
    with pytest.raises(Refused, match=sentence) as caught:
        scene_of(tmp_path, SCENE.replace(old, new))
    assert "\n" not in str(caught.value) and str(caught.value).startswith("Expected ")


def test_a_photograph_shows_the_piece_where_the_homography_says(tmp_path):
    """In photo and square alike: pixels that it covers whole lie within its outline, their shares sum up to its
    area, and their weighted middle is that of the outline.
    """
    trimesh.creation.box((300, 300, 300)).export(tmp_path / "box.ply")  # the carton's ridge hides some of the edge
    scene = scene_of(tmp_path, SCENE.replace("primitive:carton", "box.ply"))
    stage, conditions = set_stage(scene), scene.draw("promise", 5)
    piece = PiecePicture.of(torch.ones(64, 64, 3))
    for size in ((800, 600), (300, 300)):
        seen = render_views(stage, piece, conditions, size)
        homographies = scene.piece_homographies(conditions, size)
        width, height = size
        for i in range(5):
            mine = seen.piece.view == i
            pixel, share = seen.piece.pixel[mine].numpy() - i * width * height, seen.piece.share[mine, 0].numpy()
            centers = np.stack([pixel % width + 0.5, pixel // width + 0.5], 1)
            back = geometry.apply_homography(np.linalg.inv(homographies[i]), centers)
            size_mm = np.array(scene.placement.size_mm)
            assert (back[share > 0.99] > 0).all() and (back[share > 0.99] < size_mm).all()
            covered = geometry.apply_homography(homographies[i], geometry.rect_corners([0, 0, *size_mm]))
            x, y = covered.T
            cross = x * np.roll(y, -1) - np.roll(x, -1) * y
            assert share.sum() == pytest.approx(abs(cross.sum()) / 2, rel=0.005)
            middle = ((covered + np.roll(covered, -1, 0)) * cross[:, None]).sum(0) / (3 * cross.sum())
            np.testing.assert_allclose(share @ centers / share.sum(), middle, atol=0.1)


def test_the_square_is_the_middle_of_the_photograph(tmp_path):
    """The classifier's square rendered directly, and cut out of the full photograph at the same pixels."""
    text = SCENE.replace("[800, 600]", "[400, 300]" + QUIET).replace(
        "color = [0.5, 0.5, 0.5]", 'images = "backgrounds"'
    )
    (tmp_path / "backgrounds").mkdir()
    from PIL import Image

    for i in range(3):
        noise = np.random.default_rng(i).integers(0, 256, (12, 16, 3), np.uint8)
        Image.fromarray(noise).resize((320, 240), 3).save(tmp_path / "backgrounds" / f"{i}.png")
    scene = scene_of(tmp_path, text)
    stage, conditions, piece = set_stage(scene), scene.draw("promise", 4), piece_of(scene)
    photo = photograph(stage, piece, conditions, (400, 300), jpeg=False)[..., 50:350]
    square = photograph(stage, piece, conditions, (300, 300), jpeg=False)
    assert float((photo - square).abs().mean()) < 1e-3
    assert float((photo - square).abs().max()) < 0.1  # a background resampled at another phase


def test_a_patch_turned_away_is_not_seen(tmp_path):
    """But for the back of what stands out beside the carton's ridge."""
    scene = scene_of(tmp_path, SCENE.replace("_mm = 90", "_mm = 134"))
    stage, conditions = set_stage(scene), with_values(scene.draw("promise", 2), azimuth_deg=np.array([180.0, 165.0]))
    seen = render_views(stage, piece_of(scene), conditions, (96, 96))
    assert len(seen.piece.pixel) == 0 < len(seen.piece.back_pixel)


def test_views_seen_once_can_be_shaded_with_another_design(tmp_path, scene_file):
    scene = load_scene(scene_file)
    stage, conditions, piece = set_stage(scene), scene.draw("train", 3), piece_of(scene)
    dark = PiecePicture.of(piece.srgb * 0.3)
    seen = render_views(stage, piece, conditions, (96, 96))
    torch.testing.assert_close(expose(seen, dark), photograph(stage, dark, conditions, (96, 96)))
    assert not torch.equal(expose(seen, dark), expose(seen, piece))


def test_the_gradient_reaches_the_texels_that_were_seen_and_no_other(scene_file):
    """Up to the cut line, but for what belongs to the markers."""
    scene = load_scene(scene_file)
    stage, conditions = set_stage(scene), scene.draw("train", 2)
    design = torch.full((3, 120, 120), 0.5, requires_grad=True)
    shown = PrintedPiece(scene.piece, scene.sheet_id, identity_printer(), torch.device("cpu")).appearance(design)
    (gradient,) = torch.autograd.grad(photograph(stage, shown, conditions, (96, 96)).sum(), design)
    _, reserved = marker_image(scene.piece, (120, 120))
    touched = (gradient.abs().sum(0) > 0).numpy()
    assert touched[~reserved].mean() > 0.99 and not touched[reserved].any()
    assert touched[[0, -1], 60].all() and touched[60, [0, -1]].all() and reserved[0, 0]
    assert bool(torch.isfinite(gradient).all())


@pytest.mark.parametrize("kind", ["design", "noise"])
def test_a_printed_piece_shows_the_markers_of_its_kind_whatever_the_design_has_there(scene_file, kind):
    scene = load_scene(scene_file)
    printed = PrintedPiece(scene.piece, scene.sheet_id, identity_printer(), torch.device("cpu"))
    image, reserved = marker_image(with_ids(scene.piece, scene.sheet_id, kind), (120, 96))
    for design in (torch.rand(3, 96, 120, generator=torch.Generator().manual_seed(0)), torch.zeros(3, 96, 120)):
        shown = printed.appearance(design, kind).srgb.numpy()
        assert np.abs(shown[reserved] - image[reserved]).max() < 1e-6
        assert np.abs(shown - design.permute(1, 2, 0).numpy())[~reserved].max() < 1e-6


def test_what_trains_and_what_is_photographed_agree_in_rate(tmp_path):
    """The network's square with adapted effects against full photographs reduced to it, on the same conditions: 0.005
    in the mean.
    """
    from patchproof.classifier.network import center_square

    scene = scene_of(tmp_path, SCENE)
    stage, conditions, piece = set_stage(scene), scene.draw("evaluate", 2), piece_of(scene)
    with torch.no_grad():
        small = photograph(stage, piece, conditions, (96, 96))
        large = center_square(photograph(stage, piece, conditions, (800, 600)), 96)
    assert float((small - large).abs().mean()) < 0.01
