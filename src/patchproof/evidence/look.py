"""Each photograph of a folder, on its own: measured (over processes), classified, kept in the journal and let go.

In: paths, a `Task` (all that a photograph is measured against), what the networks say of squares, open workers. Out:
a `Seen` for each photograph, in order, however they finished; a `Glanced` for each photograph of a control. A file
that cannot be read, cannot be measured or ends its process each time becomes a rejected entry; the others go on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from patchproof.evidence.camera import view_of
from patchproof.evidence.classify import squares_of
from patchproof.evidence.journal import Journal, file_sha256
from patchproof.evidence.ledger import usable
from patchproof.evidence.measure import measure
from patchproof.evidence.pictures import thumbnail
from patchproof.evidence.ranges import PromisedRanges, promised_ranges, promised_side_px
from patchproof.evidence.reproject import Shot, shot_of
from patchproof.evidence.results import PhotoEntry, Prediction
from patchproof.evidence.surface import Promised, Surface, promised_of, surface_of
from patchproof.photo.cannot import CannotJudge
from patchproof.photo.quality import FrameLight
from patchproof.photo.read import read_photo
from patchproof.workers import WorkerDied, Workers, result_of

if TYPE_CHECKING:
    from patchproof.channel.lens import Camera

WITH_PICTURES = 120  # photographs shown with pictures; the rest is listed. Keeps the page below some 15 MB
JudgeAll = Callable[[Mapping[int, np.ndarray]], dict[str, Prediction]]


@dataclass(frozen=True)
class Task:
    """All that one photograph is measured against; small enough to be sent to another process."""

    surface: Surface
    promised: Promised | None
    ranges: PromisedRanges
    sizes_px: tuple[int, ...]
    scan_dpi: float | None
    camera: Camera | None
    ledger_px: int | None  # the primary network's input size, where there can be a ledger


@dataclass(frozen=True)
class Looked:
    """One photograph as it comes from the process that measured it."""

    entry: PhotoEntry
    counted: bool
    light: FrameLight | None
    pictures: dict[str, np.ndarray]
    squares: dict[int, np.ndarray] | None  # None: unreadable


@dataclass(frozen=True)
class Seen:
    """What is kept of one photograph: its entry with predictions, whether it counts, the light on its frame."""

    entry: PhotoEntry
    counted: bool
    light: FrameLight | None


@dataclass(frozen=True)
class Glanced:
    """A control photograph and whether its networks recognize the target; none where it is unreadable."""

    file: str
    predictions: dict[str, Prediction]


def set_task(manifest, models, printer, scan_dpi, camera) -> Task:
    """What all photographs of a verification are measured against; the manifest's printer where none is given."""
    surface = surface_of(manifest)
    conditions = manifest.promise.conditions if manifest.promise else ()
    promised = None
    if manifest.design:
        if printer is None:
            from patchproof.channel.printer import load_printer

            printer = load_printer(manifest.settings.get("printer", {}).get("profile", "coated"))
        promised = promised_of(manifest, surface, printer)
    sizes = tuple(sorted({m.input_px for m in models})) if manifest.promise else ()
    ledger_px = None
    if manifest.promise and promised is not None:
        ledger_px = next(m.input_px for m in models if m.name == manifest.promise.models[0].name)
    ranges = promised_ranges(conditions, promised_side_px(manifest))
    return Task(surface, promised, ranges, sizes, scan_dpi, camera, ledger_px)


def look_at_all(
    task: Task,
    paths: Sequence[Path],
    judge_all: JudgeAll,
    workers: Workers,
    kept: Journal | None,
    on_pictures: Callable[[str, Mapping[str, np.ndarray]], None],
    step: Callable[[int], None],
) -> list[Seen]:
    """Every photograph in order; those in the journal `kept` are not opened again. `step` gets how many are done."""
    seen: list[Seen | None] = [None] * len(paths)
    for number, path in enumerate(paths):
        said = kept.find(path.name, path) if kept is not None else None
        if said is not None and (said["pictures"] or number >= WITH_PICTURES):
            seen[number] = _seen_again(said)
    todo = [(number, path) for number, path in enumerate(paths) if seen[number] is None]
    done = len(paths) - len(todo)
    step(done)
    for at, future in workers.completed(partial(_look, task), todo):
        number, path = todo[at]
        try:
            looked = result_of(future)
        except WorkerDied:
            looked = _unreadable(path, "measuring it ended its process each time, for want of memory: save it smaller")
        predictions = {} if looked.squares is None else judge_all(looked.squares)
        entry = looked.entry.model_copy(update={"predictions": predictions})
        on_pictures(path.name, looked.pictures)
        said = _said(Seen(entry, looked.counted, looked.light), number < WITH_PICTURES)
        if kept is not None:
            kept.add(path.name, path, said)
        seen[number] = _seen_again(said)  # as a later run will find it: what is kept and what is new must not differ
        done += 1
        step(done)
    return seen


def _look(task: Task, numbered: tuple[int, Path]) -> Looked:
    number, path = numbered
    sha256 = file_sha256(path)
    try:
        photo = read_photo(path)
        squares = squares_of(photo.srgb, task.sizes_px)
        view = view_of(photo, task.camera)
        measured = measure(view, path.name, task.surface, task.promised, task.ranges, task.scan_dpi)
        # checked here, where a figure that is no number costs one photograph
        entry = PhotoEntry.model_validate(measured.entry.model_dump(mode="json") | {"sha256": sha256})
        pictures = {}
        if number < WITH_PICTURES:
            pictures = {"photo": thumbnail(view.photo.srgb, entry, task.surface), **measured.pictures}
    except CannotJudge as cannot:
        codes = {"code": cannot.code, "figure": cannot.figure, "threshold": cannot.threshold, "advice": cannot.advice}
        return Looked(PhotoEntry(file=path.name, status="rejected", sha256=sha256, **codes), False, None, {}, None)
    except (ArithmeticError, ValueError, TypeError, LookupError, MemoryError, cv2.error) as error:
        # no photograph is known that does this; one that does must not cost the others
        return _unreadable(path, f"it could not be measured ({type(error).__name__}): leave it out, or take it again")
    return Looked(entry, measured.counted, measured.light, pictures, squares)


def _unreadable(path: Path, advice: str) -> Looked:
    entry = PhotoEntry(file=path.name, status="rejected", code="unreadable", advice=advice)
    return Looked(entry, False, None, {}, None)


def _said(seen: Seen, with_pictures: bool) -> dict[str, Any]:
    light = None if seen.light is None else {k: np.asarray(v).tolist() for k, v in asdict(seen.light).items()}
    return {
        "entry": seen.entry.model_dump(mode="json"),
        "counted": seen.counted,
        "light": light,
        "pictures": with_pictures,
    }


def _seen_again(said: Mapping[str, Any]) -> Seen:
    light = said["light"]
    if light is not None:
        light = FrameLight(np.array(light["paper"]), np.array(light["ink"]), light["contrast"], light["clipped"])
    return Seen(PhotoEntry.model_validate(said["entry"]), said["counted"], light)


def glance_at_all(task, name: str, paths: Sequence[Path], judge_all, workers: Workers, kept, step) -> list[Glanced]:
    """A control's photographs in order; a name of their own keeps them apart in the journal."""
    found: list[Glanced | None] = [None] * len(paths)
    for number, path in enumerate(paths):
        said = kept.find(f"{name}/{path.name}", path) if kept is not None else None
        if said is not None:
            found[number] = Glanced(path.name, {k: Prediction.model_validate(p) for k, p in said.items()})
    todo = [number for number in range(len(paths)) if found[number] is None]
    done = len(paths) - len(todo)
    for at, future in workers.completed(partial(_glance, task), [paths[number] for number in todo]):
        number, path = todo[at], paths[todo[at]]
        try:
            squares = result_of(future)
        except WorkerDied:
            squares = None
        found[number] = Glanced(path.name, {} if squares is None else judge_all(squares))
        if kept is not None:
            said = {k: p.model_dump(mode="json") for k, p in found[number].predictions.items()}
            kept.add(f"{name}/{path.name}", path, said)
        done += 1
        step(done)
    return found


def _glance(task: Task, path: Path) -> dict[int, np.ndarray] | None:
    """A control photograph: only what the networks see of it counts, since a bare object carries no marker."""
    try:
        return squares_of(read_photo(path).srgb, task.sizes_px)
    except (CannotJudge, MemoryError, cv2.error):
        return None


def in_ledger(seen: Seen) -> bool:
    """Whether the gap ledger can work with a photograph: it counts, and its sheet is flat and can be believed."""
    entry = seen.entry
    flat = entry.homography_px_from_mm is not None and entry.blur_px is not None and seen.light is not None
    return seen.counted and flat and usable(entry.status, entry.code)


def shot_again(task: Task, item: tuple[Path, PhotoEntry, FrameLight]) -> Shot | None:
    """What the ledger needs of a photograph, which is read again for it: only few are, and none then waits."""
    path, entry, light = item
    try:
        view = view_of(read_photo(path), task.camera)
        return shot_of(view.photo.srgb, entry, light, task.surface, task.ledger_px)
    except (CannotJudge, ArithmeticError, ValueError, LookupError, MemoryError, cv2.error):
        return None  # read before, so this is a file that went away: the ledger does without
