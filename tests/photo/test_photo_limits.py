"""A photograph that takes too long or too much is given up, and only that: in this process and in others."""

from __future__ import annotations

import io
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import toy_studies as toy
from degraded_photos import take
from fuzz.readers import small_task
from fuzz.watch import peak_bytes
from PIL import Image

from patchproof.base import input as bounds
from patchproof.base.errors import Refused
from patchproof.base.input import limit_memory
from patchproof.calibrate import camera as boards
from patchproof.calibrate.camera import BoardView, find_boards, find_corners
from patchproof.evidence.batch import PhotoItem, _measure_or_reject
from patchproof.evidence.locate import pinhole_photo
from patchproof.evidence.measure import measure
from patchproof.evidence.task import promised_ranges
from patchproof.photo import detect, limits, page_code, read
from patchproof.photo.limits import count_finder_lines, find_squares, run_limited
from patchproof.photo.page_code import read_page_code
from patchproof.photo.read import read_photo
from patchproof.photo.rejection import PhotoRejected
from patchproof.sheets.blank import load_board
from patchproof.sheets.markers import aruco_dictionary

needs_timer = pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="there are no such timers on Windows")
needs_linux = pytest.mark.skipif(not Path("/proc/self/statm").is_file(), reason="memory is limited on Linux alone")


def squares(side: int) -> np.ndarray:
    """Dark squares of 12 px, as far apart, in a picture side×side."""
    y, x = np.mgrid[:side, :side]
    return np.where((y % 24 < 12) & (x % 24 < 12), 0, 255).astype(np.uint8)


@needs_timer
def test_work_is_interrupted_after_its_time_and_not_before(monkeypatch):
    monkeypatch.setattr(bounds, "TIME_LIMIT_S", 0.1)
    assert run_limited(toy.spin, 0.05) == 0.05
    before = time.process_time()
    with pytest.raises(PhotoRejected) as caught:
        run_limited(toy.spin, 5.0)
    assert time.process_time() - before < 1
    assert (caught.value.code, caught.value.threshold) == ("too_costly", 0.1) and "0.1 s" in caught.value.advice
    assert signal.getsignal(signal.SIGPROF) == signal.SIG_DFL and signal.getitimer(signal.ITIMER_PROF) == (0, 0)


@needs_timer
def test_a_library_that_swallows_what_interrupts_it_is_interrupted_again(monkeypatch):
    monkeypatch.setattr(bounds, "TIME_LIMIT_S", 0.1)
    monkeypatch.setattr(bounds, "_REPEAT_S", 0.1)

    def stubborn():
        for _ in range(2):
            try:
                toy.spin(5.0)
            except BaseException:
                continue
        toy.spin(5.0)

    with pytest.raises(PhotoRejected, match="too_costly"):
        run_limited(stubborn)


@needs_timer
def test_inside_a_limit_there_is_one_and_in_other_threads_none(monkeypatch):
    monkeypatch.setattr(bounds, "TIME_LIMIT_S", 0.1)
    with pytest.raises(PhotoRejected):
        run_limited(lambda: [run_limited(toy.spin, 0.05) for _ in range(20)])
    results = []
    thread = threading.Thread(target=lambda: results.append(run_limited(toy.spin, 0.15)))
    thread.start()
    thread.join()
    assert results == [0.15]


@needs_timer
def test_a_photograph_that_takes_too_long_is_rejected_with_advice(tmp_path, monkeypatch):
    monkeypatch.setattr(bounds, "TIME_LIMIT_S", 0.1)
    monkeypatch.setattr("patchproof.evidence.batch.read_photo", lambda path: toy.spin(5.0))
    entry = _measure_or_reject(small_task(), PhotoItem(tmp_path / "a.jpg", "a.jpg")).entry
    assert (entry.status, entry.code, entry.remark.threshold) == ("rejected", "too_costly", 0.1)
    assert "save it smaller" in entry.remark.advice


@needs_timer
def test_a_photograph_of_a_board_that_takes_too_long_is_left_out(tmp_path, monkeypatch):
    for name in "ab":
        Image.new("RGB", (40, 40)).save(tmp_path / f"{name}.png")
    view = BoardView("b.png", np.zeros(0, int), np.zeros((0, 2)), np.zeros((0, 2)), (40, 40))
    monkeypatch.setattr(bounds, "TIME_LIMIT_S", 0.1)
    monkeypatch.setattr(boards, "_read_view", lambda path, *_: (view, None) if path.stem == "b" else toy.spin(5.0))
    views, left, _ = find_boards(tmp_path, load_board("charuco_a4"))
    assert views == [view] and "0.1 s of processor time" in left["a.png"]


@needs_linux
def test_memory_is_limited_while_a_photograph_is_read(tmp_path, monkeypatch):
    with limit_memory(limits.MOST_BYTES):
        np.empty(limits.MOST_BYTES // 2, np.uint8)
        with pytest.raises(MemoryError):
            np.empty(limits.MOST_BYTES + 2**28, np.uint8)
    np.empty(limits.MOST_BYTES + 2**28, np.uint8)
    Image.new("RGB", (40, 40)).save(tmp_path / "a.png")
    monkeypatch.setattr(read, "_decode_pixels", lambda *_: np.empty(limits.MOST_BYTES + 2**28, np.uint8))
    with pytest.raises(PhotoRejected, match="too_costly: the picture takes too much memory: save it smaller"):
        read_photo(tmp_path / "a.png")


@needs_linux
@pytest.mark.parametrize(("kind", "size"), [("roll_100_300_bends", (2230, 1672)), ("plain_8_markers", (4500, 3375))])
def test_a_photograph_of_any_size_is_measured_in_a_gigabyte(kind, size, tmp_path, monkeypatch):
    """At an eighth of everything: the largest that is looked at whole, and one of 120 megapixels."""
    monkeypatch.setattr(read, "WHOLE_PX", read.WHOLE_PX // 8)
    truth, surface, promised = take(kind, 0)
    picture = Image.open(io.BytesIO(truth.jpeg))
    picture.resize(size).save(tmp_path / "a.jpg", exif=picture.getexif())
    before = peak_bytes(reset=True)
    view = pinhole_photo(read_photo(tmp_path / "a.jpg"), None)
    entry = measure(view, "a.jpg", surface, promised, promised_ranges(())).entry
    assert peak_bytes() - before < limits.MOST_BYTES / 8
    assert entry.status == "measured" and entry.photo_px == ((2250, 1687) if size[0] > 2400 else size)


def test_a_file_that_is_too_large_is_not_opened(tmp_path, monkeypatch):
    (tmp_path / "a.png").write_bytes(bytes(2001))
    monkeypatch.setattr(read, "MOST_BYTES", 2000)
    with pytest.raises(PhotoRejected) as caught:
        read_photo(tmp_path / "a.png")
    assert (caught.value.code, caught.value.figure, caught.value.threshold) == ("too_costly", 2001, 2000)


def test_squares_are_counted_and_too_many_are_not_looked_into(monkeypatch):
    """1200 / 24 a side. The detector would take 8 s to look into them, and nothing could interrupt it; nor 49 of them
    where 0.1 s is left.
    """
    picture, printed = squares(1200), aruco_dictionary(detect.DICTIONARY)
    assert 2300 <= len(find_squares(picture)) <= 2600
    count = max(len(find_squares(picture, window_px=window)) for window in (3, 13, 23))  # a thin line has two outlines
    monkeypatch.setattr(detect, "MOST_SQUARES", count - 1)
    before = time.process_time()
    with pytest.raises(PhotoRejected) as caught:
        detect._detect(picture, printed, 1200)
    assert (caught.value.code, caught.value.figure, caught.value.threshold) == ("too_costly", count, count - 1)
    assert time.process_time() - before < 2
    few = np.pad(squares(168), (0, 1032), constant_values=255)
    assert 45 <= len(find_squares(few)) <= 55 and detect._detect(few, printed, 1200) == ([], set())
    monkeypatch.setattr(detect, "remaining_seconds", lambda: 0.1)
    with pytest.raises(PhotoRejected) as caught:
        detect._detect(few, printed, 1200)
    assert caught.value.threshold == 25


def test_squares_are_counted_from_the_size_on_that_the_detector_looks_into():
    """One of 34 px about in each of 62 × 62 places of a megapixel picture: 14 s."""
    y, x = np.mgrid[:992, :992] % 16
    picture = np.where((abs(y - 8) < 5) & (abs(x - 8) < 5), 0, 255).astype(np.uint8)
    assert len(find_squares(picture)) == 0 and len(find_squares(picture, 29.76)) > 3600
    before = time.process_time()
    with pytest.raises(PhotoRejected, match="squares that could be markers"):
        detect._detect(picture, aruco_dictionary(detect.DICTIONARY), 992)
    assert time.process_time() - before < 2


def test_a_board_among_too_many_squares_is_left_out(tmp_path, monkeypatch):
    """Of the photographs of a calibration each has the limits of any other."""
    Image.fromarray(squares(1200)).save(tmp_path / "a.png")
    monkeypatch.setattr(detect, "MOST_SQUARES", 10)
    board = load_board("charuco_a4")
    with pytest.raises(Refused, match="photographs of the board"):
        find_boards(tmp_path, board)
    with pytest.raises(PhotoRejected, match="squares that could be markers"):
        find_corners(np.repeat(squares(1200)[..., None], 3, 2), board)


def test_no_code_is_looked_for_in_a_picture_full_of_lines_like_a_finders():
    """Rows of 1:1:3:1:1 alone: of 2000 px a side, the other detector takes more than 40 s."""
    row = np.repeat([0, 255, 0, 255, 0, 255], np.array([1, 1, 3, 1, 1, 6]) * 2).astype(np.uint8)
    picture = np.tile(row, (1000, 1000 // len(row)))
    assert (
        count_finder_lines(picture) == pytest.approx(picture.size / len(row), rel=0.2)
        and len(find_squares(picture)) == 0
    )
    assert count_finder_lines(np.ascontiguousarray(picture.T)) < 1000
    picture = np.tile(picture, (2, 2))
    assert count_finder_lines(picture) > page_code._MAX_LINES
    before = time.process_time()
    assert read_page_code(np.repeat(picture[..., None], 3, 2)) is None
    assert time.process_time() - before < 2


def test_no_code_is_looked_for_in_a_picture_full_of_finder_patterns():
    """900 finder patterns take one detector 10 s."""
    y, x = np.mgrid[:600, :600]
    distance = np.maximum(abs(y % 20 - 7), abs(x % 20 - 7)) // 2
    picture = np.where((distance == 2) | (distance > 3), 255, 0).astype(np.uint8)
    assert len(find_squares(picture)) > page_code._MAX_SQUARES
    before = time.process_time()
    assert read_page_code(np.repeat(picture[..., None], 3, 2)) is None
    assert time.process_time() - before < 2
