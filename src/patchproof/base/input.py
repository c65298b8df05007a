"""Files that anybody may have made, read within bounds: JSON, pictures, and time.

In: a path, or bytes, and what is expected there. Out: its content, or one `Refused`, whatever a decoder stumbles over.
Sizes are looked at before memory is taken, and of pictures only formats are opened that hold pictures: Pillow knows
some that start other programs. Photographs have limits of their own (`photo.limits`), and so has every archive.

Time is limited by a timer that interrupts the work between two steps of Python, so that a long call into a library is
seen through first, unless it is `left_behind`. There are such timers on Linux and macOS, in a process's main thread:
not on Windows, and not in the threads of a cluster's workers. Inside another limit, or a profiler's timer, that one
counts.
"""

from __future__ import annotations

import io
import json
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

from patchproof.base.errors import Refused, TimeLimitExceeded

if TYPE_CHECKING:
    from PIL.Image import Image

SECONDS = 10.0  # of processor time: a photograph of 119 megapixels takes 4, one of 12 less than 1
_AGAIN_S = 0.5  # should a library swallow the first interruption
_LOOK_S = 0.1

Arguments = ParamSpec("Arguments")
ReturnType = TypeVar("ReturnType")

# an allow-list, because Pillow also opens formats that start other programs (EPS) or hold no photograph
IMAGE_FORMATS = ("JPEG", "MPO", "PNG", "TIFF", "WEBP", "BMP", "GIF", "AVIF", "HEIF")
MAX_IMAGE_PX = 120_000_000  # 360 MB as pixels; the largest phone sensors in common use give 50 to 108 million
MAX_JSON_BYTES = 16 << 20  # bytes; a manifest has 0.3 million, and lists of nothing take 25 times their text in memory


def is_file(path: str | Path) -> bool:
    """Whether a file is there; at a path that no system takes (300 letters, a NUL) there is none."""
    return os.path.isfile(path)


def is_folder(path: str | Path) -> bool:
    """Whether a folder is there; see `is_file`."""
    return os.path.isdir(path)


def read_json(path: str | Path, expected: str, do: str, missing: str = "check the path") -> Any:
    """A JSON file's content; refused with `do` where it is broken, with `missing` where there is none."""
    path = Path(path)
    if not is_file(path):
        raise Refused(expected, f"no file at {path}", missing)
    try:
        if path.stat().st_size > MAX_JSON_BYTES:
            raise ValueError(f"more than {MAX_JSON_BYTES >> 20} MiB")
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:  # RecursionError: thousands of lists in each other
        raise Refused(expected, f"{path} that cannot be read ({error})", do) from error


@contextmanager
def open_image(source: Path | bytes, expected: str, do: str) -> Iterator[Image]:
    """A Pillow image of a file, or of a file's bytes; what fails in decoding it is refused with `do`."""
    from PIL import Image

    where = "one" if isinstance(source, bytes) else f"{source.name}"
    try:
        opened = io.BytesIO(source) if isinstance(source, bytes) else source
        with Image.open(opened, formats=readable_formats()) as image:
            if image.width * image.height > MAX_IMAGE_PX:
                raise ValueError(f"{image.width} × {image.height} pixels")
            yield image
    except Refused:
        raise
    except Exception as error:  # decoders fail in many ways (OSError, SyntaxError, struct.error...), all alike here
        reason = " ".join(str(error).split())[:100] or type(error).__name__
        raise Refused(expected, f"{where} that cannot be read ({reason})", do) from error


def readable_formats() -> list[str]:
    """Those of `IMAGE_FORMATS` that this Pillow reads."""
    from PIL import Image

    Image.init()
    return [name for name in IMAGE_FORMATS if name in Image.OPEN]


class _Expired(BaseException):
    """The time is over; no `except Exception` on the way may think otherwise."""


def within_time(
    work: Callable[Arguments, ReturnType], *arguments: Arguments.args, **keywords: Arguments.kwargs
) -> ReturnType:
    """What `work` returns; `TimeLimitExceeded` when it takes too long."""
    if not has_timer() or signal.getitimer(signal.ITIMER_PROF)[0] > 0:
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
        raise TimeLimitExceeded(SECONDS) from None
    finally:
        signal.signal(signal.SIGPROF, before)


def left_behind(work: Callable[[], ReturnType]) -> ReturnType:
    """What `work` returns, done in a thread that an interruption leaves to itself: for libraries that take what time
    they like, and whose results nobody else uses.
    """
    done: list[ReturnType] = []
    failed: list[BaseException] = []

    def run() -> None:
        try:
            done.append(work())
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    while thread.is_alive():
        thread.join(_LOOK_S)  # the signal may reach the other thread, and wakes none that waits
    if failed:
        raise failed[0]
    return done[0]


def seconds_left() -> float:
    """Of processor time in the limit that counts; without one there is no end."""
    left = signal.getitimer(signal.ITIMER_PROF)[0] if has_timer() else 0.0
    return left or float("inf")


def has_timer() -> bool:
    """Whether work can be interrupted here."""
    return hasattr(signal, "setitimer") and threading.current_thread() is threading.main_thread()
