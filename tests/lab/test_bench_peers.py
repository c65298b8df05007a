"""Ours beside other methods: what they are given, what they spend, and tables by hand."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from patchlab.bench import methods, peers
from patchlab.bench.chart import all_checks
from patchlab.study.grid import scene_values
from patchlab.study.record import hits_text
from patchlab.study.study import Cell, Result, run_study
from patchproof.base.errors import Refused
from patchproof.optimizer import loop
from patchproof.optimizer.problem import set_problem
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
    assert made.passes == 72 and redness(made.pixels) > 10
    assert made.pixels.shape[:2][::-1] == problem.patch.printed_px
    assert np.array_equal(made.pixels, methods.train_with_art(problem).pixels)


def test_a_missing_art_is_said_before_anything_is_trained(scene_file, without_art, tmp_path):
    config = tmp_path / "study.toml"
    config.write_text('scenes = ["scene.toml"]\n')
    with pytest.raises(Refused, match=r'Toolbox, got none.*patchproof\[lab\]", or leave art out of peers'):
        run_study("peers", config, tmp_path / "out")
    assert not (tmp_path / "out" / "cells").exists()


# The study


def test_all_designs_hang_in_the_same_piece_in_the_same_views(scene_file, without_art, tmp_path):
    red_scene(scene_file)
    config = tmp_path / "study.toml"
    config.write_text('scenes = ["scene.toml"]\nseeds = [3]\nn = 6\npeers = ["sign", "flat"]\n')
    finished = run_study("peers", config, tmp_path / "out")
    assert not finished.failed
    (result,), (pooled, cells) = finished.results, finished.tables
    assert list(result.answers["hits"]) == ["bare", "gray", "ours", "sign", "flat"]
    assert {len(hits[0]) for hits in result.answers["hits"].values()} == {6}
    assert [row[0] for row in pooled.rows] == ["ours", "sign", "flat"] and pooled.rows[0][1] == 1
    assert {row[-2] for row in pooled.rows} == {4 * 4 + 8} and all(row[-1] > 0 for row in pooled.rows)
    assert cells.head == ("object", "network", "seed", "bare", "gray", "ours", "sign", "flat")
    shapes = set()
    for name in ("ours", "sign", "flat"):
        with Image.open(tmp_path / f"out/files/scene.fake_networks.red_against_blue.3-{name}.png") as image:
            shapes.add(image.size)
    assert len(shapes) == 1
    with Image.open(tmp_path / "out/peers_designs.png") as image:
        assert np.asarray(image.convert("L")).std() > 5


def test_a_texture_is_refused(scene_file, without_art, tmp_path):
    scene_file.write_text(scene_file.read_text().replace("width_mm = 90\nheight_mm = 90", 'kind = "texture"'))
    settings = peers.PeersSettings(scenes=("scene.toml",), peers=("flat",))
    with pytest.raises(Refused, match="a mesh and a printed patch, got"):
        peers.cells(settings, tmp_path)


def result_of(scene_file, network, seed, goal="assist", **hits):
    """A result whose things were recognized in so many of four views."""
    values = scene_values(scene_file.name, scene_file.parent, {"target": {"goal": goal}})
    values |= {"networks": [network], "network": network, "seed": seed}
    answers = {
        "hits": {name: [hits_text(i < count for i in range(4))] for name, count in hits.items()},
        "passes": dict.fromkeys(("ours", "flat"), 100),
        "seconds": {"ours": 2.0, "flat": 3.0},
    }
    return Result(Cell(f"{network}-{seed}", values), answers, Path())


def settings_of(**more):
    return peers.PeersSettings(scenes=("scene.toml",), peers=("flat",), n=4, **more)


def test_ours_minus_a_peer_counts_cells_and_pairs(scene_file):
    results = [result_of(scene_file, f"m{m}", s, bare=1, gray=2, ours=4, flat=2 + s) for m in range(3) for s in (0, 1)]
    pooled, cells = peers.tables(settings_of(), results)
    ours, flat = pooled.rows
    assert ours[:2] == ("ours", 1.0) and flat[1] == pytest.approx(0.625)
    assert ours[2].value == pytest.approx(0.5) and flat[2].value == pytest.approx(0.125)  # gray is the best control
    assert ours[3:5] == (None, None)
    assert flat[3].value == pytest.approx(0.375) and flat[3].n == 6 and flat[3].low < 0.375 < flat[3].high
    assert flat[4] == pytest.approx(0.375)  # three pairs: no interval
    assert flat[5:] == (100, 3.0)
    assert cells.rows[0] == ("scene", "m0", 0, 0.25, 0.5, 1.0, 0.5)


def test_what_deceives_gains_by_what_is_lost(scene_file):
    results = [result_of(scene_file, "m", 0, "deceive", bare=4, gray=3, ours=0, flat=1)]
    (ours, flat), _ = (table.rows for table in peers.tables(settings_of(), results))
    assert ours[1:3] == (0.0, 0.75) and flat[1:4] == (0.25, 0.5, 0.25)


def test_the_chart_holds_ours_against_the_front(scene_file):
    results = [result_of(scene_file, "m", s, bare=1, gray=2, ours=3 + s, flat=4 - s) for s in (0, 1)]
    chart = peers.peers_chart(settings_of(), results)
    (ours, flat), (check,) = chart.series["methods"], all_checks(chart)
    assert (ours.setting, ours.default, flat.default) == ("ours", True, False)
    assert ours.cost.value == 1 and flat.cost.value == 1.5
    assert ours.error.value == flat.error.value == pytest.approx(0.125) and check.holds
    assert "ART is not installed" in chart.about


def test_the_benchmark_runs_on_the_demo_s_scene_without_art(without_art, monkeypatch):
    monkeypatch.setattr(peers, "QUICK_STEPS", 1)
    monkeypatch.setattr(peers, "QUICK_VIEWS", 2)
    stages = []
    (chart,) = peers.charts(True, lambda *stage: stages.append(stage))
    assert [point.setting for point in chart.series["methods"]] == ["ours", "sign", "flat"]
    assert stages == [("cells", 1, 2), ("cells", 2, 2)] and [table.name for table in chart.tables] == [
        "pooled",
        "cells",
    ]
