"""ArUco markers of OpenCV's dictionaries, and their places on a ChArUco board.

In: a dictionary's name, ids, or a board's rows and columns. Out: modules, and places. A board's first square, top-left,
is black; markers lie in the middle of its white squares, with their ids row by row.
"""

from collections.abc import Iterable

import numpy as np

from patchproof.sheets.rects import PointMm

DICTIONARY = "DICT_5X5_1000"
MARKER_MODULES = 7  # a 5×5 code and its black border


def aruco_dictionary(dictionary: str):
    """OpenCV's dictionary by its name."""
    import cv2

    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))


def marker_cells(dictionary: str, ids: Iterable[int]) -> np.ndarray:
    """The modules M×n×n of marker ids, including the black border: 1 = paper, 0 = ink."""
    import cv2

    aruco = aruco_dictionary(dictionary)
    side = aruco.markerSize + 2
    cells = [cv2.aruco.generateImageMarker(aruco, int(i), side) for i in ids]
    return np.array(cells).reshape(-1, side, side).astype(float) / 255


def board_squares(rows: int, columns: int, white: bool) -> list[tuple[int, int]]:
    """(row, column) of a ChArUco board's black squares, or of its white ones in the order of their markers' ids."""
    return [(row, column) for row in range(rows) for column in range(columns) if (row + column) % 2 == white]


def marker_corner(square: tuple[int, int], side: float, marker: float, board: PointMm = (0.0, 0.0)) -> PointMm:
    """Top-left corner (x, y) of the marker in a square (row, column), on a board with its top-left corner at `board`;
    `side` and `marker` are the sides of squares and markers.
    """
    inset, (x, y), (row, column) = (side - marker) / 2, board, square
    return x + column * side + inset, y + row * side + inset
