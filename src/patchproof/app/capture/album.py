"""The folder that uploads are written to: a subfolder for each session and for each control.

    OUT/session_01/photo_0001.jpg  ...  OUT/controls/mean/photo_0017.jpg  ...  OUT/photos.jsonl  OUT/corners.csv

In: bytes from anybody who has the address. Out: files that `verify OUT --controls OUT/controls` reads. We choose their
names, and tell their kind by their first bytes; a file appears once it is complete, and the same bytes are not stored
twice. No link is followed. Left out on purpose: removing photographs, since a selection by answers proves nothing.
"""

import hashlib
import os
import re
from contextlib import suppress
from pathlib import Path
from typing import Any

from patchproof.base.errors import Refused
from patchproof.base.output import make_folder, refuse_other_files
from patchproof.evidence.annotations import CORNERS_FILE
from patchproof.evidence.batch import JOURNAL_FILE
from patchproof.photo.read import list_images

CONTROLS_FOLDER = "controls"
CONTROLS = ("bare", "mean", "gray", "noise", "blank")
MOST_BYTES = 40_000_000  # phones' largest JPEGs, of 108 and 200 megapixels, have some 30
MOST_PHOTOS = 1000
_OWN = ("session_*", CONTROLS_FOLDER, JOURNAL_FILE, CORNERS_FILE)
_HEAD = 12  # bytes that tell the kind of a file
# by suffix: where the bytes begin that tell a kind, and which they are
_KINDS = {
    ".jpg": (0, (b"\xff\xd8\xff",)),
    ".png": (0, (b"\x89PNG\r\n\x1a\n",)),
    ".webp": (8, (b"WEBP",)),
    ".heic": (4, (b"ftypheic", b"ftypheix", b"ftypheim", b"ftypheis", b"ftypmif1", b"ftypmsf1")),
    ".avif": (4, (b"ftypavif",)),
}
_NUMBERED = re.compile(r"\.?photo_(\d{4,})\.")
_SESSION = re.compile(r"session_[0-9]+")


class UploadRefused(Refused):
    """An upload that is not accepted, with its HTTP status."""

    def __init__(self, status: int, expected: str, got: str, do: str):
        super().__init__(expected, got, do)
        self.status = status

    def __reduce__(self) -> Any:
        return UploadRefused, (self.status, *self._parts)


class Album:
    """A folder of photographs, which is created if it is missing; refused if it has other files, or links."""

    def __init__(self, folder: Path):
        make_folder(folder)
        self.folder = folder = folder.resolve()
        for path in folder.rglob("*"):
            if path.is_symlink() or (path.name.startswith("session_") and not _SESSION.fullmatch(path.name)):
                do = "move it out of the folder, or choose another --out"
                raise Refused("no links, and sessions with numbers, among the photographs", str(path), do)
        refuse_other_files(folder, _OWN)
        for path in folder.rglob(".photo_*.part"):  # of uploads that an earlier server did not finish
            path.unlink()
        self.by_sha256: dict[str, Path] = {}  # the photographs, to recognize the same bytes when they are sent again
        if not self.sessions:
            make_folder(folder / "session_01")

    @property
    def sessions(self) -> list[str]:
        """The sessions' names in order, including empty ones."""
        folders = (path for path in self.folder.iterdir() if path.is_dir() and not path.is_symlink())
        names = (path.name for path in folders if _SESSION.fullmatch(path.name))
        return sorted(names, key=lambda name: (len(name), name))

    def photos(self) -> list[Path]:
        """List all photographs, those of controls last."""
        controls = [self.folder / CONTROLS_FOLDER / name for name in CONTROLS]
        folders = [self.folder / name for name in self.sessions] + [path for path in controls if path.is_dir()]
        return [photo for folder in folders for photo in list_images(folder)]

    def new_session(self) -> str:
        """Begin a new session and return its name; the last one's if it is still empty."""
        last = self.sessions[-1]
        if list_images(self.folder / last):
            last = f"session_{int(last.removeprefix('session_')) + 1:02d}"
            make_folder(self.folder / last)
        return last

    def incoming(self, into: str) -> "Incoming":
        """Prepare to receive a photograph for the session or control of that name."""
        folder = self.folder / (CONTROLS_FOLDER if into in CONTROLS else "") / into
        if into in CONTROLS:
            make_folder(folder)
        if into not in (*CONTROLS, *self.sessions) or folder.resolve() != folder:
            raise UploadRefused(404, "a session or a control of this folder", f'"{into[:40]}"', "load the page again")
        names = (match for path in self.folder.rglob("*photo_*") if (match := _NUMBERED.match(path.name)))
        number = 1 + max((int(match[1]) for match in names), default=0)
        if number > MOST_PHOTOS:
            expected = f"at most {MOST_PHOTOS} photographs in a folder"
            raise UploadRefused(507, expected, f"photograph {number}", "start with a new folder")
        return Incoming(folder / f"photo_{number:04d}", self.by_sha256)


class Incoming:
    """One upload, as a context manager; without a call of `keep` its file is removed at the end."""

    def __init__(self, stem: Path, by_sha256: dict[str, Path]):
        self._stem, self._part, self._by_sha256 = stem, stem.with_name(f".{stem.name}.part"), by_sha256
        self._file, self._digest, self._head, self._bytes = open(self._part, "xb"), hashlib.sha256(), b"", 0

    def __enter__(self) -> "Incoming":
        return self

    def __exit__(self, *error: object) -> None:
        with suppress(OSError):  # a full disk, which takes no byte of what is still to be written
            self._file.close()
        self._part.unlink(missing_ok=True)

    def write(self, chunk: bytes) -> None:
        """Write the next bytes; refused as soon as they are too many, or are not a photograph's."""
        refuse_size(self._bytes + len(chunk))
        self._head += chunk[: _HEAD - len(self._head)]
        if len(self._head) == _HEAD:
            _suffix_of(self._head)
        self._bytes += len(chunk)
        self._digest.update(chunk)
        self._file.write(chunk)

    def keep(self) -> Path:
        """Store the whole photograph and return its path, or that of the same bytes in the same folder."""
        path, sha256 = self._stem.with_suffix(_suffix_of(self._head)), self._digest.hexdigest()
        earlier = self._by_sha256.get(sha256)
        if earlier is not None:
            if earlier.parent != path.parent:
                got = f"{earlier.parent.name}/{earlier.name} once more"
                raise UploadRefused(409, "a photograph that is not here yet", got, "take a new one")
            return earlier
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        os.replace(self._part, path)
        self._by_sha256[sha256] = path
        return path


def refuse_size(size: int) -> None:
    """Refuse a photograph of more than `MOST_BYTES`; `size` is the number of bytes that came or are announced."""
    if size > MOST_BYTES:
        got = "a larger file" if size < 2 * MOST_BYTES else f"{size / 1e6:.0f} MB"
        do = "choose a smaller picture size in the camera's settings"
        raise UploadRefused(413, f"a photograph of at most {MOST_BYTES / 1e6:.0f} MB", got, do)


def _suffix_of(head: bytes) -> str:
    """Suffix of the kind of picture that begins with these bytes; refused if phones do not make it."""
    for suffix, (start, beginnings) in _KINDS.items():
        if head.startswith(beginnings, start) and (suffix != ".webp" or head.startswith(b"RIFF")):
            return suffix
    got = f"a file that begins with the bytes {head.hex(' ')}" if head else "an empty file"
    raise UploadRefused(415, "a photograph (JPEG, PNG, WebP, HEIC or AVIF)", got, "take it again")
