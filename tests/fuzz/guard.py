"""A process of its own for each hostile input, and a record of all that it does outside of the folders it was given."""

from __future__ import annotations

import json
import multiprocessing
import os
import re
import resource
import signal
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fuzz.watch import peak_bytes
from patchproof.base.errors import PatchproofError
from patchproof.base.workers import use_threads

SECONDS, BYTES = 60.0, 2_000_000_000
FRESH_BYTES = 450_000_000  # of a process that has loaded all and read nothing
WAIT_S = 900.0  # for a process that may have to share its core with others
HERE = Path(__file__).resolve().parents[2]
INSTALLED = tuple(f"{Path(p).resolve()}/" for p in (sys.prefix, sys.base_prefix, HERE, "/usr/lib", "/usr/share"))
SYSTEM = re.compile(
    r"/proc/self/(statm|status|cgroup|mountinfo|maps)|/proc/\d+/statm|/proc/(cpu|mem)info|/sys/(fs|dev)"
)
QUIET = ("/dev/null", "/dev/urandom", "/etc/localtime", "/etc/mime.types", "/etc/fonts", f"{Path.home()}/.cache/")
CHANGES = re.compile(r"os\.(mkdir|rename|remove|rmdir|link|symlink|truncate|chmod|chown|utime)$")
NEVER = re.compile(
    r"os\.(system|exec|posix_spawn|spawn|startfile)|subprocess\.|socket\.(connect|getaddrinfo|bind|sendto)|pty\.|webbrowser"
)


@dataclass(frozen=True)
class Place:
    """What an input has: a folder that somebody sent, one to write into, and what it must not touch."""

    given: Path
    out: Path
    outside: Path

    @classmethod
    def at(cls, root: Path) -> Place:
        """The folders, with a file outside, and code beside the given files that must never run."""
        place = cls(root / "given", root / "out", root / "outside")
        for folder in (place.given, place.out, place.outside, root / "temporary"):
            folder.mkdir()
        (place.outside / "secret.txt").write_text("secret")
        (place.outside / "holiday.jpg").write_bytes(b"\xff\xd8 a photograph of somebody's")
        (place.given / "evil.py").write_text("raise SystemExit('this code was executed')\n")
        return place

    def contents(self) -> dict[str, tuple]:
        """Every file that must stay as it is."""
        found = {}
        for folder in (self.given, self.outside):
            for path in sorted(folder.rglob("*")):
                state = path.lstat()
                found[str(path)] = (state.st_mode, state.st_size, state.st_mtime_ns)
        return found


@dataclass(frozen=True)
class Ended:
    """What became of one input: `how` is "result", "refused", or what went wrong."""

    kind: str
    number: int
    how: str
    seconds: float
    bytes: int
    said: str = ""


class Guard:
    """An audit hook that stays for good: it reports what a process does outside of its folders."""

    def __init__(self, root: Path, report: Callable[[str], Any]):
        self.root, self.report = f"{root.resolve()}/", report
        self.writable = (f"{self.root}out/", f"{self.root}temporary/")
        self.readable = (f"{self.root}given/", *self.writable, *INSTALLED)
        sys.addaudithook(self.hook)

    def hook(self, event: str, arguments: tuple) -> None:
        if NEVER.match(event):
            self.report(f"{event} {str(arguments)[:150]}")
        elif event == "open":
            path, mode, flags = arguments
            writes = re.search("[wax+]", mode) if mode else (flags or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
            self.check("wrote" if writes else "read", path, bool(writes))
        elif CHANGES.match(event):
            for path in arguments[: 2 if event in ("os.rename", "os.link") else 1]:
                self.check(event, path, True, follow=event in ("os.truncate", "os.chmod"))
        elif event in ("exec", "compile"):
            name = getattr(arguments[0], "co_filename", None) if event == "exec" else arguments[1]
            if str(name).startswith(self.root):
                self.report(f"executed {name}")

    def check(self, deed: str, path: Any, writes: bool, follow: bool = True) -> None:
        if isinstance(path, int) or path is None:
            return
        text = os.path.abspath(os.fsdecode(path))
        real = (
            os.path.realpath(text)
            if follow
            else os.path.join(os.path.realpath(os.path.dirname(text)), os.path.basename(text))
        )
        if (SYSTEM.match(text) and not writes) or real.startswith(QUIET) or "__pycache__" in real:
            return
        if not f"{real}/".startswith(self.writable if writes else self.readable):
            self.report(f"{deed} {text}")


def attempt(kind: str, number: int, make: Callable[[Place, int], Callable[[], object]]) -> Ended:
    """Make the input and use it in a forked process, under guard and within limits."""
    with tempfile.TemporaryDirectory() as name, use_threads(1), warnings.catch_warnings(action="ignore"):
        root = Path(name).resolve()
        context = multiprocessing.get_context("fork")
        receiver, sender = context.Pipe(duplex=False)
        child = context.Process(target=_use, args=(root, number, make, sender))
        child.start()
        sender.close()
        lines: list[str] = []
        reader = threading.Thread(target=_collect, args=(receiver, lines), daemon=True)
        reader.start()
        begin = time.monotonic()
        child.join(WAIT_S)
        hung = child.is_alive()
        child.kill()
        child.join()
        reader.join(5)
        last = json.loads(lines[-1]) if lines and lines[-1].startswith("{") else {}
        events = [line for line in lines if not line.startswith("{")]
        how, seconds, size = last.get("how"), last.get("seconds", time.monotonic() - begin), last.get("bytes", 0)
        if hung or how is None:
            how = "hangs" if hung else f"died with {child.exitcode}"
        elif events:
            how = f"did {list(dict.fromkeys(events))[:3]}"
        elif how in ("result", "refused") and (seconds > SECONDS or size > BYTES):
            how = f"took {seconds:.0f} s and {size / 1e6:.0f} MB"
        return Ended(kind, number, how, seconds, size, last.get("said", ""))


def _collect(receiver: Any, lines: list[str]) -> None:
    try:
        while True:
            lines.append(receiver.recv_bytes().decode("utf-8", "replace"))
    except (EOFError, OSError):
        pass


def _use(root: Path, number: int, make: Callable[[Place, int], Callable[[], object]], sender: Any) -> None:
    """In the new process: make the input, use it, and send what it did and how it ended."""
    silence = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(silence, stream)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_CPU, (int(1.5 * SECONDS),) * 2)
    os.environ["EMPTY"], os.environ["SECRET"], os.environ["COLON"] = "", "hunter2", ":"
    os.environ["OUTSIDE"] = str(root / "outside")
    place = Place.at(root)
    use = make(place, number)
    os.chdir(root / "out")
    tempfile.tempdir = str(root / "temporary")
    before = place.contents()
    held = peak_bytes(reset=True)  # by the process that was forked, which may have run other tests before
    Guard(root, lambda text: sender.send_bytes(text.encode("utf-8", "replace")))
    begin, children = time.process_time(), resource.getrusage(resource.RUSAGE_CHILDREN)
    how, said = _how(use)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = time.process_time() - begin + after.ru_utime + after.ru_stime - children.ru_utime - children.ru_stime
    most = FRESH_BYTES + max(peak_bytes() - held, after.ru_maxrss * 1024 - held, 0)
    if how in ("result", "refused") and place.contents() != before:
        how = f"changed {sorted({name for name, _ in before.items() ^ place.contents().items()})[:3]}"
    sender.send_bytes(json.dumps({"how": how, "said": said, "seconds": seconds, "bytes": most}).encode())
    os._exit(0)  # nothing that waits for threads


def _how(use: Callable[[], object]) -> tuple[str, str]:
    warnings.simplefilter("ignore")
    try:
        use()
        return "result", ""
    except PatchproofError as error:
        text = str(error)
        return ("refused" if "\n" not in text and len(text) < 4000 else f"said {text[:300]!r}"), text
    except BaseException:
        return traceback.format_exc(), ""
