"""Which photographs were taken in one session: in one go, in one place and light, with one camera.

In: the folder of the photographs. Out: their sessions, and how that is known. Folders in the folder are sessions. Else
the cameras' own words decide: another camera, or a pause of half an hour, begins another session. Where they say
nothing, all are one session: the cautious guess, since photographs of one session count for less.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from patchproof.base.input import is_folder, readable_formats
from patchproof.photo.limits import run_limited
from patchproof.photo.read import list_images, list_photos, printable_name

PAUSE_MINUTES = 30.0
_EXIF_IFD, _TAKEN, _MODEL = 0x8769, 0x9003, 0x0110


@dataclass(frozen=True)
class Grouping:
    """Every photograph with the number of its session, sessions' names, and in a few words how they are known."""

    paths: tuple[Path, ...]
    session: tuple[int, ...]
    names: tuple[str, ...]
    known_from: str

    def file(self, number: int) -> str:
        """A photograph's name in reports: its file's, after that of its folder where folders are sessions."""
        folder, path = self.names[self.session[number]], self.paths[number]
        name, parent = printable_name(path.name), printable_name(path.parent.name)
        return f"{folder}/{name}" if parent == folder and self.known_from == BY_FOLDERS else name


BY_FOLDERS, BY_TIMES, BY_GUESS = "folders", "cameras and times", "nothing said so: taken as one"


def group(folder: str | Path, without: Path | None = None) -> Grouping:
    """The photographs in a folder (or the one at a path) by session; refused where there are none. The folder `without`
    is left out: it has those of controls.
    """
    folder, left_out = Path(folder), None if without is None else without.resolve()
    inside = sorted(folder.iterdir()) if is_folder(folder) else []
    inside = [p for p in inside if p.is_dir() and not p.name.startswith(".") and p.resolve() != left_out]
    parts = {printable_name(p.name): paths for p in inside if (paths := list_images(p))}
    if not parts:
        return _by_time(list_photos(folder))
    if loose := list_images(folder):
        parts = {"": loose} | parts
    pairs = [(path, number) for number, paths in enumerate(parts.values()) for path in paths]
    return Grouping(tuple(p for p, _ in pairs), tuple(n for _, n in pairs), tuple(parts), BY_FOLDERS)


def _by_time(paths: Sequence[Path]) -> Grouping:
    taken = [words for path in paths if (words := _taken(path)) is not None]
    if len(taken) < len(paths):
        return Grouping(tuple(paths), (0,) * len(paths), ("",), BY_GUESS)
    session, names, last = [0] * len(paths), [], {}
    for (when, camera), number in sorted(zip(taken, range(len(paths)), strict=True)):
        before, own = last.get(camera, (None, len(names)))
        if before is None or (when - before).total_seconds() > 60 * PAUSE_MINUTES:
            own = len(names)
            names.append(f"{when:%Y-%m-%d %H:%M} {camera}".strip())
        session[number], last[camera] = own, (when, own)
    return Grouping(tuple(paths), tuple(session), tuple(names), BY_TIMES)


def _taken(path: Path) -> tuple[datetime, str] | None:
    """When a photograph was taken and by which camera, as its file says; None where it does not."""
    try:
        when, camera = run_limited(_labels, path)
        return datetime.strptime(when.strip("\0 "), "%Y:%m:%d %H:%M:%S"), " ".join(camera.split())[:40]
    except Exception:  # a file that cannot be read is a photograph that will be rejected, and says no time
        return None


def _labels(path: Path) -> tuple[str, str]:
    """EXIF's time and camera."""
    from PIL import Image

    with warnings.catch_warnings(action="ignore"), Image.open(path, formats=readable_formats()) as image:
        exif = image.getexif()
        return str(exif.get_ifd(_EXIF_IFD).get(_TAKEN)), str(exif.get(_MODEL) or "")
