"""Run studies: many independent cells, each stored when finished, so that a killed study can be resumed.

In: a study's name and one strict TOML file. Out: a folder with `NAME.json` (settings, every cell's values, failures,
tables), a CSV per table, a PNG per figure, `NAME.html`, and `cells/`, one JSON per finished cell, written atomically. A
cell that fails is reported with its error and the others run; `resume` runs failed and missing cells again. Cells
compute on one thread each, so tables are the same for any number of jobs, on a cluster, and after a kill.

A study is a module with a `STUDY`; its functions get plain values and know nothing of files, processes or resuming.
Left out on purpose: cells that depend on one another (one cell trains and tests), and times (they would differ).
"""

import ast
import json
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from patchproof.base.errors import Refused
from patchproof.base.folder_lock import lock_folder
from patchproof.base.input import read_json
from patchproof.base.output import (
    check_folder,
    clear_folder,
    make_folder,
    refuse_other_files,
    write_atomically,
    write_json,
)
from patchproof.base.validation import StrictModel, read_toml, spelling_hint, validate_model
from patchproof.base.workers import open_workers, result_of, use_threads
from patchproof.report.tables import Drawing, Results, Table, write_results

# by name: the module with the STUDY; the first line of its docstring describes the study
STUDIES: dict[str, str] = {
    "ablation": "patchlab.validation.ablation",
    "breaks": "patchlab.charts.breaks",
    "deceive": "patchlab.paper.deceive",
    "envelope": "patchlab.validation.envelope.sweeps",
    "effects": "patchlab.validation.effects",
    "harden": "patchlab.harden.harden_study",
    "patch2d": "patchlab.paper.patch2d",
    "patch3d": "patchlab.paper.patch3d",
    "printed": "patchlab.paper.printed",
    "promises": "patchlab.validation.promises",
    "real": "patchlab.validation.real_photos",
    "real-prints": "patchlab.validation.real_prints",
    "robust": "patchlab.paper.robust",
    "session-trials": "patchlab.validation.session_trials",
    "speed": "patchlab.charts.speed",
    "stress": "patchlab.paper.stress",
    "terms": "patchlab.charts.terms",
    "transfer": "patchlab.paper.transfer",
}
_CELL_NAME = re.compile(r"[\w=+.,-]{1,120}")


@dataclass(frozen=True)
class Cell:
    """One piece of work. `name` is unique and names its file; `values` are JSON values and all that it depends on
    besides the settings: a stored cell whose values have changed is run again.
    """

    name: str
    values: Mapping[str, Any]


@dataclass(frozen=True)
class Result:
    """A finished cell and what `run` returned for it, read from JSON: tuples are lists, keys are text.

    Where `run` returned `bytes`, `answers` has the path of their file, relative to the study's folder `out`.
    """

    cell: Cell
    answers: Mapping[str, Any]
    out: Path

    def file(self, key: str) -> Path:
        """The file of the bytes that `run` returned under this key."""
        return self.out / self.answers[key]


@dataclass(frozen=True)
class Study:
    """A study's parts: module-level functions, so that other processes can import them.

    `cells(settings, base)` lists the work; paths in settings are relative to the config's folder `base`.
    `run(settings, base, cell)` runs one cell: JSON values and, under keys that are file names, bytes to store.
    `tables(settings, results)` and, if any, `figures(settings, results)` get the finished cells in the order of
    `cells`; some may be missing. Whatever `run` needs at random follows from the settings' seed and the cell's values.
    """

    name: str
    settings: type[StrictModel]
    cells: Callable[[Any, Path], Sequence[Cell]]
    run: Callable[[Any, Path, Cell], dict[str, Any]]
    tables: Callable[[Any, Sequence[Result]], Sequence[Table]]
    figures: Callable[[Any, Sequence[Result]], Sequence[Drawing]] = lambda settings, results: ()
    files: str = "files"  # folder for files of cells' bytes; "." is the study's folder
    own_files: tuple[str, ...] = ("files",)  # patterns of more names that --overwrite may replace
    extent: Callable[[Any, Sequence[Cell]], str] = lambda settings, cells: ""  # of the work, said before it starts

    @property
    def about(self) -> str:
        """A line about the study: the first of its module's docstring."""
        return module_summary(self.run.__module__)


@dataclass(frozen=True)
class FinishedStudy:
    """A study's tables, results, and errors by cell."""

    tables: tuple[Table, ...]
    results: tuple[Result, ...]
    failed: dict[str, str]


def load_study(name: str) -> Study:
    """Load the study of that name; an unknown name is refused with the nearest one."""
    if name not in STUDIES:
        raise Refused("the name of a study", f'"{name}"', spelling_hint(name, STUDIES))
    return import_module(STUDIES[name]).STUDY


def module_summary(module: str) -> str:
    """The first line of a module's docstring, read without importing the module."""
    spec = find_spec(module)
    source = "" if spec is None or spec.origin is None else Path(spec.origin).read_text(encoding="utf-8")
    return (ast.get_docstring(ast.parse(source)) or "").partition("\n")[0]


@dataclass(frozen=True)
class Work:
    """How a study is run: folder, and workers (see `open_workers`); `on_cell` is called with (done, all), `on_start`
    with the extent of the work, where a study says it.
    """

    resume: bool = False
    overwrite: bool = False
    jobs: int = 1
    cluster: str | None = None
    on_cell: Callable[[int, int], None] = lambda done, total: None
    on_start: Callable[[str], None] = lambda extent: None


DEFAULT_WORK = Work()  # in this process, into a new folder


def run_study(
    name: str, config: str | Path, out: str | Path, work: Work = DEFAULT_WORK, changed: Mapping[str, Any] | None = None
) -> FinishedStudy:
    """Run the study that the TOML file describes, with some keys `changed`, into the folder `out`."""
    study = load_study(name)
    settings = validate_model(study.settings, {**read_toml(config), **(changed or {})}, str(config))
    return run_cells(study, settings, Path(config).resolve().parent, out, work)


def run_cells(
    study: Study, settings: StrictModel, base: Path, out: str | Path, work: Work = DEFAULT_WORK
) -> FinishedStudy:
    """Run a study with these settings; paths in them are relative to `base`."""
    with lock_folder(out):
        return _run_locked(study, settings, base, Path(out), work)


def _run_locked(study: Study, settings: StrictModel, base: Path, out: Path, work: Work) -> FinishedStudy:
    if work.resume:
        refuse_other_files(out, ("*",))
    else:
        unfinished = (out / f"{study.name}.json").is_file() and not (out / f"{study.name}.html").is_file()
        own_files = (f"{study.name}.json", f"{study.name}.html", f"{study.name}_*", "cells", *study.own_files)
        check_folder(out, own_files, work.overwrite, unfinished)
    cells = tuple(study.cells(settings, base))
    _check_cells(study, cells)
    with open_workers(work.jobs, work.cluster) as workers:
        _prepare_folder(study, settings, out, work.resume)
        found = {cell.name: answers for cell in cells if (answers := _load_finished(out, cell)) is not None}
        todo = [cell for cell in cells if cell.name not in found]
        failed: dict[str, str] = {}
        if todo and (extent := study.extent(settings, todo)):
            work.on_start(extent)
        work.on_cell(len(found), len(cells))
        task = partial(_run_cell, study.run, settings, base)
        for done, (number, future) in enumerate(workers.completed(task, todo), len(found) + 1):
            cell = todo[number]
            try:
                values, files, error = result_of(future)
            except Exception as failure:  # a worker that died
                values, files, error = {}, {}, _error_text(failure)
            if error is None:
                found[cell.name] = _save_cell(study, out, cell, values, files)
            else:
                failed[cell.name] = error
            work.on_cell(done, len(cells))
    results = tuple(Result(cell, found[cell.name], out) for cell in cells if cell.name in found)
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
    counts = Counter(names)
    bad = [name for name in names if not _CELL_NAME.fullmatch(name) or counts[name] > 1]
    if bad:
        raise ValueError(f"cells of {study.name} need unique names that files can have, got {bad[0]!r}")
    if not cells:
        expected = f"settings that give the study {study.name} something to do"
        raise Refused(expected, "settings without cells", "ask for more")


def _prepare_folder(study: Study, settings: StrictModel, out: Path, resume: bool) -> None:
    """Write the study's settings into `out`; refused if a study to resume has others."""
    path, dumped = out / f"{study.name}.json", settings.model_dump(mode="json")
    if resume and path.is_file():
        if (stored := _read(path).get("settings")) != dumped:
            changed = _first_difference(stored, dumped)
            do = "give it the same settings, or another --out"
            raise Refused(f"the settings that {out} was begun with, to resume it", changed, do)
    else:
        if resume:  # there is nothing to resume: other files must not be mistaken for the study's
            check_folder(out, ())
        clear_folder(out)
        make_folder(out)
        write_json(path, {"study": study.name, "settings": dumped})  # first: this file marks the folder as the study's
    make_folder(out / "cells")


def _first_difference(stored: dict[str, Any] | None, dumped: dict[str, Any]) -> str:
    before = stored or {}
    key = next(key for key in {**dumped, **before} if before.get(key) != dumped.get(key))
    return f"{key} = {json.dumps(dumped.get(key))[:80]} in place of {json.dumps(before.get(key))[:80]}"


def _load_finished(out: Path, cell: Cell) -> dict[str, Any] | None:
    """A cell's stored answers, or None if there are none for these values with all their files."""
    path = out / "cells" / f"{cell.name}.json"
    if not path.is_file():
        return None
    try:
        stored = _read(path)
    except Refused:  # cut off when the machine went down
        return None
    if stored.get("cell") != _as_json_values(cell.values) or not all((out / f).is_file() for f in stored["files"]):
        return None
    return stored["found"]


# (JSON values, bytes by file name, None), or ({}, {}, the error)
Outcome = tuple[dict[str, Any], dict[str, bytes], str | None]


def _run_cell(
    run: Callable[[Any, Path, Cell], dict[str, Any]], settings: StrictModel, base: Path, cell: Cell
) -> Outcome:
    """Run a cell and return its outcome; errors become text, since not every exception can be pickled."""
    try:
        with use_threads(1):
            answers = run(settings, base, cell)
        files = {key: value for key, value in answers.items() if isinstance(value, bytes)}
        return _as_json_values({key: value for key, value in answers.items() if key not in files}), files, None
    except Exception as error:  # including those of a user's network
        return {}, {}, _error_text(error)


def _error_text(error: Exception) -> str:
    text = " ".join(str(error).split())[:500]
    return text if isinstance(error, Refused) else f"{type(error).__name__}: {text}"


def _save_cell(study: Study, out: Path, cell: Cell, values: dict, files: dict[str, bytes]) -> dict[str, Any]:
    """Write the cell's files, then its JSON, each atomically: the JSON proves that all files are there."""
    names = {key: (Path(study.files) / key).as_posix() for key in files}
    for key, name in names.items():
        make_folder((out / name).parent)
        write_atomically(out / name, lambda path, key=key: path.write_bytes(files[key]))
    stored = {"cell": dict(cell.values), "found": values | names, "files": list(names.values())}
    write_json(out / "cells" / f"{cell.name}.json", stored)
    return values | names


def _as_json_values(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values as read from JSON, so that a resumed study sees the same types as an uninterrupted one."""
    return json.loads(json.dumps(dict(values), allow_nan=False))


def _read(path: Path) -> dict[str, Any]:
    return read_json(path, "a study's JSON", "remove it")
