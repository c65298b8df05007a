"""Studies: many independent cells, each finished one kept, so that a study that was killed goes on where it was.

In: a study's name and one strict TOML file. Out: a folder with `NAME.json` (settings, every cell's values, failures,
tables), a CSV per table, a PNG per figure, `NAME.html`, and `cells/`, one JSON per finished cell, written whole. A cell
that fails is reported with its sentence and the rest goes on; `resume` does again what failed or is missing. Cells
compute on one thread each, so the tables are the same for any number of jobs, on a cluster, and after a kill.

A study is a module with a `STUDY`; its parts get plain values and know nothing of files, processes or resuming.
Left out on purpose: cells that depend on one another (one cell trains and tests), and times (they would differ).
"""

from __future__ import annotations

import ast
import json
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from patchproof.base.errors import Refused
from patchproof.base.input import read_json
from patchproof.base.output import check_folder, make_folder, write_atomically
from patchproof.base.validation import StrictModel, read_toml, spelling_hint, validate_model
from patchproof.base.workers import open_workers, result_of, use_threads
from patchproof.report.tables import Drawing, Results, Table, write_json, write_results

# by name the module whose STUDY it is; the first line of its docstring says what it is about
STUDIES: dict[str, str] = {
    "ablation": "patchlab.validation.ablation",
    "deceive": "patchlab.paper.deceive",
    "detection": "patchlab.validation.detection",
    "envelope": "patchlab.validation.envelope.sweeps",
    "forecasts": "patchlab.validation.forecasts",
    "harden": "patchlab.harden.harden_study",
    "layouts": "patchlab.validation.layouts",
    "ledger": "patchlab.validation.ledger_trials",
    "patch2d": "patchlab.paper.patch2d",
    "patch3d": "patchlab.paper.patch3d",
    "peers": "patchlab.bench.peers",
    "promises": "patchlab.validation.promises",
    "real": "patchlab.validation.real_photos",
    "robust": "patchlab.paper.robust",
    "stress": "patchlab.paper.stress",
    "transfer": "patchlab.paper.transfer",
    "verdicts": "patchlab.validation.verdicts",
}
_CELL_NAME = re.compile(r"[\w=+.,-]{1,120}")


@dataclass(frozen=True)
class Cell:
    """One piece of work. `name` is unique and becomes a file's; `values` are JSON values and all that it depends on
    besides the settings: a finished cell whose values have changed since is done again.
    """

    name: str
    values: Mapping[str, Any]


@dataclass(frozen=True)
class Result:
    """A finished cell and what `run` returned for it, after a way through JSON: tuples are lists, keys are text.

    What `run` gave as `bytes` lies in the file that stands in its place, relative to the study's folder `out`.
    """

    cell: Cell
    answers: Mapping[str, Any]
    out: Path

    def file(self, key: str) -> Path:
        """The file of what `run` gave as bytes."""
        return self.out / self.answers[key]


@dataclass(frozen=True)
class Study:
    """A study's parts: functions of a module's top level, so that they reach other processes.

    `cells(settings, base)` lists the work; paths in settings are relative to the config's folder `base`.
    `run(settings, base, cell)` does one cell: JSON values and, under keys that are file names, bytes to be kept.
    `tables(settings, results)` and, if any, `figures(settings, results)` get the finished cells in the order of
    `cells`; some may be missing. Whatever `run` needs at random follows from the settings' seed and the cell's values.
    """

    name: str
    settings: type[StrictModel]
    cells: Callable[[Any, Path], Sequence[Cell]]
    run: Callable[[Any, Path, Cell], dict[str, Any]]
    tables: Callable[[Any, Sequence[Result]], Sequence[Table]]
    figures: Callable[[Any, Sequence[Result]], Sequence[Drawing]] = lambda settings, results: ()
    files: str = "files"  # folder for what cells gave as bytes; "." is the study's own
    own_files: tuple[str, ...] = ("files",)  # patterns of names that --overwrite may replace besides

    @property
    def about(self) -> str:
        """What it is about, in one line."""
        return module_summary(self.run.__module__)


@dataclass(frozen=True)
class FinishedStudy:
    """A study's tables and what failed, cell by cell."""

    tables: tuple[Table, ...]
    results: tuple[Result, ...]
    failed: dict[str, str]


def load_study(name: str) -> Study:
    """The study of that name; refused with the nearest one where there is none."""
    if name not in STUDIES:
        raise Refused("the name of a study", f'"{name}"', spelling_hint(name, STUDIES))
    return import_module(STUDIES[name]).STUDY


def module_summary(module: str) -> str:
    """What a study's module is about: the first line of its docstring; it is not imported."""
    spec = find_spec(module)
    source = "" if spec is None or spec.origin is None else Path(spec.origin).read_text(encoding="utf-8")
    return (ast.get_docstring(ast.parse(source)) or "").partition("\n")[0]


@dataclass(frozen=True)
class Work:
    """How a study is carried out: what may lie in its folder already, and who computes (see `open_workers`);
    `on_cell` is called with (done, all).
    """

    resume: bool = False
    overwrite: bool = False
    jobs: int = 1
    cluster: str | None = None
    on_cell: Callable[[int, int], None] = lambda done, total: None


DEFAULT_WORK = Work()  # in this process, into a new folder


def run_study(name: str, config: str | Path, out: str | Path, work: Work = DEFAULT_WORK) -> FinishedStudy:
    """Run the study that the TOML file describes into the folder `out`."""
    study = load_study(name)
    settings = validate_model(study.settings, read_toml(config), str(config))
    return run_cells(study, settings, Path(config).resolve().parent, out, work)


def run_cells(
    study: Study, settings: StrictModel, base: Path, out: str | Path, work: Work = DEFAULT_WORK
) -> FinishedStudy:
    """Run a study with settings at hand."""
    out = Path(out)
    if not work.resume:
        unfinished = (out / f"{study.name}.json").is_file() and not (out / f"{study.name}.html").is_file()
        check_folder(out, _owned_patterns(study), work.overwrite, unfinished)
    cells = tuple(study.cells(settings, base))
    _check_cells(study, cells)
    with open_workers(work.jobs, work.cluster) as workers:
        _prepare_folder(study, settings, out, work.resume)
        kept = {cell.name: answers for cell in cells if (answers := _load_finished(out, cell)) is not None}
        todo = [cell for cell in cells if cell.name not in kept]
        failed: dict[str, str] = {}
        work.on_cell(len(kept), len(cells))
        do = partial(_run_cell, study.run, settings, base)
        for done, (number, future) in enumerate(workers.completed(do, todo), len(kept) + 1):
            cell = todo[number]
            values, files, sentence = _future_outcome(future)
            if sentence is None:
                kept[cell.name] = _save_cell(study, out, cell, values, files)
            else:
                failed[cell.name] = sentence
            work.on_cell(done, len(cells))
    results = tuple(Result(cell, kept[cell.name], out) for cell in cells if cell.name in kept)
    tables = tuple(study.tables(settings, results)) if results else ()
    page = Results(
        program="patchlab",
        kind="study",
        name=study.name,
        about=study.about,
        extent=f"{len(results)} of {len(cells)} cells finished",
        settings=settings.model_dump(mode="json"),
        tables=tables,
        figures=tuple(study.figures(settings, results)) if results else (),
        failed={cell.name: failed[cell.name] for cell in cells if cell.name in failed},
        more={"cells": {each.cell.name: {"cell": dict(each.cell.values), "found": each.answers} for each in results}},
    )
    write_results(out, page)
    return FinishedStudy(tables, results, dict(page.failed))


def _check_cells(study: Study, cells: Sequence[Cell]) -> None:
    names = [cell.name for cell in cells]
    bad = [name for name in names if not _CELL_NAME.fullmatch(name) or names.count(name) > 1]
    if bad:
        raise ValueError(f"cells of {study.name} need unique names that files can have, got {bad[0]!r}")
    if not cells:
        raise Refused(f"settings that leave the study {study.name} something to do", "no cells", "ask for more")


def _owned_patterns(study: Study) -> tuple[str, ...]:
    return (f"{study.name}.json", f"{study.name}.html", f"{study.name}_*", "cells", ".*.part", *study.own_files)


def _prepare_folder(study: Study, settings: StrictModel, out: Path, resume: bool) -> None:
    """The study's settings in `out`, which must be the same where one goes on."""
    path, asked = out / f"{study.name}.json", settings.model_dump(mode="json")
    if resume and path.is_file():
        if _read(path).get("settings") != asked:
            do = "give it the same settings, or another --out"
            raise Refused(f"the settings that {out} was begun with, to resume it", "others", do)
    else:
        if resume:  # nothing was begun: as without it, so that no stranger's files are mistaken for the study's
            check_folder(out, ())
        for pattern in _owned_patterns(study):
            for old in out.glob(pattern):
                shutil.rmtree(old) if old.is_dir() else old.unlink()
        make_folder(out)
        write_json(path, {"study": study.name, "settings": asked})  # first: by it a study is known
    make_folder(out / "cells")


def _load_finished(out: Path, cell: Cell) -> dict[str, Any] | None:
    """What an earlier run found for this very cell, with its files in place."""
    path = out / "cells" / f"{cell.name}.json"
    if not path.is_file():
        return None
    try:
        kept = _read(path)
    except Refused:  # cut short when the machine went down
        return None
    if kept.get("cell") != _as_json_values(cell.values) or not all((out / name).is_file() for name in kept["files"]):
        return None
    return kept["found"]


Outcome = tuple[dict[str, Any], dict[str, bytes], str | None]  # (JSON values, bytes, None), or why there are none


def _run_cell(
    run: Callable[[Any, Path, Cell], dict[str, Any]], settings: StrictModel, base: Path, cell: Cell
) -> Outcome:
    """What a cell gave; errors do not travel, since not every one survives it."""
    try:
        with use_threads(1):
            answers = run(settings, base, cell)
        files = {key: value for key, value in answers.items() if isinstance(value, bytes)}
        return _as_json_values({key: value for key, value in answers.items() if key not in files}), files, None
    except Exception as error:  # also what a user's own network raises
        return {}, {}, _error_text(error)


def _future_outcome(future: Future) -> Outcome:
    try:
        return result_of(future)
    except Exception as error:  # a worker that died
        return {}, {}, _error_text(error)


def _error_text(error: Exception) -> str:
    text = " ".join(str(error).split())[:500]
    return text if isinstance(error, Refused) else f"{type(error).__name__}: {text}"


def _save_cell(study: Study, out: Path, cell: Cell, values: dict, files: dict[str, bytes]) -> dict[str, Any]:
    """Write the cell's files, then its JSON, each whole: the JSON says that all of it is there."""
    names = {key: (Path(study.files) / key).as_posix() for key in files}
    for key, name in names.items():
        make_folder((out / name).parent)
        write_atomically(out / name, lambda path, key=key: path.write_bytes(files[key]))
    kept = {"cell": dict(cell.values), "found": values | names, "files": list(names.values())}
    write_json(out / "cells" / f"{cell.name}.json", kept)
    return values | names


def _as_json_values(values: Mapping[str, Any]) -> dict[str, Any]:
    """What a reader of the JSON will find, also now: a resumed study must not see other types than one in one go."""
    return json.loads(json.dumps(dict(values), allow_nan=False))


def _read(path: Path) -> dict[str, Any]:
    return read_json(path, "a study's JSON", "remove it")
