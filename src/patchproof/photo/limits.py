"""What a photograph may cost: ten seconds of processor time, and a gigabyte of memory to be read.

In: work on a photograph. Out: its result, or `PhotoRejected("too_costly")`. A long call into a library is seen through
before the time is over (`input.within_time`), so those that a picture could make endless are not made where
`squares_in` or `finder_lines_in` count too many. Memory is limited where the kernel says how much there is of it: on
Linux.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from patchproof.base.errors import TimeLimitExceeded
from patchproof.base.input import Arguments, ReturnType, has_timer, within_time
from patchproof.photo.rejection import PhotoRejected

MOST_BYTES = 1_000_000_000  # 119 megapixels take 0.5 GB while they are read
_SPARSE = 4  # rows of which one is looked at
_NOISY = 4  # times the edges that so many squares have


def run_limited(
    work: Callable[Arguments, ReturnType], *arguments: Arguments.args, **keywords: Arguments.kwargs
) -> ReturnType:
    """What `work` returns; `PhotoRejected("too_costly")` when it takes longer than `within_time` allows."""
    try:
        return within_time(work, *arguments, **keywords)
    except TimeLimitExceeded as over:
        raise PhotoRejected(
            "too_costly", None, over.seconds, f"it takes {over}: save it smaller, or leave it out"
        ) from None


@contextmanager
def limited_memory() -> Iterator[None]:
    """Inside, `MOST_BYTES` more than now can be had; beyond them allocations fail, mostly as MemoryError."""
    if not has_timer() or not Path("/proc/self/statm").is_file():
        yield
        return
    import resource

    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    most = pages * os.sysconf("SC_PAGE_SIZE") + MOST_BYTES
    if soft == resource.RLIM_INFINITY or most < soft:
        resource.setrlimit(resource.RLIMIT_AS, (most, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def squares_in(gray: np.ndarray, perimeter_px: float = 36, most: int = 0) -> int:
    """How many dark or light squares of that perimeter or more a detector of markers would have to look into, of uint8
    H×W; 0 where so many edges of pixels are too few for more than `most`, which spares following them.
    """
    dark = cv2.adaptiveThreshold(gray, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, 13, 3)
    edges = edges_in(dark)
    if edges <= most * perimeter_px:
        return 0
    # noise: specks have outlines that are too short, and are most of them; a few are sooner followed than taken off
    if most and edges > _NOISY * most * perimeter_px:
        _, labels, stats, _ = cv2.connectedComponentsWithStats(dark)
        large = np.asarray(stats)[:, cv2.CC_STAT_AREA] >= perimeter_px / 2
        large[0] = False  # what is not dark
        dark = large.view(np.uint8)[labels.astype(np.int32, copy=False)]
        if edges_in(dark) <= most * perimeter_px:
            return 0
    outlines, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    polygons = (cv2.approxPolyDP(o, 0.03 * len(o), True) for o in outlines if len(o) >= perimeter_px)
    return sum(len(polygon) == 4 for polygon in polygons)


def edges_in(mask: np.ndarray) -> int:
    """How many edges of pixels lie between 0 and anything else, with 0 all round: each point of an outline has one."""
    mask = cv2.copyMakeBorder((mask != 0).view(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    return int(np.count_nonzero(mask[1:] != mask[:-1]) + np.count_nonzero(mask[:, 1:] != mask[:, :-1]))


def finder_lines_in(gray: np.ndarray) -> int:
    """About how many stretches of rows look like the middle of a QR code's finder pattern (runs of 1:1:3:1:1)."""
    light = cv2.adaptiveThreshold(gray, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY, 83, 2)[::_SPARSE]
    runs = np.diff(np.flatnonzero(np.diff(light.reshape(-1)))).astype(np.float32)
    if len(runs) < 5:
        return 0
    five = np.lib.stride_tricks.sliding_window_view(runs, 5)
    away = np.abs(five / five.sum(1, keepdims=True) - np.array([1, 1, 3, 1, 1], np.float32) / 7).sum(1)
    return _SPARSE * int((away < 0.2).sum())  # as OpenCV's detector has it
