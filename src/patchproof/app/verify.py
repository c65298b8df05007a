"""Verify: judge photographs of a printed sheet against its manifest, and write the report.

In: a folder of photographs (or of folders, one a session) and SHEET.json. Out: REPORT/ with report.json, report.csv,
report.html, pictures, coco.json with places of the piece and of a detected object, and photos.jsonl, one line per
finished photograph, from which `resume` continues. The promise's primary network always judges, also if others are
named. Scene, renderer and optimizer are never imported.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from patchproof.base import output
from patchproof.base.errors import Refused
from patchproof.base.folder_lock import lock_folder
from patchproof.base.geometry import apply_homography, rect_corners
from patchproof.base.input import is_file, read_json
from patchproof.base.progress import Compute, Progress, no_progress
from patchproof.base.text import printable
from patchproof.base.validation import refuse_untrusted
from patchproof.channel.printer import load_printer, printer_of_sheet
from patchproof.classifier.load import load_classifier
from patchproof.classifier.network import Classifier
from patchproof.evidence.batch import JOURNAL_FILE, MAX_PICTURED_PHOTOS, file_sha256
from patchproof.evidence.classify import box_corners_px
from patchproof.evidence.gather import gather_evidence
from patchproof.evidence.results import Origin, PhotoEntry, Report
from patchproof.evidence.task import LEDGER_PHOTOS, Options
from patchproof.evidence.verdict import Look
from patchproof.report.coco import PATCH, LabeledPhoto, coco_json
from patchproof.report.page import save_pictures, stem_of, versions_of
from patchproof.report.write import write_report
from patchproof.sheets.manifest import Manifest, load_manifest

if TYPE_CHECKING:
    from patchproof.channel.lens import Camera

_SCAN_DPI = 30, 4800  # as on the command line
_PHOTOS = "photos"
REPORT_FILES = ("report.json", "report.csv", "report.html", "coco.json", "pictures", _PHOTOS, JOURNAL_FILE)
_LIBRARIES = ("patchproof", "numpy", "opencv-contrib-python-headless", "torch", "scipy")


@dataclass(frozen=True)
class CaptureInfo:
    """Facts about how the photographs were taken.

    Attributes:
        camera: a camera file's name or path, which replaces the EXIF focal length and takes the lens's distortion out.
        scan_dpi: resolution of flat scans of the uncut page; None for photographs.
        ruler_mm: lengths (x, y) of the two printed 100 mm rulers as measured on the print, in millimeters.
        boxes: COCO JSON with the object's box in photographs, for detectors, if the sheet does not tell.
        corners: CSV or COCO JSON with the design's four corners in photographs of a print whose markers cannot be read.
        find: search photographs without readable markers and named corners for the design itself.
    """

    camera: str | Path | None = None
    scan_dpi: float | None = None
    ruler_mm: tuple[float, float] | None = None
    boxes: str | Path | None = None
    corners: str | Path | None = None
    find: bool = False


def verify(
    photos: str | Path | Sequence[np.ndarray],
    sheet: str | Path,
    out: str | Path,
    *,
    models: Sequence[str | Classifier] | None = None,
    controls: str | Path | None = None,
    capture: CaptureInfo = CaptureInfo(),
    trust: bool = False,
    ledger_photos: int = LEDGER_PHOTOS,
    compute: Compute = Compute(),
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> Report:
    """Measure photographs of a print, judge them against the promise of its sheet, and write the report.

    Args:
        photos: a folder of photographs, or of folders, one a session; one photograph; or uint8 H×W×3 sRGB arrays of one
            session, which are kept as PNG files in `out`.
        sheet: the manifest, SHEET.json; its folder is where its models and printers are looked up.
        out: folder for the report, new or empty.
        models: networks besides the sheet's first: names, or classifiers in memory. Code (`module:`) and downloads that
            the sheet names are used only where they are among them.
        controls: folder with a folder of photographs for each control ("bare", "mean", ...).
        capture: camera, scan resolution, measured rulers, the object's boxes, the design's corners.
        trust: use what the sheet names without naming it in `models`, also variables of the environment.
        ledger_photos: photographs at most in the gap ledger and the estimated effect, 0 for neither; each costs 16
            classifications.
        compute: processes or cluster; photographs are judged on the CPU, and another device is refused.
        resume: keep what an earlier call finished, and measure only photographs that are new or differ.
        overwrite: delete an earlier report in `out` first.
        progress: called with the stage "verify" (photographs).

    Raises:
        Refused: for a sheet, network or folder that cannot be used. Photographs that cannot be measured or judged are
        listed in the report with the code of their `PhotoRejected`.

    Examples:
        ```python
        report = pp.verify("photos", "sheet.json", "report", compute=pp.Compute(jobs=4))
        print(report.summary.verdict, report.summary.rate)
        ```
    """
    out, manifest, compute = Path(out), load_manifest(sheet), compute.without("verify", device=True)
    if not (manifest.markers or capture.find or capture.corners):
        raise Refused("--find or --corners FILE for a print without markers", "neither", "add one of them")
    low, high = _SCAN_DPI
    if capture.scan_dpi is not None and not low <= capture.scan_dpi <= high:
        raise Refused(f"a scan's resolution from {low} to {high} dpi", f"{capture.scan_dpi}", "correct scan_dpi")
    with lock_folder(out):
        files = {"camera": capture.camera, "boxes": capture.boxes, "corners": capture.corners}
        _check_out(out, resume, overwrite, (photos, sheet, controls, *files.values()))
        look_at = _look_at(out, manifest, resume)
        if isinstance(photos, str | Path) and is_file(Path(photos) / JOURNAL_FILE):
            look_at = lambda entries: None  # noqa: E731  # `capture` showed the answers while they were taken
        options = options_of(sheet, manifest, models, capture.camera, trust)
        parameters: dict[str, Any] = {"scan_dpi": capture.scan_dpi, "ruler_mm": capture.ruler_mm, "find": capture.find}
        options = replace(options, **parameters, controls=controls, ledger_photos=ledger_photos)
        if capture.boxes is not None:
            if manifest.promise is None or not any(model.LOOKS_AT_BOXES for model in options.models):
                got = f"the classifiers {', '.join(model.name for model in options.models) or '(none)'}"
                raise Refused("a detector, since classifiers use no boxes", got, "leave boxes out")
            from patchproof.evidence.annotations import load_boxes

            options = replace(options, boxes=load_boxes(capture.boxes, manifest.promise.target.label))
        if capture.corners is not None:
            from patchproof.evidence.annotations import load_corners

            options = replace(options, corners=load_corners(capture.corners))
        clear = (lambda: None) if resume else partial(output.clear_folder, out)
        if not isinstance(photos, str | Path):
            clear()
            photos, clear = output.write_pictures(photos, out / _PHOTOS), lambda: None
        on_pictures, advance = partial(save_pictures, out / "pictures"), partial(progress, "verify")
        how: dict[str, Any] = {"on_pictures": on_pictures, "advance": advance, "look_at": look_at}
        how |= {"on_start": clear, "compute": compute, "journal": out / JOURNAL_FILE, "resume": resume}
        report = gather_evidence(photos, manifest, options, **how)
        parameters |= {name: path and Path(path).name for name, path in files.items()}
        parameters["ledger_photos"] = ledger_photos
        hashes = {"manifest": file_sha256(Path(sheet))} | {f"network {m.name}": m.sha256 for m in options.models}
        notes = tuple(note for model in options.models for note in model.notes)
        origin = Origin(options=parameters, sha256=hashes, versions=versions_of(_LIBRARIES), notes=notes)
        report = report.changed(origin=origin, folder=out)
        stems = {stem_of(photo.file) for photo in report.photos[:MAX_PICTURED_PHOTOS]}
        # but for pictures of photographs that this report does not show
        output.clear_folder(out, lambda name: not name.startswith("pictures/") or name[9:].rsplit(".", 2)[0] in stems)
        write_report(report.model_dump(mode="json"), manifest.model_dump(mode="json"), out)
        output.write_atomically(out / "coco.json", _boxes(report, manifest, options.camera))
    return report


def _boxes(report: Report, manifest: Manifest, camera: "Camera | None") -> str:
    """Write the photographs as COCO JSON: outlines of pieces that are flat and not rejected, and known object boxes."""
    corners, photos = rect_corners(manifest.cut_mm), []
    bends = camera is not None and camera.has_distortion  # then places are those in the undistorted picture
    label = "object" if manifest.promise is None else manifest.promise.target.label
    for entry in report.photos:
        if entry.photo_px is None:
            continue
        px_from_mm = None if entry.geometry is None else entry.geometry.homography_px_from_mm
        known = px_from_mm is not None and not bends and entry.status != "rejected"
        outlines = {PATCH: apply_homography(np.array(px_from_mm), corners)} if known else {}
        if entry.box is not None and not bends:
            outlines[label] = box_corners_px(entry.box, entry.photo_px)
        photos.append(LabeledPhoto(entry.file, entry.photo_px, outlines, entry.located if known else None))
    return coco_json(photos, label, f"photographs of sheet {manifest.sheet_id}")


def options_of(
    sheet: str | Path,
    manifest: Manifest,
    models: Sequence[str | Classifier] | None = None,
    camera: str | Path | None = None,
    trust: bool = False,
) -> Options:
    """Load the networks, the printer and the camera for photographs of the sheet; see `verify`."""
    base, promise = Path(sheet).resolve().parent, manifest.promise
    least_score, networks = None if promise is None else promise.models[0].least_score, _networks(manifest, models)
    if not trust:
        refuse_untrusted(sheet, [name for name in networks if isinstance(name, str) and name not in _by_name(models)])
    if (carried := manifest.settings.get("printer_file")) is None:
        printer = load_printer((manifest.settings.get("printer") or {}).get("profile", "coated"), base)
    else:
        printer = printer_of_sheet(carried, sheet)
    classifiers = [load_classifier(each, base).with_least_score(least_score) for each in networks]
    if camera is None:
        return Options(classifiers, printer)
    from patchproof.channel.lens import load_camera

    return Options(classifiers, printer, load_camera(camera))


def _look_at(out: Path, manifest: Manifest, resume: bool) -> Callable[[Sequence[PhotoEntry]], Look]:
    """Return a function that numbers this look at photographs: as the report of this sheet in `out` does if its
    photographs were the same, one more if they were others, 1 without such a report. One of another sheet is not
    resumed.
    """
    sheet_id = manifest.sheet_id
    try:
        report = read_json(out / "report.json", "a report", "verify again")
        sheet_id = str(report["sheet_id"])
        number, hashes = int(report["summary"]["looks"]), {photo["sha256"] for photo in report["photos"]}
        earlier = min(max(number, 1), 1000) if sheet_id == manifest.sheet_id else 0
    except (Refused, LookupError, TypeError, ValueError, OverflowError):
        earlier, hashes = 0, set()
    if resume and sheet_id != manifest.sheet_id:
        expected, got = f"the sheet {printable(sheet_id)} of the report in {out}", manifest.sheet_id
        raise Refused(expected, got, "name that sheet, or another --out")
    return lambda entries: Look(earlier + (earlier == 0 or {entry.sha256 for entry in entries} != hashes))


def _check_out(out: Path, resume: bool, overwrite: bool, inputs: Sequence[object]) -> None:
    """Refuse a folder with files, unless they are of a verification that is resumed or overwritten."""
    has_journal = is_file(out / JOURNAL_FILE)
    if resume:
        output.refuse_inputs_in(out, inputs)
        output.refuse_other_files(out, REPORT_FILES if has_journal else ())
        return
    unfinished = has_journal and not is_file(out / "report.json")
    output.check_folder(out, REPORT_FILES, overwrite, unfinished, inputs)


def _networks(manifest: Manifest, models: Sequence[str | Classifier] | None) -> tuple[str | Classifier, ...]:
    """List the primary network, then the named ones or else the promise's; classifiers in memory stay as they are."""
    named = _by_name(models)
    if manifest.promise is None:
        if named:
            return tuple(named.values())
        got = f"the {manifest.kind} sheet {manifest.sheet_id}"
        raise Refused("a sheet that promises something", got, "name --models")
    promised = tuple(model.name for model in manifest.promise.models)
    return tuple(named.get(name, name) for name in dict.fromkeys((promised[0], *(named or promised))))


def _by_name(models: Sequence[str | Classifier] | None) -> dict[str, str | Classifier]:
    return {model.name if isinstance(model, Classifier) else model: model for model in models or ()}
