"""Group photographs into sessions: those that were taken in one go, in one place and light, with one camera.

In: the folder of the photographs. Out: their sessions, and how that is known. Folders in the folder are sessions.
Without folders, EXIF decides: another camera, or a pause of half an hour, begins a new session. Without EXIF all are
one session: the cautious assumption, since photographs of one session count for less.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from patchproof.base.errors import TimeLimitExceeded
from patchproof.base.input import is_folder, open_lazily
from patchproof.base.text import printable
from patchproof.photo.limits import run_limited
from patchproof.photo.read import list_images, list_photos
from patchproof.photo.rejection import PhotoRejected

PAUSE_MINUTES = 30.0
_EXIF_IFD, _TIME_TAG, _SERIAL_TAG, _MODEL_TAG = 0x8769, 0x9003, 0xA431, 0x0110


@dataclass(frozen=True)
class Grouping:
    """Photographs, the number of each one's session, the sessions' names, and in a few words how they are known."""

    paths: tuple[Path, ...]
    session: tuple[int, ...]
    names: tuple[str, ...]
    known_from: str
    same_as: tuple[int, ...] = ()  # the number of the session that each one is part of; itself if empty
    note: str = ""  # how they were merged, or that this could not be checked

    @property
    def merged(self) -> tuple[int, ...]:
        """The number of each photograph's session, as merged."""
        return tuple(self.same_as[number] for number in self.session) if self.same_as else self.session

    def file(self, number: int) -> str:
        """Name the photograph in reports: FILE, or FOLDER/FILE where folders are sessions."""
        folder, path = self.names[self.session[number]], self.paths[number]
        name, parent = printable(path.name), printable(path.parent.name)
        return f"{folder}/{name}" if parent == folder and self.known_from == BY_FOLDERS else name


BY_FOLDERS, BY_TIMES, BY_GUESS = "folders", "cameras and times", "no folders or times"


def group_sessions(folder: str | Path, without: Path | None = None) -> Grouping:
    """Group the photographs of a folder, or the one at a path, but not those of the folder `without`, which has those
    of controls. Refused if there are none.
    """
    folder, excluded = Path(folder), None if without is None else without.resolve()
    folders = [p for p in subfolders(folder) if p.resolve() != excluded] if is_folder(folder) else []
    sessions = {printable(p.name): paths for p in folders if (paths := list_images(p))}
    if not sessions:
        return _group_by_time(list_photos(folder))
    if loose := list_images(folder):
        sessions = {"": loose} | sessions
    pairs = [(path, number) for number, paths in enumerate(sessions.values()) for path in paths]
    return Grouping(tuple(p for p, _ in pairs), tuple(n for _, n in pairs), tuple(sessions), BY_FOLDERS)


def subfolders(folder: Path) -> list[Path]:
    """The folders in a folder by name, without hidden ones."""
    return sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith("."))


def _group_by_time(paths: Sequence[Path]) -> Grouping:
    sources = [source for path in paths if (source := _time_within_limits(path)) is not None]
    if len(sources) < len(paths):
        return Grouping(tuple(paths), (0,) * len(paths), ("",), BY_GUESS)
    sessions, names, last = [0] * len(paths), [], {}
    for (time, camera), number in sorted(zip(sources, range(len(paths)), strict=True)):
        last_time, session = last.get(camera, (None, len(names)))
        if last_time is None or (time - last_time).total_seconds() > 60 * PAUSE_MINUTES:
            session = len(names)
            names.append(f"{time:%Y-%m-%d %H:%M} {camera}".strip())
        sessions[number], last[camera] = session, (time, session)
    return Grouping(tuple(paths), tuple(sessions), tuple(names), BY_TIMES)


def time_and_camera(path: Path) -> tuple[datetime, str] | None:
    """Time and camera by the file's EXIF data; None if either is missing."""
    try:
        time, camera = _read_exif(path)
        return datetime.strptime(time.strip("\0 "), "%Y:%m:%d %H:%M:%S"), " ".join(camera.split())[:40]
    except TimeLimitExceeded:
        raise
    except Exception:  # an unreadable file has no time; it is rejected later
        return None


def _time_within_limits(path: Path) -> tuple[datetime, str] | None:
    try:
        return run_limited(time_and_camera, path)
    except PhotoRejected:
        return None


def _read_exif(path: Path) -> tuple[str, str]:
    """EXIF's time, and its camera's model and serial number, as text."""
    with warnings.catch_warnings(action="ignore"), open_lazily(path) as image:
        exif = image.getexif()
        details = exif.get_ifd(_EXIF_IFD)
        return str(details.get(_TIME_TAG)), f"{exif.get(_MODEL_TAG) or ''} {details.get(_SERIAL_TAG) or ''}"
