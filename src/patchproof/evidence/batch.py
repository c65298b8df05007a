"""Measure each photograph of a folder (over processes), classify it, write it to the journal and free its memory.

In: `PhotoItem`s, a `Task` (all that a photograph is measured against), the networks, open workers. Out: a
`MeasuredPhoto` for each, in their order, without pictures and squares. A file that cannot be read or measured, or that
ends its process each time, becomes a rejected entry, and the batch continues. Photographs of controls are only
classified, since a bare object carries no marker; one that shows the patch, or a single tone or noise, is rejected.

The journal has one flushed line per finished photograph, so that a kill loses only those in work, and a key that stands
for everything a result depends on besides the photograph itself. Lines of other keys and broken lines are dropped, so
that a photograph is measured again if it, a network, the sheet or an option changed.
"""

import io
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Annotated, TextIO

import cv2
import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from patchproof.base.color import linear_from_srgb
from patchproof.base.errors import Refused, WorkerDied
from patchproof.base.fingerprint import value_sha256
from patchproof.base.geometry import apply_homography, rect_corners
from patchproof.base.input import MAX_JSON_BYTES, hash_file, is_file, read_file
from patchproof.base.output import make_folder, write_atomically
from patchproof.base.resample import downscale, downscaled_size, to_sixteenths
from patchproof.base.validation import Finite, Share, StrictModel, validate_model
from patchproof.base.version import __version__
from patchproof.base.workers import Workers, result_of
from patchproof.evidence.classify import BoxEdges, Judges, box_in_square, square_of, squares_of
from patchproof.evidence.locate import pinhole_photo
from patchproof.evidence.measure import MeasuredPhoto, measure
from patchproof.evidence.reproject import PhotoSquare, photo_square
from patchproof.evidence.results import PhotoEntry, Remark, Trace
from patchproof.evidence.surface import Surface
from patchproof.evidence.task import Options, Task
from patchproof.photo import detect
from patchproof.photo.exif import has_camera_shape, time_and_camera
from patchproof.photo.limits import MOST_BYTES, run_limited
from patchproof.photo.quality import FrameLight, is_featureless
from patchproof.photo.read import GONE_ADVICE, HEIC_ADVICE, read_photo
from patchproof.photo.registration import DesignCorners
from patchproof.photo.rejection import PhotoRejected
from patchproof.sheets.manifest import Manifest
from patchproof.sheets.markers import aruco_dictionary

MAX_PICTURED_PHOTOS = 120  # photographs whose pictures are on the page; the rest is listed. Keeps it below some 15 MB
_THUMBNAIL_PX = 560  # longer side: enough for a phone's width at twice its density, some 40 kB as JPEG
_DESIGN_COLOR, _MARKER_COLOR = (255, 64, 129), (0, 200, 140)
_DIED_ADVICE = "measuring it ended its process each time, for want of memory: save it smaller"
_UNCUT = "photographs of the uncut page, which check the print and are not counted (cut the piece out)"
_EMPTY_ADVICE = "it shows one tone or noise and nothing else: take it again"
# Longer side of the copy of a control's photograph that is searched for sheets (a full search of one that shows none
# takes a second), and the markers that prove a sheet.
_CONTROL_PX, _PROVING_MARKERS = 2400, 2
_OTHER_SHEET_ADVICE = "it shows the {}, not the control {}: put it where it belongs"
_CROP_ADVICE = "it is a crop or a screenshot by its shape, its name or EXIF: it counts, but use the camera's own file"
_MOST_OUTSIDE = 0.01  # of the picture's longer side, for corners on its edge
_OUTSIDE_ADVICE = "its corners lie outside of it: name pixels of the upright picture, which has {} × {}"
_OTHER_DPI = "resolutions of scans by their files, {:.0f} × {:.0f} dpi, where --scan-dpi says {:g}"
# codes of photographs whose homography is still accurate enough to put pieces into them
MEASURABLE_CODES = (None, "clipped", "blurred", "too_small", "cropped", "weak_ink", "noisy")
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


def settings_key(manifest: Manifest, options: Options) -> str:
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


@dataclass(frozen=True)
class PhotoItem:
    """A photograph to measure: its name in the report, the control that it shows (None: the patch), whether the page
    shows its pictures, the object's drawn box in shares of the upright photograph's sides, and the design's corners.
    """

    path: Path
    file: str
    control: str | None = None
    with_pictures: bool = False
    box: BoxEdges | None = None
    corners: DesignCorners | None = None

    @property
    def name(self) -> str:
        """The name that tells a control's photograph from one of the patch with the same file name."""
        return self.file if self.control is None else f"{self.control}/{self.file}"

    @property
    def journal_name(self) -> str:
        """The name in the journal: photographs are measured again if their corners change."""
        return self.name if self.corners is None else f"{self.name} {self.corners.px.tolist()}"


def measure_all(
    task: Task,
    items: Sequence[PhotoItem],
    judges: Judges | None,
    workers: Workers,
    journal: Journal | None,
    on_pictures: Callable[[str, Mapping[str, np.ndarray]], None],
    step: Callable[[int, int], None],
) -> list[MeasuredPhoto]:
    """Measure every photograph, in order; the journal's are not opened again. `step` gets (done, total)."""
    photos, networks = dict[int, MeasuredPhoto](), {model.name for model in judges.models} if judges else set()
    for number, item in enumerate(items):
        found = None if journal is None else journal.find(item.journal_name, item.path)
        if found is not None and found.entry.file == item.file and found.pictures >= item.with_pictures:
            if set(found.entry.predictions) in (set(), networks):
                photos[number] = found.photo
    todo = [number for number in range(len(items)) if number not in photos]
    step(len(photos), len(items))
    for position, future in workers.completed(partial(_measure_or_reject, task), [items[number] for number in todo]):
        number, item = todo[position], items[todo[position]]
        try:
            measured = result_of(future)
        except WorkerDied:
            measured = _rejected(item, Remark(code="unreadable", advice=_DIED_ADVICE))
        entry, squares, sha256 = measured.entry, measured.squares, file_sha256(item.path)
        if sha256 and entry.remark and entry.remark.advice == GONE_ADVICE:
            do = "let all its machines see them at the same paths"
            raise Refused("the photographs on a cluster's machines, too", f"none at {item.path}", do)
        predictions = judges.predictions(squares, entry.box) if judges and squares is not None else {}
        entry = entry.changed(sha256=sha256, predictions=predictions)
        if item.control is None:
            on_pictures(item.file, measured.pictures)
        finished = FinishedPhoto.of(replace(measured, entry=entry), item.with_pictures)
        if journal is not None and not (entry.remark and entry.remark.advice == HEIC_ADVICE):  # it may be installed
            journal.add(item.journal_name, sha256, finished)
        photos[number] = finished.photo
        step(len(photos), len(items))
    return [photos[number] for number in range(len(items))]


def _measure_or_reject(task: Task, item: PhotoItem) -> MeasuredPhoto:
    try:
        return run_limited(_measure, task, item)
    except PhotoRejected as rejection:
        return _rejected(item, Remark.of(rejection))
    except (ArithmeticError, ValueError, TypeError, LookupError, MemoryError, cv2.error) as error:
        # no known photograph causes this; one that does must not stop the batch
        advice = f"it could not be measured ({type(error).__name__}): leave it out, or take it again"
        return _rejected(item, Remark(code="unreadable", advice=advice))


def _measure(task: Task, item: PhotoItem) -> MeasuredPhoto:
    photo = read_photo(item.path)
    squares, size_px = squares_of(photo.srgb, task.sizes_px), photo.srgb.shape[1::-1]
    box = None if item.box is None else box_in_square(item.box, size_px)
    if item.control is not None:
        if is_featureless(square_of(photo.srgb)[0]):
            raise PhotoRejected("empty", None, None, _EMPTY_ADVICE)
        _refuse_other_sheet(photo.srgb, task, item.control)
        entry = PhotoEntry(file=item.file, status="judged", box=box, said=photo.said)
        return MeasuredPhoto(entry, True, squares=squares, trace=_trace(item.path, photo.srgb))
    view = pinhole_photo(photo, task.camera)
    corners = item.corners
    if corners is not None:
        stored_px = photo.step * np.array(size_px)
        outside = float(np.maximum(-corners.px, corners.px - stored_px).max())
        if outside > _MOST_OUTSIDE * max(stored_px):
            raise PhotoRejected("no_corners", outside, 0.0, _OUTSIDE_ADVICE.format(*stored_px))
        corners = replace(corners, px=corners.px / photo.step, sigma_px=corners.sigma_px / photo.step)
        if view.calibrated and task.camera is not None:
            corners = replace(corners, px=task.camera.undistort_points(corners.px, size_px))
    parts = task.surface, task.promised, task.ranges, task.scan_dpi
    measured = measure(view, item.file, *parts, item.with_pictures, corners, task.find)
    entry, pictures = measured.entry, {}
    # a crop or a screenshot by EXIF or its name, or by a shape that neither cameras nor the promise have
    if measured.counted and entry.code is None and (photo.is_crop or not has_camera_shape(size_px, task.photo_px)):
        entry = entry.changed(remark=Remark(code="cropped", advice=_CROP_ADVICE))
    if item.with_pictures:
        px_from_mm = entry.geometry and entry.geometry.homography_px_from_mm
        pictures = {"photo": _thumbnail(view.srgb, px_from_mm, task.surface), **measured.pictures}
    said = photo.said
    if task.scan_dpi and not measured.counted and any(abs(dpi / task.scan_dpi - 1) > 0.01 for dpi in photo.dpi if dpi):
        said += (_OTHER_DPI.format(*photo.dpi, task.scan_dpi),)
    if entry.status == "measured" and not measured.counted and not task.scan_dpi:
        said += (_UNCUT,)
    entry = entry.changed(box=box or entry.box, said=said)
    return replace(measured, entry=entry, pictures=pictures, squares=squares, trace=_trace(item.path, photo.srgb))


def _refuse_other_sheet(srgb: np.ndarray, task: Task, control: str) -> None:
    """Raise `PhotoRejected` if a control's photograph shows the patch, or the sheet of a control of another name. Under
    names of the user's own only the patch is refused.
    """
    detections, small = dict[int, list[np.ndarray]](), downscale(srgb, _CONTROL_PX)
    region, dictionary = detect.full_region(small), aruco_dictionary(task.surface.dictionary)
    for level in islice(detect.pyramid_levels(small, region), 2):
        detect.search_level(small, region, level, dictionary, detections)
    for kind, ids in task.ids_by_kind.items():
        markers, known = len(detections.keys() & ids), control in (*task.ids_by_kind, "bare")
        if markers >= _PROVING_MARKERS and kind != control and (known or kind == "design"):
            shown = "patch" if kind == "design" else f"control {kind}"
            raise PhotoRejected("wrong_sheet", markers, 0, _OTHER_SHEET_ADVICE.format(shown, control))


def _trace(path: Path, srgb: np.ndarray) -> Trace:
    """Read time and camera, and average the outer eighth of the picture on each side, where the piece rarely is."""
    step = max(1, min(srgb.shape[:2]) // 256)  # averaging all pixels of large photographs takes long
    sampled = np.ascontiguousarray(srgb[::step, ::step])
    small = linear_from_srgb(cv2.resize(sampled, (32, 32), interpolation=cv2.INTER_AREA) / 255)
    frame = np.pad(np.zeros((24, 24), bool), 4, constant_values=True)
    red, green, blue = map(float, small[frame].mean(0))
    minute, camera = time_and_camera(path)
    return Trace(minute=minute, camera=camera, frame=(red, green, blue))


def _thumbnail(srgb: np.ndarray, px_from_mm: ArrayLike | None, surface: Surface) -> np.ndarray:
    """Reduce the photograph and draw the outlines of the design and of the piece's markers, if their place is known."""
    shrink = min(1.0, _THUMBNAIL_PX / max(srgb.shape[:2]))
    size = downscaled_size(srgb.shape[1::-1], _THUMBNAIL_PX)
    # averages four pixels each: averaging all of 12 megapixels took a tenth of the whole measurement's time
    sampled = cv2.resize(srgb, (2 * size[0], 2 * size[1]), interpolation=cv2.INTER_NEAREST)
    small = cv2.resize(sampled, size, interpolation=cv2.INTER_AREA)
    if px_from_mm is None:
        return small
    small_from_mm = np.diag([shrink, shrink, 1.0]) @ np.asarray(px_from_mm)
    markers = [(surface.corners_mm[marker_id], _MARKER_COLOR, 1) for marker_id in sorted(surface.piece_ids)]
    for corners_mm, color, width in (*markers, (rect_corners(surface.rect_mm), _DESIGN_COLOR, 2)):
        points = to_sixteenths(apply_homography(small_from_mm, corners_mm))
        cv2.polylines(small, [points], True, color, width, cv2.LINE_AA, 4)
    return small


def _rejected(item: PhotoItem, remark: Remark) -> MeasuredPhoto:
    return MeasuredPhoto(PhotoEntry(file=item.file, status="rejected", remark=remark), False)


def reread_square(task: Task, size_px: int, item: tuple[Path, MeasuredPhoto]) -> PhotoSquare | None:
    """Read a measured photograph again, to put other pieces into it: keeping all of them would cost memory. None if it
    is not counted, its sheet is not flat or its homography is not reliable.
    """
    path, measured = item
    entry, geometry, light = measured.entry, measured.entry.geometry, measured.light
    reliable = measured.counted and entry.code in MEASURABLE_CODES
    if not reliable or geometry is None or geometry.homography_px_from_mm is None or light is None:
        return None
    px_from_mm, blur_px = np.array(geometry.homography_px_from_mm), geometry.blur_px
    surface = task.surface if geometry.located == "markers" else task.surface.without_markers

    def shot() -> PhotoSquare | None:
        srgb = pinhole_photo(read_photo(path), task.camera).srgb
        shot = photo_square(entry.file, srgb, px_from_mm, blur_px, light, surface, size_px)
        return shot and replace(shot, box=measured.entry.box)

    try:
        return run_limited(shot)
    except (PhotoRejected, ArithmeticError, ValueError, LookupError, MemoryError, cv2.error):
        return None  # it was readable before, so the file is gone: the ledger does without it
