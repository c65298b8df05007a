"""What reading a file may do: so much processor time and memory, and nothing outside of its folder."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import sys
import tempfile
from pathlib import Path

SECONDS, MOST_BYTES = 11.0, 1_000_000_000  # a photograph is given up after 10 s, between two steps of Python
_CAN_BE_HAD = 2_000_000_000  # bytes, beyond which allocations fail


class Watch:
    """Files opened for writing outside of a folder, processes, sockets; a hook stays for good, so it has a switch. What
    a forked process does comes through a pipe; forking itself is allowed.
    """

    WRITES = re.compile(r"os\.(mkdir|rename|remove|rmdir|link|symlink|truncate|chmod|chown|utime)|shutil\.")
    NEVER = re.compile(r"os\.(system|exec|posix_spawn|spawn|startfile)|subprocess\.|socket\.|pty\.|ctypes\.dlopen\b")

    def __init__(self):
        self.folder: str | None = None
        self.events: list[str] = []
        self.process, (self.from_children, self.to_parent) = os.getpid(), os.pipe()
        os.set_blocking(self.from_children, False)
        sys.addaudithook(self.hook)

    def hook(self, event: str, arguments: tuple) -> None:
        if self.folder is not None and self.harmful(event, arguments):
            self.report(f"{event} {str(arguments)[:200]}")

    def report(self, text: str) -> None:
        if os.getpid() == self.process:
            self.events.append(text)
        else:
            os.write(self.to_parent, f"{text}\n".encode())

    def harmful(self, event: str, arguments: tuple) -> bool:
        if event == "open":
            path, mode, flags = arguments
            writes = re.search("[wax+]", mode) if mode else (flags or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
            return bool(writes) and not isinstance(path, int) and not self.inside(path)
        if self.WRITES.match(event):
            return not self.inside(arguments[0])
        if event == "ctypes.dlopen" and sys.platform == "linux":  # threadpoolctl looks at libraries that are there
            return str(arguments[0]) not in Path("/proc/self/maps").read_text(encoding="utf-8")
        return bool(self.NEVER.match(event))

    def inside(self, path) -> bool:
        text = os.fsdecode(path) if isinstance(path, str | bytes | os.PathLike) else ""
        own = os.path.abspath(text).startswith(self.folder or "")
        return own or text.startswith(("/dev/null", "/proc/self")) or "__pycache__" in text

    @contextlib.contextmanager
    def on(self, folder: Path):
        self.folder, self.events = str(folder.resolve()), []
        try:
            yield
        finally:
            self.folder = None
            with contextlib.suppress(BlockingIOError):
                self.events += os.read(self.from_children, 1 << 16).decode().splitlines()


class TooLong(BaseException):
    """The processor time of one input is over."""


@contextlib.contextmanager
def temporary_files_in(folder: str):
    before, tempfile.tempdir = tempfile.tempdir, folder
    try:
        yield
    finally:
        tempfile.tempdir = before


@contextlib.contextmanager
def limits():
    """Processor time and memory that one input may take."""

    def over(*_):
        raise TooLong(f"more than {SECONDS:g} s of processor time")

    try:
        import resource
    except ImportError:  # on Windows
        yield
        return
    before = signal.signal(signal.SIGVTALRM, over)
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    statm = Path("/proc/self/statm")
    try:
        if statm.is_file():
            now = int(statm.read_text().split()[0]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_AS, (now + _CAN_BE_HAD, hard))
        signal.setitimer(signal.ITIMER_VIRTUAL, SECONDS)
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        signal.signal(signal.SIGVTALRM, before)


def peak_bytes(reset: bool = False) -> int:
    """The most memory that this process has held since the last reset, where the system says so."""
    try:
        if reset:
            Path("/proc/self/clear_refs").write_text("5")
        match = re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())
    except OSError:
        return 0
    return int(match[1]) * 1024 if match else 0
