"""What the command line says besides results: versions, examples, drafts, stops, full disks, and progress in a file."""

from __future__ import annotations

import errno
import os
import re
import subprocess
import sys
import time
import tomllib
from dataclasses import replace

import cv2
import pytest
from console import command, lab_command
from safetensors import SafetensorError
from safetensors import torch as safetensors_torch

from patchlab.study.study import STUDIES, load_study, run_study
from patchproof import __main__ as entry
from patchproof.app.cli import console
from patchproof.base.errors import Refused
from patchproof.base.progress import progress_bar
from patchproof.base.validation import validate_model
from patchproof.base.version import __version__
from patchproof.optimizer import run as run_module
from patchproof.optimizer.promise import PromiseOptions
from patchproof.optimizer.run import load_run
from patchproof.optimizer.run import optimize as optimize_scene
from patchproof.reprints.reprint import sheet_scene
from patchproof.reprints.run_sheet import sheet_of_several
from patchproof.scene.scene import load_scene
from patchproof.sheets.manifest import load_manifest
from patchproof.sheets.pdf_raster import page_count
from patchproof.sheets.template import template_names


@pytest.fixture(autouse=True)
def few_views_to_select_by(monkeypatch):
    monkeypatch.setattr("patchproof.optimizer.loop.SELECT_VIEWS", 4)


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried to allocate 9 bytes"),
        RuntimeError("can't start new thread"),
        ImportError("_ufuncs.so: failed to map segment from shared object"),
        cv2.error("(-4:Insufficient memory) Failed to allocate 9 bytes"),
    ],
)
def test_too_little_memory_ends_in_a_sentence(error, monkeypatch, capsys):
    def fail():
        raise error

    with pytest.raises(SystemExit) as stopped:
        console.run_command_line(fail)
    assert stopped.value.code == 1
    assert capsys.readouterr().err.startswith("Expected enough memory, got none left: give it more")


def program(name, *arguments, **environment) -> subprocess.CompletedProcess:
    """The command in a process of its own."""
    command = [sys.executable, "-m", name, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, check=False, env=os.environ | environment)


def test_the_version_and_completion_are_there(capsys):
    assert lab_command("--version") == 0 and capsys.readouterr().out == f"patchlab {__version__}\n"
    assert command("--version") == 0 and capsys.readouterr().out == f"patchproof {__version__}\n"
    assert command("--help") == 0 and "--install-completion" in capsys.readouterr().out


def test_a_greek_letter_is_said_in_any_code_page():
    """Windows gives a pipe its own code page, in which --attack-eps has no words."""
    said = program("patchlab", "harden", "--help", PYTHONIOENCODING="cp1252")
    assert said.returncode == 0 and "ε" in said.stdout.decode("utf-8")


def test_templates_are_listed_with_what_they_are(capsys):
    assert command("sheet", "--list") == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == template_names()
    assert "a4             One A4 page, portrait" in lines
    assert command("sheet") == 2 and "--out" in capsys.readouterr().err


@pytest.mark.parametrize("name", STUDIES)
def test_the_example_of_a_study_is_a_config_of_it(name, capsys):
    assert lab_command("study", name, "--example") == 0
    text = capsys.readouterr().out
    settings = validate_model(load_study(name).settings, tomllib.loads(text), "the example")
    assert settings.model_dump(exclude_defaults=True).keys() <= tomllib.loads(text).keys()
    keys = re.findall(r"^(?:# )?\[*(\w+)(?: =|\b[\].])", text, re.MULTILINE)
    assert set(type(settings).model_fields) <= set(keys)


def test_a_study_asks_for_a_config(capsys):
    assert lab_command("study", "stress") == 2 and "--example" in capsys.readouterr().err


def test_efforts_are_steps_and_views(tmp_path, scene_file, capsys, monkeypatch):
    monkeypatch.setattr(run_module, "THOROUGH_EFFORT", (3, 12))
    run = tmp_path / "run"
    assert command("optimize", scene_file, "--out", run, "--draft", "--thorough") == 2 and not run.exists()
    assert "opposite of --draft" in capsys.readouterr().err
    assert command("optimize", scene_file, "--out", run, "--thorough", "--seed", 5) == 0
    made = load_run(run)
    assert (made.scene.settings.optimize.steps, made.promise.n, made.scene.seed) == (3, 12, 5)


def test_a_draft_takes_no_more_steps_than_its_scene_and_a_thorough_run_no_fewer(scene_file):
    of_three = load_scene(scene_file)
    draft_steps, thorough_steps = run_module.DRAFT_EFFORT[0], run_module.THOROUGH_EFFORT[0]
    for steps, expected in ((3, (3, thorough_steps)), (9999, (draft_steps, 9999))):
        scene = of_three.with_steps(steps)
        efforts = [run_module.effort_of(scene, draft, not draft, None, None) for draft in (True, False)]
        assert tuple(count for count, _ in efforts) == expected
    assert run_module.effort_of(of_three, True, False, 50, 8) == (50, 8)  # as it was asked for


def test_a_draft_says_that_it_is_one(tmp_path, scene_file, capsys):
    run = tmp_path / "run"
    assert command("optimize", scene_file, "--out", run, "--steps", 2, "--draft", "--promise", 8) == 0
    assert "Draft of 8 views" in capsys.readouterr().out
    made = load_run(run)
    assert made.scene.settings.optimize.steps == 2 and (made.promise.n, made.promise.draft) == (8, True)
    assert command("sheet", run, "--out", tmp_path / "s.pdf") == 0 and "Draft of 8 views" in capsys.readouterr().out
    assert load_manifest(tmp_path / "s.json").promise.draft
    other = replace(made, scene=load_scene(scene_file, seed=5).with_steps(2))
    several = sheet_of_several([made, other], tmp_path / "two.pdf", template="a3")
    assert [manifest.plan_page for manifest in several] == [2, 3] and page_count(tmp_path / "two.pdf") == 3
    assert [sheet_scene(tmp_path / "two.pdf", each)[0] for each in (made, other)] == several  # on another's template
    with pytest.raises(Refused, match="promise of 8 views, two sessions, at least, got 7"):
        optimize_scene(scene_file, tmp_path / "other", promise=PromiseOptions(views=7))


def test_a_stopped_run_says_what_is_kept_and_a_second_try_how_to_go_on(tmp_path, scene_file, monkeypatch, capsys):
    def stop(*_, **__):
        raise KeyboardInterrupt

    out = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(run_module, "promise_of", stop)
        assert command("optimize", scene_file, "--out", out, "--overwrite") == 130
    again = f"patchproof optimize {scene_file} --out {out} --resume"
    assert capsys.readouterr().err.splitlines()[-1] == f"Stopped: {out} keeps what was finished. Go on with: {again}"
    assert command("optimize", scene_file, "--out", out) == 1
    assert "which is unfinished: continue with --resume" in capsys.readouterr().err
    monkeypatch.setattr("patchproof.app.plan.plan.plan_geometry", stop)
    assert command("plan", scene_file) == 130 and capsys.readouterr().err == "Stopped: nothing was written.\n"


def test_an_unfinished_study_is_gone_on_with(tmp_path):
    (tmp_path / "out" / "cells").mkdir(parents=True)
    (tmp_path / "out" / "stress.json").write_text("{}")
    (tmp_path / "stress.toml").write_text('scenes = ["scene.toml"]')
    with pytest.raises(Refused, match="which is unfinished: continue with --resume, or start again with --overwrite"):
        run_study("stress", tmp_path / "stress.toml", tmp_path / "out")


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.ENOSPC, "No space left on device"),
        OSError(errno.EDQUOT, "Disk quota exceeded"),
        SafetensorError("Error while serializing: I/O error: No space left on device (os error 28)"),
    ],
)
def test_a_full_disk_is_one_sentence(error, tmp_path, scene_file, monkeypatch, capsys):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr(safetensors_torch, "save_file", fail)
    assert command("optimize", scene_file, "--out", tmp_path / "run") == 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("Expected ") and "make room" in last


def test_progress_in_a_file_is_a_line_now_and_then(monkeypatch, capsys):
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    with progress_bar() as bar:
        for done in range(1, 101):
            now[0] += 1
            bar("optimize", done, 100)
    assert capsys.readouterr().err.splitlines() == [f"optimize: {n} of 100" for n in (30, 60, 90, 100)]


def test_threads_that_wait_give_their_core_away_unless_the_user_says_otherwise(monkeypatch):
    monkeypatch.setattr(entry, "handle_interrupts", lambda: None)
    monkeypatch.setattr("patchproof.app.cli.main", lambda: None)
    monkeypatch.setenv("OMP_WAIT_POLICY", "ACTIVE")
    entry.main()
    assert os.environ["OMP_WAIT_POLICY"] == "ACTIVE"
    monkeypatch.delenv("OMP_WAIT_POLICY")
    entry.main()
    assert os.environ["OMP_WAIT_POLICY"] == "PASSIVE"
