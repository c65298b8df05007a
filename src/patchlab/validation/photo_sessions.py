"""Steps that studies of promises share: make a run and its sheet, photograph it in sessions, verify.

In: scene files, networks, printers, seeds. Out: cells, and for a cell the design (optimized, or an imported picture),
the page, the photographs and their verification; a record of the promise. Everything is done as by a user's commands,
but no report is written.
"""

import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from patchlab.study import grid
from patchlab.study.record import hits_text, parse_hits
from patchlab.study.study import Cell, Result
from patchproof.base.sessions import RatePosterior, count_by_session, rate_posterior
from patchproof.base.settings import PrinterSettings
from patchproof.base.validation import StrictModel, expand_path
from patchproof.optimizer.promise import PromiseOptions

if TYPE_CHECKING:
    from patchproof.evidence.results import Report
    from patchproof.optimizer.run import Run


class PhotosSettings(StrictModel):
    """Settings of simulated photographs of a print."""

    sessions: grid.PositiveInt = 4  # sessions of each print
    photos: Annotated[int, Field(ge=5, le=1000)] = 20  # photographs of each session
    path_traced: bool = True  # photograph with Mitsuba 3, else with our renderer


class SessionsSettings(grid.GridSettings, PhotosSettings):
    """Settings: a run for each scene, network, printer and seed, and sessions of photographs of each."""

    printers: grid.Names = (PrinterSettings().profile,)  # printers of the designs, which optimizing knows


def cells(settings: SessionsSettings, base: Path) -> list[Cell]:
    """A cell per scene, network, printer and seed, with the whole scene in it."""
    profiles = {grid.short_name(name): {"printer": {"profile": name}} for name in settings.printers}
    return grid.grid_cells(
        settings,
        base,
        lambda values: (
            (grid.with_changes(values, {"target": {"models": values["networks"]}, **table}), (printer,))
            for printer, table in profiles.items()
        ),
    )


def make_run_and_sheet(
    base: Path, cell: Cell, folder: Path, views: int | None = None, controls: Sequence[str] = ("bare",)
) -> "Run":
    """Optimize or import the cell's design into folder/run, promise it by `views`, and write folder/sheet.pdf."""
    from patchproof.optimizer.imported_design import import_patch
    from patchproof.optimizer.run import optimize
    from patchproof.reprints.run_sheet import sheet as sheet_of

    scene = grid.scene_of(base, cell.values)
    scene = replace(scene, settings=scene.settings.changed(target={"models": grid.network_names(base, cell.values)}))
    promise = PromiseOptions(views, controls=tuple(controls))
    if (picture := cell.values.get("picture")) is None:
        patch_run = optimize(scene, folder / "run", promise=promise)
    else:
        patch_run = import_patch(expand_path(picture, base), scene, folder / "run", promise=promise)
    sheet_of(patch_run, folder / "sheet.pdf")
    return patch_run


def take_photos(
    settings: PhotosSettings, cell: Cell, patch_run: "Run", folder: Path, control: str | None = None
) -> Path:
    """Photograph folder/sheet.pdf, or a control under the same conditions; returns the folder of sessions."""
    from patchlab.validation.path_traced import photograph_traced
    from patchproof.reprints.reprint import ReprintSetup, render_photo, reprint

    out, n = folder / ("photos" if control is None else control), settings.sessions * settings.photos
    setup = ReprintSetup(control=control, render=photograph_traced if settings.path_traced else render_photo)
    # another seed per cell: cells with the same draws would not be independent
    seed = zlib.crc32(cell.name.encode())
    reprint(folder / "sheet.pdf", patch_run, n, out, setup, sessions=settings.sessions, seed=seed)
    return out


def verify_photos(photos: Path, folder: Path, base: Path, cell: Cell, **options: Any) -> "Report":
    """Verify photographs of folder/sheet.pdf without writing a report; `options` replace fields of `Options`."""
    from patchproof.app.verify import options_of
    from patchproof.evidence.gather import gather_evidence
    from patchproof.sheets.manifest import load_manifest

    sheet, networks = folder / "sheet.json", grid.network_names(base, cell.values)
    manifest = load_manifest(sheet)
    changed = replace(options_of(sheet, manifest, networks, None), **options)
    return gather_evidence(photos, manifest, changed)


def record_promise(patch_run: "Run") -> dict[str, Any]:
    """Record a run's promise as JSON values."""
    promise = patch_run.promise
    hits = hits_text([condition.recognized for condition in promise.conditions])
    return {"promised": hits, "per_session": promise.per_session, "places": list(promise.places)}


def promise_posterior(result: Result) -> RatePosterior:
    """The rate's posterior from a recorded promise."""
    answers = result.answers
    return rate_posterior(*count_by_session(parse_hits(answers["promised"]), answers["per_session"], answers["places"]))
