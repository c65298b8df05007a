"""One command at a time writes into an output folder.

In: the folder, which need not exist. Out: a lock that the system releases when the process ends, however it ends. Left
out on purpose: locks on single files, which appear whole (`base.output`); and file systems without locks, where
commands in one folder are not kept apart.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from errno import EACCES, EAGAIN, EDEADLK
from pathlib import Path

from patchproof.base.errors import Refused

_HELD: set[Path] = set()  # by this process, to which the system would give its own lock once more
_HELD_GUARD = threading.Lock()
_BUSY = (EACCES, EAGAIN, EDEADLK)  # what systems answer if another process has the lock


@contextmanager
def lock_folder(folder: str | Path) -> Iterator[None]:
    """Keep other commands out of an output folder while the block runs; refused if one of them is in it.

    Put it around all from the first look at the folder to the last file: `with lock_folder(out): check_folder(out,
    ...); ...`. `new_folder` does so itself. Different folders may be locked within each other. The lock is a hidden
    file beside the folder (`.NAME.lock.part`), so that the folder may be missing, be replaced or be a symbolic link; a
    file that a killed process left behind locks nothing, and `check_folder` passes over it.
    """
    try:
        real = Path(folder).resolve()
        real.parent.mkdir(parents=True, exist_ok=True)
        beside = not real.is_dir() or os.access(real.parent, os.W_OK)
    except (OSError, ValueError) as error:  # ValueError: a name with a NUL
        raise Refused("a folder that can be made", f"{folder} ({error})", "choose another --out") from error
    path = real.with_name(f".{real.name}.lock.part") if beside else real / ".lock.part"
    with _HELD_GUARD:
        if path in _HELD:
            raise _busy(folder, str(os.getpid()))
        _HELD.add(path)
    handle = None
    try:
        handle = _open_locked(path, folder)
        yield
    finally:
        if handle is not None:
            _release(path, handle)
        with _HELD_GUARD:
            _HELD.discard(path)


def _open_locked(path: Path, folder: str | Path) -> int:
    """Open and lock the file; again, if its former holder removed it in between."""
    while True:
        try:
            handle = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
        except OSError as error:
            got = f"{folder} ({error.strerror})"
            raise Refused("a folder that can be written to", got, "choose another --out") from error
        try:
            _lock(handle)
        except OSError as error:
            if error.errno in _BUSY:
                owner = os.read(handle, 20).decode(errors="replace") if os.name != "nt" else ""
                os.close(handle)
                raise _busy(folder, owner) from error
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(handle), os.stat(path)):
                os.ftruncate(handle, 0)
                os.write(handle, str(os.getpid()).encode())
                return handle
        os.close(handle)


def _lock(handle: int) -> None:
    if sys.platform == "win32":
        import msvcrt

        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.lockf(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _release(path: Path, handle: int) -> None:
    """Remove the file while it is still ours; Windows removes none that is open, and so none of another process."""
    if os.name != "nt":
        path.unlink(missing_ok=True)
    os.close(handle)
    if os.name == "nt":
        with suppress(OSError):
            path.unlink()


def _busy(folder: str | Path, owner: str) -> Refused:
    got = f"{folder}, into which process {owner or 'unknown'} writes"
    return Refused("a folder that no other command writes into", got, "wait until it ends, or choose another --out")
