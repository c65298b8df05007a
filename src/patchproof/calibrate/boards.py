"""Find the corners of a ChArUco board in photographs: their positions on the board and in the picture.

In: a folder of photographs and a printed board. Out: one `BoardView` for each photograph that shows enough of the
board, and a reason for each of the others. All views come from one camera in one state: the picture size, orientation
and focal length that most photographs share; otherwise a phone that switched lenses between two photographs would be
calibrated as the mean of both. Corners are saddle points, symmetric under half a turn, so neither blur nor the tone
curve shifts them. Pixel centers are at .5.
"""

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from patchproof.base.color import photo_codes_from_srgb
from patchproof.base.errors import Refused
from patchproof.base.input import open_lazily
from patchproof.base.progress import Advance, no_advance
from patchproof.photo.detect import detect_markers, detector_settings, luminance
from patchproof.photo.limits import run_limited
from patchproof.photo.read import list_photos, read_photo
from patchproof.photo.rejection import PhotoRejected
from patchproof.sheets.blank import Board
from patchproof.sheets.markers import DICTIONARY, aruco_dictionary

MIN_CORNERS = 12  # in one photograph: a pose has six unknowns, twelve corners give twenty-four numbers
_STATE_TAGS = 0x010F, 0x0110, 0x0112  # maker, model, orientation


@dataclass(frozen=True)
class BoardView:
    """One photograph's corners: `ids` N on the board, `board_mm` N×2 as printed, `px` N×2 of `size_px` (w, h)."""

    file: str
    ids: np.ndarray
    board_mm: np.ndarray
    px: np.ndarray
    size_px: tuple[int, int]

    def select(self, keep: np.ndarray) -> "BoardView":
        """A copy with the corners in the mask `keep` only."""
        return replace(self, ids=self.ids[keep], board_mm=self.board_mm[keep], px=self.px[keep])


def find_boards(
    photos: str | Path, board: Board, ruler_mm: tuple[float, float] | None = None, advance: Advance = no_advance
) -> tuple[list[BoardView], dict[str, str], str]:
    """Read a folder's photographs: (views, reasons by the names of photographs left out, the camera's name).

    `ruler_mm` are the printed rulers (x, y) as measured.
    """
    paths, views, left_out, states = list_photos(photos), [], {}, []
    positions_mm = corner_positions_mm(board, ruler_mm)
    for number, path in enumerate(paths, 1):
        try:
            view, focal_px = run_limited(_read_view, path, board, positions_mm)
            views.append(view)
            states.append((view.size_px, *_camera_tags(path), focal_px and round(focal_px)))
        except PhotoRejected as rejection:
            left_out[path.name] = rejection.advice
        advance(number, len(paths))
    if not views:
        got = f"{len(paths)} photographs that do not show it"
        raise Refused(f"photographs of the board {board.sheet_id}", got, "name the board with --board")
    common = Counter(states).most_common(1)[0][0]
    pairs = list(zip(views, states, strict=True))
    left_out |= {view.file: _other_state(state, common) for view, state in pairs if state != common}
    return [view for view, state in pairs if state == common], left_out, common[1]


def corner_positions_mm(board: Board, ruler_mm: tuple[float, float] | None = None) -> np.ndarray:
    """Inner corners M×2 by id, from the board's top-left corner, scaled to the rulers as measured."""
    column, row = np.meshgrid(np.arange(1, board.grid.columns), np.arange(1, board.grid.rows))
    nominal = np.column_stack([column.ravel(), row.ravel()]) * board.grid.square_mm
    return nominal if ruler_mm is None else nominal * (np.array(ruler_mm) / board.ruler_mm)


def _read_view(path: Path, board: Board, positions_mm: np.ndarray) -> tuple[BoardView, float | None]:
    photo = read_photo(path)
    ids, px, markers = find_corners(photo.srgb, board)
    if len(ids) < MIN_CORNERS or np.linalg.matrix_rank(positions_mm[ids] - positions_mm[ids].mean(0)) < 2:
        advice = f"{markers} markers and {len(ids)} corners of the board were read, {MIN_CORNERS} corners are needed"
        raise PhotoRejected("too_few_markers", len(ids), MIN_CORNERS, f"{advice}: show more of it, sharp")
    height, width = photo.srgb.shape[:2]
    return BoardView(path.name, ids, positions_mm[ids], px, (width, height)), photo.focal_px


def find_corners(srgb: np.ndarray, board: Board) -> tuple[np.ndarray, np.ndarray, int]:
    """Find the board's inner corners in a picture: (ids N, pixels N×2, number of markers).

    Markers are searched for in linear light, where blurred paper does not grow over ink; corners need no such care.
    """
    dictionary = aruco_dictionary(DICTIONARY)
    light = photo_codes_from_srgb(luminance(srgb))
    quads, names = detect_markers(light, dictionary, detector_settings())
    none = np.zeros(0, int), np.zeros((0, 2)), len(quads)
    if names is None:
        return none
    grid = board.grid
    pattern = cv2.aruco.CharucoBoard((grid.columns, grid.rows), grid.square_mm, grid.marker_mm, dictionary)
    gray = cv2.cvtColor(srgb, cv2.COLOR_RGB2GRAY)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(pattern).detectBoard(gray, None, None, quads, names)
    if ids is None or len(ids) == 0:
        return none
    # OpenCV 4 gives N×1 and N×1×2, OpenCV 5 gives N and N×2
    return np.asarray(ids).reshape(-1), np.asarray(corners, float).reshape(-1, 2) + 0.5, len(quads)


def _camera_tags(path: Path) -> tuple[str, str]:
    """(maker and model, orientation) as EXIF has them."""
    try:
        with open_lazily(path) as image:
            exif = image.getexif()
            make, model, orientation = (str(exif.get(tag, "")).strip("\0 ") for tag in _STATE_TAGS)
            return f"{make} {model}".strip(), orientation
    except Exception:  # the picture has been read; its tags are optional
        return "", ""


def _other_state(state, common) -> str:
    """Describe the first difference of a photograph's camera state from the most common one."""
    names = "a picture of {0[0]} × {0[1]} px", "a camera {0!r}", "an orientation {0!r}", "a focal length of {0} px"
    name, own, most = next(each for each in zip(names, state, common, strict=True) if each[1] != each[2])
    do = "keep one camera, its picture size, zoom and lens, and hold it one way"
    return f"{name.format(own)} where most have {name.format(most)}: {do}"
