"""Measure the photographs of an album as they arrive, and report on all of them, also as the page's content.

In: an album, a manifest, the options of a verification. Out: a `Report`, as `verify` makes it of the same folder, and
JSON values, in which every sentence about a photograph or the promise is the report's. Photographs are measured one at
a time, in the single process of the workers, where limits of time and memory apply. Finished ones are in the album's
journal and tapped corners in `corners.csv`, so that a restart measures only new ones. Cells of the map of views are
equal steps of azimuth and of distance (1 over pixels per millimeter), and need photographs in proportion to their
shares of the conditions. Left out on purpose: the gap ledger and the estimated effect, which take longer than a person
waits.
"""

import re
import signal
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from patchproof.app.capture.album import CONTROLS, CONTROLS_FOLDER, Album
from patchproof.base.errors import Refused
from patchproof.base.input import is_file
from patchproof.base.output import data_uri, write_atomically
from patchproof.base.progress import Advance, no_advance
from patchproof.base.workers import Workers
from patchproof.evidence import annotations
from patchproof.evidence.batch import JOURNAL_FILE, Journal, PhotoItem, measure_all, settings_key
from patchproof.evidence.classify import judges_of
from patchproof.evidence.gather import report_of
from patchproof.evidence.grouping import BY_FOLDERS, Grouping, merge_folders, reject_copies
from patchproof.evidence.measure import MeasuredPhoto
from patchproof.evidence.results import PhotoEntry, Report
from patchproof.evidence.task import Options, figures_of, task_of
from patchproof.evidence.verdict import PHOTOS_PER_SESSION
from patchproof.photo.registration import DesignCorners
from patchproof.report.page import jpeg
from patchproof.report.words import VERDICTS, benefit_sentence, headline_of
from patchproof.sheets.manifest import ConditionClaim, Manifest

_CORNER_CODES = ("no_corners", "other_design", "several_sheets")  # of photographs in which a person may tap corners
_OF_REPORT = " A report renders controls into the photographs themselves, and may say otherwise: patchproof verify."
_LATEST_PHOTOS = 12  # that are listed with advice
_USUAL_SESSIONS = 4  # on the map, if no number of sessions would prove the promise
_ROWS, _MOST_COLUMNS = 3, 5
_LEAST_COLUMN_DEG = 12.0  # about the error of a person who aims a phone by hand
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
        self.album.by_sha256 |= {photo.entry.sha256: path} if photo.entry.sha256 else {}

    def wants_corners(self, path: Path) -> bool:
        """Tell whether a person may tap corners: of a print without markers, until the photograph is counted."""
        photo, named = self._measured[path], _name_of(path) in self._corners
        able = not self.manifest.markers and self.control_of(path) is None and not photo.counted
        return able and (named or photo.entry.code in _CORNER_CODES)

    def name_corners(self, file: str, numbers: str) -> Path:
        """Keep the corners that a person tapped in photograph `file`, "x1,y1,...,x4,y4,width,height", and return its
        path. It is then measured again; nothing changes where no corners are wanted.
        """
        path = next((path for path in self._measured if _name_of(path) == file), None)
        pairs = np.array(numbers.split(",") if _TEN_NUMBERS.fullmatch(numbers) else [], float).reshape(-1, 2)
        if path is None or not len(pairs) or (pairs > pairs[-1]).any():
            raise Refused("four corners inside of a photograph", f"{numbers} in {file}"[:160], "load the page again")
        named = annotations.Drawn(tuple(pairs[:4].ravel().tolist()), (int(pairs[-1, 0]), int(pairs[-1, 1])))
        annotations.refuse_twisted(named, file, "the page")
        corners = annotations.corners_of_photo(named, file, path)
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
        grouping = Grouping(tuple(paths), tuple(names[path.parent.name] for path in paths), tuple(names), BY_FOLDERS)
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


def state_of(collection: PhotoCollection, sessions: int | None) -> dict[str, Any]:
    """Everything that the page shows, except for single answers; `sessions` (None: 4) are planned on the map."""
    report = collection.report()
    summary, data, promise = report.summary, report.summary.model_dump(), collection.promise
    counts = {row["name"]: row for row in data["sessions"]}
    rows = [counts.get(name, {"name": name, "judged": 0, "recognized": 0}) for name in collection.album.sessions]
    photos, width_mm = collection.photos, collection.manifest.cut_mm[2]
    counted = [photo.entry for path, photo in photos.items() if photo.counted and collection.control_of(path) is None]
    wanted = PHOTOS_PER_SESSION * (sessions or _USUAL_SESSIONS)
    names = sorted(photos, key=lambda path: path.name)  # in the order of arrival
    simulated = summary.worth is not None and summary.worth.source == "simulated"
    return {
        "verdict": summary.verdict,
        "headline": VERDICTS[summary.verdict],
        "reason": summary.reason,
        "effect": f"{headline_of(data)}. {benefit_sentence(data)}{_OF_REPORT if simulated else ''}",
        "photos": summary.photos,
        "judged": summary.judged,
        "sessions": rows,
        "each": PHOTOS_PER_SESSION,
        "plan": summary.next_step,
        "controls": [{"name": each.name, "photos": each.n, "recognized": each.recognized} for each in report.controls],
        "controls_known": [name for name in CONTROLS if name in promise.controls] or CONTROLS,
        "map": map_views(promise.conditions, counted, wanted, collection.side_px, width_mm),
        "latest": [answer_of(collection, path) for path in names[-_LATEST_PHOTOS:][::-1]],
    }


def answer_of(collection: PhotoCollection, path: Path, picture: np.ndarray | None = None) -> dict[str, Any]:
    """The answer to one measured photograph, with advice; `picture` (uint8 H×W×3) is included as a data URI."""
    photo, name = collection.photos[path], collection.promise.models[0].name
    entry = photo.entry
    prediction = entry.predictions.get(name) if photo.counted else None
    answer = "not counted" if prediction is None else "recognized" if prediction.recognized else "not recognized"
    return {
        "file": _name_of(path),
        "answer": answer,
        "tap": collection.wants_corners(path),
        "label": prediction and f"{prediction.label} {prediction.confidence:.0%}",
        "code": entry.code,
        "advice": "; ".join(filter(None, (entry.remark and entry.remark.advice, *entry.said))) or None,
        "view": _view_words(entry),
        "picture": None if picture is None else data_uri(jpeg(picture)),
    }


def _view_words(entry: PhotoEntry) -> str:
    """Describe the view by distance, side and tilt, as far as they were measured."""
    geometry, pose, parts = entry.geometry, entry.pose, []
    if pose is not None and pose.distance_mm is not None:
        parts.append(f"{pose.distance_mm / 1000:.2f} m")
    if pose is not None and pose.azimuth_deg is not None:
        parts.append(f"{abs(pose.azimuth_deg):.0f}° {'right' if pose.azimuth_deg > 0 else 'left'}")
    if geometry is not None and geometry.tilt_deg is not None:
        parts.append(f"tilt {geometry.tilt_deg:.0f}°")
    return ", ".join(parts)


def map_views(
    conditions: Sequence[ConditionClaim],
    entries: Sequence[PhotoEntry],
    wanted: int,
    side_px: float | None,
    piece_mm: float,
) -> dict[str, Any] | None:
    """Map counted photographs, of which `wanted` are needed in total; None if the conditions have no views.

    Columns run in degrees from left to right, rows from near to far (the piece's share of a picture's shorter
    `side_px`, or else pixels per millimeter); `next` is the (row, column) that lacks the most photographs, `elsewhere`
    counts those of unknown view. Photographs beyond the edges count in the outermost cells.
    """
    views = np.array([(c.azimuth_deg, c.px_per_mm) for c in conditions if c.azimuth_deg is not None and c.px_per_mm])
    if not len(views):
        return None
    (left, smallest), (right, largest) = views.min(0), views.max(0)
    columns = int(np.clip((right - left) // _LEAST_COLUMN_DEG, 1, _MOST_COLUMNS))
    azimuth_deg, distance = np.linspace(left, right, columns + 1), np.linspace(1 / largest, 1 / smallest, _ROWS + 1)

    def counts(points: np.ndarray) -> np.ndarray:
        inside = np.clip(1 / points[:, 1], *distance[[0, -1]]), np.clip(points[:, 0], left, right)
        return np.histogram2d(*inside, (distance, azimuth_deg))[0]

    figures = [figures_of(entry, side_px) for entry in entries]
    photo_views = [(each.get("azimuth_deg"), each.get("px_per_mm")) for each in figures]
    known_views = np.array([view for view in photo_views if None not in view]).reshape(-1, 2)
    photos, needed = counts(known_views).astype(int), np.rint(wanted * counts(views) / len(views)).astype(int)
    share, words = (1, "{:.1f}–{:.1f} px/mm") if side_px is None else (100 * piece_mm / side_px, "{:.0f}–{:.0f} %")
    return {
        "columns": [_azimuth_words(low, high) for low, high in pairwise(azimuth_deg)],
        "rows": [words.format(share * low, share * high) for high, low in pairwise(1 / distance)],
        "photos": photos.tolist(),
        "wanted": needed.tolist(),
        "elsewhere": len(photo_views) - len(known_views),
        "next": divmod(int((needed - photos).argmax()), columns) if (needed > photos).any() else None,
        "of_picture": side_px is not None,
    }


def _azimuth_words(low: float, high: float) -> str:
    """Describe a range of azimuths, as seen by somebody who looks at the piece."""
    if low < 0 < high:
        return f"{-low:.0f}° left to {high:.0f}° right"
    near, far = sorted((abs(low), abs(high)))
    return f"{near:.0f}–{far:.0f}° {'left' if low < 0 else 'right'}"
