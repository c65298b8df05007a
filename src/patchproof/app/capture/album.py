"""The folder that photographs are received into: a folder for each session, one for each control.

    OUT/session_01/photo_0001.jpg  ...  OUT/controls/mean/photo_0017.jpg  ...

In: bytes from anybody who has the address. Out: files that `verify OUT --controls OUT/controls` reads. Their names are
ours and what they are is known from their first bytes; a file appears when it has come whole. A number is taken by
creating a hidden part file, which nobody else can create too, so that whoever receives at the same time gets another.
Bytes that are here already are that photograph sent again, and no second one. Left out on purpose: removing any, since
photographs picked by their answers prove nothing.
"""

from __future__ import annotations

import hashlib
import os
import re
from pathlib import Path
from typing import Any

from patchproof.base.errors import Refused
from patchproof.base.output import check_folder, make_folder
from patchproof.photo.read import list_images

CONTROLS_FOLDER, JOURNAL_FILE, ADDRESS_FILE = "controls", "photos.jsonl", ".capture.json"
CONTROLS = ("bare", "mean", "gray", "noise", "shuffled", "blank")
MOST_BYTES = 40_000_000  # phones' largest JPEGs, of 108 and 200 megapixels, have some 30
MOST_PHOTOS = 1000
_OWN = ("session_*", CONTROLS_FOLDER, JOURNAL_FILE, ADDRESS_FILE)
_HEAD = 12  # bytes that tell a kind
_HEIF = (b"heic", b"heix", b"heim", b"heis", b"mif1", b"msf1")
_NUMBERED = re.compile(r"\.?photo_(\d{4,})\.")


class UploadRefused(Refused):
    """An upload that is not accepted, with its HTTP status."""

    def __init__(self, status: int, expected: str, got: str, do: str):
        super().__init__(expected, got, do)
        self.status = status

    def __reduce__(self) -> Any:
        return UploadRefused, (self.status, *self._parts)


class Album:
    """The folder with what is in it; a new one is made, one with anything else in it is refused."""

    def __init__(self, folder: Path):
        check_folder(folder, _OWN, overwrite=True)
        make_folder(folder)
        self.folder = folder
        for part in folder.rglob(".photo_*.part"):  # of uploads that ended with an earlier server
            part.unlink()
        self._by_sha256: dict[str, Path] = {}
        if not self.sessions:
            make_folder(folder / "session_01")

    @property
    def sessions(self) -> list[str]:
        """The sessions' names in order, those without a photograph too."""
        return sorted(path.name for path in self.folder.glob("session_*") if path.is_dir())

    def photos(self) -> list[Path]:
        """Every photograph, those of controls last."""
        shown = [self.folder / CONTROLS_FOLDER / name for name in CONTROLS]
        folders = [self.folder / name for name in self.sessions] + [path for path in shown if path.is_dir()]
        return [photo for folder in folders for photo in list_images(folder)]

    def know(self, photo: Path, sha256: str | None) -> None:
        """The photograph has these bytes."""
        if sha256 is not None:
            self._by_sha256[sha256] = photo

    def new_session(self) -> str:
        """A new session; the last one again where it has no photograph yet."""
        last = self.sessions[-1]
        if list_images(self.folder / last):
            last = f"session_{int(last.rpartition('_')[2]) + 1:02d}"
            make_folder(self.folder / last)
        return last

    def incoming(self, into: str) -> Incoming:
        """Room for one more photograph in the session, or of the control, of that name."""
        if into in CONTROLS:
            folder = self.folder / CONTROLS_FOLDER / into
            make_folder(folder)
        elif into in self.sessions:
            folder = self.folder / into
        else:
            raise UploadRefused(404, "a session or a control that is here", "another name", "load the page again")
        return Incoming(folder, self._free_number(), self._by_sha256)

    def _free_number(self) -> int:
        names = (match for path in self.folder.rglob("*photo_*") if (match := _NUMBERED.match(path.name)))
        number = 1 + max((int(match[1]) for match in names), default=0)
        if number > MOST_PHOTOS:
            raise UploadRefused(
                507, f"at most {MOST_PHOTOS} photographs in a folder", f"photograph {number}", "start with a new folder"
            )
        return number


class Incoming:
    """One photograph on its way; left before `keep`, nothing of it stays."""

    def __init__(self, folder: Path, number: int, known: dict[str, Path]):
        self._folder, self._known, self._digest = folder, known, hashlib.sha256()
        self._head, self._bytes = b"", 0
        while True:
            self._stem, self._part = f"photo_{number:04d}", folder / f".photo_{number:04d}.part"
            try:
                self._file = open(self._part, "xb")  # fails where another takes this number now
            except FileExistsError:
                number += 1
                continue
            if not list(folder.glob(f"{self._stem}.*")):
                return
            self._leave()
            number += 1

    def __enter__(self) -> Incoming:
        return self

    def __exit__(self, *error: object) -> None:
        self._leave()

    def write(self, chunk: bytes) -> None:
        """The next bytes; refused as soon as they are too many, or of no photograph."""
        refuse_size(self._bytes + len(chunk))
        if len(self._head) < _HEAD:
            self._head += chunk[: _HEAD - len(self._head)]
            if len(self._head) == _HEAD:
                _suffix_of(self._head)
        self._bytes += len(chunk)
        self._digest.update(chunk)
        self._file.write(chunk)

    def keep(self) -> Path:
        """The whole photograph's path: a new one's, or that of the same bytes in the same place."""
        path, sha256 = self._folder / f"{self._stem}{_suffix_of(self._head)}", self._digest.hexdigest()
        kept = self._known.get(sha256)
        if kept is not None:
            if kept.parent != self._folder:
                got = f"{kept.parent.name}/{kept.name} once more"
                raise UploadRefused(409, "a photograph that is not here yet", got, "take a new one")
            return kept
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        os.replace(self._part, path)
        self._known[sha256] = path
        return path

    def _leave(self) -> None:
        self._file.close()
        self._part.unlink(missing_ok=True)


def refuse_size(size: int) -> None:
    """Refuse a photograph of so many bytes where they are too many."""
    if size > MOST_BYTES:
        got = "a larger file" if size < 2 * MOST_BYTES else f"one of {size / 1e6:.0f} MB"
        do = "choose a smaller picture size in the camera's settings"
        raise UploadRefused(413, f"a photograph of at most {MOST_BYTES / 1e6:.0f} MB", got, do)


def _suffix_of(head: bytes) -> str:
    """The suffix of the kind of picture that starts so; refused where it is none that phones make."""
    if head.startswith(b"\xff\xd8\xff"):
        return ".jpg"
    if head.startswith(b"\x89PNG\r\n\x1a\n"):
        return ".png"
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        return ".webp"
    if head[4:8] == b"ftyp" and head[8:12] in (*_HEIF, b"avif"):
        return ".avif" if head[8:12] == b"avif" else ".heic"
    raise UploadRefused(415, "a photograph (JPEG, PNG, WebP, HEIC or AVIF)", "a file of another kind", "take it again")
