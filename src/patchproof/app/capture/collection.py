"""Measure the photographs of an album as they arrive, and report on all of them.

In: an album, a manifest, the options of a verification. Out: a `Report`, as `verify` makes it of the same folder.
Photographs are measured one at a time, in the single process of the workers, where limits of time and memory apply;
finished ones are in the album's journal, so that a restart measures only new ones, tapped corners in `corners.csv`.
Left out on purpose: the gap ledger and the estimated effect, which take longer than a person waits.
"""

import re
import signal
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from patchproof.app.capture.album import CONTROLS_FOLDER, Album
from patchproof.base.errors import Refused
from patchproof.base.input import is_file
from patchproof.base.output import write_atomically
from patchproof.base.progress import Advance, no_advance
from patchproof.base.workers import Workers
from patchproof.evidence import annotations
from patchproof.evidence.batch import JOURNAL_FILE, Journal, PhotoItem, measure_all, settings_key
from patchproof.evidence.classify import judges_of
from patchproof.evidence.gather import report_of
from patchproof.evidence.grouping import BY_FOLDERS, Grouping, merge_folders, reject_copies
from patchproof.evidence.measure import MeasuredPhoto
from patchproof.evidence.results import Report
from patchproof.evidence.task import Options, task_of
from patchproof.photo.registration import DesignCorners
from patchproof.sheets.manifest import Manifest

_CORNER_CODES = ("no_corners", "other_design", "several_sheets")  # of photographs in which a person may tap corners
_TEN_NUMBERS = re.compile(r"(\d{1,6}(\.\d{1,20})?(,(?!$)|$)){10}")


class PhotoCollection:
    """An album's measured photographs of a sheet that promises something; not thread-safe."""

    def __init__(self, album: Album, manifest: Manifest, options: Options, workers: Workers):
        assert manifest.promise is not None  # else the sheet is refused
        self.album, self.manifest, self.promise, self._workers = album, manifest, manifest.promise, workers
        self._judges = judges_of(options.models, manifest)
        self._task = task_of(manifest, options, self._judges)
        self._journal = Journal(album.folder / JOURNAL_FILE, settings_key(manifest, options), resume=True)
        self._measured: dict[Path, MeasuredPhoto] = {}
        self._photos: dict[Path, MeasuredPhoto] | None = None  # those of `photos` once they were asked for
        self._corners_file = file = album.folder / annotations.CORNERS_FILE
        named = annotations.load_corners(file) if is_file(file) else {}  # by "FOLDER/NAME", and by shorter names
        self._corners = {name: np.reshape(each.numbers, (4, 2)) for name, each in named.items() if "/" in name}

    @property
    def side_px(self) -> float | None:
        """Pixels of the promised photographs' shorter side; None if unknown."""
        return self._task.ranges.side_px

    def measure(
        self,
        paths: Sequence[Path],
        advance: Advance = no_advance,
        on_pictures: Callable[[str, Mapping[str, np.ndarray]], None] = lambda file, pictures: None,
    ) -> None:
        """Measure and classify the photographs that are new; for the callbacks see `gather_evidence`."""
        paths = [path for path in paths if path not in self._measured]
        items = [self._item(path) for path in paths]
        results = measure_all(self._task, items, self._judges, self._workers, self._journal, on_pictures, advance)
        for path, photo in zip(paths, results, strict=True):
            self.add(path, photo)

    def add(self, path: Path, photo: MeasuredPhoto) -> None:
        """Add a measured photograph of the album."""
        self._measured[path], self._photos = photo, None
        self.album.remember(path, photo.entry.sha256)

    def wants_corners(self, path: Path) -> bool:
        """Tell whether a person may tap corners: of a print without markers, until the photograph is counted."""
        photo, named = self._measured[path], _name_of(path) in self._corners
        able = not self.manifest.markers and self.control_of(path) is None and not photo.counted
        return able and (named or photo.entry.code in _CORNER_CODES)

    def name_corners(self, file: str, numbers: str) -> Path:
        """Keep the corners that a person tapped in a picture of the photograph `file`, which is then to be measured
        again, and return its path; `numbers` are "x1,y1,...,x4,y4,width,height". Nothing changes where none are wanted.
        """
        path = next((path for path in self._measured if _name_of(path) == file), None)
        pairs = np.array(numbers.split(",") if _TEN_NUMBERS.fullmatch(numbers) else [], float).reshape(-1, 2)
        if path is None or not len(pairs) or (pairs > pairs[-1]).any():
            raise Refused("four corners inside of a photograph", f"{numbers} in {file}"[:160], "load the page again")
        size_px = int(pairs[-1, 0]), int(pairs[-1, 1])
        named = annotations.Drawn(tuple(pairs[:4].ravel().tolist()), size_px)
        annotations.refuse_twisted(named, file, "the page")
        corners = annotations.corners_of_photo({file: named}, file, path)
        if self.wants_corners(path) and corners is not None:
            self._corners[file] = np.round(corners.px, 2)
            write_atomically(self._corners_file, annotations.corners_csv(self._corners))
            self._measured.pop(path)
        return path

    @property
    def photos(self) -> dict[Path, MeasuredPhoto]:
        """The measured photographs in the order of their names, copies rejected, those of controls last."""
        if self._photos is None:  # each answer asks several times
            grouping = self._grouping()
            measured = [self._measured[path] for path in grouping.paths]
            measured = reject_copies(measured, grouping.merged, self._task.surface.rect_mm)
            photos = dict(zip(grouping.paths, measured, strict=True))
            self._photos = photos | {path: self._measured[path] for path in sorted(self._measured.keys() - photos)}
        return self._photos

    def control_of(self, path: Path) -> str | None:
        """The control that a photograph shows; None for the patch itself."""
        return path.parent.name if path.parent.parent.name == CONTROLS_FOLDER else None

    def report(self) -> Report:
        """Report on all photographs that were measured so far."""
        photos, grouping = dict(self.photos), self._grouping()
        patch_photos = [photos.pop(path) for path in grouping.paths]
        controls: dict[str, list[MeasuredPhoto]] = {}
        for path, photo in photos.items():
            controls.setdefault(path.parent.name, []).append(photo)
        return report_of(self.manifest, self._judges, patch_photos, grouping, controls, look=None)

    def _grouping(self) -> Grouping:
        paths = sorted(path for path in self._measured if self.control_of(path) is None)
        names = {name: number for number, name in enumerate(sorted({path.parent.name for path in paths}))}
        numbers = tuple(names[path.parent.name] for path in paths)
        grouping = Grouping(tuple(paths), numbers, tuple(names), BY_FOLDERS)
        return merge_folders(grouping, [self._measured[path] for path in paths])

    def close(self) -> None:
        """Close the journal; nothing can be measured after this."""
        self._journal.close()

    def _item(self, path: Path) -> PhotoItem:
        control = self.control_of(path)
        file = path.name if control is not None else _name_of(path)
        px = self._corners.get(file)
        corners = None if px is None else DesignCorners(px, annotations.CORNER_SIGMA_PX)
        return PhotoItem(path, file, control, with_pictures=control is None, corners=corners)


def _name_of(path: Path) -> str:
    return f"{path.parent.name}/{path.name}"


def prepare_worker(_: object) -> None:
    """Import the modules for measuring in the worker, and let it ignore interrupts: the server ends it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
