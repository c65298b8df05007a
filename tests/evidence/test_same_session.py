"""Folders that are one session by times, cameras, light and background; sessions of photographs of controls."""

from __future__ import annotations

import itertools
import sys
from pathlib import Path

import numpy as np
import pytest

from patchproof.evidence import grouping as grouping_module
from patchproof.evidence.grouping import BY_FOLDERS, BY_TIMES, Grouping, control_keys, merge_folders
from patchproof.evidence.measure import MeasuredPhoto
from patchproof.evidence.results import PhotoEntry, Trace
from patchproof.photo.quality import FrameLight

PLACES = ((0.3, 0.25, 0.2), (0.2, 0.3, 0.45), (0.05, 0.2, 0.1), (0.6, 0.2, 0.3))


def photo(file, minute=None, place=None, camera="A", seed=0):
    """A photograph in a place (None: without readable light) at a minute (None: unknown)."""
    scatter = np.random.default_rng(seed).normal(0, [0.01, 0.1, 0.1, 0.1])
    between, number = np.modf(place or 0)  # that share of the way to the next place
    start, end = np.log(PLACES[int(number) % 4]), np.log(PLACES[(int(number) + 1) % 4])
    frame = np.exp(start + between * (end - start) + scatter[1:])
    paper = np.array([0.5, 0.5, 0.5 * np.exp(scatter[0])])
    light = None if place is None else FrameLight(paper, 0 * paper, 0.5, 0.0)
    trace = Trace(minute=minute, camera=camera, frame=tuple(map(float, frame)))
    return MeasuredPhoto(PhotoEntry(file=file, status="judged"), True, light=light, trace=trace)


def merged(*folders):
    """The sessions of folders of (minute, place, camera) rows, and the note."""
    rows = [
        (i, photo(f"f{i}/{j}", *row, seed=97 * i + j)) for i, rows in enumerate(folders) for j, row in enumerate(rows)
    ]
    names = tuple(f"f{i}" for i in range(len(folders)))
    grouping = Grouping((Path(),) * len(rows), tuple(i for i, _ in rows), names, BY_FOLDERS)
    result = merge_folders(grouping, [row for _, row in rows])
    return result.same_as, result.note


def at(*minutes, place=None, camera="A"):
    return [(minute, place, camera) for minute in minutes]


def test_photographs_of_one_camera_within_two_minutes_are_one_session():
    assert merged(at(0, 1), at(2.9, 4))[0] == (0, 0)
    assert merged(at(0, 1), at(3.1, 4))[0] == (0, 1)
    assert merged(at(0, 2, 4), at(1, 3, 5))[0] == (0, 0)
    assert merged(at(0, 1), at(2, 3, camera="B"))[0] == (0, 1)
    assert merged(at(0), at(1), at(2), at(300), at(301))[0] == (0, 0, 0, 3, 3)


def test_a_clearly_different_place_is_no_session_of_the_last_one_though_it_was_near():
    assert merged(at(0, 1, 2, place=0), at(3, 4, 5, place=1))[0] == (0, 1)
    assert merged(at(0, 1, 2, place=0), at(3, 4, 5, place=0))[0] == (0, 0)


def test_within_half_an_hour_light_and_background_decide_and_later_it_is_another_session():
    assert merged(at(0, 1, 2, place=0), at(20, 21, 22, place=0))[0] == (0, 0)
    assert merged(at(0, 1, 2, place=0), at(20, 21, 22, place=1))[0] == (0, 1)
    assert merged(at(0, 1, 2, place=0), at(60, 61, 62, place=0))[0] == (0, 1)


def test_three_sessions_without_times_in_thirty_folders_are_found_again():
    folders = [at(None, None, place=place) for place in (0, 1, 2) for _ in range(10)]
    numbers, note = merged(*folders)
    assert numbers == (0,) * 10 + (10,) * 10 + (20,) * 10
    assert note.startswith("30 folders look like 3 sessions") and "f0, f1, f2 and 7 more" in note
    assert merged(*(at(None, None, None, None, place=place) for place in range(4))) == ((0, 1, 2, 3), "")


def test_different_places_are_not_chained_by_others_between_them():
    folders = [at(None, None, None, place=0.15 * place) for place in range(9)]  # each is like its neighbors
    numbers, _ = merged(*folders)
    assert numbers[0] == numbers[1] and len(set(numbers)) >= 3
    assert merged(*folders[:2])[0] == (0, 0) and merged(folders[0], folders[-1])[0] == (0, 1)


def test_folders_that_show_neither_time_nor_light_are_said_to_be_unchecked():
    numbers, note = merged(at(None, None), at(None))
    assert numbers == (0, 1) and note.startswith("could not be checked") and note.endswith("f0, f1")
    grouping = Grouping((Path(),), (0,), ("",), BY_TIMES)
    assert merge_folders(grouping, [photo("a")]) is grouping and grouping.merged == (0,)


@pytest.mark.parametrize(
    ("file", "minute", "key"),
    [
        ("hall/1.jpg", None, (0, "hall/1.jpg")),  # the same folder and name: a pair
        ("hall/9.jpg", None, (0, "/hall/9.jpg")),
        ("2.jpg", None, (1, "yard/2.jpg")),  # the only photograph of that name
        ("1.jpg", None, (-1, "/1.jpg")),  # two have that name
        ("5.jpg", 119, (1, "/5.jpg")),  # near the yard's by time
        ("5.jpg", 500, (-1, "/5.jpg")),
    ],
)
def test_a_control_s_photograph_belongs_to_a_session_by_folder_name_or_time(file, minute, key):
    photos = [photo("hall/1.jpg", 0), photo("yard/1.jpg", 100), photo("yard/2.jpg", 101)]
    grouping = Grouping((Path(),) * 3, (0, 1, 1), ("hall", "yard"), BY_FOLDERS)
    assert control_keys(grouping, photos, [photo(file, minute)]) == {file: key}


def test_a_control_s_own_sessions_are_told_apart_by_folder_and_time():
    grouping = Grouping((Path(),), (0,), ("",), BY_TIMES)
    files = [("a", 500), ("b", 510), ("c", 900), ("x/d", None), ("x/e", None), ("y/d", None)]
    keys = control_keys(grouping, [photo("p", 0)], [photo(*each) for each in files])
    sessions = [keys[file][0] for file, _ in files]
    assert sessions[0] == sessions[1] and sessions[3] == sessions[4] and len(set(sessions)) == 4 and max(sessions) < 0


def test_a_folder_whose_first_photograph_has_no_time_has_those_of_the_others():
    assert merged([(None, None), (0, None)], at(1, 2))[0] == (0, 0)
    assert merged([(None, None), (0, None)], at(100, 101)) == ((0, 1), "")


def calls(count, minutes):
    """Python's function calls for so many folders of two photographs, so far apart, each with one of a control."""
    photos, names = [photo(f"f{i // 2}/{i}", i * minutes / 2, 0) for i in range(2 * count)], map(str, range(count))
    grouping = Grouping((Path(),) * len(photos), tuple(i // 2 for i in range(2 * count)), tuple(names), BY_FOLDERS)
    controls, number = [photo(f"c{i}", i * minutes) for i in range(count)], itertools.count()
    sys.setprofile(lambda frame, event, argument: event == "call" and next(number))
    try:
        control_keys(merge_folders(grouping, photos), photos, controls)
    finally:
        sys.setprofile(None)
    return next(number)


def test_the_work_for_sessions_grows_with_photographs_and_not_with_their_square():
    assert calls(48, 40.0) < 4.5 * calls(12, 40.0)


def test_folders_without_times_are_compared_in_one_step_each(monkeypatch):
    sizes, shares = [], grouping_module._distance_shares
    monkeypatch.setattr(grouping_module, "_distance_shares", lambda *given: sizes.append(1) or shares(*given))
    merged(*(at(None, None, place=place % 4) for place in range(12)))
    assert len(sizes) <= 12
