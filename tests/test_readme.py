"""The README's own blocks, run as they stand."""

from __future__ import annotations

import re
import shlex
from importlib import import_module
from pathlib import Path

import pytest

from patchproof.settings import SceneSettings
from patchproof.strict import read_toml, validated
from test_journey import command

try:
    import tomllib
except ModuleNotFoundError:
    import tomli as tomllib

README = Path(__file__).resolve().parents[1] / "README.md"


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)


@pytest.fixture(autouse=True)
def a_promise_of_few_views(monkeypatch):
    monkeypatch.setattr("patchproof.optimizer.run.PROMISE_VIEWS", 40)


@pytest.fixture(scope="module")
def here(tmp_path_factory):
    folder = tmp_path_factory.mktemp("readme")
    toml = blocks("toml")[0]
    # fewer steps than a user would take
    (folder / "scene.toml").write_text(toml + "\n[optimize]\nsteps = 3\nviews = 4\n", encoding="utf-8")
    return folder


def test_commands(here, monkeypatch, capsys):
    monkeypatch.chdir(here)
    for line in blocks("console")[0].splitlines():
        program, *arguments = shlex.split(line)
        assert program == "patchproof"
        assert command(*arguments) == 0, capsys.readouterr().err


def test_every_scene_is_one_and_every_option_exists(capsys):
    for toml in blocks("toml"):
        validated(SceneSettings, tomllib.loads(toml), "README.md")
    for line in "".join(blocks("console")).splitlines():
        _, *arguments = shlex.split(line)
        command(*arguments[: 2 if arguments[0] in {"calibrate"} else 1], "--help")
        listed = capsys.readouterr().out
        assert all(option in listed for option in arguments if option.startswith("--")), line


@pytest.mark.parametrize(("name", "count"), [("promises", 4 * 2 * 2 * 2), ("ablation", 4 * (1 + 16))])
def test_the_studies_that_are_quoted_can_be_run_again(name, count):
    study = import_module(f"patchproof.validation.{name}").STUDY
    folder = README.parent / ".readme" / name
    settings = validated(study.settings, read_toml(folder / f"{name}.toml"), name)
    assert len({cell.name for cell in study.cells(settings, folder)}) == count


def test_python(tmp_path, here, monkeypatch, capsys):
    (code,) = blocks("python")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text((here / "scene.toml").read_text())
    names: dict = {}
    exec(compile(code, "README.md", "exec"), names)
    assert tuple(names["pictures"].shape) == (4, 3, 96, 96) and tuple(names["logits"].shape) == (4, 12)
    assert capsys.readouterr().out.split()[0] in {"kept", "broken", "cannot_tell"}


def test_pictures_and_files_that_it_names_exist():
    text = README.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)]+)\)", text):
        assert (README.parent / target).exists(), target


def test_the_two_commands_are_there():
    text = README.read_text(encoding="utf-8")
    assert "pip install . && patchproof demo" in text and 'pip install -e ".[test]" && pytest' in text
