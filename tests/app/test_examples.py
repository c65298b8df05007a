"""The programs that `patchproof examples` copies: short, complete, and each ends in a verdict."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest
from console import command

import patchproof
from patchproof.optimizer.promise import PromiseOptions

PLAIN = "\n[background]\ncolor = [0.5, 0.5, 0.5]\n"  # in place of rooms, which take as long to draw as all else
EXAMPLES = sorted((Path(patchproof.__file__).parent / "app" / "examples").glob("*.py"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("examples") / "new"
    assert command("examples", out) == 0
    return out


def test_they_are_copied_once_and_nothing_is_replaced(folder, capsys):
    files = [path for path in folder.iterdir() if not path.name.startswith(".")]
    assert len([path for path in files if path.suffix == ".py"]) == len(EXAMPLES) == 5
    assert all(len(path.read_text(encoding="utf-8").splitlines()) <= 40 for path in files)
    assert command("examples", folder) == 1
    assert capsys.readouterr().err == f"Expected a new or empty folder, got {folder}, which has files: name another.\n"


@pytest.mark.parametrize("name", [path.name for path in EXAMPLES])
def test_each_ends_in_a_verdict(name, folder, monkeypatch, capsys):
    """In fewer steps, views and smaller photographs than its user's, before gray."""
    monkeypatch.chdir(folder)
    for constant, value in {"run.DRAFT_EFFORT": (1, 8), "run.PROMISE_VIEWS": 8, "loop.SELECT_VIEWS": 2}.items():
        monkeypatch.setattr(f"patchproof.optimizer.{constant}", value)
    monkeypatch.setattr("patchproof.evidence.verdict.kept_chance", lambda *_: 0.9)  # what pages advise is not read
    monkeypatch.setattr(patchproof, "PromiseOptions", lambda views: PromiseOptions(8, ("bare",)))
    for path in (folder / name, *folder.glob("*.toml")):
        text = path.read_text(encoding="utf-8").replace("[1040, 780]", "[640, 480]").replace("[800, 600]", "[480, 360]")
        text = text.replace('"steps": 8', '"steps": 2')
        text += PLAIN if path.name in ("box.toml", "detector.toml") and PLAIN not in text else ""
        path.write_text(re.sub(r", (6|12|48), (.*), sessions=\d+", r", 2, \2, sessions=2", text), encoding="utf-8")
    runpy.run_path(name)
    assert re.match("kept|broken|cannot_tell", capsys.readouterr().out.splitlines()[-1])
    assert (folder / name.replace(".py", "-report") / "report.html").is_file()


def test_the_gradient_through_a_photograph_is_that_of_finite_differences(monkeypatch, capsys):
    """Float32 pictures of 2 × 96 × 96 pixels, summed, and a difference over 0.04; the same in every run."""
    (program,) = (path for path in EXAMPLES if path.name == "network.py")
    code = program.read_text(encoding="utf-8").partition("run = ")[0]
    lines = []
    for _ in range(2):
        exec(compile(code, program.name, "exec"), {})
        lines.append(capsys.readouterr().out)
    gradient, difference = map(float, re.findall(r"-?\d+\.\d+", lines[0]))
    assert gradient == pytest.approx(difference, rel=0.02) and gradient != 0 and lines[0] == lines[1]
