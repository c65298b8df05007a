"""Places behind the object: each file for one part only, procedural ones where files are few, a known one for all."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from patchproof.base.errors import Refused
from patchproof.base.sessions import count_by_session, rate_posterior
from patchproof.base.settings import BackgroundSettings
from patchproof.scene import backgrounds as backgrounds_module
from patchproof.scene import backgrounds as module
from patchproof.scene import patterns
from patchproof.scene.backgrounds import (
    ENOUGH_FILES,
    FEW_PICTURES,
    PLACE_NUMBERS,
    PLACE_PX,
    VIEWS_PER_FILE,
    FileLevels,
    load_backgrounds,
    procedural_place,
)
from patchproof.scene.scene import make_scene

STREAMS = ("train", "select", "promise", "evaluate")


def folder_of(tmp_path, count):
    """Pictures of one color each, which is their number."""
    (tmp_path / "places").mkdir()
    for i in range(count):
        Image.new("RGB", (8, 8), (i, 0, 0)).save(tmp_path / "places" / f"{i:03d}.png")
    return load_backgrounds(BackgroundSettings(images="places"), tmp_path)


def shown(backgrounds, stream):
    """The numbers of files, and of procedural places, that a stream may show, and the share of views with files."""
    chosen = backgrounds.choose_for_stream(stream, (np.arange(40_000) + 0.5) / 40_000)
    pictures = [backgrounds.pictures[int(each * len(backgrounds.pictures))] for each in chosen]
    real = [int(p.path.stem) for p in pictures if not isinstance(p, int)]
    return set(real), {p for p in pictures if isinstance(p, int)}, len(real) / len(pictures)


@pytest.mark.parametrize("count", [1, 4, FEW_PICTURES, 200])
def test_no_place_is_in_two_parts_and_every_part_has_enough(tmp_path, count):
    backgrounds = folder_of(tmp_path, count)
    parts = {stream: shown(backgrounds, stream) for stream in STREAMS}
    files = [file for own, _, _ in parts.values() for file in own]
    made = [number for _, own, _ in parts.values() for number in own]
    assert sorted(files) == list(range(count)) and len(set(made)) == len(made)
    for stream, (own, rooms, _) in parts.items():
        enough = ENOUGH_FILES if stream in ("train", "select") else VIEWS_PER_FILE
        assert (
            rooms <= set(PLACE_NUMBERS[stream])
            and bool(rooms) == (len(own) < enough)
            and len(own) + len(rooms) >= ENOUGH_FILES
        )
    assert shown(backgrounds, "reprint") == parts["evaluate"]
    assert bool(backgrounds.notes) == (count < FEW_PICTURES)
    if (
        count == FEW_PICTURES
    ):  # three of them: in training as often as four procedural ones each, else one view in fifty each
        assert parts["promise"][2] == pytest.approx(3 / VIEWS_PER_FILE, abs=1e-3)
        assert parts["train"][2] == pytest.approx(16 / (16 + len(PLACE_NUMBERS["train"])), abs=1e-3)
    if count == 200:
        assert len(parts["promise"][0]) == 60
        assert {stream for stream in STREAMS if parts[stream][1]} == {"select", "evaluate"}


def test_a_promise_knows_another_place_for_every_session_and_says_which_share_one(tmp_path):
    for count, least in ((0, 98), (10, 93)):
        (tmp_path / str(count)).mkdir()
        backgrounds = folder_of(tmp_path / str(count), count) if count else load_backgrounds(BackgroundSettings(), None)
        chosen = backgrounds.choose_for_stream("promise", np.random.default_rng(0).random(100))
        assert len(np.unique(chosen)) >= least
    hits = [True] * 4 + [False] * 4 + [True, True, False, False] * 2
    assert count_by_session(hits, 4, (0, 1, 1, 3)) == ([4, 2, 2], [4, 8, 4])
    assert count_by_session(hits, 4) == ([4, 0, 2, 2], [4, 4, 4, 4])
    # sessions of one place say less of the rate than as many of places of their own
    hits = [True] * 4 + [False] * 4
    counts = [count_by_session(hits * 20, 4, places) for places in ((0, 1) * 20, ())]
    together, apart = (rate_posterior(*each).rate_interval for each in counts)
    assert np.ptp(together) > 2 * np.ptp(apart)


def test_files_are_decoded_when_they_are_shown_and_little_of_them_is_kept(tmp_path, monkeypatch):
    """Views have the bytes that they would have if every picture were in memory."""
    (tmp_path / "places").mkdir()
    rng, pictures = np.random.default_rng(0), {}
    for i in range(6):
        pixels = rng.integers(0, 256, (260 + i, 300, 3), np.uint8)
        Image.fromarray(pixels).save(tmp_path / "places" / f"{i}.png", compress_level=0)
        pictures[f"{i}.png"] = pixels
    decoded = []
    read = backgrounds_module.read_photo
    monkeypatch.setattr(backgrounds_module, "read_photo", lambda path: decoded.append(path) or read(path))
    monkeypatch.setattr(backgrounds_module, "CACHED_FILE_BYTES", 200_000)
    lazy = load_backgrounds(BackgroundSettings(images="places"), tmp_path)
    assert not decoded
    at_once = tuple(pictures[p.path.name] if isinstance(p, FileLevels) else p for p in lazy.pictures)
    eager = replace(lazy, pictures=at_once)
    files = [i for i, picture in enumerate(lazy.pictures) if isinstance(picture, FileLevels)]
    for size_px in ((64, 64), (400, 300), (64, 48)):
        for number in files:
            choice = np.array([(number + 0.5) / len(lazy.pictures), *rng.random(4)])
            views = [each.picture(choice, (400, 300), size_px) for each in (lazy, eager)]
            assert np.array_equal(*views)
            levels = backgrounds_module._file_levels.values()
            assert len(levels) == 1 or sum(level.nbytes for level in levels) <= 200_000
    assert len(decoded) > len(files)


def test_a_picture_that_is_named_and_a_color_are_known_places(tmp_path):
    folder_of(tmp_path, 3)
    for settings in ({"images": "places/001.png"}, {"color": (0.2, 0.2, 0.2)}):
        backgrounds = load_backgrounds(BackgroundSettings(**settings), tmp_path)
        assert len(backgrounds.pictures) == 1 and not backgrounds.notes
        assert all((backgrounds.choose_for_stream(stream, np.array([0.1, 0.9])) == 0.5).all() for stream in STREAMS)


def test_hidden_files_are_no_backgrounds(tmp_path):
    folder_of(tmp_path, 3)
    (tmp_path / "places" / "._001.png").write_bytes(b"what another system keeps beside 001.png")
    pictures = load_backgrounds(BackgroundSettings(images="places"), tmp_path).pictures
    assert sum(isinstance(picture, FileLevels) for picture in pictures) == 3


def test_pictures_of_all_suffixes_are_backgrounds_or_are_named(tmp_path, monkeypatch):
    folder_of(tmp_path, 2)
    for suffix in ("gif", "jpe"):
        Image.fromarray(np.full((8, 8, 3), 90, np.uint8)).save(tmp_path / "places" / f"a.{suffix}")
    settings = BackgroundSettings(images="places")
    backgrounds = load_backgrounds(settings, tmp_path)
    files = [picture for picture in backgrounds.pictures if isinstance(picture, FileLevels)]
    assert len(files) == 4 and all(abs(int(file[0].mean()) - 90) < 3 for file in files if file.path.stem == "a")
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    (tmp_path / "places" / "b.heic").write_bytes(b"x")
    with pytest.raises(Refused, match=r"b.heic that cannot be read .*pip install 'patchproof\[heic\]'"):
        load_backgrounds(settings, tmp_path)


def test_a_background_is_read_as_a_photograph_is(tmp_path):
    Image.fromarray(np.full((8, 8), 100 * 257, np.uint16)).save(tmp_path / "deep.png")
    assert (
        load_backgrounds(BackgroundSettings(images="deep.png"), tmp_path).picture(np.full(5, 0.5), (8, 8), (8, 8))
        == 100
    ).all()
    (tmp_path / "text.png").write_text("no picture")
    with pytest.raises(Refused, match=r"text.png .*cannot be read"):
        load_backgrounds(BackgroundSettings(images="text.png"), tmp_path)


def test_without_any_word_places_are_procedural_and_always_the_same():
    backgrounds = load_backgrounds(BackgroundSettings(), None)
    assert all(isinstance(each, int) for each in backgrounds.pictures) and not backgrounds.notes
    for number in (0, 1):
        picture = procedural_place(number)
        assert picture.shape == (PLACE_PX, PLACE_PX, 3) and picture.dtype == np.uint8 and picture.std() > 1
        assert np.array_equal(picture, procedural_place(number))
    assert not np.array_equal(procedural_place(0), procedural_place(2))


def test_a_session_s_photographs_share_print_light_camera_and_place_and_nothing_else():
    scene = make_scene(
        {
            "object": {"mesh": "primitive:carton", "length_mm": 300},
            "patch": {"width_mm": 120, "height_mm": 120},
            "target": {"label": "carton", "models": ["builtin"]},
            "camera": {"motion_px": [0, 4]},
        }
    )
    drawn = scene.draw("promise", 12, per_session=4)
    alone = scene.draw("promise", 12)
    of_session = [getattr(drawn.light, name) for name in vars(drawn.light)]
    of_session += [getattr(drawn.print, name) for name in ("dot_gain", "density", "veil")]
    of_session += [drawn.sensor.white_balance, drawn.sensor.jpeg]
    of_session += [drawn.pose.background[:, [0, 1, 4]]]
    for values in of_session:
        rows = values.reshape(3, 4, -1)
        assert (rows == rows[:, :1]).all() and len(np.unique(rows[:, 0], axis=0)) == 3
    own = [drawn.pose.azimuth_deg, drawn.pose.distance_mm, drawn.pose.background[:, 2], drawn.sensor.exposure_ev]
    own += [drawn.sensor.blur_px, drawn.sensor.noise, drawn.sensor.motion_px, drawn.sensor.noise_seed]
    assert all(len(np.unique(values)) == 12 for values in own)
    np.testing.assert_array_equal(drawn.pose.azimuth_deg, alone.pose.azimuth_deg)
    part = scene.draw("promise", 5, start=6, per_session=4)  # the last of one session and the first of the next
    np.testing.assert_array_equal(part.light.ambient, drawn.light.ambient[6:11])


def test_promises_of_another_scene_meet_other_draws_and_evaluations_the_same():
    settings = {
        "object": {"mesh": "primitive:carton", "length_mm": 300},
        "patch": {"width_mm": 120, "height_mm": 120},
        "target": {"label": "carton", "models": ["builtin"]},
    }
    one, other = make_scene(settings), make_scene(settings | {"optimize": {"steps": 10}})
    for stream, same in (("promise", False), ("evaluate", True), ("train", True)):
        pair = [scene.draw(stream, 8).pose.azimuth_deg for scene in (one, other)]
        assert np.array_equal(*pair) == same


@pytest.fixture(scope="module")
def places():
    return [module.procedural_place(number) for number in range(0, 12, 2)]


def test_rays_that_pass_a_box_by_are_those_that_would_not_meet_it(monkeypatch, places):
    monkeypatch.setattr(module, "_candidate_rays", lambda aim, ends: np.arange(aim.shape[1]))
    assert all(np.array_equal(module.procedural_place(2 * i), place) for i, place in enumerate(places))


@pytest.mark.parametrize("count", [1, 2, 9, 80, 800])
@pytest.mark.parametrize("px", [30, 64])
def test_pixels_have_their_nearest_point_whether_it_was_asked_for_or_not(count, px):
    points = np.random.default_rng(count).random((count, 2)) * px
    far = np.linalg.norm(np.argwhere(np.ones((px, px)))[:, None] - points, axis=2)
    assert np.array_equal(patterns._nearest(points, px).ravel(), far.argmin(1))


def test_half_of_the_views_are_mirrored_left_to_right():
    backgrounds, choice = load_backgrounds(BackgroundSettings(), None), [0.3, 0.5, 0.5, 0.5]
    plain, mirrored = (backgrounds.picture(np.array([*choice, side]), (640, 480), (64, 64)) for side in (0.7, 0.3))
    assert np.array_equal(plain[:, ::-1], mirrored) and not np.array_equal(plain, mirrored)


@pytest.mark.parametrize("place", [0.0, 0.5, 1.0])
def test_a_plain_color_is_that_color_wherever_it_is_cropped(place):
    plain = load_backgrounds(BackgroundSettings(color=(1.0, 0.0, 0.0)), Path())
    picture = plain.picture(np.array([0, 0, place, place, 0.9]), (400, 300), (40, 30))
    assert picture.shape == (30, 40, 3) and (picture == [255, 0, 0]).all()
