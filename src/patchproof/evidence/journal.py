"""The journal of a verification: one flushed line per finished photograph, so that a kill loses only those in work.

In: a file of JSON lines and a key that stands for everything a result depends on besides the photograph itself. Out:
the result of an earlier run for a photograph of the same name and bytes under the same key. Lines of other keys and
broken lines are dropped, so that a photograph is measured again if it, a network, the sheet or an option changed.
"""

import io
import json
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TextIO

import cv2
import numpy as np
from pydantic import Field

from patchproof.base.errors import Refused
from patchproof.base.fingerprint import value_sha256
from patchproof.base.input import MAX_JSON_BYTES, hash_file, is_file, read_file
from patchproof.base.output import make_folder, write_atomically
from patchproof.base.validation import Finite, Share, StrictModel, validate_model
from patchproof.base.version import __version__
from patchproof.evidence.measure import MeasuredPhoto
from patchproof.evidence.results import PhotoEntry, Trace
from patchproof.photo.limits import MOST_BYTES
from patchproof.photo.quality import FrameLight

if TYPE_CHECKING:
    from patchproof.evidence.task import Options
    from patchproof.sheets.manifest import Manifest

JOURNAL_FILE = "photos.jsonl"
MAX_JOURNAL_BYTES = 128 << 20  # of 10,000 photographs


# linear light of paper and ink, within the bounds of `frame_light`; negative where a print is lighter than its paper
LightLevel = Annotated[Finite, Field(ge=-4, le=4)]


class FinishedPhoto(StrictModel):
    """A measured photograph without pixels; `pictures` says whether those for the page were made."""

    entry: PhotoEntry
    counted: bool
    # paper, ink, contrast, clipped share
    light: tuple[LightLevel, LightLevel, LightLevel, LightLevel, LightLevel, LightLevel, Finite, Share] | None
    pictures: bool
    trace: Trace | None = None

    @classmethod
    def of(cls, measured: MeasuredPhoto, pictures: bool) -> "FinishedPhoto":
        """Make it by way of JSON, so that a resumed run, which reads it, cannot differ."""
        light = measured.light and np.hstack([*vars(measured.light).values()]).tolist()
        entry, trace = measured.entry.model_dump(mode="json"), measured.trace and measured.trace.model_dump()
        values = {"entry": entry, "counted": measured.counted, "light": light, "pictures": pictures, "trace": trace}
        return cls.model_validate(values)

    @property
    def photo(self) -> MeasuredPhoto:
        """The measured photograph."""
        n = self.light
        light = n and FrameLight(np.array(n[:3]), np.array(n[3:6]), n[6], n[7])
        return MeasuredPhoto(self.entry, self.counted, light=light, trace=self.trace)


class _Line(StrictModel):
    file: str
    sha256: str | None
    key: str
    result: FinishedPhoto

    @property
    def text(self) -> str:
        return json.dumps(self.model_dump(mode="json"), allow_nan=False) + "\n"


class Journal:
    """An open file of finished photographs; opening it drops invalid lines, or without `resume` all lines."""

    def __init__(self, path: Path, key: str, resume: bool):
        make_folder(path.parent)
        lines = [line for line in _read_lines(path) if line.key == key] if resume else []
        self._key, self._lines_by_name = key, {line.file: line for line in lines}
        write_atomically(path, "".join(line.text for line in self._lines_by_name.values()))
        self._file: TextIO = open(path, "a", encoding="utf-8")

    def find(self, name: str, photo: Path) -> FinishedPhoto | None:
        """Result of the photograph of that name; None if there is none, or if the file's bytes have changed."""
        line = self._lines_by_name.get(name)
        return line.result if line is not None and line.sha256 == file_sha256(photo) else None

    def add(self, name: str, sha256: str | None, result: FinishedPhoto) -> None:
        """Write the result of a photograph of that name and SHA-256, and flush it."""
        self._file.write(_Line(file=name, sha256=sha256, key=self._key, result=result).text)
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def settings_key(manifest: "Manifest", options: "Options") -> str:
    """SHA-256 of all that a photograph's result depends on besides its bytes; of the user's networks their names."""
    settings = {
        "versions": (__version__, cv2.__version__, np.__version__),
        "manifest": manifest.model_dump(mode="json"),
        "models": [(model.name, model.fingerprint) for model in options.models],
        "printer": options.printer.sha256,
        "scan_dpi": options.scan_dpi,
        "camera": options.camera and options.camera.model_dump(mode="json"),
        "boxes": dict(options.boxes),
        "find": options.find,
    }
    return value_sha256(settings)


def file_sha256(path: Path) -> str | None:
    """SHA-256 of a file's bytes; None if it cannot be read, or is larger than photographs may be."""
    with suppress(Refused):
        return hash_file(path, MOST_BYTES)
    return None


def _read_lines(path: Path) -> Iterator[_Line]:
    """Read the complete lines that have this layout; none if there is no file."""
    if not is_file(path):
        return
    file = io.BytesIO(read_file(path, "a journal", max_bytes=MAX_JOURNAL_BYTES))
    while text := file.readline(MAX_JSON_BYTES):  # a piece of a longer line is no JSON
        with suppress(ValueError, RecursionError):  # a line that a kill cut short, or of another layout
            yield validate_model(_Line, json.loads(text), str(path))
