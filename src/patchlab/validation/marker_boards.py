"""Find boards of markers in photographs: where each printed square lies, and each pixel's share of paper.

In: a uint8 photograph and the `BoardSettings` of its board. Out: a `BoardPose`: every printed square with its
homography to the photograph, and the mask of pixels with a known pattern, which are those of found markers and of the
squares between them. A grid and a ChArUco board lie in one plane; if its homography misses the markers' corners by too
much, `PhotoRejected`. Every loose marker has its own plane. Left out on purpose: bent boards. `shift_squares` follows
lens distortion and paper that is not quite flat.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import cv2
import numpy as np
from pydantic import Field, model_validator

from patchproof.base.geometry import apply_homography, fit_homography, rect_corners
from patchproof.base.resample import index_homography, to_sixteenths
from patchproof.base.validation import NotNegative, StrictModel
from patchproof.photo.detect import find_markers
from patchproof.photo.rectify import fit_page, region_around
from patchproof.photo.rejection import PhotoRejected
from patchproof.sheets.markers import board_squares, marker_cells, marker_corner

MIN_MARKERS = 4  # of a grid or a ChArUco board: two allow planes that are far off
# Largest root mean square distance of corners from the plane, in modules. In 25 photographs of flat boards it was 0.02
# to 0.17.
MAX_MISFIT_MODULES = 0.2
_SAMPLES = 8  # samples along each side of a pixel
_QUIET_ZONE = 1 / 8  # of a loose marker's side: paper around it must be white, or it is not found
UNIT_SQUARE = rect_corners((0, 0, 1, 1))


class BoardSettings(StrictModel):
    """Photographs, and the board in each of them."""

    photos: Annotated[tuple[str, ...], Field(min_length=1)]  # files, or folders of them
    kind: Literal["grid", "charuco", "loose"]  # ChArUco: black squares between the markers; loose: a plane for each
    dictionary: str = "DICT_6X6_250"  # OpenCV's name of the markers' dictionary
    rows: Annotated[int, Field(ge=1, le=100)] = 1  # of markers in a grid, of squares in a ChArUco board
    columns: Annotated[int, Field(ge=1, le=100)] = 1  # of markers in a grid, of squares in a ChArUco board
    gap: NotNegative = 0.0  # white between two markers, in marker sides; a ChArUco board's square is 1 + gap
    ids: tuple[Annotated[int, Field(ge=0, le=1023)], ...] = ()  # row by row; by default 0, 1, 2, ...

    @model_validator(mode="after")
    def _as_many_ids_as_places(self):
        if not hasattr(cv2.aruco, self.dictionary):
            raise ValueError(f"dictionary takes a name that OpenCV knows, such as DICT_6X6_250, not {self.dictionary}")
        if self.kind == "loose" and not self.ids:
            raise ValueError("loose markers take ids")
        if self.kind != "loose" and len(self.ids) not in (0, len(self.marker_places)):
            raise ValueError(f"ids takes one for each of the {len(self.marker_places)} markers, or none")
        return self

    @property
    def marker_places(self) -> tuple[tuple[int, int], ...]:
        """(row, column) of every marker of a grid or ChArUco board, in the order of the ids."""
        if self.kind == "grid":
            return tuple(np.ndindex(self.rows, self.columns))
        return tuple(board_squares(self.rows, self.columns, white=True))

    @property
    def marker_ids(self) -> tuple[int, ...]:
        """The markers' ids in order."""
        return self.ids or tuple(range(len(self.marker_places)))


@dataclass(frozen=True)
class PrintedSquare:
    """A printed square: modules n×n (1 = paper, 0 = ink), and the homography from the unit square to pixels.

    `area_px` K×4×2 are quadrilaterals around it with a known pattern; K is 0 where the square may be hidden.
    """

    cells: np.ndarray
    px_from_unit: np.ndarray
    area_px: np.ndarray
    is_marker: bool = True

    @property
    def corners_px(self) -> np.ndarray:
        """The square's corners 4×2 in pixels."""
        return apply_homography(self.px_from_unit, UNIT_SQUARE)


@dataclass(frozen=True)
class BoardPose:
    """The printed squares in a photograph; `misfit_px` is the root mean square distance of corners from the plane (None
    for loose markers), `module_px` the median side of a module.
    """

    prints: tuple[PrintedSquare, ...]
    found: int
    expected: int
    misfit_px: float | None
    module_px: float

    def mask(self, shape: tuple[int, ...]) -> np.ndarray:
        """H×W bool: the pixels with a known pattern."""
        filled = np.zeros(shape[:2], np.uint8)
        for printed in self.prints:
            for quad in printed.area_px:
                cv2.fillConvexPoly(filled, to_sixteenths(quad), 1, cv2.LINE_8, 4)
        return filled > 0


def find_board(srgb: np.ndarray, board: BoardSettings) -> BoardPose:
    """Find the board in a uint8 photograph; `PhotoRejected` if there are too few markers or no plane fits them."""
    detected = find_markers(srgb, set(board.marker_ids), dictionary=board.dictionary)
    least = 1 if board.kind == "loose" else min(MIN_MARKERS, len(board.marker_ids))
    if len(detected.markers) < least:
        advice = f"{len(detected.markers)} markers of {board.dictionary} with the board's ids were found"
        raise PhotoRejected("too_few_markers", len(detected.markers), least, advice)
    corners_px = detected.corners_px
    module_px = float(np.median([borders.module_px for borders in detected.markers.values()]))
    if board.kind == "loose":
        prints, misfit_px = _loose_markers(board, corners_px), None
    else:
        px_from_board, misfit_px = _fit_plane(board, corners_px, module_px)
        prints = _board_squares(board, px_from_board, set(corners_px))
    return BoardPose(prints, len(corners_px), len(board.marker_ids), misfit_px, module_px)


def _fit_plane(
    board: BoardSettings, corners_px: Mapping[int, np.ndarray], module_px: float
) -> tuple[np.ndarray, float]:
    """The homography from the board, in marker sides, and its misfit in pixels."""
    corners = {
        i: rect_corners((*marker_corner(at, 1 + board.gap, 1), 1, 1))
        for i, at in zip(board.marker_ids, board.marker_places, strict=True)
    }
    fit = fit_page(corners_px, corners)
    misses = [corners_px[i] - apply_homography(fit.px_from_mm, corners[i]) for i in corners_px]
    misfit_px = float(np.sqrt((np.concatenate(misses) ** 2).sum(1).mean()))
    if misfit_px > MAX_MISFIT_MODULES * module_px:
        advice = f"no plane fits: corners lie {misfit_px:.2f} px off it, a module is {module_px:.1f} px"
        raise PhotoRejected("curled", misfit_px, MAX_MISFIT_MODULES * module_px, advice)
    return fit.px_from_mm, misfit_px


def _board_squares(board: BoardSettings, px_from_board: np.ndarray, found: set[int]) -> tuple[PrintedSquare, ...]:
    """All markers and black squares. The pattern is known around a found marker up to half the gap, and in a black
    square if all markers beside it were found, since then nothing hides it.
    """
    grown, half = 1 + board.gap, board.gap / 2
    clear = {at for number, at in zip(board.marker_ids, board.marker_places, strict=True) if number in found}
    prints = []
    for at, modules in zip(board.marker_places, marker_cells(board.dictionary, board.marker_ids), strict=True):
        x, y = marker_corner(at, grown, 1)
        area = _square_area(board, px_from_board, at, (x - half, y - half, grown)) if at in clear else []
        prints.append(_printed_square(modules, px_from_board, (x, y, 1), area))
    for at in board_squares(board.rows, board.columns, white=False) if board.kind == "charuco" else ():
        square = at[1] * grown, at[0] * grown, grown
        beside = {(at[0] + down, at[1] + right) for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1))}
        area = _square_area(board, px_from_board, at, square) if beside & set(board.marker_places) <= clear else []
        prints.append(replace(_printed_square(np.zeros((1, 1)), px_from_board, square, area), is_marker=False))
    return tuple(prints)


def _square_area(
    board: BoardSettings, px_from_board, at: tuple[int, ...], square: tuple[float, float, float]
) -> np.ndarray:
    """A square 1×4×2 in pixels; outer squares of a ChArUco board include some paper around the board."""
    low, high = np.array(square[:2]), np.array(square[:2]) + square[2]
    if board.kind == "charuco":
        last = board.columns - 1, board.rows - 1
        low = low - [_QUIET_ZONE * (place == 0) for place in at[::-1]]
        high = high + [_QUIET_ZONE * (place == end) for place, end in zip(at[::-1], last, strict=True)]
    return apply_homography(px_from_board, rect_corners((*low, *(high - low))))[None]


def _printed_square(
    cells: np.ndarray, px_from_board: np.ndarray, square: tuple[float, float, float], area
) -> PrintedSquare:
    x, y, side = square
    place = np.array([[side, 0, x], [0, side, y], [0, 0, 1.0]])
    return PrintedSquare(cells, px_from_board @ place, np.reshape(area, (-1, 4, 2)))


def _loose_markers(board: BoardSettings, corners_px: Mapping[int, np.ndarray]) -> tuple[PrintedSquare, ...]:
    ids, prints, side = sorted(corners_px), [], 1 + 2 * _QUIET_ZONE
    for number, cells in zip(ids, marker_cells(board.dictionary, ids), strict=True):
        px_from_unit = fit_homography(UNIT_SQUARE, corners_px[number])
        area = apply_homography(px_from_unit, rect_corners((-_QUIET_ZONE, -_QUIET_ZONE, side, side)))
        prints.append(PrintedSquare(cells, px_from_unit, area[None]))
    return tuple(prints)


def shift_squares(
    prints: Sequence[PrintedSquare], shift_px: Callable[[np.ndarray], np.ndarray]
) -> tuple[PrintedSquare, ...]:
    """The squares with their corners moved by `shift_px`, a function from N×2 pixels to N×2 shifts."""
    out = []
    for printed in prints:
        corners = printed.corners_px
        out.append(replace(printed, px_from_unit=fit_homography(UNIT_SQUARE, corners + shift_px(corners))))
    return tuple(out)


def paper_share(prints: Sequence[PrintedSquare], shape: tuple[int, ...]) -> np.ndarray:
    """H×W float32: the share of paper in each pixel, from 8 × 8 samples; around the squares all is paper."""
    share = np.ones(shape[:2], np.float32)
    for printed in prints:
        box = region_around(printed.corners_px, 1, shape)
        top, left, n = box[0].start, box[1].start, len(printed.cells)
        size = box[1].stop - left, box[0].stop - top
        to_fine = np.array([[_SAMPLES, 0, -_SAMPLES * left], [0, _SAMPLES, -_SAMPLES * top], [0, 0, 1.0]])
        matrix = index_homography(to_fine @ printed.px_from_unit @ np.diag([1 / n, 1 / n, 1]))
        ink = (1 - printed.cells).astype(np.float32)
        fine = cv2.warpPerspective(ink, matrix, (size[0] * _SAMPLES, size[1] * _SAMPLES), flags=cv2.INTER_NEAREST)
        share[box] -= cv2.resize(fine, size, interpolation=cv2.INTER_AREA)
    return np.maximum(share, 0)
