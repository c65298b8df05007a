"""The public names from Python: a scene, a network and a loss that no file names, from optimizing to the verdict."""

from __future__ import annotations

import html
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

import patchproof as pp
import patchproof.base.errors
import patchproof.optimizer.run as run_module
from patchproof.app.capture.album import UploadRefused
from patchproof.base.errors import TimeLimitExceeded, WorkerDied
from patchproof.base.workers import use_threads
from patchproof.networks.bounds import UnsupportedNetwork
from patchproof.optimizer.problem import set_problem
from patchproof.optimizer.promise import PROMISE_VIEWS

SETTINGS = {
    "object": {"mesh": "python:box", "length_mm": 300},
    "patch": {"width_mm": 110, "height_mm": 110},
    "target": {"label": "box", "models": ["python:net"]},
    "view": {"azimuth_deg": [-30, 30], "distance_mm": [450, 700]},
    "background": {"color": [0.4, 0.5, 0.4]},
    "camera": {"photo_px": [96, 72]},
    "printer": {"profile": "coated"},
    "optimize": {"steps": 12, "views": 4},
}


def scene(**tables) -> pp.Scene:
    mesh = trimesh.creation.box(extents=(0.3, 0.2, 0.2))
    return pp.make_scene(SETTINGS | tables, mesh)


def network(seed: int = 0) -> pp.Classifier:
    """Three classes told apart by a picture's coarse colors."""
    torch.manual_seed(seed)
    layers = torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d(4), torch.nn.Flatten(), torch.nn.Linear(48, 3))
    return pp.classifier_of(layers, 32, ("box", "cup", "tin"), "python:net" if seed == 0 else f"python:net{seed}")


def loss(logits: torch.Tensor, indices: tuple[int, ...]) -> torch.Tensor:
    """Own loss: the margin of the target's class."""
    return -logits[:, indices[0]]


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> pp.Run:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("patchproof.optimizer.run.PROMISE_VIEWS", 24)
        patch.setattr("patchproof.optimizer.loop.SELECT_VIEWS", 4)
        return pp.optimize(scene(), tmp_path_factory.mktemp("api") / "run", models=[network()], loss=loss)


def test_settings_may_be_a_plain_dictionary_and_are_refused_in_one_sentence():
    assert scene().settings == pp.SceneSettings.model_validate(SETTINGS)
    with pytest.raises(pp.Refused, match=r"patch\.widht_mm"):
        scene(patch={"widht_mm": 110, "height_mm": 110})


def test_an_own_loss_is_descended_on_and_the_promise_is_an_object(run):
    flat = np.full_like(run.design, 128)
    stage, conditions = pp.set_stage(run.scene), run.scene.draw("promise", 16)
    with torch.no_grad():
        logits = [network().logits(pp.photograph(stage, shown, conditions, (72, 72))) for shown in (run.design, flat)]
    assert loss(logits[0], (0,)).mean() < loss(logits[1], (0,)).mean()
    promise = run.promise
    assert promise.n == 24 and PROMISE_VIEWS == 400 and promise.models[0].name == "python:net"
    assert promise.models[0].sha256 == network().sha256
    assert promise.interval[0] <= promise.rate <= promise.interval[1]


def test_a_run_of_a_mesh_given_in_python_is_loaded_again_as_the_same_scene(run):
    again = pp.load_run(run.folder)
    assert again.scene.sheet_id == run.scene.sheet_id == scene().sheet_id
    assert again.scene.with_template("letter").sheet_id == run.scene.with_template("letter").sheet_id
    assert (again.design == run.design).all() and again.promise == run.promise
    longer = pp.make_scene(SETTINGS, trimesh.creation.box(extents=(0.4, 0.2, 0.2)))
    assert longer.sheet_id != run.scene.sheet_id  # another mesh is another scene


def test_sheet_evaluation_and_verdict_take_the_network_itself(run, tmp_path):
    manifest = pp.sheet(run, tmp_path / "sheet.pdf")
    assert manifest.sheet_id == run.scene.sheet_id and manifest.promise == run.promise
    result = pp.evaluate(run.folder, models=[network()], n=8)
    assert result.models["python:net"].sha256 == network().sha256
    both = pp.evaluate(run.folder, models=[network()], n=8, compute=pp.Compute(jobs=2), overwrite=True)
    assert both.models["python:net"] == result.models["python:net"]
    pp.reprint(tmp_path / "sheet.pdf", run, 2, tmp_path / "photos")
    judge = [network(), network(1)]
    report = pp.verify(tmp_path / "photos", tmp_path / "sheet.json", tmp_path / "report", models=judge)
    assert len(report.photos) == 2
    with pytest.raises(pp.Refused, match="given in Python"):
        pp.verify(tmp_path / "photos", tmp_path / "sheet.json", tmp_path / "other")


def test_the_gradient_of_a_photograph_in_a_design_is_that_of_finite_differences():
    """Float32: a sum of 72·72·3 codes in double is off by about 6e-8·√15552 = 8e-6 at either end, which is 2e-3 over a
    step of 2·2e-3; gradients here are tens, and the tables of printer and sRGB bend by under a hundredth in a step.
    """
    stage, step, generator = pp.set_stage(scene()), 2e-3, torch.Generator().manual_seed(0)
    conditions = stage.scene.draw("train", 1)
    design = 0.35 + 0.3 * torch.rand(3, 8, 8, generator=generator)

    def total(shown: torch.Tensor) -> torch.Tensor:
        return pp.photograph(stage, shown, conditions, (72, 72), jpeg=False).double().sum()

    leaf = design.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(total(leaf), leaf)
    assert gradient.abs().max() > 1
    for place in ((0, 3, 4), (1, 4, 4), (2, 2, 5)):
        high, low = design.clone(), design.clone()
        high[place] += step
        low[place] -= step
        with torch.no_grad():
            slope = float(total(high) - total(low)) / float(high[place] - low[place])
        assert float(gradient[place]) == pytest.approx(slope, rel=0.02)


def test_a_photograph_shows_pixels_as_it_shows_the_design_they_are_of():
    stage = pp.set_stage(scene())
    conditions, pixels = stage.scene.draw("train", 2), np.random.default_rng(0).integers(0, 256, (8, 8, 3), np.uint8)
    design = torch.tensor(pixels).permute(2, 0, 1) / 255
    with torch.no_grad():
        pictures = [pp.photograph(stage, shown, conditions, (72, 72)) for shown in (pixels, design, None)]
    assert torch.equal(pictures[0], pictures[1]) and not torch.equal(pictures[0], pictures[2])


def test_a_dictionary_may_hold_the_objects_that_a_scene_file_names(tmp_path):
    pictures = [np.full((80, 90, 3), 40 * i, np.uint8) for i in range(6)]
    mesh = trimesh.creation.box(extents=(0.3, 0.2, 0.2))
    module = network().network
    module.input_px, module.labels = 32, ("box", "cup", "tin")
    tables = {
        "object": {"mesh": mesh, "length_mm": 300},
        "target": {"label": "box", "models": [module, network(1)]},
        "background": {"images": pictures},
        "printer": {"profile": Path("coated")},
    }
    made = pp.make_scene(SETTINGS | tables, base=tmp_path)
    assert (
        made.settings.target.models == ("python:network0", "python:net1") and made.settings.object.mesh == "python:mesh"
    )
    folder = tmp_path / made.settings.background.images
    assert (
        np.array_equal(np.asarray(Image.open(folder / "photo_0002.png")), pictures[1])
        and len(list(folder.glob("*.png"))) == 6
    )
    assert pp.make_scene(SETTINGS | tables, base=tmp_path).sheet_id == made.sheet_id
    assert [judge.labels for judge in set_problem(made).classifiers] == [("box", "cup", "tin")] * 2
    twice = {"target": {"label": "box", "models": [network(), network()]}}
    with pytest.raises(pp.Refused, match="python:net twice"):
        pp.make_scene(SETTINGS | twice, mesh)
    neither = pp.make_scene(SETTINGS | {"target": {"label": "box", "models": [7]}}, mesh)
    with pytest.raises(pp.Refused, match="an object of type int"):
        set_problem(neither)
    with pytest.raises(pp.Refused, match=r"float64 \(8, 8, 3\) at index 1"):
        pp.make_scene(SETTINGS | {"background": {"images": [pictures[0], np.zeros((8, 8, 3))]}}, mesh, tmp_path)


def test_photographs_may_be_arrays(run, tmp_path):
    pp.sheet(run, tmp_path / "sheet.pdf")
    photos = [np.full((120, 160, 3), 90 + i, np.uint8) for i in range(2)]
    report = pp.verify(photos, tmp_path / "sheet.json", tmp_path / "report", models=[network()])
    assert [photo.file for photo in report.photos] == ["photo_0001.png", "photo_0002.png"]
    assert {photo.code for photo in report.photos} == {"too_few_markers"}
    with pytest.raises(pp.Refused, match="an empty list"):
        pp.verify([], tmp_path / "sheet.json", tmp_path / "report", overwrite=True, models=[network()])


def test_a_scene_in_memory_keeps_its_seed(tmp_path):
    with pytest.raises(pp.Refused, match="the scene in memory, 0, got 7"):
        pp.optimize(scene(), tmp_path / "run", seed=7)


@pytest.mark.parametrize(
    ("verb", "compute", "got"),
    [("optimize", pp.Compute(cluster="tcp://a:1"), "tcp://a:1"), ("verify", pp.Compute("cuda"), '"cuda"')],
)
def test_what_a_verb_cannot_use_is_refused_by_name(verb, compute, got, run, tmp_path):
    pp.sheet(run, tmp_path / "sheet.pdf")
    arguments = (
        (scene(), tmp_path / "out") if verb == "optimize" else (tmp_path, tmp_path / "sheet.json", tmp_path / "out")
    )
    with pytest.raises(pp.Refused, match=f"{verb}.*{got}"):
        getattr(pp, verb)(*arguments, compute=compute)


def test_networks_as_python_has_them():
    layers = network().network
    pictures = (torch.rand(2, 3, 32, 32),)
    exported = torch.export.export(layers, pictures, dynamic_shapes=({0: torch.export.Dim("n", min=1, max=64)},))
    expected = network().logits(pictures[0])
    for each in (exported.module(), torch.jit.trace(layers, pictures), lambda photos: layers(photos)):
        judge = pp.load_classifier(pp.classifier_of(each, 32, ("box", "cup", "tin")))
        assert torch.allclose(judge.logits(pictures[0]), expected, atol=1e-6)
    for what, got in (
        (exported, r"an ExportedProgram: call its \.module"),
        (torch.nn.Linear, "type type"),
        ("net.pt", "type str"),
    ):
        with pytest.raises(pp.Refused, match=got):
            pp.classifier_of(what, 32, ("box", "cup", "tin"))


def test_errors_are_one_tree_and_cross_processes():
    errors = [
        pp.Refused("a", "b", "c"),
        WorkerDied("a", "b", "c"),
        UploadRefused(404, "a", "b", "c"),
        pp.PhotoRejected("blurred", 1.0, 2.0, "hold still"),
        UnsupportedNetwork("a thing"),
        TimeLimitExceeded("3 s"),
    ]
    for error in errors:
        again = pickle.loads(pickle.dumps(error))
        assert isinstance(error, pp.PatchproofError) and type(again) is type(error) and str(again) == str(error)
    assert pickle.loads(pickle.dumps(errors[2])).status == 404
    tree = patchproof.base.errors.__doc__
    assert all(type(error).__name__ in tree for error in errors)


def test_results_show_themselves_in_a_notebook(run):
    shown = run.promise._repr_html_()
    assert f"{run.promise.rate:.1%}" in shown and shown.count("<svg") == 1 + len(run.promise.controls)
    assert "data:image/png" in run._repr_html_() and html.escape(run.promise.headline) in run._repr_html_()
    assert [step["step"] for step in run.history] == list(range(1, 13)) and "loss" in run.history[0]


def test_everything_public_has_a_short_repr(run, tmp_path):
    """A line that says what it is, however large it is."""
    manifest, report = pp.sheet(run, tmp_path / "sheet.pdf"), judged_report(tmp_path)
    things = [run, run.scene, run.scene.settings, run.promise, manifest, report, report.summary, network()]
    things += [pp.set_stage(run.scene), run.scene.draw("train", 9), pp.load_printer("coated"), pp.Compute()]
    things += [pp.Reprint(tmp_path, dict.fromkeys("abcdefgh")), pp.Preview(tmp_path, ("line",) * 9, (), None)]
    for thing in things:
        assert repr(thing).startswith(f"{type(thing).__name__}(") and len(repr(thing)) < 800 and "\n" not in repr(thing)
    assert f"rate={run.promise.rate:.4g}" in repr(run) and "label='box'" in repr(run.scene)


def judged_report(folder: Path) -> pp.Report:
    """Of 9 photographs, 6 recognized, beside a control's 2 of 9, with a picture of one."""
    (folder / "pictures").mkdir()
    Image.new("RGB", (16, 12)).save(folder / "pictures" / "a.photo.jpg")
    counts = {"photos": 9, "judged": 9, "measured": 9, "rate": 6 / 9, "interval": (0.3, 0.9)}
    words = {"prediction_interval": (4, 9), "verdict": "kept"}
    control = {"name": "bare", "recognized": 2, "n": 9, "interval": (0.05, 0.6)}
    values = {"sheet_id": "0" * 10, "photos": [], "summary": counts | words, "controls": [control], "folder": folder}
    return pp.Report.model_validate(values)


def test_a_report_is_drawn_with_its_rates_and_a_photograph(tmp_path):
    report = judged_report(tmp_path)
    picture, bars = report.plot().axes
    assert len(picture.images) == 1 and [bar.get_width() for bar in bars.patches] == pytest.approx([200 / 3, 200 / 9])
    shown = report._repr_html_()
    assert shown.count("<svg") == 2 and "66.7%" in shown and "data:image" in shown and "4 to 9 of 9" in shown
    assert "folder" not in report.model_dump()


def test_a_draft_in_python_is_that_of_the_command_line(tmp_path, monkeypatch):
    """In steps and views, and as thoroughly as it shares the cores: one thread in each process."""
    monkeypatch.setattr("patchproof.optimizer.run.DRAFT_EFFORT", (2, 8))
    monkeypatch.setattr("patchproof.base.workers.available_cores", lambda: 2)
    monkeypatch.setattr("patchproof.optimizer.loop.SELECT_VIEWS", 4)
    seen, whole = [], run_module.set_problem

    def problem_of(*arguments):
        seen.append((torch.get_num_threads(), arguments[-1]))
        return whole(*arguments)

    monkeypatch.setattr(run_module, "set_problem", problem_of)
    with use_threads(2):
        run = pp.optimize(scene(), tmp_path / "run", models=[network()], draft=True)
        assert torch.get_num_threads() == 2
    assert (run.scene.settings.optimize.steps, run.promise.n, run.promise.draft) == (2, 8, True)
    assert seen == [(1, 2)] and pickle.loads(pickle.dumps(pp.optimize)) is pp.optimize


def test_the_users_script_that_types_are_checked_with_uses_every_public_name():
    script = Path(__file__).with_name("user_script.py").read_text(encoding="utf-8")
    assert not {name for name in pp.__all__ if f"pp.{name}" not in script}
