"""Which photographs are one session's: by folders, by cameras and times, and by a cautious guess."""

from __future__ import annotations

import pytest
from PIL import Image

from patchproof.base.errors import Refused
from patchproof.evidence.grouping import BY_FOLDERS, BY_GUESS, BY_TIMES, Grouping, group_sessions, merge_folders
from patchproof.evidence.measure import MeasuredPhoto
from patchproof.evidence.results import PhotoEntry, Trace
from patchproof.photo.exif import time_and_camera


def photo(path, taken=None, camera="A"):
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    if taken is not None:
        exif.get_ifd(0x8769)[0x9003] = taken
        exif[0x0110] = camera
    Image.new("RGB", (8, 8)).save(path, exif=exif)


def grouped_by_time(folder) -> Grouping:
    """The sessions of photographs without folders; files that cannot be read have no trace."""
    grouping, photos = group_sessions(folder), []
    for path in grouping.paths:
        minute, camera = time_and_camera(path)
        trace = Trace(minute=minute, camera=camera, frame=(0, 0, 0)) if path.read_bytes() != b"no picture" else None
        photos.append(MeasuredPhoto(PhotoEntry(file=path.name, status="judged"), True, trace=trace))
    return merge_folders(grouping, photos)


def test_folders_in_the_folder_are_sessions_and_controls_are_none(tmp_path):
    for name in ("yard/1.jpg", "yard/2.jpg", "hall/1.jpg", "gray/1.jpg", ".trash/1.jpg"):
        photo(tmp_path / name)
    (tmp_path / "empty").mkdir()
    grouping = group_sessions(tmp_path, without=tmp_path / "gray")
    assert (grouping.names, grouping.session, grouping.known_from) == (("hall", "yard"), (0, 1, 1), BY_FOLDERS)
    assert [grouping.file(i) for i in range(3)] == ["hall/1.jpg", "yard/1.jpg", "yard/2.jpg"]
    photo(tmp_path / "loose.jpg")
    assert group_sessions(tmp_path, tmp_path / "gray").names == ("", "hall", "yard")
    assert group_sessions(tmp_path, tmp_path / "gray").file(0) == "loose.jpg"


@pytest.mark.parametrize(("second", "sessions"), [("2026:05:01 10:30:00", 1), ("2026:05:01 10:30:01", 2)])
def test_a_pause_of_more_than_half_an_hour_begins_another_session(tmp_path, second, sessions):
    photo(tmp_path / "b.jpg", "2026:05:01 10:00:00")
    photo(tmp_path / "a.jpg", second)
    grouping = grouped_by_time(tmp_path)
    assert len(grouping.names) == sessions and grouping.known_from == BY_TIMES
    assert grouping.session == ((1, 0) if sessions == 2 else (0, 0))  # in the order of names; numbered by time


def test_another_camera_is_another_session(tmp_path):
    photo(tmp_path / "a.jpg", "2026:05:01 10:00:00", "A")
    photo(tmp_path / "b.jpg", "2026:05:01 10:00:00", "B")
    photo(tmp_path / "c.jpg", "2026:05:01 10:01:00", "A")
    assert grouped_by_time(tmp_path).session == (0, 1, 0)


@pytest.mark.parametrize("taken", [None, "yesterday", "0000:00:00 00:00:00"])
def test_photographs_that_do_not_all_say_their_time_are_taken_as_one_session(tmp_path, taken):
    photo(tmp_path / "a.jpg", "2026:05:01 10:00:00")
    photo(tmp_path / "b.jpg", taken)
    grouping = grouped_by_time(tmp_path)
    assert grouping.known_from == BY_GUESS and grouping.session == (0, 0)


def test_files_that_are_no_pictures_are_a_guess_and_no_photographs_are_refused(tmp_path):
    (tmp_path / "a.jpg").write_bytes(b"no picture")
    assert grouped_by_time(tmp_path).known_from == BY_GUESS
    photo(tmp_path / "b.jpg", "2026:05:01 10:00:00")
    grouping = grouped_by_time(tmp_path)  # a damaged file does not hide what the others say
    assert grouping.known_from == BY_TIMES and grouping.names == ("2026-05-01 10:00 A",)
    (tmp_path / "b.jpg").unlink()
    (tmp_path / "a.jpg").rename(tmp_path / "a.txt")
    with pytest.raises(Refused, match=r"photographs .*got none"):
        group_sessions(tmp_path)
    with pytest.raises(Refused, match="no folder at"):
        group_sessions(tmp_path / "nowhere")
    assert group_sessions(tmp_path / "a.txt").paths == (tmp_path / "a.txt",)
