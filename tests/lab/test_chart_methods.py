"""Methods that ours is charted beside: what they are given, and what they spend."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch

from patchlab.charts import methods
from patchproof.base.errors import Refused
from patchproof.optimizer import loop
from patchproof.optimizer.problem import set_problem
from patchproof.render.photograph import expose
from patchproof.scene.conditions import with_values
from patchproof.scene.scene import load_scene
from patchproof.sheets.piece import marker_image

RED = "module:fake_networks.red_against_blue"


@pytest.fixture(autouse=True)
def short_loop(monkeypatch):
    monkeypatch.setattr(loop, "SELECT_VIEWS", 8)


@pytest.fixture
def without_art(monkeypatch):
    monkeypatch.setitem(sys.modules, "art", None)
    monkeypatch.setitem(sys.modules, "art.attacks.evasion", None)


def red_scene(scene_file: Path, goal="assist", steps=4, size="width_mm = 90\nheight_mm = 90") -> Path:
    """A scene before a network that calls red what is red in the middle; so near that the patch is there."""
    text = scene_file.read_text().replace('label = "carton"', f'label = "red"\ngoal = "{goal}"')
    text = text.replace('"builtin"', f'"{RED}"').replace("[500, 900]", "[300, 330]").replace("[-40, 40]", "[-5, 5]")
    text = text.replace("width_mm = 90\nheight_mm = 90", size).replace("steps = 3", f"steps = {steps}")
    scene_file.write_text(text, encoding="utf-8")
    return scene_file


def redness(pixels: np.ndarray) -> float:
    """Mean red less mean blue of uint8 pixels."""
    red, _, blue = pixels.reshape(-1, 3).mean(0)
    return red - blue


# The pasted design


def test_a_pasted_design_covers_its_share_and_nothing_else(monkeypatch):
    photos = torch.full((6, 3, 200, 200), 0.25)
    # the longer side half of the photograph's, the other half of that, at any angle
    made = methods.paste_designs(photos, torch.ones(3, 10, 20), (0.5, 0.5), np.random.default_rng(0))
    covered = (made - 0.25) / 0.75
    assert covered.sum((2, 3)) / 200**2 == pytest.approx(0.5 * 0.25, rel=0.01)
    assert covered.min() >= 0 and covered.max() == pytest.approx(1, abs=1e-6)
    assert len({tuple(one[0].nonzero()[0].tolist()) for one in covered}) == 6  # each at its own place
    monkeypatch.setattr(methods, "MAX_ROLL_DEG", 0.0)
    made = methods.paste_designs(photos[:1], torch.ones(3, 10, 20), (0.5, 0.5), np.random.default_rng(0))
    rows, columns = (made[0, 0] > 0.625).numpy().nonzero()  # half white on a quarter
    assert (np.ptp(columns), np.ptp(rows)) == (pytest.approx(99, abs=1), pytest.approx(49, abs=1))


def test_a_pasted_design_is_upright_and_keeps_its_colors(monkeypatch):
    monkeypatch.setattr(methods, "MAX_ROLL_DEG", 0.0)
    design = torch.zeros(3, 2, 2)
    design[0, 0, 0], design[1, 0, 1], design[2, 1, 0] = 1, 1, 1  # red, green above blue, black
    made = methods.paste_designs(torch.ones(1, 3, 64, 64), design, (1.0, 1.0), np.random.default_rng(0))[0]
    corners = [made[:, y, x].tolist() for y in (15, 47) for x in (15, 47)]
    assert np.allclose(
        corners, [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0]], atol=0.05
    )  # beside the middles of its pixels


def test_a_pasted_design_has_a_gradient_where_it_is_seen():
    design = torch.full((3, 8, 8), 0.5, requires_grad=True)
    methods.paste_designs(torch.zeros(2, 3, 64, 64), design, (0.5, 0.6), np.random.default_rng(1)).sum().backward()
    assert design.grad is not None and (design.grad > 0).all()


# Methods


@pytest.mark.parametrize(("goal", "way"), [("assist", 1), ("deceive", -1)])
def test_every_method_of_ours_goes_where_the_goal_is_for_no_more_than_the_budget(scene_file, goal, way):
    problem = set_problem(load_scene(red_scene(scene_file, goal)))
    passes = 4 * 4 + 8
    assert methods.pass_budget(problem) == passes
    for name in ("ours", "sign", "flat"):
        made = methods.METHODS[name](problem)
        assert made.passes == passes and way * redness(made.pixels) > 10, name
        assert made.pixels.dtype == np.uint8 and made.pixels.shape[:2][::-1] == problem.patch.printed_px


def test_signed_steps_are_the_paper_s(scene_file):
    problem = set_problem(load_scene(red_scene(scene_file, steps=2)))
    made = methods.optimize_by_sign(problem)
    _, reserved = marker_image(problem.patch.scene.piece, problem.patch.printed_px)
    steps = (made.pixels[~reserved] / 255 - 0.5) / methods.SIGN_STEP
    assert np.abs(steps).max() == pytest.approx(2, abs=0.4)  # of two; codes are 0.4 of a step apart


def test_photographs_of_the_bare_object_use_up_the_budget_in_whole_rounds(scene_file, monkeypatch):
    problem = set_problem(load_scene(red_scene(scene_file, steps=8)))
    for most, count in ((256, 40), (39, 20), (7, 6)):  # 8 × 4 + 8 passes; 6 rounds of 6 leave 4 of them
        monkeypatch.setattr(methods, "MAX_PHOTOS", most)
        photos = methods.bare_photos(problem)
        assert photos.shape == (count, 3, problem.training_px, problem.training_px)


# ART, whose part a stand-in plays where what it is given matters


@pytest.fixture
def given(monkeypatch):
    """What a stand-in of ART is given; its patch is red above, blue below."""
    record = SimpleNamespace()

    class Attack:
        def __init__(self, network, **options):
            record.network, record.options = network, options

        def generate(self, x, y):
            record.x, record.y, record.draw = x, y, np.random.random()
            patch = np.zeros(self._shape(), np.float64)
            patch[0, : patch.shape[1] // 2], patch[2, patch.shape[1] // 2 :] = 255, 255
            return patch, None

        def _shape(self):
            return record.options["patch_shape"]

    def wrapper(model, loss, shape, labels, **options):
        return SimpleNamespace(model=model, shape=shape, labels=labels, **options)

    evasion, classification = ModuleType("art.attacks.evasion"), ModuleType("art.estimators.classification")
    evasion.AdversarialPatchPyTorch, classification.PyTorchClassifier = Attack, wrapper
    monkeypatch.setitem(sys.modules, "art", ModuleType("art"))
    monkeypatch.setitem(sys.modules, "art.attacks.evasion", evasion)
    monkeypatch.setitem(sys.modules, "art.estimators.classification", classification)
    return record


def test_art_gets_the_same_photographs_the_target_and_the_design_s_size(scene_file, given):
    problem = set_problem(load_scene(red_scene(scene_file, steps=8)))
    np.random.seed(5)
    untouched = np.random.RandomState(5).random()
    made = methods.train_with_art(problem)
    assert np.random.random() == untouched and given.draw != untouched  # its own draws, and ours as before
    assert np.array_equal(given.x, 255 * methods.bare_photos(problem).numpy()) and given.x.max() > 2
    assert given.y.tolist() == [[1, 0]] * 40 and made.passes == 40 * given.options["max_iter"] == 40
    assert given.options["targeted"] is True and given.options["batch_size"] == 4
    low, high = methods.paste_size_range(problem)
    assert (given.options["scale_min"], given.options["scale_max"]) == (low, high) and 0 < low < high <= 1
    codes = torch.full((1, 3, 64, 64), 255.0)
    assert torch.equal(given.network.model(codes), problem.classifiers[0].logits(codes / 255))
    middle = made.pixels.shape[1] // 2  # of the first and last rows: the corners are the markers'
    assert (made.pixels[0, middle].tolist(), made.pixels[-1, middle].tolist()) == ([255, 0, 0], [0, 0, 255])


def test_art_s_square_patch_is_squeezed_into_a_design_of_another_shape(scene_file, given):
    size = "width_mm = 120\nheight_mm = 60"
    problem = set_problem(load_scene(red_scene(scene_file, "deceive", steps=1, size=size)))
    made, (width, height) = methods.train_with_art(problem), problem.patch.design_px
    assert given.options["patch_shape"] == (3, width, width) and width > height
    assert given.options["targeted"] is False
    assert made.pixels.shape[:2][::-1] == problem.patch.printed_px
    free = ~marker_image(problem.patch.scene.piece, problem.patch.printed_px)[1]
    first, last = (made.pixels[row][free[row]] for row in (0, -1))
    assert len(first) > 20 and (first == [255, 0, 0]).all() and (last == [0, 0, 255]).all()


@pytest.mark.filterwarnings("ignore")  # ART's own
def test_art_itself_goes_where_the_goal_is(scene_file):
    try:
        methods.load_art()
    except Refused as missing:
        pytest.skip(str(missing))
    problem = set_problem(load_scene(red_scene(scene_file, steps=8)))
    made = methods.train_with_art(problem)
    assert made.passes == 8 * 4 + 8 and redness(made.pixels) > 10  # views of steps and of the selection
    assert made.pixels.shape[:2][::-1] == problem.patch.printed_px
    assert np.array_equal(made.pixels, methods.train_with_art(problem).pixels)


def test_a_missing_art_is_refused_with_what_installs_it(scene_file, without_art):
    with pytest.raises(Refused, match=r'Toolbox, got none.*patchproof\[lab\]", or choose another method'):
        methods.train_with_art(set_problem(load_scene(red_scene(scene_file))))


def test_the_unadversarial_way_knows_neither_printer_nor_camera(scene_file, monkeypatch):
    """It is the loop by signed steps in a world whose pictures no camera changes; light is the mean of all."""
    seen = []
    monkeypatch.setattr(methods, "optimize_by_sign", lambda problem, step: seen.append((problem, step)))
    problem = set_problem(load_scene(red_scene(scene_file)))
    methods.optimize_unadversarially(problem)
    ((simple, step),) = seen
    drawn = problem.scene.draw("train", 2)
    dark = with_values(drawn, exposure_ev=-1.0, white_balance=0.5, noise=0.1)
    for world, alike in ((simple, True), (problem, False)):
        shown = world.subject.appearance(problem.subject.start())
        pictures = [expose(world.see(shown, each, 96), shown) for each in (drawn, dark)]
        assert torch.equal(*pictures) == alike
    assert step == methods.UNADVERSARIAL_STEP and simple.subject.printer.name == "identity"
