"""A folder of photographs against a manifest: every photograph listed, one bad file never stops the batch.

In: photographs, a manifest, networks, and where there are any photographs of controls. Out: `Evidence`: the report
and its pictures. Photographs are taken in the order of their names; sidecar files and anything that is no picture by
its suffix are never opened. Each is measured on its own (over processes when `jobs` > 1) and leaves small squares
behind, which the networks then see in batches.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from patchproof.claims import wilson
from patchproof.photo.cannot import CannotJudge
from patchproof.photo.read import list_photos, pictures_in, read_photo
from patchproof.settings import Refused
from patchproof.sheet.manifest import Manifest
from patchproof.verify.camera import view_of
from patchproof.verify.classify import check_primary, predict, squares_of, target_indices
from patchproof.verify.ledger import Ledger, ledger_of, usable
from patchproof.verify.measure import Measured, measure
from patchproof.verify.pictures import thumbnail
from patchproof.verify.ranges import PromisedRanges, matched_rate, promised_ranges
from patchproof.verify.reproject import Shot, shot_of
from patchproof.verify.results import Control, Evidence, ModelRate, PhotoEntry, Report, Summary
from patchproof.verify.surface import Promised, Surface, promised_of, surface_of
from patchproof.verify.verdict import Verdict, compare, effect_of, judge
from patchproof.workers import open_workers

if TYPE_CHECKING:
    from patchproof.channel.lens import Camera
    from patchproof.channel.printer import Printer
    from patchproof.classifier import Classifier

LEDGER_PHOTOS = 24  # each costs 16 classifications; 24 leave intervals of some ± 5 points
WITH_PICTURES = 120  # photographs shown with pictures; the rest is listed. Keeps the page below some 15 MB


def gather_evidence(
    photos: str | Path,
    manifest: Manifest,
    *,
    models: Sequence[Classifier],
    printer: Printer | None = None,
    scan_dpi: float | None = None,
    controls: str | Path | None = None,
    camera: Camera | None = None,
    card: bool = False,
    ledger_photos: int = LEDGER_PHOTOS,
    jobs: int = 1,
    cluster: str | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Evidence:
    """Measure, classify and judge every picture in the folder (or the one picture) `photos`.

    `printer` is the appearance model that the promise was made with (None: the manifest's profile by its name).
    `camera` replaces the EXIF focal length and takes out the lens; `card` looks for a bank card in its outline.
    `ledger_photos` of the photographs at most, spread evenly, go into the gap ledger (0: no ledger). `progress` is
    called with (done, all). Photographs are measured by `jobs` local processes or by a Dask cluster's workers.
    """
    paths = list_photos(photos)
    control_paths = _list_controls(controls) if controls is not None else {}
    if manifest.promise:
        check_primary(models, manifest.promise)
    task = _task(manifest, models, printer, scan_dpi, camera, card, _spread(len(paths), ledger_photos))
    total = len(paths) + sum(map(len, control_paths.values()))
    with open_workers(jobs, cluster) as workers:
        looks = workers.map(partial(_look, task), enumerate(paths), lambda done, _: progress(done, total))
        control_looks, done = {}, len(paths)
        for name, files in control_paths.items():
            control_looks[name] = workers.map(
                partial(_glance, task), files, lambda more, _, done=done: progress(done + more, total)
            )
            done += len(files)
    indices = {m.name: target_indices(m, manifest) for m in models} if manifest.promise else {}
    entries = _with_predictions(looks, models, indices)
    ledger = _ledger(task, manifest, models, indices, entries, looks)
    return _evidence(manifest, models, indices, entries, looks, control_looks, ledger)


def _spread(count: int, most: int) -> frozenset[int]:
    """At most `most` of `count` numbers from 0, evenly spread."""
    return frozenset(range(count)) if count <= most else frozenset(i * count // most for i in range(most))


def _list_controls(folder: str | Path) -> dict[str, list[Path]]:
    """Photographs by control: the folder's own pictures, or one control for each folder in it."""
    folder = Path(folder)
    if not folder.is_dir():
        raise Refused("a folder of control photographs", f"no folder at {folder}", "check the path")
    if own := pictures_in(folder):
        return {folder.name: own}
    inside = {p.name: pictures_in(p) for p in sorted(folder.iterdir()) if p.is_dir() and not p.name.startswith(".")}
    inside = {name: files for name, files in inside.items() if files}
    if not inside:
        raise Refused(f"control photographs in {folder}", "none", "copy them there, one control per folder")
    return inside


@dataclass(frozen=True)
class _Task:
    """All that one photograph is measured against; small enough to be sent to another process."""

    surface: Surface
    promised: Promised | None
    ranges: PromisedRanges
    sizes_px: tuple[int, ...]
    scan_dpi: float | None
    camera: Camera | None
    card: bool
    ledger_px: int | None  # the primary network's input size, where there can be a ledger
    ledger: frozenset[int]  # numbers of the photographs that go into it


@dataclass(frozen=True)
class _Looked:
    """What is kept of one photograph once it has been seen."""

    measured: Measured
    squares: dict[int, np.ndarray] | None
    shot: Shot | None = None


def _task(manifest, models, printer, scan_dpi, camera, card, ledger) -> _Task:
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
    return _Task(surface, promised, promised_ranges(conditions), sizes, scan_dpi, camera, card, ledger_px, ledger)


def _look(task: _Task, numbered: tuple[int, Path]) -> _Looked:
    number, path = numbered
    try:
        photo = read_photo(path)
    except CannotJudge as cannot:
        entry = PhotoEntry(
            file=path.name,
            status="rejected",
            code=cannot.code,
            figure=cannot.figure,
            threshold=cannot.threshold,
            advice=cannot.advice,
        )
        return _Looked(Measured(entry, False, {}), None)
    try:
        view = view_of(photo, task.camera)
        measured = measure(view, path.name, task.surface, task.promised, task.ranges, task.scan_dpi, task.card)
    except (ArithmeticError, ValueError, LookupError, MemoryError, cv2.error) as error:
        # no photograph is known that does this; one that does must not cost the others
        advice = f"it could not be measured ({type(error).__name__}): leave it out, or take it again"
        entry = PhotoEntry(file=path.name, status="rejected", code="unreadable", advice=advice)
        return _Looked(Measured(entry, False, {}), None)
    pictures = {}
    if number < WITH_PICTURES:
        pictures = {"photo": thumbnail(view.photo.srgb, measured.entry, task.surface), **measured.pictures}
    shot, entry = None, measured.entry
    if number in task.ledger and task.ledger_px and measured.counted and usable(entry.status, entry.code):
        shot = shot_of(view.photo.srgb, entry, measured.light, task.surface, task.ledger_px)
    return _Looked(Measured(entry, measured.counted, pictures), squares_of(photo.srgb, task.sizes_px), shot)


def _glance(task: _Task, path: Path) -> tuple[str, dict[int, np.ndarray] | None]:
    """A control photograph: only what the networks see of it counts, since a bare object carries no marker."""
    try:
        return path.name, squares_of(read_photo(path).srgb, task.sizes_px)
    except CannotJudge:
        return path.name, None


def _with_predictions(looks: Sequence[_Looked], models, indices) -> list[PhotoEntry]:
    """The entries with what every network says of every readable photograph."""
    readable = [n for n, look in enumerate(looks) if look.squares is not None]
    predictions: list[dict] = [{} for _ in looks]
    for model in models if indices else ():
        squares = [looks[n].squares[model.input_px] for n in readable]
        for n, prediction in zip(readable, predict(model, indices[model.name], squares), strict=True):
            predictions[n][model.name] = prediction
    return [
        look.measured.entry.model_copy(update={"predictions": p}) for look, p in zip(looks, predictions, strict=True)
    ]


def _ledger(task: _Task, manifest, models, indices, entries, looks) -> Ledger | None:
    shots = [look.shot for look in looks if look.shot is not None]
    if not shots:
        return None
    model = next(m for m in models if m.name == manifest.promise.models[0].name)
    confidence = {e.file: e.predictions[model.name].target_confidence for e in entries if e.predictions}
    return ledger_of(shots, manifest, task.surface, task.promised, model, indices[model.name], confidence)


def _evidence(manifest, models, indices, entries, looks, control_looks, ledger) -> Evidence:
    counted = [e for e, look in zip(entries, looks, strict=True) if look.measured.counted]
    verdict, effect, controls = Verdict("cannot_tell", None, "The sheet promises nothing."), "not_tested", ()
    rate, matched = ModelRate(rate=None, interval=None), None
    rates = {m.name: _rate([e.predictions[m.name].recognized for e in counted]) for m in models} if indices else {}
    if manifest.promise:
        promise, primary = manifest.promise, manifest.promise.models[0].name
        results = {e.file: e.predictions[primary].recognized for e in counted}
        without = sum(e.code == "too_few_markers" and e.status == "rejected" for e in entries)
        goal = promise.target.goal
        verdict = judge(sum(results.values()), len(results), promise.rate, promise.n, goal, without)
        rate, matched = rates[primary], matched_rate((e for e in counted if e.status == "measured"), promise.conditions)
        model = next(m for m in models if m.name == primary)
        controls, effect = _compared(model, indices[primary], results, control_looks, goal)
    summary = Summary(
        photos=len(entries),
        judged=len(counted),
        measured=sum(e.status == "measured" for e in entries),
        rate=rate.rate,
        interval=rate.interval,
        prediction_interval=verdict.prediction_interval,
        verdict=verdict.verdict,
        effect=effect,
        matched_rate=matched,
        ledger=ledger.shares if ledger else None,
        culprit=ledger.culprit if ledger else None,
        models=rates,
    )
    pictures = {look.measured.entry.file: look.measured.pictures for look in looks if look.measured.pictures}
    report = Report(sheet_id=manifest.sheet_id, photos=tuple(entries), summary=summary)
    return Evidence(report, pictures, controls, verdict.reason, ledger)


def _rate(results: list[bool]) -> ModelRate:
    if not results:
        return ModelRate(rate=None, interval=None)
    return ModelRate(rate=sum(results) / len(results), interval=wilson(sum(results), len(results)))


def _compared(model, indices, results: dict[str, bool], control_looks, goal: str):
    """Controls with their comparison, and the effect that they show together."""
    controls, comparisons = [], []
    for name, looked in control_looks.items():
        readable = [(file, squares) for file, squares in looked if squares is not None]
        said = predict(model, indices, [squares[model.input_px] for _, squares in readable])
        seen = {file: p.recognized for (file, _), p in zip(readable, said, strict=True)}
        comparison, k = compare(results, seen, goal), sum(seen.values())
        comparisons.append(comparison)
        control = Control(name, k, len(seen), wilson(k, len(seen)))
        if comparison is not None:
            c = comparison
            control = Control(
                name, k, len(seen), control.interval, c.pairs, c.difference, c.interval, c.p_value, c.shown
            )
        controls.append(control)
    return tuple(controls), effect_of(comparisons)
