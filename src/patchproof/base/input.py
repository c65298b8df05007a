"""Read untrusted JSON and images within size and time limits.

In: a path, or bytes, and the words for a refusal. Out: the content, or one `Refused` whatever makes a decoder fail.
Sizes are checked before memory is allocated, and only formats that hold pictures are opened, because Pillow also opens
some that start other programs. Photographs have limits of their own (`photo.limits`), and so has every archive.

Time is limited by a timer that interrupts Python between two steps, so that a long call into a library ends first,
unless it runs in `run_in_daemon_thread`. Such timers exist on Linux and macOS, in a process's main thread: not on
Windows, and not in the threads of a cluster's workers. Within another time limit, or a profiler's timer, the outer one
applies.
"""

from __future__ import annotations

import io
import json
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

from patchproof.base.errors import Refused, TimeLimitExceeded

if TYPE_CHECKING:
    from PIL.Image import Image

TIME_LIMIT_S = 10.0  # of processor time: a photograph of 119 megapixels takes 4, one of 12 less than 1
_REPEAT_S = 0.5  # until the next interruption, in case a library swallows the first
_POLL_S = 0.1

Params = ParamSpec("Params")
ReturnType = TypeVar("ReturnType")

# an allow-list, because Pillow also opens formats that start other programs (EPS) or hold no photograph
IMAGE_FORMATS = ("JPEG", "MPO", "PNG", "TIFF", "WEBP", "BMP", "GIF", "AVIF", "HEIF")
MAX_IMAGE_PX = 120_000_000  # 360 MB as pixels; the largest phone sensors in common use give 50 to 108 million
MAX_JSON_BYTES = 16 << 20  # a manifest has 0.3 million; nested empty lists take 25 times their text in memory


def is_file(path: str | Path) -> bool:
    """True if there is a file at `path`; False for a path that no system accepts (300 letters, a NUL)."""
    return os.path.isfile(path)


def is_folder(path: str | Path) -> bool:
    """True if there is a folder at `path`; see `is_file`."""
    return os.path.isdir(path)


def read_json(path: str | Path, expected: str, do: str, missing: str = "check the path") -> Any:
    """Read a JSON file; refused with the instruction `do` if it is broken, with `missing` if there is none."""
    path = Path(path)
    if not is_file(path):
        raise Refused(expected, f"no file at {path}", missing)
    try:
        if path.stat().st_size > MAX_JSON_BYTES:
            raise ValueError(f"more than {MAX_JSON_BYTES >> 20} MiB")
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:  # RecursionError: thousands of nested lists
        raise Refused(expected, f"{path} that cannot be read ({error})", do) from error


@contextmanager
def open_image(source: Path | bytes, expected: str, do: str) -> Iterator[Image]:
    """Open a Pillow image from a file or a file's bytes; every error in decoding it is refused with `do`."""
    from PIL import Image

    name = "an image" if isinstance(source, bytes) else source.name
    try:
        stream = io.BytesIO(source) if isinstance(source, bytes) else source
        with Image.open(stream, formats=readable_formats()) as image:
            if image.width * image.height > MAX_IMAGE_PX:
                raise ValueError(f"{image.width} × {image.height} pixels")
            yield image
    except Refused:
        raise
    except Exception as error:  # decoders fail in many ways: OSError, SyntaxError, struct.error...
        reason = " ".join(str(error).split())[:100] or type(error).__name__
        raise Refused(expected, f"{name} that cannot be read ({reason})", do) from error


def readable_formats() -> list[str]:
    """The formats of `IMAGE_FORMATS` that the installed Pillow reads."""
    from PIL import Image

    Image.init()
    return [name for name in IMAGE_FORMATS if name in Image.OPEN]


class _Expired(BaseException):
    """The time is over; a BaseException, so that no `except Exception` in the work catches it."""


def run_within_time(work: Callable[Params, ReturnType], *args: Params.args, **kwargs: Params.kwargs) -> ReturnType:
    """Call `work` and return its result; raises `TimeLimitExceeded` after `TIME_LIMIT_S`."""
    if not has_timer() or signal.getitimer(signal.ITIMER_PROF)[0] > 0:
        return work(*args, **kwargs)
    armed = [True]

    def expire(*_) -> None:
        if armed:
            raise _Expired

    previous_handler = signal.signal(signal.SIGPROF, expire)
    try:
        try:
            signal.setitimer(signal.ITIMER_PROF, TIME_LIMIT_S, _REPEAT_S)
            return work(*args, **kwargs)
        finally:
            armed.clear()
            signal.setitimer(signal.ITIMER_PROF, 0)
    except _Expired:
        armed.clear()  # the interruption may have come just before these two lines in the `finally` above
        signal.setitimer(signal.ITIMER_PROF, 0)
        raise TimeLimitExceeded(TIME_LIMIT_S) from None
    finally:
        signal.signal(signal.SIGPROF, previous_handler)


def run_in_daemon_thread(work: Callable[[], ReturnType]) -> ReturnType:
    """Call `work` in a thread and return its result; an interruption abandons the thread. For calls into libraries that
    cannot be interrupted and share nothing with other work.
    """
    future: Future[ReturnType] = Future()

    def run() -> None:
        try:
            future.set_result(work())
        except BaseException as error:
            future.set_exception(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    while thread.is_alive():
        thread.join(_POLL_S)  # the signal may reach the other thread, and does not wake a thread that waits
    return future.result()


def remaining_seconds() -> float:
    """Processor time that remains in the current time limit; infinite without one."""
    seconds = signal.getitimer(signal.ITIMER_PROF)[0] if has_timer() else 0.0
    return seconds or float("inf")


def has_timer() -> bool:
    """True if work can be interrupted by a timer here: not on Windows, nor outside of the main thread."""
    return hasattr(signal, "setitimer") and threading.current_thread() is threading.main_thread()
