"""Places behind the object: each file for one part only, procedural ones where files are few, a known one for all."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from patchproof.scene.backgrounds import ENOUGH, FEW, ROOMS, load_backgrounds
from patchproof.scene.rooms import PLACE_PX, place
from patchproof.scene.scene import make_scene
from patchproof.settings import BackgroundSettings

STREAMS = ("train", "select", "promise", "evaluate")


def folder_of(tmp_path, count):
    """Pictures of one color each, which is their number."""
    (tmp_path / "places").mkdir()
    for i in range(count):
        Image.new("RGB", (8, 8), (i, 0, 0)).save(tmp_path / "places" / f"{i:03d}.png")
    return load_backgrounds(BackgroundSettings(images="places"), tmp_path)


def shown(backgrounds, stream):
    """The numbers of files, and of procedural places, that a stream may show."""
    chosen = backgrounds.chosen(stream, (np.arange(4000) + 0.5) / 4000)
    pictures = [backgrounds.pictures[int(each * len(backgrounds.pictures))] for each in np.unique(chosen)]
    files = {int(p[0, 0, 0]) for p in pictures if not isinstance(p, int)}
    return files, {p for p in pictures if isinstance(p, int)}


@pytest.mark.parametrize("count", [1, 4, FEW, 200])
def test_no_place_is_in_two_parts_and_every_part_has_enough(tmp_path, count):
    backgrounds = folder_of(tmp_path, count)
    parts = {stream: shown(backgrounds, stream) for stream in STREAMS}
    files = [file for own, _ in parts.values() for file in own]
    made = [number for _, own in parts.values() for number in own]
    assert sorted(files) == list(range(count)) and len(set(made)) == len(made)
    assert all(len(own) >= ENOUGH or len(rooms) == ROOMS[stream] for stream, (own, rooms) in parts.items())
    assert shown(backgrounds, "reprint") == parts["evaluate"]
    assert bool(backgrounds.notes) == (count < FEW)
    if count == FEW:  # three of them, and each as often as four procedural ones
        chosen = backgrounds.chosen("promise", (np.arange(4000) + 0.5) / 4000) * len(backgrounds.pictures)
        real = [not isinstance(backgrounds.pictures[int(each)], int) for each in chosen]
        assert np.mean(real) == pytest.approx(12 / (12 + ROOMS["promise"]), abs=0.01)
    if count == 200:
        assert len(parts["promise"][0]) == 60 and {stream for stream in STREAMS if parts[stream][1]} == {"select"}


def test_a_picture_that_is_named_and_a_color_are_known_places(tmp_path):
    folder_of(tmp_path, 3)
    for settings in ({"images": "places/001.png"}, {"color": (0.2, 0.2, 0.2)}):
        backgrounds = load_backgrounds(BackgroundSettings(**settings), tmp_path)
        assert len(backgrounds.pictures) == 1 and not backgrounds.notes
        assert all((backgrounds.chosen(stream, np.array([0.1, 0.9])) == 0.5).all() for stream in STREAMS)


def test_without_any_word_places_are_procedural_and_always_the_same():
    backgrounds = load_backgrounds(BackgroundSettings(), None)
    assert all(isinstance(each, int) for each in backgrounds.pictures) and not backgrounds.notes
    for number in (0, 1):
        picture = place(number)
        assert picture.shape == (PLACE_PX, PLACE_PX, 3) and picture.dtype == np.uint8 and picture.std() > 1
        assert np.array_equal(picture, place.__wrapped__(number))  # drawn anew, not kept
        assert place(number) is picture and not picture.flags.writeable  # scenes share it
    assert not np.array_equal(place(0), place(2))


def test_a_session_s_photographs_share_print_light_camera_and_place_and_nothing_else():
    scene = make_scene(
        {
            "object": {"mesh": "primitive:carton", "length_mm": 300},
            "patch": {"width_mm": 120, "height_mm": 120},
            "target": {"label": "carton", "models": ["builtin"]},
            "camera": {"motion_px": [0, 4], "vignetting": [0, 0.5]},
            "light": {"point": [0, 1], "sh2": [0, 0.3], "gloss": [0, 0.1]},
        }
    )
    drawn = scene.draw("promise", 12, per_session=4)
    alone = scene.draw("promise", 12)
    of_session = [getattr(drawn.light, name) for name in vars(drawn.light)]
    of_session += [getattr(drawn.print, name) for name in ("dot_gain", "density", "black")]
    of_session += [drawn.sensor.white_balance, drawn.sensor.vignetting, drawn.sensor.jpeg]
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
