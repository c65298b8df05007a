"""A folder of photographs against a manifest: every photograph listed, one bad file never stops the batch.

In: photographs, a manifest, networks, and where there are any photographs of controls. Out: `Evidence`: the report
and what its page shows besides. Photographs are taken in the order of their names; sidecar files and anything that is
no picture by its suffix are never opened. Each is measured on its own (over processes when `jobs` > 1), classified at
once and let go, so that memory does not grow with their number; with a journal, what is finished survives a kill.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from patchproof.claims import wilson
from patchproof.evidence.classify import check_primary, predict, target_indices
from patchproof.evidence.journal import Journal, settings_key
from patchproof.evidence.ledger import Ledger, ledger_of
from patchproof.evidence.look import Glanced, Task, glance_at_all, in_ledger, look_at_all, set_task, shot_again
from patchproof.evidence.ranges import at_side, matched_rate, promised_side_px
from patchproof.evidence.reproject import Shot
from patchproof.evidence.results import Control, Evidence, ModelRate, Prediction, Report, Summary
from patchproof.evidence.verdict import Verdict, compare, effect_of, judge
from patchproof.goal import Goal
from patchproof.photo.read import list_photos, pictures_in
from patchproof.sheets.manifest import Manifest
from patchproof.strict import Refused
from patchproof.workers import open_workers

if TYPE_CHECKING:
    from patchproof.channel.lens import Camera
    from patchproof.channel.printer import Printer
    from patchproof.classifier import Classifier

LEDGER_PHOTOS = 24  # each costs 16 classifications; 24 leave intervals of some ± 5 points


def gather_evidence(
    photos: str | Path,
    manifest: Manifest,
    *,
    models: Sequence[Classifier],
    printer: Printer | None = None,
    scan_dpi: float | None = None,
    controls: str | Path | None = None,
    camera: Camera | None = None,
    ledger_photos: int = LEDGER_PHOTOS,
    jobs: int = 1,
    cluster: str | None = None,
    journal: Path | None = None,
    resume: bool = False,
    on_pictures: Callable[[str, Mapping[str, np.ndarray]], None] = lambda file, pictures: None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Evidence:
    """Measure, classify and judge every picture in the folder (or the one picture) `photos`.

    `printer` is the appearance model that the promise was made with (None: the manifest's profile by its name).
    `camera` replaces the EXIF focal length and takes out the lens.
    `ledger_photos` of the photographs at most, spread evenly, go into the gap ledger (0: no ledger). Photographs are
    measured by `jobs` local processes or by a Dask cluster's workers. The file `journal` keeps what is finished;
    with `resume`, what it has of an earlier run is not done again. `on_pictures` gets the pictures of each photograph
    that is (of the first `look.WITH_PICTURES`: `photo`, and `seen`, `fitted`, `promised`, `delta_e00` where it was
    measured); `progress` is called with (done, all).
    """
    paths = list_photos(photos)
    control_paths = _list_controls(controls) if controls is not None else {}
    if manifest.promise:
        check_primary(models, manifest.promise)
    indices = {m.name: target_indices(m, manifest) for m in models} if manifest.promise else {}
    task = set_task(manifest, models, printer, scan_dpi, camera)
    judge_all = partial(_predictions, models, indices)
    total, done = len(paths) + sum(map(len, control_paths.values())), 0
    options = {"scan_dpi": scan_dpi, "camera": camera and camera.model_dump(mode="json")}
    kept = Journal(journal, settings_key(manifest, models, printer, options), resume) if journal is not None else None
    with closing(kept) if kept is not None else nullcontext(), open_workers(jobs, cluster) as workers:
        step = lambda more: progress(done + more, total)  # noqa: E731
        seen = look_at_all(task, paths, judge_all, workers, kept, on_pictures, step)
        glances: dict[str, list[Glanced]] = {}
        for name, files in control_paths.items():
            done = len(paths) + sum(map(len, glances.values()))
            glances[name] = glance_at_all(task, name, files, judge_all, workers, kept, step)
        chosen = [n for n in sorted(_spread(len(paths), ledger_photos)) if task.ledger_px and in_ledger(seen[n])]
        shots = list(workers.map(partial(shot_again, task), [(paths[n], seen[n].entry, seen[n].light) for n in chosen]))
    entries = [one.entry for one in seen]
    ledger = _ledger(task, manifest, models, indices, entries, shots)
    return _evidence(manifest, models, indices, entries, [one.counted for one in seen], glances, ledger)


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


def _predictions(models, indices, squares: Mapping[int, np.ndarray]) -> dict[str, Prediction]:
    """What every network says of one photograph; nothing where the sheet promises nothing."""
    if not indices:
        return {}
    return {model.name: predict(model, indices[model.name], squares[model.input_px]) for model in models}


def _ledger(task: Task, manifest, models, indices, entries, shots: Iterable[Shot | None]) -> Ledger | None:
    shots = [shot for shot in shots if shot is not None]
    if not shots:
        return None
    model = next(m for m in models if m.name == manifest.promise.models[0].name)
    confidence = {e.file: e.predictions[model.name].target_confidence for e in entries if e.predictions}
    return ledger_of(shots, manifest, task.surface, task.promised, model, indices[model.name], confidence)


def _evidence(manifest, models, indices, entries, counts: Sequence[bool], glances, ledger) -> Evidence:
    counted = [entry for entry, counts_too in zip(entries, counts, strict=True) if counts_too]
    verdict, effect, controls = Verdict("cannot_tell", None, "The sheet promises nothing."), "not_tested", ()
    rate, matched = ModelRate(rate=None, interval=None), None
    rates = {m.name: _rate([e.predictions[m.name].recognized for e in counted]) for m in models} if indices else {}
    if manifest.promise:
        promise, primary = manifest.promise, manifest.promise.models[0].name
        results = {e.file: e.predictions[primary].recognized for e in counted}
        without = sum(e.code == "too_few_markers" and e.status == "rejected" for e in entries)
        goal = promise.target.goal
        verdict = judge(sum(results.values()), len(results), promise.rate, promise.n, goal, without)
        side_px = promised_side_px(manifest)
        measured = (at_side(entry, side_px) for entry in counted if entry.status == "measured")
        rate, matched = rates[primary], matched_rate(measured, promise.conditions)
        controls, effect = _compared(primary, results, glances, goal)
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
        reason=verdict.reason,
        models=rates,
    )
    return Evidence(
        Report(sheet_id=manifest.sheet_id, photos=tuple(entries), summary=summary, controls=controls), ledger
    )


def _rate(results: list[bool]) -> ModelRate:
    if not results:
        return ModelRate(rate=None, interval=None)
    return ModelRate(rate=sum(results) / len(results), interval=wilson(sum(results), len(results)))


def _compared(primary: str, results: dict[str, bool], glances: Mapping[str, Sequence[Glanced]], goal: Goal):
    """Controls with their comparison, and the effect that they show together."""
    controls, comparisons = [], []
    for name, looked in glances.items():
        seen = {one.file: one.predictions[primary].recognized for one in looked if one.predictions}
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
