"""Studies: what is written, what fails, and that a kill and another number of workers change nothing."""

from __future__ import annotations

import csv
import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import toy_studies as toy
from PIL import Image

import patchlab
from patchlab.study import study
from patchlab.study.study import Work, load_study, run_cells, run_study
from patchproof.base.errors import Refused
from patchproof.base.fingerprint import value_sha256
from undrawn import draw_nothing

BASE = Path(__file__).parents[1]


def carried_out(out, *numbers, **options):
    return run_cells(toy.STUDY, toy.ToySettings(numbers=numbers), BASE, out, Work(**options))


def contents(folder):
    files = (path for path in Path(folder).rglob("*") if path.is_file() and not path.name.startswith("."))
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def test_a_study_leaves_json_csv_figures_and_a_page(tmp_path):
    calls = []
    finished = carried_out(tmp_path, 1, 2, 3, on_cell=lambda *call: calls.append(call))
    assert calls == [(0, 3), (1, 3), (2, 3), (3, 3)] and not finished.failed
    names = {"toy.json", "toy.html", "toy_squares.csv", "toy_squares.png", "cells/n1.json", "files/n1.txt"}
    assert names <= contents(tmp_path).keys()
    rows = list(csv.reader((tmp_path / "toy_squares.csv").read_text().splitlines()))
    assert rows[0] == ["cell", "square", "large", "large_low", "large_high", "large_n"]
    # Wilson's interval of 4 of 4: low = 4 / (4 + 1.96²)
    assert rows[2][:3] == ["n2", "4", "1.0"] and float(rows[2][3]) == pytest.approx(0.5101, abs=1e-4)
    data = json.loads((tmp_path / "toy.json").read_text())
    with Image.open(tmp_path / "toy_squares.png") as picture:
        assert picture.info["Comment"] == value_sha256(data), "says which figures it shows"
    assert data["cells"]["n3"]["found"] == {"square": 9, "parts": [1, 2], "n3.txt": "files/n3.txt"}
    assert (tmp_path / "files/n3.txt").read_text() == "3"
    page = (tmp_path / "toy.html").read_text()
    assert "1.000 <small>[0.510, 1.000]</small>" in page and "data:image/png" in page and "http" not in page


def test_cells_that_fail_are_reported_and_the_rest_goes_on(tmp_path, monkeypatch):
    draw_nothing(monkeypatch)
    finished = carried_out(tmp_path, 13, 2, 14, 15)
    assert [one.cell.name for one in finished.results] == ["n2"]
    assert list(finished.failed) == ["n13", "n14", "n15"]
    assert finished.failed["n13"] == "Expected a number that brings luck, got 13: use another."
    assert finished.failed["n14"] == "ArithmeticError: over flow" and "ValueError" in finished.failed["n15"]
    assert "brings luck" in (tmp_path / "toy.html").read_text()


def test_where_all_cells_fail_the_page_says_so(tmp_path):
    assert carried_out(tmp_path, 13).tables == ()
    assert "0 of 1 cells finished" in (tmp_path / "toy.html").read_text()


def test_resuming_does_what_failed_changed_or_is_missing_and_nothing_else(tmp_path, monkeypatch):
    draw_nothing(monkeypatch)
    carried_out(tmp_path, 2, 3, 13)
    (tmp_path / "files/n3.txt").unlink()
    done = []

    def run(settings, base, cell):
        done.append(cell.name)
        return {"square": -1}

    run_cells(replace(toy.STUDY, run=run), toy.ToySettings(numbers=(2, 3, 13)), BASE, tmp_path, Work(resume=True))
    assert done == ["n3", "n13"]
    changed = replace(toy.STUDY, run=run, cells=lambda s, b: [study.Cell("n2", {"number": 20})])
    run_cells(changed, toy.ToySettings(numbers=(2, 3, 13)), BASE, tmp_path, Work(resume=True))
    assert done == ["n3", "n13", "n2"]


def test_a_cell_cut_short_on_disk_is_done_again(tmp_path, monkeypatch):
    draw_nothing(monkeypatch)
    carried_out(tmp_path, 2)
    whole = contents(tmp_path)
    (tmp_path / "cells/n2.json").write_text('{"cell": {"num')
    carried_out(tmp_path, 2, resume=True)
    assert contents(tmp_path) == whole


def test_folders_settings_and_names_that_will_not_do_are_refused(tmp_path, monkeypatch):
    draw_nothing(monkeypatch)
    carried_out(tmp_path, 2)
    with pytest.raises(Refused, match="empty or new folder"):
        carried_out(tmp_path, 2)
    with pytest.raises(Refused, match=r"the settings that .* was begun with"):
        carried_out(tmp_path, 3, resume=True)
    carried_out(tmp_path, 3, overwrite=True)
    assert "cells/n2.json" not in contents(tmp_path)
    (tmp_path / "mine.txt").touch()
    with pytest.raises(Refused, match=r"mine\.txt"):
        carried_out(tmp_path, 2, overwrite=True)
    (tmp_path / "toy.json").unlink()
    with pytest.raises(Refused, match="empty or new folder"):
        carried_out(tmp_path, 2, resume=True)
    with pytest.raises(Refused, match="something to do"):
        carried_out(tmp_path / "none")
    with pytest.raises(ValueError, match="unique"):
        carried_out(tmp_path / "twice", 2, 2)


def test_studies_are_found_by_name_and_configs_read_strictly(tmp_path, monkeypatch):
    draw_nothing(monkeypatch)
    monkeypatch.setitem(study.STUDIES, "toy", "toy_studies")
    with pytest.raises(Refused, match='did you mean "toy"'):
        load_study("toi")
    config = tmp_path / "toy.toml"
    config.write_text("numbers = [2]\npauses = 1")
    with pytest.raises(Refused, match='did you mean "pause_s"'):
        run_study("toy", config, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    config.write_text("numbers = [2]")
    assert len(run_study("toy", config, tmp_path / "out").results) == 1


def test_every_study_is_listed_under_its_own_name_and_says_what_it_is_about():
    root = Path(patchlab.__file__).parent
    modules = {
        ".".join(["patchlab", *path.relative_to(root).with_suffix("").parts])
        for path in root.rglob("*.py")
        if re.search(r"^STUDY\b", path.read_text(encoding="utf-8"), re.MULTILINE)
    }
    assert modules == set(study.STUDIES.values()), "list it in STUDIES"
    for name, module in study.STUDIES.items():
        assert load_study(name).name == name
        assert re.fullmatch(r"[A-Z].{20,118}\.", study.module_summary(module)), module


def test_listing_the_studies_imports_none_of_them():
    code = (
        "import sys; from patchlab.study.study import STUDIES, module_summary\n"
        "print(*map(module_summary, STUDIES.values())); sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_kill_in_the_middle_and_more_workers_change_no_byte(tmp_path, monkeypatch):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    settings = toy.ToySettings(numbers=tuple(range(20, 32)))
    run_cells(toy.STUDY, settings, BASE, whole, Work(jobs=2))
    child = os.fork()
    if child == 0:
        try:
            monkeypatch.setattr(toy, "time", SimpleNamespace(sleep=lambda _: time.sleep(0.2)))  # time for a kill
            run_cells(toy.STUDY, settings, BASE, killed, Work())
        finally:
            os._exit(1)
    while len(list(killed.glob("cells/*.json"))) < 3:
        assert os.waitpid(child, os.WNOHANG) == (0, 0)
        time.sleep(0.02)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    assert len(list(killed.glob("cells/*.json"))) < 12
    run_cells(toy.STUDY, settings, BASE, killed, Work(resume=True))
    assert contents(killed) == contents(whole)
