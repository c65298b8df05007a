"""Scenes of images: which ones count, where the piece lies, what is erased."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from patchproof.base.errors import Refused
from patchproof.base.geometry import apply_homography, rect_corners
from patchproof.base.settings import SceneSettings
from patchproof.scene.image_scene import ERASED_AREA, FEW_IMAGES, erase
from patchproof.scene.picture_scene import pick_indices
from patchproof.scene.scene import build_scene

PHOTO = (320, 240)


def folder_of(tmp_path, count=24, table=None):
    """Plain images whose red channel is their number, even ones "jeep, landrover", odd ones "cup"."""
    (tmp_path / "images").mkdir()
    lines = ["file,label"]
    for i in range(count):
        Image.new("RGB", (90 + i, 60), (i, 100, 200)).save(tmp_path / "images" / f"{i}.png")
        lines.append(f'{i}.png,"Jeep, landrover"' if i % 2 == 0 else f"{i}.png,cup")
    (tmp_path / "labels.csv").write_text("\n".join(lines) if table is None else table, encoding="utf-8")
    return tmp_path


def settings_of(label="jeep", **tables) -> SceneSettings:
    tables = {"patch": {"width_mm": 60, "height_mm": 40}, "camera": {"photo_px": PHOTO}} | tables
    return SceneSettings.model_validate(
        {
            "object": {"images": "images", "labels": "labels.csv"},
            "target": {"label": label, "models": ["builtin"]} | tables.pop("target", {}),
            "view": {"roll_deg": (-40, 40)} | tables.pop("view", {}),
        }
        | tables
    )


def numbers(pictures) -> set[int]:
    return {int(np.median(picture[..., 0])) for picture in pictures}


@pytest.mark.parametrize("label", ["jeep", "LANDROVER", "jeep, landrover"])
def test_only_images_of_the_class_are_used(tmp_path, label):
    scene = build_scene(settings_of(label, background={"erasing": 0}), folder_of(tmp_path), 0)
    shown = [numbers(scene.pictures(scene.draw(stream, 64), (24, 24))) for stream in ("train", "evaluate")]
    assert len(scene.images) == 12 and set.union(*shown) == set(range(0, 24, 2))


def test_indices_and_accepted_labels_count(tmp_path):
    folder = folder_of(tmp_path, 6, "0.png,609\n1.png, 42\n2.png,609\n3.png,cup\n")
    assert len(build_scene(settings_of(609), folder, 0).images) == 2
    assert len(build_scene(settings_of(609, target={"accept": ["cup"]}), folder, 0).images) == 3
    assert len(build_scene(settings_of("42", target={"goal": "deceive"}), folder, 0).images) == 1


def test_another_template_is_the_scene_made_for_it(tmp_path):
    folder = folder_of(tmp_path)
    scene = build_scene(settings_of("jeep"), folder, 0)
    made = build_scene(settings_of("jeep", sheet={"template": "letter"}), folder, 0)
    changed = scene.with_template("letter")
    assert scene.with_template("a4") is scene and changed.images is scene.images
    assert (changed.settings, changed.sheet_id, changed.piece) == (made.settings, made.sheet_id, made.piece)
    assert changed.warnings == made.warnings and changed.unreadable_share == made.unreadable_share


def test_what_is_promised_was_not_optimized_on(tmp_path):
    scene = build_scene(settings_of("cup", background={"erasing": 0}), folder_of(tmp_path, 2 * FEW_IMAGES), 0)
    seen = {s: numbers(scene.pictures(scene.draw(s, 128), (24, 24))) for s in ("train", "select", "promise", "reprint")}
    assert seen["train"] == seen["select"] and seen["promise"] == seen["reprint"]
    assert not seen["train"] & seen["promise"] and len(seen["train"] | seen["promise"]) == FEW_IMAGES
    assert all("too small" in warning for warning in scene.warnings)
    few = build_scene(settings_of("cup"), folder_of_few(tmp_path), 0)
    assert few.warnings[0] == "the promise is made on 2 images, and says little of others: give 20 or more"
    pictures = {stream: few.draw(stream, 64).pose.background[:, 0] for stream in ("train", "promise")}
    assert pictures["train"].max() < 1 / 3 <= pictures["promise"].min()
    alone = replace(few, images=few.images[:1]).draw("promise", 8).pose.background[:, 0]
    assert alone.min() < 0.5  # where it is alone, it serves all


def folder_of_few(tmp_path):
    (tmp_path / "few").mkdir()
    return folder_of(tmp_path / "few", 6)


@pytest.mark.parametrize("size_px", [PHOTO, (240, 240), (96, 96)])
def test_the_whole_piece_lies_in_the_square_at_the_drawn_size(tmp_path, size_px):
    scene = build_scene(settings_of(), folder_of(tmp_path), 0)
    conditions = scene.draw("promise", 200)
    piece = rect_corners((0, 0, *scene.piece.size_mm))
    side = min(size_px)
    low = (np.array(size_px) - side) / 2
    shares, places = [], []
    for where in scene.piece_homographies(conditions, size_px):
        corners = apply_homography(where, piece)
        assert (corners > low - 1e-9).all() and (corners < low + side + 1e-9).all()
        a, b, c, _ = corners
        assert np.linalg.norm(b - a) / np.linalg.norm(c - b) == pytest.approx(60 / 40)  # a similarity
        shares.append(np.linalg.norm(b - a) / side)
        places.append(corners.mean(0) / side)
    low_share, high_share = scene.settings.view.patch_share
    assert low_share <= min(shares) < 1.1 * low_share and 0.9 * high_share < max(shares) <= high_share
    assert np.ptp(places, axis=0) == pytest.approx([0.8, 0.8], abs=0.12)  # everywhere that there is room


def test_the_piece_turns_as_the_camera_does_not(tmp_path):
    scene = build_scene(settings_of(view={"roll_deg": (30, 30)}), folder_of(tmp_path), 0)
    where = scene.piece_homographies(scene.draw("train", 1), PHOTO)[0]
    left, right = apply_homography(where, np.array([[0.0, 0], [1, 0]]))
    # the camera turned clockwise: what it sees rises to the right
    assert np.degrees(np.arctan2(*(right - left)[::-1])) == pytest.approx(-30)


def test_paper_is_white_and_clean(tmp_path):
    scene = build_scene(settings_of(), folder_of(tmp_path), 0)
    conditions = scene.draw("train", 3)
    light = scene.piece_light(conditions)
    assert light.shape == (3, 3, 6) and (light @ [1, 0.3, -0.7, 0.09, -0.21, 0.49] == 1).all()
    assert not np.any(scene.picture_blur_and_noise(conditions))
    assert scene.design_px(96)[0] > scene.design_px(96)[1] >= 32


def test_a_square_is_the_middle_of_the_picture_erased_or_not(tmp_path):
    scene = build_scene(settings_of(background={"erasing": 1}), folder_of(tmp_path), 0)
    conditions = scene.draw("train", 12)
    whole, square = scene.pictures(conditions, PHOTO), scene.pictures(conditions, (240, 240))
    assert np.abs(whole[:, :, 40:280].astype(int) - square).max() <= 1
    assert np.array_equal(scene.pictures(conditions[3:5], (96, 96)), scene.pictures(conditions, (96, 96))[3:5])


def test_erasing_follows_its_chance_in_training_and_never_else(tmp_path):
    """500 pictures: as many erased as asked (within 4 sigma)."""
    scene = build_scene(settings_of(background={"erasing": 0.4}), folder_of(tmp_path), 0)
    erased = [np.ptp(picture[..., 1]) > 0 for picture in scene.pictures(scene.draw("train", 500), (24, 24))]
    assert abs(np.mean(erased) - 0.4) < 4 * (0.4 * 0.6 / 500) ** 0.5
    assert not any(np.ptp(picture[..., 1]) for picture in scene.pictures(scene.draw("promise", 100), (24, 24)))


def test_erased_boxes_have_the_paper_s_areas_and_lie_in_the_square():
    areas = []
    for seed in range(300):
        picture = np.zeros((100, 140, 3), np.uint8)
        erase(picture, seed)
        assert not picture[:, :20].any() and not picture[:, 120:].any()
        areas.append((picture.max(-1) > 0).mean() * 1.4)
    assert ERASED_AREA[0] * 0.7 < min(areas) and max(areas) < ERASED_AREA[1] * 1.05
    assert np.ptp(areas) > 0.25


def test_erased_values_are_random_in_every_channel():
    picture = np.zeros((224, 224, 3), np.uint8)
    erase(picture, 5)
    values = picture[picture.max(-1) > 0].astype(float)
    assert values.mean(0) == pytest.approx([127.5] * 3, abs=6) and values.std(0) == pytest.approx([73.9] * 3, abs=4)


def test_small_pictures_show_what_large_ones_average_to(tmp_path):
    """A fine checkerboard is gray when it is reduced, not a moiré."""
    (tmp_path / "images").mkdir()
    board = (np.indices((960, 1200)).sum(0) % 2 * 255).astype(np.uint8)
    Image.fromarray(board).save(tmp_path / "images" / "a.png")
    (tmp_path / "labels.csv").write_text("a.png,cup")
    scene = build_scene(settings_of("cup", background={"erasing": 0}, camera={"photo_px": (1200, 960)}), tmp_path, 0)
    picture = scene.pictures(scene.draw("train", 1), (96, 96))
    assert np.abs(picture.astype(int) - 127).max() <= 2


def test_damaged_images_are_left_out(tmp_path):
    folder = folder_of(tmp_path, 6)
    (folder / "images" / "2.png").write_bytes(b"no picture")
    scene = build_scene(settings_of(), folder, 0)
    assert len(scene.images) == 2 and scene.warnings[0] == "2.png is left out: it cannot be read"


@pytest.mark.parametrize(
    ("tables", "sentence"),
    [
        ({"label": "bus"}, r'images labeled "bus".*got 6 images with other labels \(cup, jeep, landrover ...\)'),
        ({"patch": {"width_mm": 60, "height_mm": 40, "bend": True}}, r"got bend = true: give a mesh"),
        ({"view": {"patch_share": (0.0, 0.3)}}, r"patch_share above 0, got 0"),
        (
            {"view": {"patch_share": (0.3, 0.9)}},
            r"fits into the picture's centered square.*got 0\.\d+, which is \d+%.*lower it to 0\.\d",
        ),
        ({"object": {"images": "images", "labels": "none.csv"}}, r"no file at .*none.csv"),
        ({"object": {"images": "other", "labels": "labels.csv"}}, r"got 3 missing \(0.png\)"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path, tables, sentence):
    folder = folder_of(tmp_path, 6)
    with pytest.raises(Refused, match=sentence):
        build_scene(settings_of(**tables), folder, 0)


def test_markers_are_as_large_as_views_need_and_pictures_hold(tmp_path):
    """60 mm at 0.1 of 1200 px are 2 px/mm at the least: 17.5 px of marker need 8.4 mm, or so at the 5 % point."""
    folder = folder_of(tmp_path)
    large = build_scene(settings_of(camera={"photo_px": (1600, 1200)}), folder, 0)
    assert 8 <= large.piece.module_mm * 7 < 8.75 and large.unreadable_share <= 0.06
    small = build_scene(settings_of(), folder, 0)
    assert small.piece.marker_mm == pytest.approx(8.2)  # 0.29 × 40 = 11.6 mm for a corner; (11.6 - 1) × 7/9 = 8.24
    assert small.unreadable_share > 0.5 and "too small" in small.warnings[-1]
    whole = build_scene(settings_of(view={"patch_share": (0.1, 1.0), "roll_deg": (0, 0)}), folder, 0)
    assert whole.piece.size_mm == small.piece.size_mm == (60, 40)  # up to the whole square the piece stays as asked
    with pytest.raises(Refused, match=r"at least 39 mm, which has room for 8 mm markers, got 60 × 38\.9 mm"):
        build_scene(settings_of(patch={"width_mm": 60, "height_mm": 38.9}), folder, 0)
    with pytest.raises(Refused, match=r"at most 166\.6 × 179\.6 mm on this page, got 170 × 40 mm"):
        build_scene(settings_of(patch={"width_mm": 170, "height_mm": 40}), folder, 0)


def test_a_line_without_a_label_is_refused(tmp_path):
    with pytest.raises(Refused, match=r'a file name and a label in each line.*got "1\.png"'):
        build_scene(settings_of(), folder_of(tmp_path, 2, "0.png,cup\n1.png\n"), 0)


def test_pick_covers_every_picture():
    assert pick_indices(np.array([0.0, 0.49, 0.5, 0.999999999]), 2).tolist() == [0, 0, 1, 1]
    assert pick_indices(np.array([1 - 1e-17]), 3).tolist() == [2]
