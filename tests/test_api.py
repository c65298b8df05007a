"""The public names from Python: a scene, a network and a loss that no file names, from optimizing to the verdict."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

import patchproof as pp
from patchproof.optimizer.promise import PROMISE_VIEWS

SETTINGS = {
    "object": {"mesh": "python:box", "length_mm": 300},
    "patch": {"width_mm": 110, "height_mm": 110},
    "target": {"label": "box", "models": ["python:net"]},
    "view": {"azimuth_deg": [-30, 30], "distance_mm": [450, 700]},
    "background": {"color": [0.4, 0.5, 0.4]},
    "camera": {"photo_px": [96, 72]},
    "optimize": {"steps": 3, "views": 2},
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
    with pytest.raises(pp.Refused, match="one in memory"):
        pp.evaluate(run.folder, models=[network()], n=8, compute=pp.Compute(jobs=2))
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
