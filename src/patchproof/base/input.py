"""Read untrusted files, text, JSON, CSV and images within limits of size, time and memory.

In: a path, or bytes, and the words for a refusal. Out: the content, or one `Refused` whatever makes a decoder fail.
Only regular files are opened, and no more of them is read than their size says: pipes wait, devices and some files of
/proc never end. Sizes are checked before memory is allocated. Photographs and archives have limits of their own.

Time is limited by a timer that interrupts Python between two steps, so that a long call into a library ends first,
unless it runs in `run_in_child`. Timers exist on Linux and macOS, in a process's main thread, which a cluster's workers
do not use. Within another time limit, or a profiler's timer, the outer one applies.
"""

import faulthandler
import hashlib
import io
import json
import os
import pickle
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from patchproof.base.errors import Refused, TimeLimitExceeded

if TYPE_CHECKING:
    from PIL.Image import Image

TIME_LIMIT_S = 10.0  # of processor time: a photograph of 119 megapixels takes 4, one of 12 less than 1
_LIMIT_TEXT = "more than {:g} s of processor time"
_REPEAT_S = 0.5  # until the next interruption, in case a library swallows the first

ReturnType = TypeVar("ReturnType")

# an allow-list, because Pillow also opens formats that start other programs (EPS) or hold no photograph
IMAGE_FORMATS = ("JPEG", "MPO", "PNG", "TIFF", "WEBP", "BMP", "GIF", "AVIF", "HEIF")
MAX_JSON_BYTES = 16 << 20  # of any text: a manifest has 0.3 million; nested empty lists take 25 times that in memory
MAX_IMAGE_PX = 120_000_000  # 360 MB as pixels; the largest phone sensors in common use give 50 to 108 million
MAX_FILE_BYTES = 1 << 30  # of one file, where its kind has no limit of its own
MAX_CHILD_BYTES = 1_200_000_000  # more memory than a child has at its start: 140 megapixels took 0.9 GB in all


# False for a path that no system accepts (300 letters, a NUL), at which those of pathlib raise an error
is_file, is_folder = os.path.isfile, os.path.isdir


def file_size(path: str | Path, max_bytes: int = MAX_FILE_BYTES) -> int:
    """Return the size of a regular file; an OSError for anything else that is at `path`, and beyond `max_bytes`."""
    if not is_file(path):
        raise FileNotFoundError(f"no file at {path}")
    if (size := os.path.getsize(path)) > max_bytes:
        raise OSError(f"{size >> 10} KiB, more than {max_bytes >> 10} KiB")
    return size


def read_file(
    path: str | Path, expected: str, do: str = "check the path", max_bytes: int = MAX_FILE_BYTES, missing: str = ""
) -> bytes:
    """Read a regular file; refused if there is none (with the instruction `missing`), or beyond `max_bytes`."""
    try:
        if not (size := file_size(path, max_bytes)):
            return b""  # or a file of the system's, of which some wait
        with open(path, "rb") as file:
            return file.read(size)
    except FileNotFoundError as error:
        raise Refused(expected, f"no file at {path}", missing or do) from error
    except (OSError, MemoryError) as error:
        raise Refused(expected, f"{path} that cannot be read ({error})", do) from error


def hash_file(path: str | Path, max_bytes: int = MAX_FILE_BYTES) -> str:
    """SHA-256 of a regular file; see `read_file`."""
    return hashlib.sha256(read_file(path, "a file", max_bytes=max_bytes)).hexdigest()


def read_text(
    path: str | Path, expected: str, do: str = "correct it", missing: str = "check the path", max_bytes=MAX_JSON_BYTES
) -> str:
    """Read a text file without its byte order mark; refused as by `read_file`, and if it is not UTF-8."""
    content, do_save = read_file(path, expected, do, max_bytes, missing), "save it as UTF-8"
    even, odd = (content[start:200:2].count(0) for start in (0, 1))
    if content.startswith((b"\xff\xfe", b"\xfe\xff")) or (min(even, odd) == 0 and max(even, odd) > 1):
        raise Refused(f"{expected} in UTF-8", f"{path} in UTF-16", do_save)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        byte = content[error.start : error.start + 1]
        got = f'{path}, whose line {line} has the byte 0x{byte.hex()} ("{byte.decode("latin-1")}" in Latin-1)'
        raise Refused(f"{expected} in UTF-8", got, do_save) from error


def read_json(path: str | Path, expected: str, do: str, missing: str = "check the path") -> Any:
    """Read a JSON file; refused with the instruction `do` if it is broken, with `missing` if there is none."""
    text = read_text(path, expected, do, missing)
    try:
        return json.loads(text)
    except (ValueError, RecursionError, MemoryError) as error:  # RecursionError: thousands of nested lists
        raise Refused(expected, f"{path} that cannot be read ({error})", do) from error


@contextmanager
def open_image(source: Path | bytes, expected: str, do: str) -> "Iterator[Image]":
    """Open a Pillow image from a file or a file's bytes; every error in decoding it is refused with `do`."""
    name = "an image" if isinstance(source, bytes) else source.name
    try:
        with open_lazily(source) as image:
            if image.width * image.height > MAX_IMAGE_PX:
                raise ValueError(f"{image.width} × {image.height} pixels")
            yield image
    except Refused:
        raise
    except Exception as error:  # decoders fail in many ways: OSError, SyntaxError, struct.error...
        reason = " ".join(str(error).split())[:100] or type(error).__name__
        raise Refused(expected, f"{name} that cannot be read ({reason})", do) from error


def open_lazily(source: Path | bytes) -> "Image":
    """Open a picture with Pillow, which decodes it later; errors are Pillow's, and an OSError for what is no file."""
    from PIL import Image

    if not isinstance(source, bytes) and not file_size(source, 1 << 62):
        raise OSError("an empty file")  # or one of the system's, of which Pillow would not see the end
    Image.init()
    formats = [name for name in IMAGE_FORMATS if name in Image.OPEN]
    image = Image.open(io.BytesIO(source) if isinstance(source, bytes) else source, formats=formats)
    image.filename = ""  # or Pillow would map the file's memory, and read the rows of turned TIFFs at a wrong length
    return image


class _Expired(BaseException):
    """The time is over; a BaseException, so that no `except Exception` in the work catches it."""


def run_within_seconds(seconds: float, work: Callable[[], ReturnType]) -> ReturnType:
    """Call `work` and return its result; raises `TimeLimitExceeded` after `seconds` of processor time."""
    if not has_timer() or signal.getitimer(signal.ITIMER_PROF)[0] > 0:
        return work()
    armed = [True]

    def expire(*_) -> None:
        if armed:
            raise _Expired

    previous_handler = signal.signal(signal.SIGPROF, expire)
    try:
        try:
            signal.setitimer(signal.ITIMER_PROF, seconds, _REPEAT_S)
            return work()
        finally:
            armed.clear()
            signal.setitimer(signal.ITIMER_PROF, 0)
    except _Expired:
        armed.clear()  # the interruption may have come just before these two lines in the `finally` above
        signal.setitimer(signal.ITIMER_PROF, 0)
        raise TimeLimitExceeded(_LIMIT_TEXT.format(seconds)) from None
    finally:
        signal.signal(signal.SIGPROF, previous_handler)


def run_in_child(work: Callable[[], ReturnType]) -> ReturnType:
    """Call `work` in a forked process (in this one except on Linux) and return its result. Raises `TimeLimitExceeded`
    after `TIME_LIMIT_S`, MemoryError beyond `MAX_CHILD_BYTES` or if the process dies.
    """
    if sys.platform != "linux":
        return run_within_seconds(TIME_LIMIT_S, work)
    receiver, sender = os.pipe()
    with warnings.catch_warnings(action="ignore"):  # of a fork with other threads: the child uses none of their locks
        child = os.fork()  # multiprocessing allows none in the workers of a cluster
    if child == 0:
        os.close(receiver)  # a child that had it, too, would wait for ever to write to a parent that was killed
        _send_result(work, sender)
    os.close(sender)
    try:
        with open(receiver, "rb") as file:
            stored = file.read()
    finally:
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
    try:
        result, error = pickle.loads(stored)
    except (EOFError, pickle.UnpicklingError):
        if os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGPROF:
            raise TimeLimitExceeded(_LIMIT_TEXT.format(TIME_LIMIT_S)) from None
        raise MemoryError("more memory than it may take") from None
    if error is not None:
        raise error
    return result


def _send_result(work: Callable[[], Any], sender: int) -> NoReturn:
    """Do the work of a child: the system ends it, even within a library, when its time is over."""
    import resource

    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGPROF, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_PROF, TIME_LIMIT_S)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # libraries say a lot before they abort
        faulthandler.disable()
        try:
            with limit_memory(MAX_CHILD_BYTES):
                answer = work(), None
        except Exception as error:
            answer = None, error
        with open(sender, "wb") as file:
            pickle.dump(answer, file, 5)
    finally:
        os._exit(0)


@contextmanager
def limit_memory(max_bytes: int) -> Iterator[None]:
    """Within the block `max_bytes` more than before can be allocated; beyond that, mostly a MemoryError is raised."""
    if not has_timer() or not is_file("/proc/self/statm"):
        yield
        return
    import resource

    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    limit = pages * os.sysconf("SC_PAGE_SIZE") + max_bytes
    if soft == resource.RLIM_INFINITY or limit < soft:
        resource.setrlimit(resource.RLIMIT_AS, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def remaining_seconds() -> float:
    """Processor time that remains in the current time limit; infinite without one."""
    return (signal.getitimer(signal.ITIMER_PROF)[0] if has_timer() else 0) or float("inf")


def has_timer() -> bool:
    """True if work can be interrupted by a timer here: not on Windows, nor outside of the main thread."""
    return hasattr(signal, "setitimer") and threading.current_thread() is threading.main_thread()
