"""A run from somebody else: no code of its choice runs, nothing is sent, and no variable is read without our word."""

from __future__ import annotations

import importlib
import json
import os
import shutil
import socket
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from console import command

from patchproof.app.verify import verify
from patchproof.base.errors import Refused
from patchproof.optimizer.evaluate import evaluate, promise_run
from patchproof.optimizer.imported_design import import_patch
from patchproof.optimizer.problem import set_problem
from patchproof.optimizer.promise import PromiseOptions
from patchproof.optimizer.run import load_run
from patchproof.reprints.run_sheet import sheet
from patchproof.sheets.manifest import load_manifest
from test_optimize import toml

CODE = "module:fake_networks.red_against_blue"
NETWORKS = (
    *("${EMPTY}module:evil.make", "mod${EMPTY}ule:evil.make", "${CODE}", "module:evil.make"),
    *("timm:hf-hub:someone/x-${SECRET}", "timm:hf-hub:someone/x", "timm:hf-hub:a/b@w.safetensors", "timm:resnet18"),
    *("torchvision:resnet18", "torchvision:resnet18@w.pth", "clip:ViT-B-32/openai@p.json", "clip:B@w.safetensors"),
    *("file:${SECRET}/net.onnx", "torchvision:resnet18@${SECRET}.safetensors"),
)
PATHS = ("object__mesh", "background__images", "printer__profile", "camera__file", "sheet__template")
USED = ("evil", "fake_networks", "timm", "torchvision", "open_clip")  # by networks


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A folder with run/, sheet.pdf and sheet.json; the run's network is code."""
    folder = tmp_path_factory.mktemp("made")
    picture, options = np.full((64, 64, 3), 120, np.uint8), PromiseOptions(views=8, controls=("bare",))
    run = import_patch(picture, toml(folder / "scene.toml"), folder / "run", promise=options)
    sheet(run, folder / "sheet.pdf", control="gray")
    return folder


@pytest.fixture
def received(made, tmp_path, monkeypatch) -> Callable[..., Path]:
    """A copy of the run with other settings; whatever it may not do fails the test."""

    class Watched(dict):
        def __getitem__(self, name: str) -> str:
            assert name not in ("SECRET", "EMPTY", "CODE"), name
            return super().__getitem__(name)

    def forbidden(*args: object, **kwargs: object) -> None:
        raise AssertionError(args)

    monkeypatch.setattr(os, "environ", Watched(os.environ, SECRET="/s3cret", EMPTY="", CODE=CODE))
    monkeypatch.setattr(socket, "getaddrinfo", forbidden)
    monkeypatch.setattr(socket.socket, "connect", forbidden)
    real_import = importlib.import_module

    def watched_import(name: str, *package: str) -> object:
        return forbidden(name) if name in USED else real_import(name, *package)

    monkeypatch.setattr(importlib, "import_module", watched_import)

    def changed(**values: object) -> Path:
        run = shutil.copytree(made / "run", tmp_path / "run", dirs_exist_ok=True)
        details = json.loads((run / "run.json").read_text())
        for key, value in values.items():
            table, name = key.split("__")
            details["settings"][table][name] = value
        details["inputs"] = {}
        (run / "run.json").write_text(json.dumps(details))
        return run

    return changed


def test_a_run_does_not_choose_code_downloads_or_variables_as_networks(received):
    scene = load_run(received()).scene
    for name in NETWORKS:
        settings = scene.settings.changed(target={"models": ("builtin", name)})
        with pytest.raises(Refused, match="add --trust if you trust where it is from, or name the networks yourself"):
            set_problem(replace(scene, settings=settings))


@pytest.mark.parametrize("key", PATHS)
def test_a_run_does_not_choose_variables_in_paths(received, key):
    run = received(background__color=None, **{key: "${SECRET}/x"})
    with pytest.raises(Refused, match=r"without variables of your environment, got \$\{SECRET\}/x: add --trust"):
        load_run(run)


def test_every_verb_asks(received, made, tmp_path, capsys):
    """Those that load networks refuse code, and all refuse variables."""
    pdf = made / "sheet.pdf"

    def refused(run: Path, *verbs: tuple[object, ...]) -> None:
        before = sorted(path.name for path in tmp_path.rglob("*"))
        for verb in verbs:
            assert command(*verb) == 1, verb
            assert "add --trust" in capsys.readouterr().err, verb
        assert sorted(path.name for path in tmp_path.rglob("*")) == before

    run, out = tmp_path / "run", tmp_path / "out"
    other = shutil.copytree(made / "run", tmp_path / "other")
    loading = (("promise", run), ("evaluate", run), ("evaluate", run, other, "--out", out))
    refused(received(), *loading)
    others = (("sheet", run, "--out", tmp_path / "page.pdf"), ("reprint", pdf, "--n", 1, "--run", run, "--out", out))
    refused(received(background__color=None, background__images="${SECRET}"), *loading, *others)


def test_our_word_is_enough(made, tmp_path):
    """`--trust`, or the network's name where a verb takes names."""
    run = shutil.copytree(made / "run", tmp_path / "run")
    assert set_problem(load_run(run, trust=True).scene).classifiers[0].name == CODE
    assert set_problem(load_run(run, named=[CODE]).scene).classifiers[0].name == CODE
    assert set_problem(load_run(run).scene, models=[CODE]).classifiers[0].name == CODE
    with pytest.raises(Refused, match="files, not code or downloads"):
        set_problem(load_run(run, named=["builtin"]).scene)
    trusted, named = evaluate(run, n=1, trust=True), evaluate(run, n=1, models=[CODE], overwrite=True)
    assert trusted.models.keys() == named.models.keys() == {CODE}
    assert promise_run(run, views=8, trust=True).promise == load_run(run).promise


def test_own_files_and_built_in_networks_need_no_word(received, tmp_path):
    for name in ("builtin", "builtin-detector"):
        assert (
            set_problem(load_run(received(target__models=[name], target__label="mug")).scene).classifiers[0].name
            == name
        )
    for name in ("file:no.onnx", "python:net", "no.onnx", f"file:{tmp_path}/no.onnx"):
        with pytest.raises(Refused) as refusal:
            set_problem(load_run(received(target__models=[name])).scene)
        assert "--trust" not in str(refusal.value)
    with pytest.raises(Refused, match="timm"):  # a file with weights: nothing is downloaded
        set_problem(load_run(received(target__models=["timm:no@no.safetensors"])).scene)


def test_a_sheet_is_asked_like_a_run(received, made, tmp_path):
    manifest = json.loads((made / "sheet.json").read_text())
    run = json.loads((received() / "run.json").read_text())
    (tmp_path / "photos").mkdir()
    for name in NETWORKS:
        run["promise"]["models"][0]["name"] = name
        (tmp_path / "sheet.json").write_text(json.dumps(manifest | {"promise": run["promise"]}))
        assert load_manifest(tmp_path / "sheet.json").promise is not None
        for models in (None, ["builtin"]):
            with pytest.raises(Refused, match="add --trust"):
                verify(tmp_path / "photos", tmp_path / "sheet.json", tmp_path / "out", models=models)
