"""The board page: read by OpenCV's own detector, and its geometry by hand."""

import cv2
import numpy as np
import pytest

from patchproof.base.errors import Refused
from patchproof.base.packaged import packaged_path
from patchproof.sheets.blank import blank_page, blank_sheet, board_sheet, load_board
from patchproof.sheets.manifest import load_manifest
from patchproof.sheets.pdf_raster import attached_manifests, rasterize_page

FILE = packaged_path("print_templates", "charuco_a4.toml")


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    path = tmp_path_factory.mktemp("board") / "board.pdf"
    return path, blank_page(path, template="charuco_a4")


def other(tmp_path, old, new):
    text = FILE.read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "mine.toml"
    path.write_text(text.replace(old, new), encoding="utf-8")
    return path


def test_opencv_s_own_board_detector_reads_the_page(board):
    # a board as anybody would make it: size, squares, markers, dictionary; OpenCV's own ids and pattern
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_1000)
    detector = cv2.aruco.CharucoDetector(cv2.aruco.CharucoBoard((7, 10), 24.0, 18.0, dictionary))
    gray = cv2.cvtColor(rasterize_page(board[0], 1, 150), cv2.COLOR_RGB2GRAY)
    corners, ids, quads, names = detector.detectBoard(gray)
    ids, corners = np.asarray(ids).reshape(-1), np.asarray(corners).reshape(-1, 2)
    assert ids.tolist() == list(range(54)) and sorted(np.asarray(names).reshape(-1)) == list(range(35))
    places = np.column_stack([12 + 24 * (ids % 6 + 1), 20 + 24 * (ids // 6 + 1)])
    off = (corners + 0.5) / 150 * 25.4 - places
    # measured 0.014 mm; OpenCV 4.10 counts corners of boards from half a pixel (0.08 mm) further on
    assert np.abs(off - off.mean(0)).max() < 0.05 and np.abs(off.mean(0)).max() < 0.1
    exact = {m.id: np.array(m.corners_mm) for m in board[1].markers}
    for name, quad in zip(np.asarray(names).reshape(-1), quads, strict=True):
        assert np.abs((quad.reshape(4, 2) + 0.5) / 150 * 25.4 - exact[int(name)]).max() < 0.25  # whole pixels


def test_the_first_marker_lies_in_the_first_white_square(board):
    # column 1 of row 0: x from 12 + 24 + (24 - 18) / 2 = 39 mm, y from 20 + 3 = 23 mm
    assert np.array(board[1].markers[0].corners_mm) == pytest.approx(np.array([[39, 23], [57, 23], [57, 41], [39, 41]]))


def test_its_manifest_gives_the_board_back_and_equal_templates_equal_bytes(board, tmp_path):
    path, manifest = board
    assert manifest.design is None and manifest.promise is None and manifest.kind == "board"
    assert load_manifest(path.with_suffix(".json")) == attached_manifests(path)[0] == manifest
    assert load_board("charuco_a4") == load_board(path.with_suffix(".json"))
    assert (
        cv2.QRCodeDetector().detectAndDecode(rasterize_page(path, 1, 150))[0] == f"patchproof:{manifest.sheet_id}:board"
    )
    board_sheet(FILE, tmp_path / "again.pdf")
    assert (tmp_path / "again.pdf").read_bytes() == path.read_bytes()


def test_what_is_no_board_is_refused(tmp_path):
    with pytest.raises(Refused, match=r"Expected a template with a \[board\] table, got a4"):
        load_board("a4")
    with pytest.raises(Refused, match='did you mean "charuco_a4"'):
        load_board("charuco_a")
    blank_sheet("blank_a4", tmp_path / "b.pdf")
    with pytest.raises(Refused, match="Expected the manifest of a board"):
        load_board(tmp_path / "b.json")


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("marker_mm = 18.0", "marker_mm = 19.0", "board.marker_mm of at most 18.7"),
        ("square_mm = 24.0", "square_mm = 25.0", "parts that do not overlap"),
        ("columns = 7", "columns = 8", "board within the margins"),
        ("rows = 10", "rows = 12", "board within the margins"),
        ("rows = 10", "rows = 3", "board.rows"),
    ],
)
def test_a_board_that_would_not_be_read_or_not_fit_is_refused(tmp_path, old, new, reason):
    with pytest.raises(Refused, match=reason):
        board_sheet(other(tmp_path, old, new), tmp_path / "b.pdf")
