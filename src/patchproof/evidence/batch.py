"""Each photograph of a folder, on its own: measured (over processes), classified, kept in the journal and let go.

In: `PhotoItem`s, a `Task` (all that a photograph is measured against), the networks, open workers. Out: a `MeasuredPhoto`
for each, in order, however they finished, without its pictures and squares. A file that cannot be read, cannot be
measured or ends its process each time becomes a rejected entry; the others go on. Of a control's photographs only what
the networks see counts, since a bare object carries no marker; one that shows nothing at all is rejected.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, ValidationError

from patchproof.base.errors import WorkerDied
from patchproof.base.geometry import apply_homography, rect_corners
from patchproof.base.resample import downscaled_size, to_sixteenths
from patchproof.base.validation import Finite, Share, StrictModel
from patchproof.base.workers import Workers, result_of
from patchproof.evidence.boxes import box_in_square
from patchproof.evidence.camera import pinhole_photo
from patchproof.evidence.classify import BoxEdges, Judges, square_of, squares_of
from patchproof.evidence.journal import Journal, file_sha256
from patchproof.evidence.measure import MeasuredPhoto, measure
from patchproof.evidence.reproject import PhotoSquare, photo_square
from patchproof.evidence.results import PhotoEntry, Remark
from patchproof.evidence.surface import Surface
from patchproof.evidence.task import Task
from patchproof.photo.exif import has_camera_shape
from patchproof.photo.limits import run_limited
from patchproof.photo.quality import FrameLight, is_featureless
from patchproof.photo.read import read_photo
from patchproof.photo.rejection import PhotoRejected

MAX_PICTURED_PHOTOS = 120  # photographs shown with pictures; the rest is listed. Keeps the page below some 15 MB
_THUMBNAIL_PX = 560  # longer side: enough for a phone's width at twice its density, some 40 kB as JPEG
_DESIGN_COLOR, _MARKER_COLOR = (255, 64, 129), (0, 200, 140)
_DIED = "measuring it ended its process each time, for want of memory: save it smaller"
_EMPTY = "it shows one tone or noise and nothing else: take it again"
# codes of photographs whose homography can still be believed
MEASURABLE_CODES = (None, "clipped", "blurred", "too_small", "cropped")
_PART = "it is a crop or a screenshot by its shape, its name or EXIF: it counts, but use the camera's own file"

# linear light of paper and ink; `frame_light` can give no more, and less than none of a print lighter than its paper
LightLevel = Annotated[Finite, Field(ge=-4, le=4)]


@dataclass(frozen=True)
class PhotoItem:
    """A photograph to look at, its name in the report, the control that it shows (None: the patch), whether pictures of
    it are wanted, and the box that somebody drew round the object.
    """

    path: Path
    file: str
    control: str | None = None
    with_pictures: bool = False
    box_px: BoxEdges | None = None

    @property
    def name(self) -> str:
        """Its name in the journal, where controls' photographs may be called as the patch's are."""
        return self.file if self.control is None else f"{self.control}/{self.file}"


def measure_all(
    task: Task,
    items: Sequence[PhotoItem],
    judges: Judges | None,
    workers: Workers,
    journal: Journal | None,
    on_pictures: Callable[[str, Mapping[str, np.ndarray]], None],
    step: Callable[[int, int], None],
) -> list[MeasuredPhoto]:
    """Every photograph in order; those in the journal are not opened again. `step` gets how many are done, and all."""
    photos: dict[int, MeasuredPhoto] = {}
    for number, item in enumerate(items):
        kept = journal.find(item.name, item.path) if journal is not None else None
        finished = None if kept is None else _parsed(kept, item, judges)
        if finished is not None:
            photos[number] = finished
    todo = [number for number in range(len(items)) if number not in photos]
    step(len(photos), len(items))
    for at, future in workers.completed(partial(_measured, task), [items[number] for number in todo]):
        number, item = todo[at], items[todo[at]]
        try:
            measured = result_of(future)
        except WorkerDied:
            measured = _rejected(item, Remark(code="unreadable", advice=_DIED))
        entry, squares, sha256 = measured.entry, measured.squares, file_sha256(item.path)
        predictions = judges.predictions(squares, entry.box) if judges and squares is not None else {}
        entry = entry.changed(sha256=sha256, predictions=predictions)
        if item.control is None:
            on_pictures(item.file, measured.pictures)
        kept = _serialized(replace(measured, entry=entry), item.with_pictures)
        if journal is not None:
            journal.add(item.name, sha256, kept)
        photos[number] = _Kept.model_validate(kept).photo  # as a later run will find it: both must not differ
        step(len(photos), len(items))
    return [photos[number] for number in range(len(items))]


class _Light(StrictModel):
    paper: tuple[LightLevel, LightLevel, LightLevel]
    ink: tuple[LightLevel, LightLevel, LightLevel]
    contrast: Finite
    clipped: Share


class _Kept(StrictModel):
    """A photograph's result in the journal."""

    entry: PhotoEntry
    counted: bool
    light: _Light | None
    pictures: bool

    @property
    def photo(self) -> MeasuredPhoto:
        light = self.light
        if light is not None:
            light = FrameLight(np.array(light.paper), np.array(light.ink), light.contrast, light.clipped)
        return MeasuredPhoto(self.entry, self.counted, light=light)


def _serialized(measured: MeasuredPhoto, pictures: bool) -> dict[str, Any]:
    light = measured.light and {key: np.asarray(value).tolist() for key, value in vars(measured.light).items()}
    entry = measured.entry.model_dump(mode="json")
    return {"entry": entry, "counted": measured.counted, "light": light, "pictures": pictures}


def _parsed(kept: Mapping[str, Any], item: PhotoItem, judges: Judges | None) -> MeasuredPhoto | None:
    """What the journal has of the photograph; None where it is of another, or not what this run needs."""
    try:
        result = _Kept.model_validate(kept)
    except ValidationError:
        return None
    entry, names = result.entry, {model.name for model in judges.models} if judges else set()
    whole = entry.file == item.file and set(entry.predictions) in (set(), names)
    return result.photo if whole and (result.pictures or not item.with_pictures) else None


def _measured(task: Task, item: PhotoItem) -> MeasuredPhoto:
    try:
        return run_limited(_measure, task, item)
    except PhotoRejected as cannot:
        return _rejected(item, Remark.of(cannot))
    except (ArithmeticError, ValueError, TypeError, LookupError, MemoryError, cv2.error) as error:
        # no photograph is known that does this; one that does must not cost the others
        advice = f"it could not be measured ({type(error).__name__}): leave it out, or take it again"
        return _rejected(item, Remark(code="unreadable", advice=advice))


def _measure(task: Task, item: PhotoItem) -> MeasuredPhoto:
    photo = read_photo(item.path)
    squares, size_px = squares_of(photo.srgb, task.sizes_px), photo.srgb.shape[1::-1]
    box = None if item.box_px is None else box_in_square(item.box_px, size_px)
    if item.control is not None:
        if is_featureless(square_of(photo.srgb)[0]):
            return _rejected(item, Remark(code="empty", advice=_EMPTY))
        return MeasuredPhoto(PhotoEntry(file=item.file, status="judged", box=box), True, squares=squares)
    view = pinhole_photo(photo, task.camera)
    wanted = task.scan_dpi, item.with_pictures
    measured = measure(view, item.file, task.surface, task.promised, task.ranges, *wanted)
    entry, pictures = measured.entry, {}
    # a crop or a screenshot: EXIF or its name says so, or cameras and the promise have other shapes
    if measured.counted and entry.code is None and (photo.is_crop or not has_camera_shape(size_px, task.photo_px)):
        entry = entry.changed(remark=Remark(code="cropped", advice=_PART))
    if item.with_pictures:
        px_from_mm = entry.geometry and entry.geometry.homography_px_from_mm
        pictures = {"photo": _thumbnail(view.srgb, px_from_mm, task.surface), **measured.pictures}
    return replace(measured, entry=entry.changed(box=box or entry.box), pictures=pictures, squares=squares)


def _thumbnail(srgb: np.ndarray, px_from_mm: ArrayLike | None, surface: Surface) -> np.ndarray:
    """The photograph reduced, with the outline of the design and of the piece's markers where they are known to lie."""
    shrink = min(1.0, _THUMBNAIL_PX / max(srgb.shape[:2]))
    size = downscaled_size(srgb.shape[1::-1], _THUMBNAIL_PX)
    # four pixels for each of it: all of 12 megapixels took a tenth of the whole measurement's time
    few = cv2.resize(srgb, (2 * size[0], 2 * size[1]), interpolation=cv2.INTER_NEAREST)
    small = cv2.resize(few, size, interpolation=cv2.INTER_AREA)
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
    """What it takes to put other pieces into a photograph, which is read again for it: only few are, and none waits.

    None where that cannot be done: it does not count, or its sheet is not flat or not to be believed.
    """
    path, measured = item
    entry, geometry, light = measured.entry, measured.entry.geometry, measured.light
    believed = measured.counted and entry.code in MEASURABLE_CODES
    if not believed or geometry is None or geometry.homography_px_from_mm is None or light is None:
        return None
    px_from_mm, blur_px = np.array(geometry.homography_px_from_mm), geometry.blur_px

    def shot() -> PhotoSquare | None:
        view = pinhole_photo(read_photo(path), task.camera)
        shot = photo_square(entry.file, view.srgb, px_from_mm, blur_px, light, task.surface, size_px, view.matrix_px)
        return shot and replace(shot, box=measured.entry.box)

    try:
        return run_limited(shot)
    except (PhotoRejected, ArithmeticError, ValueError, LookupError, MemoryError, cv2.error):
        return None  # read before, so this is a file that went away: the ledger does without
