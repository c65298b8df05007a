"""The loop on a network whose best design is known: what it learns, keeps, repeats and resumes."""

from __future__ import annotations

import json
import math
import os
import shutil
import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from matplotlib.figure import Figure
from PIL import Image

from patchproof.base.errors import Refused
from patchproof.base.folder_lock import lock_folder
from patchproof.base.goal import Goal
from patchproof.base.intervals import wilson
from patchproof.base.progress import Compute
from patchproof.base.settings import SceneSettings
from patchproof.base.validation import validate_model
from patchproof.base.workers import Workers, can_fork, use_threads
from patchproof.classifier.network import Classifier
from patchproof.optimizer import expectation, loop, place_files, run
from patchproof.optimizer.evaluate import evaluate, promise_run
from patchproof.optimizer.loop import start, steps, take_step
from patchproof.optimizer.problem import set_problem
from patchproof.optimizer.promise import CONTROLS, PromiseOptions, make_promise
from patchproof.optimizer.responses import responses
from patchproof.optimizer.run import load_run
from patchproof.optimizer.run import optimize as optimize_scene
from patchproof.optimizer.subject import as_pixels, from_pixels, side_by_side, target_loss, total_variation
from patchproof.render.photograph import photograph
from patchproof.scene.conditions import fields_of, with_values
from patchproof.scene.scene import build_scene

SCENE = {
    "object": {"mesh": "primitive:carton", "length_mm": 300, "up": "y"},
    "patch": {"side": "+z", "width_mm": 115, "height_mm": 115},
    "target": {"label": "red", "models": ["module:fake_networks.red_against_blue"]},
    "view": {"azimuth_deg": [-30, 30], "elevation_deg": [0, 20], "distance_mm": [400, 500], "look_at_jitter": 0},
    "background": {"color": [0.5, 0.5, 0.5]},
    "camera": {"photo_px": [1600, 1200]},
    "optimize": {"steps": 12, "views": 4, "gamut": 0.0},
}
BESIDE_BARE = PromiseOptions(controls=("bare",))  # where controls are not the point


def scene_with(tmp_path, **changes):
    data = {key: dict(value) for key, value in SCENE.items()}
    for key, value in changes.items():
        table, name = key.split("__")
        data.setdefault(table, {})[name] = value
    return build_scene(validate_model(SceneSettings, data, "test"), tmp_path)


def toml(path, **changes):
    """A scene file of few steps and small photographs: for tests of files, not of figures."""
    lines = []
    data = {key: dict(value) for key, value in SCENE.items()}
    data["camera"] = {"photo_px": [64, 64]}
    data["optimize"] |= {"steps": 4, "views": 2}
    for key, value in changes.items():
        table, name = key.split("__")
        data.setdefault(table, {})[name] = value
    for table, values in data.items():
        lines += [f"[{table}]", *(f"{name} = {json.dumps(value)}" for name, value in values.items())]
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def odds(logits, indices):
    return Classifier("plain", None, 8, ("a", "b"), lambda x: x).odds(logits, indices)


def last(problem):
    return list(steps(problem))[-1]


def test_cross_entropy_of_the_accepted_labels_by_hand():
    """Logits 0, ln 2, ln 5: probabilities 1/8, 2/8, 5/8."""
    logits = torch.tensor([[0.0, math.log(2), math.log(5)]])
    assert float(target_loss(odds(logits, [0, 1]), Goal.assist)) == pytest.approx(-math.log(3 / 8))
    assert float(target_loss(odds(logits, [0, 1]), Goal.deceive)) == pytest.approx(-math.log(5 / 8))
    certain = torch.tensor([[60.0, 0.0]], requires_grad=True)
    (gradient,) = torch.autograd.grad(target_loss(odds(certain, [1]), Goal.assist).sum(), certain)
    assert float(gradient[0, 0]) == pytest.approx(1)  # a sure network still says which way


@pytest.mark.parametrize(("goal", "wrong"), [(Goal.assist, [[0.0, 1.0]]), (Goal.deceive, [[1.0, 0.0]])])
@pytest.mark.parametrize("margin", [80.0, 800.0, 3e4])
def test_what_is_wrong_with_certainty_keeps_its_gradient(goal, wrong, margin):
    """The goal is far from reached: p of label 0 is e^-margin or 1 - e^-margin. float32's log(1 - p) is lost at 17."""
    logits = (margin * torch.tensor(wrong)).requires_grad_()
    (gradient,) = torch.autograd.grad(target_loss(odds(logits, [0]), goal).sum(), logits)
    assert gradient[0].tolist() == pytest.approx([-1, 1] if goal is Goal.assist else [1, -1])
    assert not bool(torch.isfinite(torch.log(1 - torch.softmax(torch.tensor([17.0, 0.0]), 0)[0])))


def test_total_variation_by_hand():
    checks = torch.tensor([[0.0, 1.0], [1.0, 0.0]]).expand(3, 2, 2)
    assert float(total_variation(checks)) == 2 and float(total_variation(torch.ones(3, 4, 4))) == 0


def test_the_gradient_through_printer_scene_and_camera_is_a_difference_of_losses(tmp_path):
    """Along a random direction: the whole chain against central differences."""
    problem = set_problem(scene_with(tmp_path))
    conditions = problem.scene.draw("train", 4)

    def loss(design):
        pictures = photograph(problem.stage, problem.subject.appearance(design), conditions, (32, 32))
        network = problem.classifiers[0]
        return problem.losses(network, network.logits(pictures), (0,)).mean()

    torch.manual_seed(0)
    design = (0.4 + 0.2 * torch.rand(start(problem).design.shape)).requires_grad_()
    (gradient,) = torch.autograd.grad(loss(design), design)
    direction = torch.rand_like(design) - 0.5 + torch.tensor([0.5, 0, -0.5])[:, None, None]
    with torch.no_grad():
        difference = (loss(design + 0.01 * direction) - loss(design - 0.01 * direction)) / 0.02
    assert float((gradient * direction).sum()) == pytest.approx(float(difference), rel=0.02)


@pytest.mark.parametrize("optimizer", ["adam", "sign"])
def test_assist_turns_the_patch_red_and_deceive_blue(tmp_path, optimizer, monkeypatch):
    monkeypatch.setattr(loop, "SELECT_VIEWS", 8)  # by which nothing is selected: it is tried once, at the end
    for goal, channel in (("assist", 0), ("deceive", 2)):
        optimize = {
            "optimize__optimizer": optimizer,
            "optimize__step_size": 0.05,
            "optimize__views": 2,
        }  # far, in twelve steps
        state = last(set_problem(scene_with(tmp_path, target__goal=goal, **optimize))).state
        color = state.best.mean((1, 2))
        assert int(color.argmax()) == channel and float(color[channel] - color[2 - channel]) > 0.5


def test_a_signed_step_moves_each_pixel_by_the_step_size(tmp_path):
    problem = set_problem(scene_with(tmp_path, optimize__optimizer="sign", optimize__step_size=0.03))
    step = next(steps(problem))
    moved = (step.state.design - 0.5).abs()
    assert float(moved.max()) == pytest.approx(0.03, abs=1e-6)
    assert step.gradient > 0


@pytest.mark.parametrize("explosion", [1.0, 1e6, 1e15])
def test_however_a_gradient_explodes_adam_moves_by_a_few_step_sizes(tmp_path, explosion):
    """(1 - β1) / √(1 - β2) = 3.2 step sizes at most, in the one step that explodes after a hundred calm ones."""
    problem = set_problem(scene_with(tmp_path, optimize__step_size=0.01))
    state = start(problem)
    for _ in range(100):
        state = loop._update(
            problem, state, torch.randn(state.design.shape, generator=torch.Generator().manual_seed(0))
        )
    state = replace(state, design=torch.full_like(state.design, 0.5))
    moved = (loop._update(problem, state, torch.full_like(state.design, explosion)).design - 0.5).abs().max()
    assert bool(torch.isfinite(moved)) and float(moved) < 0.0317


class Fragile(torch.nn.Module):
    """What a network does to logits (by `spoil`) beyond the pictures that it was checked on."""

    def __init__(self, spoil):
        super().__init__()
        self.spoil = spoil

    def forward(self, photos):
        score = photos.mean((1, 2, 3)) * 4
        return self.spoil(torch.stack([score, -score], 1))


def spoiled(problem, spoil):
    return replace(problem, classifiers=(replace(problem.classifiers[0], network=Fragile(spoil)),))


def test_networks_that_answer_nan_or_infinity_are_refused_and_large_answers_are_not(tmp_path):
    """Unseen, one such step would have ended every later one, and a NaN counts as the largest logit."""
    problem = set_problem(scene_with(tmp_path, camera__photo_px=[96, 96]))
    begin, drawn = start(problem), problem.scene.draw("promise", 2)
    assert math.isfinite(take_step(spoiled(problem, lambda logits: 1e30 * logits), begin, drawn).loss)
    for spoil in (lambda logits: logits * torch.nan, lambda logits: logits * 1e30 * 1e30):
        with pytest.raises(Refused, match="finite logits, got NaN or infinity from the network"):
            take_step(spoiled(problem, spoil), begin, drawn)
        with pytest.raises(Refused, match="finite logits"):
            responses(spoiled(problem, spoil), {"design": problem.subject.appearance(begin.design)}, drawn)
    with pytest.raises(Refused, match="finite gradients, got nan in step 1"):
        take_step(spoiled(problem, lambda logits: logits + (logits - logits.detach()).sqrt()), begin, drawn)


def test_the_penalty_moves_the_design_and_is_not_taken_for_a_gradient_of_the_networks(tmp_path):
    problem = set_problem(scene_with(tmp_path, optimize__tv=1.0, target__models=["module:fake_networks.corner"]))
    noisy = replace(start(problem), design=torch.rand_like(start(problem).design))
    step = take_step(problem, noisy, problem.scene.draw("promise", 2))
    assert step.gradient == 0 and not torch.equal(step.state.design, noisy.design)


def test_steps_whose_views_show_no_patch_change_nothing(tmp_path):
    """All cameras behind the object: a gradient of zero, not an error."""
    scene = scene_with(tmp_path, view__azimuth_deg=[-90, 90], optimize__steps=2)
    problem = set_problem(scene)
    behind = scene.draw("train", 4)
    behind = with_values(behind, azimuth_deg=180.0)
    shown = problem.subject.appearance(start(problem).design.requires_grad_())
    seen = problem.see(shown, behind, problem.training_px)
    assert len(seen.piece.pixel) == 0
    step = take_step(problem, start(problem), behind)
    assert step.gradient == 0 and torch.equal(step.state.design, start(problem).design)


def test_the_design_kept_is_the_best_on_the_selection_set(tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "SELECT_AFTER", 8)
    monkeypatch.setattr(loop, "SELECT_VIEWS", 8)
    problem = set_problem(scene_with(tmp_path, optimize__steps=12, optimize__views=2))
    tried = [step for step in steps(problem) if step.select_loss is not None]
    assert [step.state.number for step in tried] == [4, 8, 12]
    assert tried[-1].state.best_loss == min(step.select_loss for step in tried)


def test_variation_and_gamut_terms_do_what_they_say(tmp_path, few_views):
    """From noise in strong colors: the one smooths it, the other draws it towards what can be printed."""

    def after(**weights):
        few = {"optimize__steps": 16, "optimize__views": 1}
        problem = set_problem(scene_with(tmp_path, optimize__step_size=0.05, **few, **weights))
        noise = torch.rand(start(problem).design.shape, generator=torch.Generator().manual_seed(0)).round()
        return problem, list(steps(problem, replace(start(problem), design=noise)))[-1].state.design

    problem, plain = after()
    assert float(total_variation(after(optimize__tv=20.0)[1])) < 0.8 * float(total_variation(plain))

    def excess(design):
        return float(problem.subject.printer.gamut_distance(design[None]).mean())

    assert excess(after(optimize__gamut=50.0)[1]) < 0.8 * excess(plain)


def test_a_design_survives_its_own_pixels():
    pixels = np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)
    np.testing.assert_array_equal(as_pixels(from_pixels(pixels)), pixels)


def test_the_promise_counts_what_was_recognized(tmp_path):
    problem = set_problem(scene_with(tmp_path, target__label="blue", printer__profile="coated"))
    blue = np.zeros((*problem.subject.printed_px[::-1], 3), np.uint8)
    blue[..., 2] = 255
    promise = make_promise(problem, blue, problem.scene.draw("promise", 24))
    assert promise.n == 24 and len(promise.conditions) == 24
    assert promise.rate == sum(c.recognized for c in promise.conditions) / 24
    np.testing.assert_allclose(promise.interval, wilson(round(promise.rate * 24), 24), atol=0.04)
    assert promise.posterior.rate_interval == promise.interval
    assert set(promise.controls) == set(CONTROLS)
    for claim in promise.controls.values():
        assert claim.difference == pytest.approx(promise.rate - claim.rate)
    assert promise.rate > 0.9 and all(promise.controls[kind].rate < 0.5 for kind in ("bare", "gray"))
    views = problem.scene.settings.view
    assert all(views.azimuth_deg[0] - 12 < c.azimuth_deg < views.azimuth_deg[1] + 12 for c in promise.conditions)


@pytest.mark.parametrize(
    ("input_px", "training_px", "figure_px"),
    [(8, 128, 128), (96, 135, 135), (192, 192, 269), (224, 224, 314), (800, 800, 1120), (1300, 1200, 1200)],
)
def test_sizes_of_views_follow_the_network_s_up_to_the_photograph_s(tmp_path, input_px, training_px, figure_px):
    problem = replace(set_problem(scene_with(tmp_path)), classifiers=(SimpleNamespace(input_px=input_px),))
    assert (problem.training_px, problem.figure_px) == (training_px, figure_px)


@pytest.fixture
def few_views(monkeypatch):
    """Fewer views to select by and to promise from, where rates do not matter."""
    monkeypatch.setattr(run, "PROMISE_VIEWS", 12)
    monkeypatch.setattr(loop, "SELECT_VIEWS", 4)
    monkeypatch.setattr(loop, "SELECT_AFTER", 8)
    monkeypatch.setattr(loop, "SAVE_AFTER", 4)


def same_files(a, b, names=("design.png", "steps.jsonl", "checkpoint.safetensors", "views.png")):
    return all((a / name).read_bytes() == (b / name).read_bytes() for name in names)


def test_the_same_seed_gives_the_same_bytes_and_another_does_not(tmp_path, few_views):
    scene = toml(tmp_path / "scene.toml", optimize__steps=2)
    for out, seed in (("a", 0), ("b", 0), ("c", 1)):
        optimize_scene(scene, tmp_path / out, seed=seed, promise=PromiseOptions() if seed == 0 else BESIDE_BARE)
    assert same_files(tmp_path / "a", tmp_path / "b")
    assert (tmp_path / "a" / "run.json").read_bytes() == (tmp_path / "b" / "run.json").read_bytes()
    assert not same_files(tmp_path / "a", tmp_path / "c", ("design.png",))


def test_views_stand_over_what_the_network_says_of_them():
    views = torch.rand(5, 3, 20, 60)
    plain, labeled = (side_by_side(views, [text] * 5).astype(int) for text in ("", "Ü 92 %"))
    assert plain.shape == labeled.shape == (2 * (20 + 13), 4 * 60, 3)
    changed = (plain != labeled).any(2).reshape(2, 33, 4, 60)
    assert not changed[:, :20].any() and changed[:, 20:].any((1, 3)).tolist() == [[True] * 4, [True, *[False] * 3]]


@pytest.mark.parametrize(
    ("models", "step_size", "says"),
    [
        ("red_against_blue", 0.005, None),
        ("red_against_blue", 0.00125, "its start: give it more optimize.steps or a larger optimize.step_size"),
        ("corner", 0.1, "its start: no network's answer depends on it"),
    ],
)
def test_a_design_that_never_moved_is_said_to_be_none(tmp_path, few_views, models, step_size, says):
    """Four signed steps of 0.005 are 5 of 255 codes, of 0.00125 one. The promise tells it, too: as good as gray."""
    models = [f"module:fake_networks.{models}"]
    changes = dict(target__models=models, optimize__step_size=step_size, optimize__optimizer="sign")
    scene = toml(tmp_path / "scene.toml", **changes)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        promise = optimize_scene(scene, tmp_path / "run", promise=PromiseOptions(controls=("gray",))).promise
    told = [str(one.message) for one in caught if "its start" in str(one.message)]
    assert told == [] if says is None else says in told[0]
    low, high = promise.controls["gray"].difference_interval
    assert says is None or low <= 0 <= high


def test_a_step_across_the_whole_range_is_the_largest(tmp_path):
    assert scene_with(tmp_path, optimize__step_size=1.0).settings.optimize.step_size == 1
    with pytest.raises(Refused, match=r'usable "optimize\.step_size"'):
        scene_with(tmp_path, optimize__step_size=1.01)


def dispersion(counts, n):
    """Variance of counts over a binomial's."""
    rate = np.sum(counts) / (n * len(counts))
    return np.var(counts, ddof=1) / (n * rate * (1 - rate))


def test_promises_of_other_seeds_spread_as_their_interval_says(tmp_path):
    """A hundred promises of what is recognized from one side in warm light. Last good: its own draws, dispersion 1 and
    95 of 100 intervals hold. First bad: each draw eight times, as near-duplicates would be, and half of them fail.
    """
    scene, n = scene_with(tmp_path), 64
    drawn = [scene.draw("promise", n, seed) for seed in range(100)]
    seen = np.array(
        [(c.pose.azimuth_deg < 10) | (c.sensor.white_balance[:, 0] > c.sensor.white_balance[:, 2]) for c in drawn]
    )
    for recognized, holds in ((seen, True), (seen[:, :8].repeat(8, 1), False)):
        counts, rate = recognized.sum(1), recognized.mean()
        inside = sum(low <= rate <= high for low, high in (wilson(int(count), n) for count in counts))
        assert rate == pytest.approx(5 / 6, abs=0.04)
        assert (0.6 < dispersion(counts, n) < 1.5) == holds and (inside >= 90) == holds, inside


class Killed(Exception):
    pass


def test_a_run_killed_and_resumed_gives_the_bytes_of_one_that_was_not(tmp_path, few_views):
    """Saved after 2 and 4 steps, tried on the selection set after 4 alone."""
    scene = toml(tmp_path / "scene.toml", optimize__steps=6)
    optimize_scene(scene, tmp_path / "whole", promise=BESIDE_BARE)
    for last, after in ((5, 4), (3, 2)):
        out, made = tmp_path / str(last), list[tuple]()

        def kill(stage, done, total, last=last):
            if (stage, done) == ("optimize", last):
                raise Killed

        with pytest.raises(Killed):
            optimize_scene(scene, out, promise=BESIDE_BARE, progress=kill)
        with pytest.raises(Refused, match="an unfinished one"):
            load_run(out)
        options = {"promise": BESIDE_BARE, "resume": True}
        resumed = optimize_scene(scene, out, **options, progress=lambda *report, m=made: m.append(report))
        assert [done for stage, done, _ in made if stage == "optimize"] == [*range(after + 1, 7)]
        assert same_files(tmp_path / "whole", out)
        assert len((out / "steps.jsonl").read_text().splitlines()) == 6
        np.testing.assert_array_equal(load_run(out).design, resumed.design)


@pytest.mark.skipif(not can_fork(), reason="processes are forked on Linux without a GPU")
def test_the_number_of_processes_changes_no_byte(tmp_path, few_views, a_small_search, monkeypatch):
    """Steps of 5 views, the selection, promise and controls, and the search for a place among three; nor does it what
    of the five poses a process keeps.
    """
    monkeypatch.setattr(expectation, "MIN_POSES", 5)
    monkeypatch.setattr(place_files, "_draw", lambda *_: Figure())  # the picture of the places is not compared
    scene = toml(tmp_path / "scene.toml", optimize__steps=2, optimize__views=5, patch__place="auto")
    files = ("design.png", "steps.jsonl", "views.png", "place.json", "run.json")
    with use_threads(1):
        for jobs, kept_px in ((2, expectation.CACHE_PX), (1, 0)):
            monkeypatch.setattr(expectation, "CACHE_PX", kept_px)
            optimize_scene(scene, tmp_path / str(jobs), compute=Compute(jobs=jobs), promise=BESIDE_BARE)
    assert same_files(tmp_path / "1", tmp_path / "2", files)


@pytest.mark.skipif(not can_fork(), reason="processes are forked on Linux without a GPU")
def test_more_processes_than_cores_change_no_byte_and_see_no_view_twice(tmp_path, monkeypatch):
    """Each view of a step can have a process of its own; a pose that comes round comes to the one that has seen it."""
    seen, see = tmp_path / "seen", expectation.training_views

    def noting(problem, drawn):
        with open(seen / str(os.getpid()), "a") as file:
            file.write("v" * len(drawn))
        return see(problem, drawn)

    monkeypatch.setattr(expectation, "training_views", noting)
    monkeypatch.setattr(expectation, "MIN_POSES", 4)
    monkeypatch.setattr(loop, "SELECT_VIEWS", 12)
    settings = {"optimize__steps": 2, "optimize__views_per_batch": 1, "camera__photo_px": [64, 64]}
    problem = set_problem(scene_with(tmp_path, **settings))
    ends = []
    with use_threads(1):
        for jobs in (1, 2, 4, 8):
            shutil.rmtree(seen, ignore_errors=True)
            seen.mkdir()
            (*_, last) = loop.steps(replace(problem, jobs=jobs))
            ends.append((last.state.design.numpy().tobytes(), last.loss, last.select_loss))
            views = [file.stat().st_size for file in seen.iterdir()]
            assert sum(views) == 4 + 12, "4 poses and 12 views of the selection set, each once"
            assert len(views) == min(jobs, 4), "a view of each step for every process"
    assert len(set(ends)) == 1


def test_poses_come_round_with_other_backgrounds_light_print_and_camera(tmp_path, monkeypatch):
    monkeypatch.setattr(expectation, "MIN_POSES", 6)
    scene = scene_with(tmp_path, optimize__steps=10)
    drawn, trained = scene.draw("train", 40), expectation.training_conditions(scene)
    assert expectation.new_pose_share(scene) == 8 / 40
    for name, rounds in (("azimuth_deg", True), ("distance_mm", True), ("background", False)):
        values, own = getattr(trained.pose, name), getattr(drawn.pose, name)
        assert np.array_equal(values[:8], own[:8]) and np.array_equal(values[36:], own[4:8] if rounds else own[36:])
    trained, drawn = fields_of(trained), fields_of(drawn)
    alike = {name for name, values in drawn.items() if np.array_equal(trained[name], values)}
    assert alike >= {"ambient", "light_azimuth_deg", "dot_gain", "exposure_ev", "noise_seed", "background"}
    assert expectation.new_pose_share(SimpleNamespace(HAS_OBJECT=False, settings=scene.settings)) == 1, (
        "pictures are all of a view"
    )
    monkeypatch.setattr(expectation, "MIN_POSES", 240)
    assert expectation.new_pose_share(scene) == 1
    assert np.array_equal(expectation.training_conditions(scene).pose.azimuth_deg, drawn["azimuth_deg"])


def test_only_views_that_fit_are_kept(tmp_path, monkeypatch):
    problem = set_problem(scene_with(tmp_path))
    monkeypatch.setattr(expectation, "MIN_POSES", 24)
    monkeypatch.setattr(expectation, "CACHE_PX", 5 * 2 * problem.training_px**2)
    monkeypatch.setattr(expectation, "AHEAD_PX", 9 * problem.training_px**2)
    drawn, seen = problem.scene.draw("train", 24), []
    monkeypatch.setattr(
        expectation,
        "training_views",
        lambda problem, drawn: seen.append(len(drawn)) or problem.see(None, drawn, 16),
    )
    cache = expectation.ViewCache(problem, drawn)
    for first in (0, 4, 8, 12, 16, 20, 0, 4, 8, 12, 16, 20):
        cache.views(first, drawn[first : first + 2])
    assert seen == [8, 4, 2], "the last pair is seen twice"
    assert not cache._ahead, "what is not kept is seen once"


def test_an_odd_view_counts_as_much_as_those_that_are_seen_together(tmp_path):
    problem = set_problem(scene_with(tmp_path))
    begin, drawn = start(problem), problem.scene.draw("train", 3)
    alone = [take_step(problem, begin, drawn[i : i + 1]).loss for i in range(3)]
    assert len(set(alone)) == 3 and take_step(problem, begin, drawn).loss == pytest.approx(np.mean(alone), rel=1e-5)


def test_controls_beside_some_views_are_those_of_these_views_and_the_design_keeps_its_order(tmp_path):
    problem = set_problem(scene_with(tmp_path))
    drawn, beside = problem.scene.draw("promise", 7), np.array([0, 1, 0, 0, 1, 1, 0], bool)
    shown = {"design": problem.subject.appearance(start(problem).design), "bare": None}
    whole, part = responses(problem, shown, drawn), responses(problem, shown, drawn, control_mask=beside)
    np.testing.assert_allclose(part["design"].loss, whole["design"].loss, rtol=1e-4)
    np.testing.assert_allclose(part["bare"].loss, whole["bare"].loss[:, beside], rtol=1e-4)
    assert len(np.unique(whole["design"].loss)) == 7


def test_a_session_is_seen_by_one_process(tmp_path, monkeypatch):
    """Whoever sees a session draws the place behind it."""
    tasks, counts, work = [], [], Workers.map

    def kept(workers, function, items, on_done):
        tasks.extend(items)
        return work(workers, function, items, on_done)

    monkeypatch.setattr(Workers, "map", kept)
    problem = set_problem(scene_with(tmp_path, camera__photo_px=[96, 96]))
    drawn, beside = problem.scene.draw("promise", 32, per_session=4), np.arange(32) % 4 < 2
    shown = {"design": problem.subject.appearance(start(problem).design), "bare": None}
    responses(problem, shown, drawn, control_mask=beside, advance=lambda *count: counts.append(count))
    rows = [np.concatenate([part for part, _ in task]) for task in tasks]
    assert sorted(np.concatenate(rows)) == list(range(32)) and [len(each) for each in rows] == [8, 8, 8, 8]
    assert all(len({*each // 4}) == 2 for each in rows), "two sessions each"
    assert counts == [(8, 32), (16, 32), (24, 32), (32, 32)]


def test_texels_are_to_the_byte_those_of_one_thread_before_processes_share_views(tmp_path):
    box = trimesh.creation.box((300, 200, 100))
    picture = Image.fromarray(np.random.default_rng(0).integers(0, 256, (150, 150, 3), dtype=np.uint8))
    uv = np.random.default_rng(1).random((len(box.vertices), 2))
    box.visual = trimesh.visual.TextureVisuals(uv, image=picture)
    box.export(tmp_path / "box.glb")
    scene = scene_with(tmp_path, object__mesh=str(tmp_path / "box.glb"), object__length_mm=300)
    with use_threads(2):
        shared = set_problem(scene, jobs=2).stage.object_surface.texels(reduced=True, fixed=True)
        on_two = set_problem(scene).stage.object_surface.texels(reduced=True, fixed=True)
    with use_threads(1):
        alone = set_problem(scene).stage.object_surface.texels(reduced=True, fixed=True)
    assert torch.equal(shared, alone) and len(alone) > 150**2
    assert (on_two - alone).abs().max() < 1e-6, "two threads round otherwise, by no more"


def test_a_draft_gets_the_promise_that_it_would_have_had(tmp_path, few_views, monkeypatch):
    scene = toml(tmp_path / "scene.toml")
    optimize_scene(scene, tmp_path / "whole")
    draft = optimize_scene(scene, tmp_path / "draft", promise=PromiseOptions(views=8))
    assert draft.promise.draft and not same_files(tmp_path / "whole", tmp_path / "draft", ("run.json",))
    promised = promise_run(tmp_path / "draft", trust=True)
    assert same_files(tmp_path / "whole", tmp_path / "draft", ("run.json",)) and not promised.promise.draft
    assert load_run(tmp_path / "draft").promise == promised.promise
    resumed = optimize_scene(scene, tmp_path / "draft", promise=PromiseOptions(views=8), resume=True)
    assert resumed.promise == promised.promise, "a fuller one is kept"
    assert same_files(tmp_path / "whole", tmp_path / "draft", ("run.json",))
    with pytest.raises(Refused, match="a promise of 8 views"):
        promise_run(tmp_path / "draft", views=4, trust=True)
    for use in (promise_run, evaluate):
        with pytest.raises(Refused, match="a finished run, got none"):
            use(tmp_path / "missing" / "nothing")
    assert not (tmp_path / "missing").exists()
    more = promise_run(tmp_path / "draft", views=promised.promise.n + 4, trust=True).promise
    stored = (tmp_path / "draft" / "run.json").read_bytes()
    with pytest.raises(Refused, match=rf"{more.n} views or more, as the promise has now, got 8: ask for {more.n}"):
        promise_run(tmp_path / "draft", views=8, trust=True)
    with lock_folder(tmp_path / "draft"), pytest.raises(Refused, match="no other command writes into"):
        evaluate(tmp_path / "draft", trust=True)
    monkeypatch.setattr("os.access", lambda *_: False)
    monkeypatch.setattr("patchproof.optimizer.evaluate.load_run", lambda *_: pytest.fail("before that"))
    for use in (promise_run, evaluate):
        with pytest.raises(Refused, match=r"written to, got .*draft: allow that, or use a copy of the run\.$"):
            use(tmp_path / "draft", trust=True)
    assert (tmp_path / "draft" / "run.json").read_bytes() == stored


def test_runs_are_not_overwritten_unasked_nor_resumed_with_another_seed(tmp_path, few_views):
    scene, options = (
        toml(tmp_path / "scene.toml", optimize__steps=2),
        {"promise": PromiseOptions(views=8, controls=("bare",))},
    )
    optimize_scene(scene, tmp_path / "run", **options)
    before = {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()}
    with pytest.raises(Refused, match="--overwrite"):
        optimize_scene(scene, tmp_path / "run")
    with pytest.raises(Refused, match=r"checkpoint of the same run, got .* --steps and --draft that it was begun with"):
        optimize_scene(scene, tmp_path / "run", seed=5, resume=True)
    broken = toml(tmp_path / "broken.toml", target__label="no such label")
    with pytest.raises(Refused, match="no such label"):
        optimize_scene(broken, tmp_path / "run", overwrite=True)
    assert before == {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()}
    optimize_scene(scene, tmp_path / "run", overwrite=True, **options)
    (tmp_path / "run" / "thesis.txt").write_text("mine")
    with pytest.raises(Refused, match=r"thesis\.txt"):
        optimize_scene(scene, tmp_path / "run", overwrite=True)


def test_every_goal_has_a_loss_that_falls_the_way_it_wants():
    logits = torch.tensor([[2.0, 0.0], [0.0, 2.0]])
    for goal in Goal:
        likely, unlikely = target_loss(odds(logits, [0]), goal).tolist()
        assert goal.sign * (unlikely - likely) > 0
