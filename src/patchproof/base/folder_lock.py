"""One command at a time writes into an output folder, and the folder lists what was written.

In: the folder, which need not exist. Out: a lock that the system releases when the process ends, however it ends, and
`.patchproof.jsonl` in the folder, by which `--overwrite` knows what it may delete (`base.output`). Left out on purpose:
locks on single files, which appear whole; and file systems without locks, where commands are not kept apart.
"""

import json
import os
import stat
import sys
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from errno import EACCES, EAGAIN, EDEADLK
from pathlib import Path

from patchproof.base.errors import Refused
from patchproof.base.input import MAX_JSON_BYTES, is_file

LISTING_FILE = ".patchproof.jsonl"  # lines of lists of names, relative to the folder
_OPEN: dict[Path, set[str]] = {}  # folders that this process has locked, with what it listed in each
_GUARD = threading.Lock()  # systems give a process its own lock once more
_MAX_PID_BYTES = 20  # of a lock's content
_BUSY = (EACCES, EAGAIN, EDEADLK)  # what they answer if another process has the lock


@contextmanager
def lock_folder(folder: str | Path) -> Iterator[None]:
    """Keep other commands out of an output folder while the block runs, and list in it what `write_atomically` writes
    there; refused if another command is in it.

    Put it around all from the first look at the folder to the last file, as `new_folder` does itself. Different folders
    may be locked within each other. The lock is a hidden file beside the folder, which may be missing or be replaced
    (`.NAME.lock.part`); one that a killed process left behind locks nothing.
    """
    try:
        real = Path(folder).resolve()
        real.parent.mkdir(parents=True, exist_ok=True)
        inside = real.is_dir() and not os.access(real.parent, os.W_OK)
        path = real / ".lock.part" if inside else real.with_name(f".{real.name}.lock.part")
    except (OSError, ValueError) as error:  # ValueError: a name with a NUL, or none
        raise Refused("a folder that can be made", f"{folder} ({error})", "choose another --out") from error
    handle = None
    with _GUARD:
        if real in _OPEN:
            raise _busy(folder, str(os.getpid()))
        _OPEN[real] = set()
    try:
        handle = _open_locked(path, folder)
        yield
    finally:
        if handle is not None:
            _sort_listing(real)
            with suppress(OSError):  # while it is still ours; Windows keeps files that are open
                path.unlink()
            os.close(handle)
        with _GUARD:
            del _OPEN[real]


def _open_locked(path: Path, folder: str | Path) -> int:
    """Open and lock the file; again, if its former holder removed it in between."""
    while True:
        try:
            handle = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
        except OSError as error:
            got = f"{folder} ({error.strerror})"
            raise Refused("a folder that can be written to", got, "choose another --out") from error
        try:
            if sys.platform == "win32":
                import msvcrt

                msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
            else:
                import fcntl

                fcntl.lockf(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in _BUSY:
                owner = os.read(handle, _MAX_PID_BYTES).decode(errors="replace") if os.name != "nt" else ""
                os.close(handle)
                raise _busy(folder, owner) from error
        status = os.fstat(handle)
        if not stat.S_ISREG(status.st_mode) or status.st_size > _MAX_PID_BYTES:
            os.close(handle)
            raise Refused(f"a lock file of this program at {path}", "something else", "move it away")
        with suppress(FileNotFoundError):
            if os.path.samestat(status, os.stat(path)):
                os.ftruncate(handle, 0)
                os.write(handle, str(os.getpid()).encode())
                return handle
        os.close(handle)


def _busy(folder: str | Path, owner: str) -> Refused:
    got = f"{folder}, into which process {owner or 'unknown'} writes"
    return Refused("a folder that no other command writes into", got, "wait until it ends, or choose another --out")


def list_file(path: Path) -> None:
    """List a file that is about to be written in each locked folder that it lies in."""
    real = path.parent.resolve() / path.name
    for folder, listed in [*_OPEN.items()]:
        name = real.relative_to(folder).as_posix() if real.is_relative_to(folder) else LISTING_FILE
        if name != LISTING_FILE and name not in listed:
            listed.add(name)
            append_listing(folder, [name])


def append_listing(folder: Path, names: Iterable[str]) -> None:
    """Append names to a folder's listing; refused where something else lies in its place."""
    path = folder / LISTING_FILE
    if os.path.lexists(path) and (path.is_symlink() or not path.is_file()):
        raise Refused(f"a file {LISTING_FILE} of this program", f"{path}, which is not one", "remove it")
    with open(path, "a", encoding="utf-8") as file:
        file.write(f"\n{json.dumps(list(names))}\n")  # begins a line of its own after one that a kill cut short


def listed_names(folder: Path) -> set[str]:
    """Return the names in a folder's own listing; empty without one."""
    path, names = folder / LISTING_FILE, set()
    if is_file(path) and not path.is_symlink() and path.stat().st_size <= MAX_JSON_BYTES:
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
            with suppress(ValueError, TypeError, RecursionError):  # a line that a kill cut short, or somebody made up
                names |= set(json.loads(line))
    return names


def _sort_listing(folder: Path) -> None:
    """Rewrite the listing in order, so that its bytes do not tell in how many goes the files were written."""
    if names := listed_names(folder):
        with suppress(OSError, TypeError):  # a full disk; names that somebody made up: the listing stays as it is
            content = "".join(f"{json.dumps([name])}\n" for name in sorted(names))
            part = folder / f"{LISTING_FILE}.part"
            part.unlink(missing_ok=True)  # a link there would lead the content elsewhere
            with open(part, "x", encoding="utf-8") as file:
                file.write(content)
            os.replace(part, folder / LISTING_FILE)
