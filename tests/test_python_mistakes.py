"""Wrong inputs through Python: each ends in a `Refused` of one sentence, before anything is computed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from test_api import SETTINGS, network

import patchproof as pp

LABELS = ("box", "cup", "tin")
MESH = trimesh.creation.box(extents=(0.3, 0.2, 0.2))
SCENE = pp.make_scene(SETTINGS, MESH)
NET, STAGE, VIEWS = network(), pp.set_stage(SCENE), SCENE.draw("train", 2)
MODULE = torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d(4), torch.nn.Flatten(), torch.nn.Linear(48, 3))
RUN = pp.Run(Path("run"), SCENE, np.zeros((8, 8, 3), np.uint8), None, {})  # pyright: ignore[reportArgumentType]


def same(value):
    return value


def optimize(**options):
    return pp.optimize(SCENE, "out", **{"models": [NET]} | options)


def verify(**options):
    return pp.verify(**{"photos": ".", "sheet": "sheet.json", "out": "report", "models": [NET]} | options)


def make(**tables):
    return pp.make_scene({name: SETTINGS.get(name, {}) | table for name, table in (SETTINGS | tables).items()}, MESH)


def photograph(design, views=VIEWS, size_px=(72, 72), stage=STAGE):
    return pp.photograph(stage, design, views, size_px)


MISTAKES: dict[str, tuple[Callable[[], object], str]] = {
    "loss: a mean": (lambda: optimize(loss=lambda logits, i: logits[:, i[0]].mean()), "no mean, no sum"),
    "loss: all logits": (lambda: optimize(loss=lambda logits, i: logits), "got torch.float32 3×3"),
    "loss: NumPy": (lambda: optimize(loss=lambda logits, i: logits.detach().numpy()[:, 0]), "N losses"),
    "loss: detached": (lambda: optimize(loss=lambda logits, i: logits.detach()[:, 0]), "without detach"),
    "loss: one argument": (lambda: optimize(loss=lambda logits: logits[:, 0]), "takes 1 positional"),
    "loss: a criterion": (lambda: optimize(loss=torch.nn.CrossEntropyLoss()), "must be Tensor"),
    "loss: a name": (lambda: optimize(loss="margin"), "loss of optimize as .*, got 'margin'"),
    "models: a raw module": (lambda: optimize(models=[MODULE]), "Sequential at index 0: wrap it"),
    "models: no list": (lambda: optimize(models=NET), "got Classifier: wrap it"),
    "models: a name": (lambda: optimize(models="builtin"), r'write a list: \["builtin"\]'),
    "models: a path": (lambda: optimize(models=[Path("net.onnx")]), r"PosixPath\('net.onnx'\) at index 0"),
    "models: a class": (lambda: optimize(models=[torch.nn.Linear]), "wrap it with classifier_of"),
    "scene: settings": (lambda: pp.optimize(SETTINGS, "out"), "a dictionary of 8 items: load a file"),
    "scene: none": (lambda: pp.optimize(None, "out"), "got None"),
    "out: none": (lambda: pp.optimize(SCENE, None), "out of optimize"),
    "out: left out": (lambda: pp.optimize(SCENE), "missing a required argument: 'out'"),
    "seed: text": (lambda: optimize(seed="1"), "seed of optimize as int . None, got '1'"),
    "seed: negative": (lambda: pp.make_scene(SETTINGS, MESH, seed=-1), r"0 or more \(below 2\*\*32\), got -1"),
    "seed: beyond 32 bits": (lambda: pp.make_scene(SETTINGS, MESH, seed=2**32), r"below 2\*\*32\), got 4294967296"),
    "seed: a fraction": (lambda: pp.make_scene(SETTINGS, MESH, seed=1.5), "got 1.5: give int"),
    "promise: a number": (lambda: optimize(promise=100), r"write PromiseOptions\(...\)"),
    "promise: views in words": (lambda: optimize(promise=pp.PromiseOptions(views="many")), "views of PromiseOptions"),
    "promise: half a view": (lambda: optimize(promise=pp.PromiseOptions(views=20.5)), "got 20.5"),
    "promise: no control": (lambda: optimize(promise=pp.PromiseOptions(controls=())), "one control at least"),
    "promise: one control": (lambda: optimize(promise=pp.PromiseOptions(controls="bare")), r'\["bare"\]'),
    "compute: a number": (lambda: optimize(compute=2), r"write Compute\(...\)"),
    "compute: no job": (lambda: optimize(compute=pp.Compute(jobs=0)), "jobs of Compute of 1 or more .*, got 0"),
    "compute: jobs as text": (lambda: optimize(compute=pp.Compute(jobs="2")), "got '2'"),
    "compute: a device": (lambda: optimize(compute=pp.Compute(device="gpu")), "a device that this torch can use"),
    "draft and thorough": (lambda: optimize(draft=True, thorough=True), "a draft or a thorough run, got both"),
    "draft: text": (lambda: optimize(draft="yes"), "draft of optimize as bool, got 'yes'"),
    "progress: true": (lambda: optimize(progress=True), "progress of optimize as .*, got True"),
    "a misspelled option": (lambda: optimize(draught=True), 'did you mean "draft"'),
    "mesh: a path": (lambda: pp.make_scene(SETTINGS, Path("box.obj")), "name its path as object.mesh"),
    "mesh: a function": (lambda: pp.make_scene(SETTINGS, same), "got function: load it with trimesh"),
    "mesh: a function in settings": (lambda: make(object={"mesh": same}), "object.mesh"),
    "mesh: vertices": (lambda: make(object={"mesh": np.zeros((8, 3))}), "object.mesh"),
    "mesh: without faces": (lambda: pp.make_scene(SETTINGS, trimesh.Trimesh()), "got no face"),
    "mesh: a missing file": (lambda: make(object={"mesh": Path("no.obj")}), "no file at"),
    "label: a function": (lambda: make(target={"label": same}), "target.label"),
    "label: unknown": (lambda: pp.optimize(make(target={"label": "dog"}), "out", models=[NET]), "box, cup, tin"),
    "settings: a list": (lambda: pp.make_scene([1], MESH), "settings of make_scene"),
    "settings: a path": (lambda: pp.make_scene("scene.toml"), "load a file with load_scene"),
    "length: NaN": (lambda: make(object={"length_mm": float("nan")}), "finite"),
    "length: an array": (lambda: make(object={"length_mm": np.array([1, 2])}), "object.length_mm"),
    "base: a number": (lambda: pp.make_scene(SETTINGS, MESH, 3), "base of make_scene"),
    "load_scene: a number": (lambda: pp.load_scene(3), "got 3: give str . Path"),
    "load_scene: no file": (lambda: pp.load_scene("nothere.toml"), "no file at nothere.toml"),
    "load_run: nothing": (lambda: pp.load_run(None), "got None"),
    "load_run: trust": (lambda: pp.load_run("run", trust="yes"), "as bool"),
    "sheet: a folder": (lambda: pp.sheet("run", "a.pdf"), "load it with load_run"),
    "sheet: no copies": (lambda: pp.sheet(RUN, "a.pdf", copies=0), "1 or more .*, got 0"),
    "sheet: a template": (lambda: pp.sheet(RUN, "a.pdf", template=4), "str . None, got 4"),
    "sheet: exists": (lambda: pp.sheet(RUN, "there.pdf"), "choose another out or add overwrite=True"),
    "reprint: none": (lambda: pp.reprint("a.pdf", RUN, 0, "photos"), "n of reprint of 1 or more"),
    "reprint: a fraction": (lambda: pp.reprint("a.pdf", RUN, 2.5, "photos"), "got 2.5"),
    "reprint: a printer": (lambda: pp.reprint("a.pdf", RUN, 2, "photos", "office"), r"write ReprintSetup\(...\)"),
    "reprint: a scale": (
        lambda: pp.reprint("a.pdf", RUN, 2, "photos", pp.ReprintSetup(print_scale="97 %")),
        "print_scale of ReprintSetup",
    ),
    "verify: a dictionary": (lambda: verify(capture={"scan_dpi": 300}), r"write CaptureInfo\(...\)"),
    "verify: dpi as text": (lambda: verify(capture=pp.CaptureInfo(scan_dpi="300")), "scan_dpi of CaptureInfo"),
    "verify: one ruler": (
        lambda: verify(capture=pp.CaptureInfo(ruler_mm=97.1)),
        "ruler_mm of CaptureInfo as .*, got 97.1",
    ),
    "verify: controls": (lambda: verify(controls={"mean": "photos"}), "controls of verify"),
    "verify: a list of paths": (lambda: verify(photos=[Path("a.jpg")]), "at index 0"),
    "evaluate: none": (lambda: pp.evaluate("run", n=0), "1 or more"),
    "compare: one name": (lambda: pp.compare("run", "out"), r'\["run"\]'),
    "classifier_of: one label": (lambda: pp.classifier_of(MODULE, 32, "box"), r'\["box"\]'),
    "classifier_of: a size": (lambda: pp.classifier_of(MODULE, (32, 32), LABELS), r"got \(32, 32\)"),
    "load_classifier: a number": (lambda: pp.load_classifier(3), "name of load_classifier"),
    "load_classifier: a device": (lambda: pp.load_classifier(NET, device="gpu"), "a device that this torch can use"),
    "photograph: channels last": (lambda: photograph(torch.zeros(8, 8, 3)), "got torch.float32 8×8×3"),
    "photograph: bytes": (lambda: photograph(torch.zeros(3, 8, 8, dtype=torch.uint8)), "got torch.uint8 3×8×8"),
    "photograph: codes": (lambda: photograph(torch.full((3, 8, 8), 255.0)), r"in \[0, 1\], got torch.float32"),
    "photograph: negative": (lambda: photograph(torch.full((3, 8, 8), -1.0)), r"in \[0, 1\], got torch.float32"),
    "photograph: not a number": (lambda: photograph(torch.full((3, 8, 8), torch.nan)), r"in \[0, 1\]"),
    "photograph: nothing": (lambda: photograph(torch.zeros(3, 0, 8)), "got torch.float32 3×0×8"),
    "photograph: floats": (lambda: photograph(np.zeros((8, 8, 3))), "got float64 8×8×3"),
    "photograph: one side": (
        lambda: photograph(RUN.design, size_px=72),
        r"size_px of photograph as tuple\[int, int\], got 72",
    ),
    "photograph: no pixels": (lambda: photograph(RUN.design, size_px=(0, 72)), "1 pixel at least"),
    "photograph: a scene": (lambda: photograph(RUN.design, stage=SCENE), r"set_stage\(scene\)"),
    "photograph: a count": (lambda: photograph(RUN.design, views=2), "scene.draw"),
    "set_stage: a file": (lambda: pp.set_stage("scene.toml"), "load a file with load_scene"),
    "draw: a stream": (lambda: SCENE.draw("test", 2), "evaluate"),
    "draw: fewer than none": (lambda: SCENE.draw("train", -1), "-1"),
    "logits: one photograph": (lambda: NET.logits(torch.zeros(3, 32, 32)), "torch.float32 3×32×32: stack them"),
    "logits: an array": (lambda: NET.logits(np.zeros((1, 3, 32, 32))), "float64 1×3×32×32"),
    "import_patch: a number": (lambda: pp.import_patch(3, SCENE, "out"), "ndarray, got 3"),
    "choose_place: a file": (lambda: pp.choose_place("scene.toml"), "load a file with load_scene"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_refused_in_one_sentence(mistake, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("there.pdf").touch()
    call, said = MISTAKES[mistake]
    with pytest.raises(pp.Refused, match=said) as refused:
        call()
    sentence = str(refused.value)
    assert sentence.startswith("Expected ") and ", got " in sentence and sentence.endswith(".") and "\n" not in sentence
    assert len(sentence) < 500 and "--" not in sentence and " at 0x" not in sentence
    assert len(MISTAKES) >= 60 and sorted(path.name for path in tmp_path.iterdir()) == ["there.pdf"]


def test_a_design_in_float64_is_one_in_float32():
    design = torch.rand(3, 8, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert torch.equal(photograph(design), photograph(design.float()))


def test_numbers_of_numpy_are_numbers():
    made = pp.make_scene(SETTINGS, MESH, seed=np.int64(3))
    assert type(made.seed) is int and len(made.draw("train", np.int64(2))) == 2
    assert pp.classifier_of(MODULE, np.int32(32), np.array(LABELS)).labels == LABELS
