"""The photographs of an album, each measured when it has come, and what all of them say so far.

In: an album, a manifest, what photographs are judged with. Out: a `Report`, as `verify` makes it of the same folder: by
the same functions, from what is kept of each photograph. One at a time is measured, in the one process of the workers,
where the limits of time and memory hold; the album's journal keeps what is finished, so that a restart measures only
what is new. Left out on purpose: the gap ledger and the estimated effect, which take longer than a person waits.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from patchproof.app.capture.album import CONTROLS_FOLDER, JOURNAL_FILE, Album
from patchproof.base.progress import Advance, no_advance
from patchproof.base.workers import Workers
from patchproof.evidence.batch import PhotoItem, measure_all, reread_square
from patchproof.evidence.classify import judges_of
from patchproof.evidence.copies import reject_copies
from patchproof.evidence.gather import report_of, with_forecast
from patchproof.evidence.grouping import BY_FOLDERS, Grouping
from patchproof.evidence.journal import Journal, settings_key
from patchproof.evidence.measure import MeasuredPhoto
from patchproof.evidence.reproject import PhotoSquare
from patchproof.evidence.results import PhotoEntry, Report
from patchproof.evidence.task import Options, Task, task_of
from patchproof.sheets.manifest import Manifest, load_manifest

RunAndSheet = tuple[Path, Path]  # the folder of a run and its sheet's manifest


class PhotoCollection:
    """What is known of an album's photographs; called by one thread at a time. By `forecast` each has its forecast."""

    def __init__(
        self, album: Album, manifest: Manifest, options: Options, workers: Workers, forecast: RunAndSheet | None = None
    ):
        self.album, self.manifest = album, manifest
        self._judges = judges_of(options.models, manifest)
        self._task = task_of(manifest, options, self._judges)
        self._workers, self._forecast = workers, forecast
        self._journal = Journal(album.folder / JOURNAL_FILE, settings_key(manifest, options), resume=True)
        self._measured: dict[Path, MeasuredPhoto] = {}

    @property
    def side_px(self) -> float | None:
        """The shorter side of the photographs that were promised."""
        return self._task.ranges.side_px

    def measure(
        self,
        paths: Sequence[Path],
        advance: Advance = no_advance,
        on_pictures: Callable[[str, Mapping[str, np.ndarray]], None] = lambda file, pictures: None,
    ) -> None:
        """Measure and classify those of these photographs that are not yet; see `gather_evidence`."""
        paths = [path for path in paths if path not in self._measured]
        items = [self._item(path) for path in paths]
        results = measure_all(self._task, items, self._judges, self._workers, self._journal, on_pictures, advance)
        if self._forecast is not None and self._judges is not None:
            there = partial(_forecast_there, self._forecast, self._task, self._judges.primary.input_px)
            own = [i for i, item in enumerate(items) if item.control is None]
            for i, photo in zip(own, self._workers.map(there, [(paths[i], results[i]) for i in own]), strict=True):
                results[i] = photo
        for path, photo in zip(paths, results, strict=True):
            self._measured[path] = photo
            self.album.know(path, photo.entry.sha256)

    @property
    def photos(self) -> dict[Path, MeasuredPhoto]:
        """The measured photographs as they count, in the order of their names."""
        grouping, rect_mm = self._grouping(), self._task.surface.rect_mm
        own = [self._measured[path] for path in grouping.paths]
        counted = dict(zip(grouping.paths, reject_copies(own, grouping.session, rect_mm), strict=True))
        return counted | {path: self._measured[path] for path in sorted(self._measured.keys() - counted)}

    def control_of(self, path: Path) -> str | None:
        """The control that a photograph shows; None for the piece itself."""
        return path.parent.name if path.parent.parent.name == CONTROLS_FOLDER else None

    def report(self) -> Report:
        """What the photographs that are measured say together."""
        photos, grouping = self.photos, self._grouping()
        own = [photos.pop(path) for path in grouping.paths]
        controls: dict[str, list[PhotoEntry]] = {}
        for path, photo in photos.items():
            controls.setdefault(path.parent.name, []).append(photo.entry)
        return report_of(self.manifest, self._judges, own, grouping, controls)

    def _grouping(self) -> Grouping:
        own = sorted(path for path in self._measured if self.control_of(path) is None)
        names = sorted({path.parent.name for path in own})
        return Grouping(tuple(own), tuple(names.index(path.parent.name) for path in own), tuple(names), BY_FOLDERS)

    def close(self) -> None:
        """Nothing is measured after this."""
        self._journal.close()

    def _item(self, path: Path) -> PhotoItem:
        control = self.control_of(path)
        file = path.name if control is not None else f"{path.parent.name}/{path.name}"
        return PhotoItem(path, file, control, with_pictures=control is None)


def ready(_: object) -> None:
    """Import in the workers' process what measuring takes; an interrupt ends the server, which ends that process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _forecast_there(source: RunAndSheet, task: Task, size_px: int, item: tuple[Path, MeasuredPhoto]) -> MeasuredPhoto:
    return with_forecast(partial(reread_square, task, size_px), _forecaster(*source), *item)


@lru_cache(maxsize=1)
def _forecaster(run: Path, sheet: Path) -> Callable[[PhotoSquare], float | None]:
    from patchproof.reprints.photo_forecast import photo_forecaster  # brings scene, renderer and optimizer in

    return photo_forecaster(run, load_manifest(sheet))
