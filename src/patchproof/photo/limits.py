"""What a photograph may cost: ten seconds of processor time, and a gigabyte of memory to be read.

In: work on a photograph. Out: its result, or `CannotJudge("too_costly")`. A timer interrupts the work between two steps
of Python, so that a long call into a library is seen through first; those that a picture could make endless are not
made where `squares_in` or `finder_lines_in` count too many. There are such timers on Linux and macOS, in a process's
main thread: not on Windows, and not in the threads of a cluster's workers. Memory is limited where the kernel says how
much there is of it: on Linux. Inside another limit, or a profiler's timer, that one counts.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import ParamSpec, TypeVar

import cv2
import numpy as np

from patchproof.photo.cannot import CannotJudge

SECONDS = 10.0  # of processor time: a photograph of 119 megapixels takes 7.6, one of 12 less than 1
MOST_BYTES = 1_000_000_000  # 119 megapixels take 0.85 GB while they are read
_AGAIN_S = 0.5  # should a library swallow the first interruption
_SPARSE = 4  # rows of which one is looked at
_SMALLEST_SQUARE_PX = 36  # perimeter of the least marker that is read

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


class _Expired(BaseException):
    """The time is over; no `except Exception` on the way may think otherwise."""


def limited(work: Callable[Arguments, Result], *arguments: Arguments.args, **keywords: Arguments.kwargs) -> Result:
    """What `work` returns; `CannotJudge("too_costly")` when it has taken `SECONDS` of this process's time."""
    if not _has_timer() or signal.getitimer(signal.ITIMER_PROF)[0] > 0:
        return work(*arguments, **keywords)
    armed = [True]

    def expire(*_) -> None:
        if armed:
            raise _Expired

    before = signal.signal(signal.SIGPROF, expire)
    try:
        try:
            signal.setitimer(signal.ITIMER_PROF, SECONDS, _AGAIN_S)
            return work(*arguments, **keywords)
        finally:
            armed.clear()
            signal.setitimer(signal.ITIMER_PROF, 0)
    except _Expired:
        armed.clear()  # it may have come just before the same two lines above
        signal.setitimer(signal.ITIMER_PROF, 0)
        advice = f"it takes more than {SECONDS:g} s of processor time: save it smaller, or leave it out"
        raise CannotJudge("too_costly", None, SECONDS, advice) from None
    finally:
        signal.signal(signal.SIGPROF, before)


@contextmanager
def limited_memory() -> Iterator[None]:
    """Inside, `MOST_BYTES` more than now can be had; beyond them allocations fail, mostly as MemoryError."""
    if not _has_timer() or not Path("/proc/self/statm").is_file():
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


def squares_in(gray: np.ndarray) -> int:
    """How many dark or light squares a detector of markers would have to look into, of uint8 H×W."""
    dark = cv2.adaptiveThreshold(gray, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, 13, 3)
    outlines, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    polygons = (cv2.approxPolyDP(o, 0.03 * len(o), True) for o in outlines if len(o) >= _SMALLEST_SQUARE_PX)
    return sum(len(polygon) == 4 for polygon in polygons)


def finder_lines_in(gray: np.ndarray) -> int:
    """About how many stretches of rows look like the middle of a QR code's finder pattern (runs of 1:1:3:1:1)."""
    light = cv2.adaptiveThreshold(gray, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY, 83, 2)[::_SPARSE]
    runs = np.diff(np.flatnonzero(np.diff(light.reshape(-1)))).astype(np.float32)
    if len(runs) < 5:
        return 0
    five = np.lib.stride_tricks.sliding_window_view(runs, 5)
    away = np.abs(five / five.sum(1, keepdims=True) - np.array([1, 1, 3, 1, 1], np.float32) / 7).sum(1)
    return _SPARSE * int((away < 0.2).sum())  # as OpenCV's detector has it


def _has_timer() -> bool:
    return hasattr(signal, "setitimer") and threading.current_thread() is threading.main_thread()
