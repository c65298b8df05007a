"""A run and its sheet go on with what they were made from, to the byte; anything else of that name is refused."""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from onnx import numpy_helper
from onnx_files import save, small
from PIL import Image

from patchproof.base.errors import Refused
from patchproof.base.fingerprint import files_sha256
from patchproof.base.packaged import packaged_path
from patchproof.evidence.classify import judges_of
from patchproof.optimizer import loop
from patchproof.optimizer import run as run_module
from patchproof.optimizer.imported_design import import_patch
from patchproof.optimizer.problem import set_problem
from patchproof.optimizer.promise import PromiseOptions
from patchproof.optimizer.run import load_run, optimize
from patchproof.reprints.run_sheet import sheet
from test_optimize import toml

DRAFT = PromiseOptions(views=8, controls=("bare",))
PICTURE = np.full((64, 64, 3), 120, np.uint8)
OBJ = """mtllib box.mtl\nusemtl red\nvt 0 0\nvt 1 0\nvt 1 1
v 0 0 0\nv 2 0 0\nv 2 1 0\nv 0 1 0\nv 0 0 1\nv 2 0 1\nv 2 1 1\nv 0 1 1
f 1/1 3/2 2/3\nf 1 4 3\nf 5 6 7\nf 5 7 8\nf 1 2 6\nf 1 6 5\nf 3 4 8\nf 3 8 7\nf 2 3 7\nf 2 7 6\nf 1 5 8\nf 1 8 4
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A scene of files alone, and a run of it."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "box.obj").write_text(OBJ)
    (folder / "box.mtl").write_text("newmtl red\nmap_Kd box.png\n")
    Image.fromarray(PICTURE[:8, :8]).save(folder / "box.png")
    (folder / "places").mkdir()
    for number in range(3):
        Image.fromarray(PICTURE + np.uint8(number)).save(folder / "places" / f"{number}.png")
    for suffix in (".npz", ".json"):
        shutil.copy(packaged_path("calibration", "printers", f"coated{suffix}"), folder / f"own{suffix}")
    shutil.copy(packaged_path("calibration", "cameras", "phone.json"), folder / "phone.json")
    save(folder, small())
    text = (folder / "small.json").read_text().replace('"red"', '"red, mug"')  # what the built-in one calls the same
    (folder / "small.json").write_text(text)
    settings = {
        **{"object__mesh": "box.obj", "object__length_mm": 400, "background__images": "places"},
        **{"printer__profile": "own.npz", "camera__file": "phone.json", "camera__photo_px": [400, 300]},
        **{"target__models": ["file:small.onnx", "builtin"], "target__label": 0},
    }
    toml(folder / "scene.toml", **settings)
    text = (folder / "scene.toml").read_text().replace("color = [0.5, 0.5, 0.5]\n", "")
    (folder / "scene.toml").write_text(text)
    import_patch(PICTURE, folder / "scene.toml", folder / "run", promise=DRAFT)
    return folder


def repaint(path: Path) -> None:
    Image.fromarray(np.asarray(Image.open(path)) // 2).save(path)


def recalibrate(path: Path) -> None:
    """Another printer or camera, as far as anybody can tell by its name."""
    card = json.loads(path.read_text())
    card |= {"paper": card["paper"] | {"black_L": 3.0}} if "paper" in card else {"k1": card["k1"] + 0.01}
    path.write_text(json.dumps(card))


def relabel(path: Path) -> None:
    path.write_text(path.read_text().replace("red", "rot"))


def retrain(path: Path) -> None:
    network = small()
    weights = network.graph.initializer[0]
    weights.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(weights) / 2, weights.name))
    path.write_bytes(network.SerializeToString())


def reshape(path: Path) -> None:
    path.write_text(OBJ.replace("v 0 1 1", "v 0 1.1 1"))


CHANGES = {
    "box.obj": (reshape, "object.mesh box.obj"),
    "box.mtl": (lambda path: path.write_text("newmtl red\nKd 1 0 0\nmap_Kd box.png\n"), "object.mesh box.obj"),
    "box.png": (repaint, "object.mesh box.obj"),
    "places/1.png": (repaint, "background.images places"),
    "places/3.png": (lambda path: shutil.copy(path.with_name("2.png"), path), "background.images places"),
    "own.json": (recalibrate, "printer.profile own.npz"),
    "phone.json": (recalibrate, "camera.file phone.json"),
    "small.onnx": (retrain, "target.models file:small.onnx"),
    "small.json": (relabel, "target.models file:small.onnx"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_another_input_of_that_name_is_refused(made, tmp_path, name):
    folder = shutil.copytree(made, tmp_path / "copy")
    change, key = CHANGES[name]
    change(folder / name)
    with pytest.raises(Refused, match=f"Expected the {key} that .* was made with .*got another .*optimize again"):
        set_problem(load_run(folder / "run").scene)


def test_nothing_is_refused_where_nothing_changed(made):
    run = load_run(made / "run")
    assert set_problem(run.scene).inputs == run.details["inputs"] and len(run.details["inputs"]) == 6


def test_networks_that_the_user_names_are_not_those_of_the_run(made, tmp_path):
    folder = shutil.copytree(made, tmp_path / "copy")
    retrain(folder / "small.onnx")
    assert set_problem(load_run(folder / "run").scene, models=["file:small.onnx"])
    with pytest.raises(Refused, match="got another"):
        set_problem(load_run(folder / "run").scene)


def test_a_scene_of_files_in_the_run_is_not_optimized_over_them(made, tmp_path):
    folder = shutil.copytree(made, tmp_path / "copy")
    scene, before = folder / "scene.toml", sorted(folder.rglob("*"))
    scene.write_text(scene.read_text().replace('"places"', '"run/design.png"'))
    with pytest.raises(Refused, match=r"inputs that lie outside of what is written, got .*design\.png"):
        optimize(scene, folder / "run", overwrite=True)
    with pytest.raises(Refused, match=r"inputs that lie outside of what is written, got .*design\.png"):
        import_patch(folder / "run" / "design.png", made / "scene.toml", folder / "run", overwrite=True)
    assert sorted(folder.rglob("*")) == before


def test_only_a_run_is_resumed_and_not_over_inputs_or_through_links(made, tmp_path):
    """A picture that happens to be named like a run's stays, as does what a received run's links lead to."""
    folder, out = shutil.copytree(made, tmp_path / "copy"), tmp_path / "copy" / "new"
    scene, text = folder / "scene.toml", (folder / "scene.toml").read_text()
    out.mkdir()
    Image.fromarray(PICTURE).save(out / "design.png")
    mine = (out / "design.png").read_bytes()
    with pytest.raises(Refused, match="an empty or new folder"):
        optimize(scene, out, resume=True)
    (out / "steps.jsonl").touch()
    scene.write_text(text.replace('"places"', '"new/design.png"'))
    with pytest.raises(Refused, match="inputs that lie outside of what is written"):
        optimize(scene, out, resume=True)
    scene.write_text(text)
    (out / "steps.jsonl").unlink()
    (out / "steps.jsonl").symlink_to(scene)
    with pytest.raises(Refused, match=r"own output only.* got .*with steps\.jsonl"):
        optimize(scene, out, resume=True)
    assert (out / "design.png").read_bytes() == mine and scene.read_text() == text


def test_an_optimization_is_not_resumed_with_another_network(made, tmp_path, monkeypatch):
    """Its labels alone are another network, too."""
    monkeypatch.setattr(loop, "SAVE_AFTER", 1)
    monkeypatch.setattr(loop, "SELECT_VIEWS", 2)
    monkeypatch.setattr(run_module, "finish_run", lambda *given: None)
    folder = shutil.copytree(made, tmp_path / "copy")
    optimize(folder / "scene.toml", folder / "new")
    optimize(folder / "scene.toml", folder / "new", resume=True)
    relabel(folder / "small.json")
    with pytest.raises(Refused, match=r"the target\.models file:small\.onnx that .*new was made with"):
        optimize(folder / "scene.toml", folder / "new", resume=True)


def test_a_sheet_refuses_other_networks_than_its_own(made, tmp_path):
    """Any of its promise, not the first alone."""
    run = load_run(made / "run")
    manifest, models = sheet(run, made / "sheet.pdf"), set_problem(run.scene).classifiers
    assert judges_of(models, manifest) is not None
    for number in (0, 1):
        changed = [replace(each, sha256="0" * 64) if i == number else each for i, each in enumerate(models)]
        with pytest.raises(Refused, match="that the promise was made for"):
            judges_of(changed, manifest)


def test_one_file_is_hashed_whole_and_a_long_list_by_its_ends(tmp_path):
    paths = [tmp_path / name for name in ("a", "b")]
    paths[0].write_bytes(bytes(300_000))
    paths[1].write_bytes(b"x")
    assert files_sha256(paths[:1]) == hashlib.sha256(bytes(300_000)).hexdigest()
    before = files_sha256(paths), files_sha256(paths, whole=False)
    for at, seen in ((0, True), (299_999, True), (150_000, False)):
        paths[0].write_bytes(bytes(at) + b"y" + bytes(299_999 - at))
        assert files_sha256(paths) != before[0] and (files_sha256(paths, whole=False) != before[1]) is seen
    paths[0].write_bytes(bytes(300_001))
    assert files_sha256(paths, whole=False) != before[1]
