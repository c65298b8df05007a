"""What studies of promises share: a run for each combination, its sheet, and sessions of photographs of the print.

In: scene files, networks, printers, seeds. Out: cells, and for one of them the design (optimized, or a picture that is
imported), the page, the photographs, their judgment; what answers keep of the promise. All as a user's commands do it,
but that no report is written of what is judged.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from patchlab.study.grid import (
    GridSettings,
    Names,
    PositiveInt,
    grid_cells,
    network_names,
    scene_of,
    short_name,
    with_scene_changes,
)
from patchlab.study.record import hits_text, parse_hits
from patchlab.study.study import Cell, Result
from patchproof.base.sessions import RatePosterior, count_by_session, rate_posterior
from patchproof.base.validation import expand_path
from patchproof.optimizer.promise import PromiseOptions

if TYPE_CHECKING:
    from patchproof.evidence.reproject import PhotoSquare
    from patchproof.evidence.results import Report
    from patchproof.optimizer.run import Run


class SessionsSettings(GridSettings):
    """A run for each scene, network, printer and seed, and sessions of photographs of each."""

    printers: Names = ("coated",)  # that print the designs, and are known while optimizing
    sessions: PositiveInt = 4  # of each print
    photos: Annotated[int, Field(ge=5, le=1000)] = 20  # of each session
    path_traced: bool = True  # taken by Mitsuba 3, else by our renderer


def cells(settings: SessionsSettings, base: Path) -> list[Cell]:
    """One per combination, with the whole scene in it."""
    profiles = {short_name(name): {"printer": {"profile": name}} for name in settings.printers}
    return grid_cells(
        settings,
        base,
        lambda values: (
            (with_scene_changes(values, {"target": {"models": values["networks"]}, **table}), (printer,))
            for printer, table in profiles.items()
        ),
    )


def make_run_and_sheet(base: Path, cell: Cell, folder: Path) -> Run:
    """The cell's design in folder/run, its sheet in folder/sheet.pdf."""
    from patchproof.optimizer.imported_design import import_patch
    from patchproof.optimizer.run import optimize
    from patchproof.reprints.run_sheet import sheet as sheet_of

    scene = scene_of(base, cell.values)
    scene = replace(scene, settings=scene.settings.changed(target={"models": network_names(base, cell.values)}))
    # one control is enough for a page, and all of them would take most of a promise's time
    if (picture := cell.values.get("picture")) is None:
        made = optimize(scene, folder / "run", promise=PromiseOptions(controls=("bare",)))
    else:
        made = import_patch(
            expand_path(picture, base), scene, folder / "run", promise=PromiseOptions(controls=("bare",))
        )
    sheet_of(made, folder / "sheet.pdf")
    return made


def take_photos(settings: SessionsSettings, cell: Cell, made: Run, folder: Path, control: str | None = None) -> Path:
    """The folder with sessions of photographs of folder/sheet.pdf, or of a control in its place and under the same
    conditions.
    """
    from patchproof.reprints.mounted_sheet import ReprintSetup
    from patchproof.reprints.reprint import reprint

    out, n = folder / ("photos" if control is None else control), settings.sessions * settings.photos
    how = ReprintSetup(path_traced=settings.path_traced, control=control)
    # cells that shared a seed's draws would be one case
    seed = zlib.crc32(cell.name.encode())
    reprint(folder / "sheet.pdf", made, n, out, how, sessions=settings.sessions, seed=seed)
    return out


def verify_photos(
    photos: Path,
    folder: Path,
    base: Path,
    cell: Cell,
    forecast: Callable[[PhotoSquare], float | None] | None = None,
    **options: Any,
) -> Report:
    """What `verify` finds in photographs of folder/sheet.pdf, without its files; `options` are some of `Options`."""
    from patchproof.app.verify import options_of
    from patchproof.evidence.gather import gather_evidence
    from patchproof.sheets.manifest import load_manifest

    sheet, networks = folder / "sheet.json", network_names(base, cell.values)
    manifest = load_manifest(sheet)
    given = replace(options_of(sheet, manifest, networks, None), **options)
    return gather_evidence(photos, manifest, given, forecast=forecast)


def record_promise(made: Run) -> dict[str, Any]:
    """What answers keep of a run's promise."""
    promise = made.promise
    hits = hits_text([condition.recognized for condition in promise.conditions])
    return {"promised": hits, "per_session": promise.per_session, "places": list(promise.places)}


def promise_posterior(result: Result) -> RatePosterior:
    """What that promise says of photographs to come."""
    answers = result.answers
    return rate_posterior(*count_by_session(parse_hits(answers["promised"]), answers["per_session"], answers["places"]))
