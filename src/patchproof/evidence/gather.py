"""Judge a folder of photographs against a manifest. Every photograph is listed; a bad file never stops the batch.

In: photographs, a manifest, networks, and photographs of controls if there are any. Out: a `Report`. Photographs are
taken in the order of their names; files that are no pictures by their suffix are never opened. Each is measured on its
own (over processes if `jobs` > 1), classified and freed, so that memory does not grow with their number; with a
journal, finished photographs survive a kill.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from patchproof.base.errors import Refused
from patchproof.base.input import is_folder
from patchproof.base.intervals import wilson
from patchproof.base.progress import Advance, Compute, no_advance
from patchproof.base.settings import background_summary
from patchproof.base.text import printable
from patchproof.base.validation import summarize_names
from patchproof.base.workers import open_workers
from patchproof.evidence import verdict
from patchproof.evidence.batch import MAX_PICTURED_PHOTOS, Journal, PhotoItem, measure_all, reread_square, settings_key
from patchproof.evidence.classify import Judges, judges_of
from patchproof.evidence.grouping import COPY_CODE, Grouping, control_keys, group_sessions, merge_folders, reject_copies
from patchproof.evidence.ledger import estimate_effect, ledger_of
from patchproof.evidence.measure import UNLOCATED_CODES, UNNAMED_ADVICE, MeasuredPhoto, ruler_scale
from patchproof.evidence.reproject import PhotoSquare, read_print
from patchproof.evidence.results import (
    EffectEstimate,
    Ledger,
    ModelRate,
    PhotoEntry,
    Report,
    Scale,
    SessionCount,
    Summary,
)
from patchproof.evidence.task import Options, task_of
from patchproof.evidence.verdict import MOST_PHOTOS, PLANNED_LOOK, Look, Verdict
from patchproof.photo.read import list_images, list_skipped_files, subfolders, summarize_said
from patchproof.sheets.manifest import Manifest


def gather_evidence(
    photos: str | Path,
    manifest: Manifest,
    options: Options,
    *,
    compute: Compute = Compute(),
    journal: Path | None = None,
    resume: bool = False,
    on_start: Callable[[], None] = lambda: None,
    look_at: Callable[[Sequence[PhotoEntry]], Look | None] = lambda entries: PLANNED_LOOK,
    on_pictures: Callable[[str, Mapping[str, np.ndarray]], None] = lambda file, pictures: None,
    advance: Advance = no_advance,
) -> Report:
    """Measure, classify and judge every picture in the folder, or the one picture, `photos`; subfolders are sessions.

    Photographs are measured by the processes or the cluster of `compute`. The file `journal` records finished
    photographs; with `resume` those of an earlier run are not measured again. `on_start` is called when nothing is left
    that could be refused, before the journal is opened. `look_at` tells the look from the entries, see `report_of`.
    `on_pictures` gets a name and pictures by kind (`photo`, and `seen`, `fitted`, `promised`, `delta_e00` of a measured
    one) of the first `batch.MAX_PICTURED_PHOTOS` photographs when each is measured; `advance` is called with (done,
    total).
    """
    print_scale = None if options.ruler_mm is None else ruler_scale(options.ruler_mm, manifest.ruler_mm)
    controls_folder = None if options.controls is None else Path(options.controls)
    grouping = group_sessions(photos, controls_folder)
    by_control = _list_controls(controls_folder, grouping.names)
    paths = [path.absolute() for path in grouping.paths]  # workers of a cluster may stand in other folders
    judges, count = judges_of(options.models, manifest), len(paths)
    task = task_of(manifest, options, judges)
    items = [PhotoItem(path, grouping.file(i), with_pictures=i < MAX_PICTURED_PHOTOS) for i, path in enumerate(paths)]
    items += [PhotoItem(path.absolute(), file, name) for name, e in by_control.items() for file, path in e.items()]
    left_out = list_skipped_files(Path(photos), controls_folder and controls_folder.resolve())
    if options.boxes or options.corners:
        from patchproof.evidence.annotations import box_of_photo, corners_of_photo, find_in_photos

        sources = [(item.name, item.path) for item in items]
        if options.boxes:
            boxes, remaining = find_in_photos("boxes", options.boxes, box_of_photo, sources[:count])
            of_controls, _ = find_in_photos("", remaining, box_of_photo, sources[count:])
            items = [replace(item, box=box) for item, box in zip(items, boxes + of_controls, strict=True)]
        if options.corners:
            corners, remaining = find_in_photos("corners", options.corners, corners_of_photo, sources[:count])
            items[:count] = [replace(item, corners=px) for item, px in zip(items[:count], corners, strict=True)]
            if remaining:
                left_out.append(f"corners of {len(remaining)} other photographs ({summarize_names([*remaining])})")
    with ExitStack() as stack:
        workers = stack.enter_context(open_workers(compute.jobs, compute.cluster))  # a cluster may not be there
        on_start()
        log = Journal(journal, settings_key(manifest, options), resume) if journal else None
        stack.callback(log.close if log else lambda: None)
        results = measure_all(task, items, judges, workers, log, on_pictures, advance)
        if options.corners and not options.find:
            for number, (item, result) in enumerate(zip(items, results, strict=True)):
                if item.corners is None and result.entry.code == "no_corners":
                    results[number] = replace(result, entry=result.entry.changed(remark={"advice": UNNAMED_ADVICE}))
        grouping = merge_folders(grouping, results[:count])
        patch_photos = reject_copies(results[:count], grouping.merged, task.surface.rect_mm)
        squares: list[PhotoSquare | None] = []
        if judges and task.promised:
            originals = [number for number, photo in enumerate(patch_photos) if photo.entry.code != COPY_CODE]
            numbers = _spread(originals, MOST_PHOTOS if options.ledger_photos else 0)
            read_square = partial(reread_square, task, judges.primary.input_px)
            squares = workers.map(read_square, [(paths[number], patch_photos[number]) for number in numbers])
    ledger, estimate = None, None
    if judges and task.promised:  # other processes, which hold the networks
        name, entries = judges.primary.name, [photo.entry for photo in patch_photos if photo.entry.predictions]
        confidence = {entry.file: entry.predictions[name].target_confidence for entry in entries}
        session = {p.entry.file: number for p, number in zip(patch_photos, grouping.merged, strict=True) if p.counted}
        found = read_print([square for square in squares if square is not None], task.promised)
        some = replace(found, shots=_spread(found.shots, options.ledger_photos))
        ledger = ledger_of(some, manifest, task, judges, confidence, compute.jobs)
        answers = _recognized(entries, name)
        estimate = estimate_effect(found, manifest, task, options.printer, judges, answers, session, compute.jobs)
    if controls_folder:
        control_name = printable(controls_folder.name)
        left_out += [f"{control_name}: {text}" for text in list_skipped_files(controls_folder, depth=2)]
    left_out += summarize_said((item.name, result.entry.said) for item, result in zip(items, results, strict=True))
    controls: dict[str, list[MeasuredPhoto]] = {}
    first_of = {photo.entry.sha256: photo.entry.file for photo in reversed(patch_photos)}  # a patch's are no control's
    for item, result in zip(items[count:], results[count:], strict=True):
        entry, file = result.entry, f"{item.control}/{result.entry.file}"
        if (first := first_of.setdefault(entry.sha256 or file, file)) != file:
            left_out.append(f"{file} has the bytes of {first}, which counts once")
            continue
        controls.setdefault(item.control or "", []).append(result)
        if entry.status == "rejected" and entry.remark is not None:
            left_out.append(f"{file} does not count: {entry.remark.advice}")
    look = look_at([photo.entry for photo in patch_photos])
    report = report_of(manifest, judges, patch_photos, grouping, controls, ledger, print_scale, look, estimate)
    missing = {}
    if options.scan_dpi and not any(photo.entry.scale for photo in patch_photos):
        missing["the print's scale"] = f"no photograph is a flat scan at {options.scan_dpi:g} dpi"
    if placed := sum(photo.counted and photo.entry.located not in ("markers", None) for photo in patch_photos):
        missing["bend, and where paper was cut"] = f"{placed} photographs were located by the design alone"
    if judges and task.promised and options.ledger_photos and (ledger is None or estimate is None):
        missing["where the rate was lost, what controls would show"] = "too few photographs can be measured"
    return report.changed(summary=report.summary.changed(left_out=tuple(left_out), not_measured=missing))


def _spread(items: list, most: int) -> list:
    count = min(len(items), most)
    return [items[number * len(items) // count] for number in range(count)]


def _list_controls(folder: Path | None, sessions: Sequence[str]) -> dict[str, dict[str, Path]]:
    """List photographs by control, and by FILE or SESSION/FILE: those of the folder itself, also if its folders have
    the names of the patch's `sessions`, or one control for each subfolder.
    """
    if folder is None:
        return {}
    if not is_folder(folder):
        raise Refused("a folder of control photographs", f"no folder at {folder}", "check the path")
    folders = subfolders(folder)
    named = [p for p in folders if list_images(p)]
    if list_images(folder) or (named and all(printable(p.name) in sessions for p in named)):
        return {printable(folder.name): _control_files(folder)}
    controls = {printable(p.name): files for p in folders if (files := _control_files(p))}
    if not controls:
        raise Refused(f"control photographs in {folder}", "none", "copy them there, one control per folder")
    return controls


def _control_files(folder: Path) -> dict[str, Path]:
    """A control's photographs: those in the folder, or in its folders if there are none."""
    if pictures := list_images(folder):
        return {printable(path.name): path for path in pictures}
    pairs = ((p, path) for p in subfolders(folder) for path in list_images(p))
    return {printable(f"{p.name}/{path.name}"): path for p, path in pairs}


def report_of(
    manifest: Manifest,
    judges: Judges | None,
    photos: Sequence[MeasuredPhoto],
    grouping: Grouping,
    controls: Mapping[str, Sequence[MeasuredPhoto]],
    ledger: Ledger | None = None,
    print_scale: Scale | None = None,
    look: Look | None = PLANNED_LOOK,
    estimate: EffectEstimate | None = None,
) -> Report:
    """Sum up all photographs; with a promise and `judges` also verdict, rates and whether the patch helps.
    Without a `look` the photographs were watched while they were taken. `print_scale` is by its rulers.
    """
    entries, counted = [photo.entry for photo in photos], [photo.entry for photo in photos if photo.counted]
    judgment = Verdict("cannot_tell", None, "The sheet promises nothing.")
    comparisons, rates, rate, interval, sessions, do, worth = [], {}, _rate({}), None, (), "", None
    if judges and manifest.promise:
        promise, primary = manifest.promise, judges.primary.name
        rates = {model.name: _rate(_recognized(counted, model.name)) for model in judges.models}
        rate, recognized = rates[primary], _recognized(counted, primary)
        without_markers = sum(e.code in UNLOCATED_CODES and e.status == "rejected" for e in entries)
        sessions = _sessions(grouping, photos, recognized)
        numbers = dict(zip((entry.file for entry in entries), grouping.merged, strict=True))
        counts = sum(recognized.values()), list(Counter(numbers[file] for file in recognized).values())
        look = look or verdict.watched(counts[1], promise)
        judgment = verdict.judge(*counts, promise, without_markers, look)
        if recognized:
            interval = promise.posterior.rate_given(*counts)
        answers = {(numbers[file], file): answer for file, answer in recognized.items()}
        for name, control in controls.items():
            keys, hits = control_keys(grouping, photos, control), _recognized((p.entry for p in control), primary)
            hits_by_key = {keys[file]: hit for file, hit in hits.items()}
            comparisons.append(verdict.compare_with_control(answers, name, hits_by_key, promise))
        if rate.rate is not None and interval is not None:
            worth = verdict.benefit_of(len(recognized), rate.rate, interval, comparisons, promise, estimate)
        do = verdict.still_needed(promise, counts[1], without_markers, judgment.verdict, worth)
    summary = Summary(
        photos=len(entries),
        judged=len(counted),
        measured=sum(entry.status == "measured" for entry in entries),
        rate=rate.rate,
        interval=interval,
        sessions=sessions,
        sessions_known_from=grouping.known_from,
        sessions_note=grouping.note,
        looks=(look or PLANNED_LOOK).number,
        looks_planned=(look or PLANNED_LOOK).planned,
        ledger=ledger,
        **vars(judgment),
        next_step=do,
        worth=worth,
        estimated=estimate,
        background=background_summary(manifest.settings),
        draft_views=manifest.promise.n if manifest.promise is not None and manifest.promise.draft else 0,
        models=rates,
    )
    if print_scale is not None:
        entries = [entry if entry.scale else _of_print(entry, print_scale) for entry in entries]
    return Report(sheet_id=manifest.sheet_id, photos=tuple(entries), summary=summary, controls=tuple(comparisons))


def _of_print(entry: PhotoEntry, scale: Scale) -> PhotoEntry:
    """The photograph of a print of that scale: its distance was of a print of full size."""
    size, pose = float(np.sqrt(scale.scale_x * scale.scale_y)), entry.pose
    if pose and pose.distance_mm is not None and pose.distance_uncertainty_mm is not None:
        far = {name: getattr(pose, name) * size for name in ("distance_mm", "distance_uncertainty_mm")}
        pose = pose.changed(**far)
    return entry.changed(scale=scale, pose=pose)


def _sessions(grouping: Grouping, photos: Sequence[MeasuredPhoto], hits: dict[str, bool]) -> tuple[SessionCount, ...]:
    """Count the judged and recognized photographs of each session, or of each folder that is part of one."""
    answers: list[list[bool]] = [[] for _ in grouping.names]
    for number, photo in zip(grouping.session, photos, strict=True):
        if photo.counted and photo.entry.file in hits:
            answers[number].append(hits[photo.entry.file])
    firsts = grouping.same_as or range(len(grouping.names))
    same_as = [None if first == number else grouping.names[first] for number, first in enumerate(firsts)]
    rows = zip(grouping.names, answers, same_as, strict=True)
    return tuple(SessionCount(name=n, recognized=sum(a), judged=len(a), same_as=first) for n, a, first in rows)


def _recognized(entries: Iterable[PhotoEntry], network: str) -> dict[str, bool]:
    return {entry.file: entry.predictions[network].recognized for entry in entries if entry.predictions}


def _rate(recognized: Mapping[str, bool]) -> ModelRate:
    k, n = sum(recognized.values()), len(recognized)
    return ModelRate(rate=k / n, interval=wilson(k, n)) if n else ModelRate(rate=None, interval=None)
