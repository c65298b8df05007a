"""Verify: photographs and a manifest in, a report out.

In: a folder of photographs and SHEET.json. Out: REPORT/ with report.json, report.html and pictures. This joins what
must not know each other: the judge, its networks and the page. The promise's primary network always judges, whatever
others are named.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from patchproof.channel.lens import load_camera
from patchproof.channel.printer import load_printer
from patchproof.classifier.load import load_classifier
from patchproof.output import new_folder
from patchproof.report.write import write_report
from patchproof.settings import Refused
from patchproof.sheet.manifest import Manifest, load_manifest
from patchproof.verify.results import Evidence, Report
from patchproof.verify.run import LEDGER_PHOTOS, gather_evidence

OWN = ("report.json", "report.html", "photos.csv", "pictures")


def verify_photos(
    photos: str | Path,
    sheet: str | Path,
    out: str | Path,
    *,
    models: tuple[str, ...] | None = None,
    controls: str | Path | None = None,
    scan_dpi: float | None = None,
    ruler_mm: tuple[float, float] | None = None,
    ledger_photos: int = LEDGER_PHOTOS,
    card: bool = False,
    camera: str | None = None,
    jobs: int = 1,
    cluster: str | None = None,
    overwrite: bool = False,
    on_photo: Callable[[int, int], None] = lambda done, total: None,
) -> Report:
    """Judge the photographs and write the report; `ruler_mm` are the printed rulers (x, y) as somebody measured them.

    `card` looks for a bank card in its outline on the uncut page; `camera` is a camera file's name or path.
    Model and printer names are looked up from the manifest's folder, then as the scene's were.
    """
    manifest = load_manifest(sheet)
    base = Path(sheet).resolve().parent
    with new_folder(out, OWN, overwrite) as folder:
        evidence = gather_evidence(
            photos,
            manifest,
            models=[load_classifier(name, base) for name in _names(manifest, models)],
            printer=load_printer(manifest.settings["printer"]["profile"], base)
            if "printer" in manifest.settings
            else None,
            scan_dpi=scan_dpi,
            controls=controls,
            ledger_photos=ledger_photos,
            camera=None if camera is None else load_camera(camera),
            card=card,
            jobs=jobs,
            cluster=cluster,
            progress=on_photo,
        )
        if ruler_mm is not None:
            evidence = _with_ruler(evidence, manifest, ruler_mm)
        report = evidence.report
        write_report(
            report.model_dump(mode="json"),
            manifest.model_dump(mode="json"),
            evidence.pictures,
            folder,
            evidence.notes(),
        )
    return report


def _names(manifest: Manifest, models: tuple[str, ...] | None) -> tuple[str, ...]:
    """The primary network first, then the others asked for, or else the promise's."""
    if manifest.promise is None:
        if not models:
            raise Refused(
                "a sheet that promises something", f"the {manifest.kind} sheet {manifest.sheet_id}", "name --models"
            )
        return models
    promised = tuple(model.name for model in manifest.promise.models)
    return tuple(dict.fromkeys((promised[0], *(models or promised))))


def _with_ruler(evidence: Evidence, manifest: Manifest, ruler_mm: tuple[float, float]) -> Evidence:
    """The scale that a ruler on the print shows, for every photograph of it that shows none itself."""
    scale = [measured / nominal for measured, nominal in zip(ruler_mm, manifest.ruler_mm, strict=True)]
    photos = tuple(
        photo if photo.scale_x is not None else photo.model_copy(update={"scale_x": scale[0], "scale_y": scale[1]})
        for photo in evidence.report.photos
    )
    return replace(evidence, report=evidence.report.model_copy(update={"photos": photos}))
