"""The markers of a dictionary that OpenCV knows, and where those of a board lie.

In: a dictionary's name, ids, or a board's rows and columns. Out: modules, and places. A ChArUco board's first square,
top-left, is black; markers lie in the middle of its white squares, with their ids row by row.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from patchproof.sheets.rects import PointMm

DICTIONARY = "DICT_5X5_1000"
MARKER_MODULES = 7  # a 5×5 code and its black border


def aruco_dictionary(dictionary: str):
    """OpenCV's dictionary of that name."""
    import cv2

    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))


def marker_cells(dictionary: str, ids: Iterable[int]) -> np.ndarray:
    """The printed modules M×n×n of marker ids, rim included: 1 = paper, 0 = ink."""
    import cv2

    printed = aruco_dictionary(dictionary)
    side = printed.markerSize + 2
    cells = [cv2.aruco.generateImageMarker(printed, int(i), side) for i in ids]
    return np.array(cells).reshape(-1, side, side).astype(float) / 255


def board_squares(rows: int, columns: int, white: bool) -> list[tuple[int, int]]:
    """(row, column) of a ChArUco board's black squares, or of its white ones in the order of their markers' ids."""
    return [(row, column) for row in range(rows) for column in range(columns) if (row + column) % 2 == white]


def marker_corner(square: tuple[int, int], side: float, marker: float, board: PointMm = (0.0, 0.0)) -> PointMm:
    """x, y of the top-left corner of the marker in the middle of a square (row, column) of that side, on a board whose
    top-left corner is `board`.
    """
    inset, (x, y), (row, column) = (side - marker) / 2, board, square
    return x + column * side + inset, y + row * side + inset
