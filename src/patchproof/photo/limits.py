"""Limit the work on a photograph to ten seconds of processor time.

Calls into a library cannot be interrupted (`input.run_within_seconds`), so those that some pictures would make endless
are skipped if `find_squares` or `count_finder_lines` count too many.
"""

from collections.abc import Callable
from functools import partial
from typing import ParamSpec

import cv2
import numpy as np

from patchproof.base import input as bounds
from patchproof.base.errors import TimeLimitExceeded
from patchproof.base.input import ReturnType
from patchproof.photo.rejection import PhotoRejected

Params = ParamSpec("Params")

MOST_BYTES = 1_000_000_000  # of a file, and of memory to read it: 119 megapixels take 0.5 GB
_ROW_STEP = 4  # rows of which one is examined
_NOISE_EDGES = 2_600_000  # with more, taking specks off costs less than following their outlines


def run_limited(work: Callable[Params, ReturnType], *args: Params.args, **kwargs: Params.kwargs) -> ReturnType:
    """Call `work` and return its result; raises `PhotoRejected("too_costly")` after `TIME_LIMIT_S`."""
    try:
        return bounds.run_within_seconds(bounds.TIME_LIMIT_S, partial(work, *args, **kwargs))
    except TimeLimitExceeded as error:
        advice = f"it takes {error}: save it smaller, or leave it out"
        raise PhotoRejected("too_costly", None, bounds.TIME_LIMIT_S, advice) from None


def find_squares(gray: np.ndarray, perimeter_px: float = 36, window_px: int = 13) -> np.ndarray:
    """Corners Q×4×2 px, clockwise, of the squares in uint8 H×W that a marker detector examines at this window."""
    dark = cv2.adaptiveThreshold(gray, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, window_px, 3)
    if count_edges(dark) > _NOISE_EDGES:  # most outlines of noise are those of specks, too short for a square
        _, labels, stats, _ = cv2.connectedComponentsWithStats(dark)
        large = np.asarray(stats)[:, cv2.CC_STAT_AREA] >= perimeter_px / 2
        large[0] = False  # the background
        dark = large.view(np.uint8)[labels.astype(np.int32, copy=False)]
    outlines, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    polygons = (cv2.approxPolyDP(o, 0.03 * len(o), True) for o in outlines if len(o) >= perimeter_px)
    quads = np.array([polygon for polygon in polygons if len(polygon) == 4], float).reshape(-1, 4, 2)
    diagonals = quads[:, 2:] - quads[:, :2]
    clockwise = diagonals[:, 0, 0] * diagonals[:, 1, 1] > diagonals[:, 0, 1] * diagonals[:, 1, 0]
    return np.where(clockwise[:, None, None], quads, quads[:, ::-1])


def count_edges(mask: np.ndarray) -> int:
    """Count the pixel edges between 0 and nonzero, with 0 all around: an outline has at least one for each point."""
    mask = cv2.copyMakeBorder((mask != 0).view(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    return int(np.count_nonzero(mask[1:] != mask[:-1]) + np.count_nonzero(mask[:, 1:] != mask[:, :-1]))


def count_finder_lines(gray: np.ndarray) -> int:
    """Estimate the number of stretches of rows that look like a QR code's finder pattern (runs of 1:1:3:1:1)."""
    light = cv2.adaptiveThreshold(gray, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY, 83, 2)[::_ROW_STEP]
    runs = np.diff(np.flatnonzero(np.diff(light.reshape(-1)))).astype(np.float32)
    if len(runs) < 5:
        return 0
    five = np.lib.stride_tricks.sliding_window_view(runs, 5)
    deviation = np.abs(five / five.sum(1, keepdims=True) - np.array([1, 1, 3, 1, 1], np.float32) / 7).sum(1)
    return _ROW_STEP * int((deviation < 0.2).sum())  # the tolerance of OpenCV's detector
