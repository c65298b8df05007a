"""Print the patches of a finished study of 3D and 2D patches: what is left of their gain in photographs.

In: the folder of a finished study `patch3d`. Out: each of its designs through a sheet, simulated photographs and
`verify`: recognition in photographs with both designs and of the bare object, beside the digital rates of the study,
and the loss of confidence by step of the gap ledger. Both designs of a cell are photographed under the same conditions.

The paper never printed a patch, so no figure of its own stands beside these.
"""

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from patchlab.study import grid
from patchlab.study.estimates import cluster_mean
from patchlab.study.record import parse_hits
from patchlab.study.study import Cell, Result, Study
from patchlab.validation import photo_sessions
from patchproof.base.errors import Refused
from patchproof.base.input import hash_file, is_file, read_json
from patchproof.base.validation import expand_path
from patchproof.report.tables import Table

KINDS = ("3d", "2d")


class PrintedSettings(photo_sessions.PhotosSettings):
    """A finished study `patch3d`, and photographs of each of its designs."""

    patches: str  # folder of the finished study
    scenes: tuple[str, ...] = ()  # names of its scenes; by default all
    views: int | None = Field(64, ge=8)  # views of each promise; with fewer than 400 it is a draft


def cells(settings: PrintedSettings, base: Path) -> list[Cell]:
    """A cell per finished cell of the study: its two designs and their digital rates."""
    path = Path(expand_path(settings.patches, base)) / "patch3d.json"
    if not is_file(path) or "cells" not in (stored := read_json(path, "a study's JSON", "run it again")):
        raise Refused(f"a finished study patch3d in {path.parent}", "no patch3d.json with cells", "finish it first")
    found = []
    for name, each in stored["cells"].items():
        values, hits = each["cell"], each["found"]["hits"]
        if not settings.scenes or values["name"] in settings.scenes:
            digests = [hash_file(Path(expand_path(_design(settings, name, kind), base))) for kind in KINDS]
            digital = {kind: float(np.mean(parse_hits(hits[kind][0]))) for kind in ("bare", *KINDS)}
            found.append(Cell(name, values | {"sha256": digests, "digital": digital}))
    return found


def run(settings: PrintedSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Print, photograph and verify both designs; photograph the bare object."""
    answers: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as temporary:
        bare = None
        for kind in KINDS:
            folder = Path(temporary) / kind
            folder.mkdir()
            imported = Cell(cell.name, {**cell.values, "picture": _design(settings, cell.name, kind)})
            patch_run = photo_sessions.make_run_and_sheet(base, imported, folder, settings.views)
            photos = photo_sessions.take_photos(settings, cell, patch_run, folder)
            bare = bare or photo_sessions.take_photos(settings, cell, patch_run, folder, "bare")
            most = settings.sessions * settings.photos
            report = photo_sessions.verify_photos(photos, folder, base, cell, ledger_photos=most, controls=bare)
            ledger, counts = report.summary.ledger, report.summary.sessions
            answers[kind] = {
                "recognized": sum(session.recognized for session in counts),
                "judged": sum(session.judged for session in counts),
                "ideal": ledger and ledger.ideal,
                "shares": {step: share.share for step, share in ledger.shares.items()} if ledger else {},
            }
            answers["bare"] = {"recognized": report.controls[0].recognized, "judged": report.controls[0].n}
    return answers


def tables(settings: PrintedSettings, results: Sequence[Result]) -> tuple[Table, ...]:
    """Tables of gains before and after printing, and of the ledger's steps."""
    head, rows = ("gain", "digital", "on paper", "lost", "pairs"), []
    for better, worse in (("3d", "bare"), ("2d", "bare"), ("3d", "2d")):
        digital, paper = [], []
        for some in _pairs(results):
            if (on_paper := _gain(some, better, worse, _on_paper)) is not None:
                digital.append(_gain(some, better, worse, _digital) or 0.0)
                paper.append(on_paper)
        lost = np.subtract(digital, paper).tolist()
        rows.append((f"{better} minus {worse}", *map(cluster_mean, (digital, paper, lost)), len(paper)))
    about = (
        "Differences of rates: digital over the study's unseen views, on paper over photographs that could be judged."
        " Intervals: a bootstrap over pairs of object and network, each with all its seeds; fewer than 5 get none."
    )
    return Table("gains", "What is left of the gain on paper", head, tuple(rows), about), _steps(results)


def _design(settings: PrintedSettings, cell_name: str, kind: str) -> str:
    return f"{settings.patches}/files/{cell_name}-{kind}.png"


def _steps(results: Sequence[Result]) -> Table:
    rows = []
    for kind in KINDS:
        by_pair = [
            [one.answers[kind]["shares"] for one in some if one.answers[kind]["shares"]] for some in _pairs(results)
        ]
        for step in dict.fromkeys(step for some in by_pair for shares in some for step in shares):
            means = [
                float(np.mean(found))
                for some in by_pair
                if (found := [shares[step] for shares in some if step in shares])
            ]
            rows.append((kind, step, cluster_mean(means), len(means)))
    about = "Confidence lost between the ideal picture and the photograph, by step of the gap ledger."
    return Table("steps", "Lost by step", ("design", "step", "confidence lost", "pairs"), tuple(rows), about)


def _pairs(results: Sequence[Result]) -> list[list[Result]]:
    return list(grid.group_by(results, grid.by_values("name", "network")).values())


def _digital(result: Result, kind: str) -> float:
    return result.cell.values["digital"][kind]


def _on_paper(result: Result, kind: str) -> float | None:
    counts: Mapping[str, int] = result.answers[kind]
    return counts["recognized"] / counts["judged"] if counts["judged"] else None


def _gain(results: Sequence[Result], better: str, worse: str, rate_of: Any) -> float | None:
    """The mean difference over seeds; None where no photograph could be judged."""
    pairs = [(rate_of(one, better), rate_of(one, worse)) for one in results]
    differences = [high - low for high, low in pairs if high is not None and low is not None]
    return float(np.mean(differences)) if differences else None


STUDY = Study("printed", PrintedSettings, cells, run, tables)
