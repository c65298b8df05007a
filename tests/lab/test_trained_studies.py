"""Studies of trained designs on networks whose answers are known, and on the built-in one."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from patchlab.paper import deceive, transfer
from patchlab.study.estimates import mean
from patchlab.study.grid import short_name
from patchlab.study.record import Record
from patchlab.study.study import Cell, Result, run_study
from patchlab.study.trained_designs import (
    TrainedSettings,
    gain_word,
    mean_color,
    trained_cells,
    trained_problem,
    views_from,
    views_in_drawn_light,
)
from patchproof.base.errors import Refused
from patchproof.base.intervals import Estimate
from patchproof.base.validation import validate_model
from patchproof.optimizer import loop, run
from patchproof.optimizer.evaluate import evaluate
from patchproof.optimizer.problem import set_problem
from patchproof.optimizer.run import optimize as optimize_scene
from patchproof.scene.scene import load_scene
from test_textures_optimized import scene_file
from undrawn import draw_nothing

RED, BLUE = "module:fake_networks.red_against_blue", "module:fake_networks.blue_against_red"
CORNER = "module:fake_networks.corner"


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(loop, "SELECT_AFTER", 4)
    monkeypatch.setattr(loop, "SELECT_VIEWS", 4)
    monkeypatch.setattr(run, "PROMISE_VIEWS", 2)


def written(folder: Path, label="red", config="", kind="texture"):
    """A scene of painted boxes, their whole texture free, and a config that names it; the config's path."""
    path = scene_file(folder, kind)
    text = path.read_text().replace('label = "carton"', f'label = "{label}"').replace("epsilon = 0.1\n", "")
    path.write_text(text)
    (folder / "study.toml").write_text(f'scenes = ["{path.name}"]\n{config}', encoding="utf-8")
    return folder / "study.toml"


def table(finished, name):
    (found,) = (one for one in finished.tables if one.name == name)
    return [dict(zip(found.head, row, strict=True)) for row in found.rows]


def test_a_design_helps_the_network_that_agrees_and_harms_the_one_that_reads_the_opposite(tmp_path):
    config = written(tmp_path, config=f'networks = ["{RED}", "{BLUE}"]\nn = 6\nlights = 2\n')
    finished = run_study("transfer", config, tmp_path / "out")
    assert not finished.failed
    rows = {
        (row["trained on"].split(".")[-1], row["tested on"].split(".")[-1]): row for row in table(finished, "matrix")
    }
    red, blue = "red_against_blue", "blue_against_red"
    assert set(rows) == {(row, network) for row in ("original", red, blue, "all") for network in (red, blue)}
    for mine, other in ((red, blue), (blue, red)):
        assert rows[mine, mine]["rate"].value == 1 and rows[mine, mine]["seen"] == "yes"
        assert rows[mine, other]["rate"].value == 0 and rows[mine, other]["seen"] == "no"
        assert rows[mine, other]["gain in confidence"].high < 0 < rows[mine, mine]["gain in confidence"].low
    before = [rows["original", network]["rate"].value for network in (red, blue)]
    assert sum(before) == 1
    views = table(finished, "views")
    assert {row["design"].n for row in views} == {2} and {row["azimuth (deg)"] for row in views} > {0.0}
    assert {row["seen"]: row["design"].value for row in views if row["trained on"] != "all"} == {"yes": 1, "no": 0}
    assert not any(one.name == "left_out" for one in finished.tables)  # one network would be left: a row already


def test_networks_left_out_get_a_table_of_their_own(tmp_path):
    config = written(tmp_path, config=f'networks = ["{RED}", "{BLUE}", "builtin"]\nn = 2\n')
    settings = transfer.TransferSettings(scenes=("texture.toml",), networks=(RED, BLUE, "builtin"), n=2)
    cells = transfer.cells(settings, config.parent)
    assert [one.values["row"].replace("fake_networks.", "") for one in cells] == [
        "original",
        "red_against_blue",
        "blue_against_red",
        "builtin",
        "without_red_against_blue",
        "without_blue_against_red",
        "without_builtin",
        "all",
    ]
    hits = {"original": "0000", "builtin": "0001", "red_against_blue": "0011", "without_blue_against_red": "1111"}
    results = [
        Result(
            one, {"hits": {"design": [hits.get(row, "0000")] * 3}, "confidence": {"design": [[0.5] * 4] * 3}}, tmp_path
        )
        for one in cells
        if (row := one.values["row"].replace("fake_networks.", "")) != "all"
    ]
    tables = {one.name: one for one in transfer.tables(settings, results)}
    rows = {row[2]: row for row in tables["left_out"].rows}
    name = short_name(BLUE)
    # 4 of 4 against 0 of 4; the others' designs alone: 1 and 2 of 4
    assert rows[name][3].value == 0 and rows[name][4].value == 1 and rows[name][5].value == 1
    assert rows[name][7] == pytest.approx(0.375) and rows[name][8] == "gain"
    assert rows["builtin"][5].value == 0 and rows["builtin"][8] == "none shown"


def test_a_family_is_left_out_as_a_whole_and_gains_count_objects_and_seeds(tmp_path):
    config = written(tmp_path, config="")
    networks, families = (RED, BLUE, "builtin", CORNER), {"colors": (RED, BLUE), "places": ("builtin", CORNER)}
    settings = transfer.TransferSettings(
        scenes=("texture.toml",), networks=networks, families=families, seeds=(0, 1), n=4
    )
    cells = transfer.cells(settings, config.parent)
    trained = {one.values["row"]: one.values["trained"] for one in cells}
    assert trained["without_colors"] == ["builtin", CORNER] and trained["without_places"] == [RED, BLUE]
    assert len(cells) == 2 * (1 + 4 + 2 + 1)

    def hits(one: Cell, network: str) -> str:
        """Red's designs help the corner's network in all of 4 conditions, the built-in one in 2 or 0 by seed."""
        if one.values["row"] != short_name(RED) or network not in families["places"]:
            return "0000"
        return "1111" if network == CORNER else ("1100", "0000")[one.values["seed"]]

    results = [
        Result(
            one,
            {"hits": {"design": [hits(one, name) for name in networks]}, "confidence": {"design": [[0.5] * 4] * 4}},
            tmp_path,
        )
        for one in cells
    ]
    tables = {one.name: one for one in transfer.tables(settings, results)}
    by_network = {row[1:4]: row for row in tables["objects"].rows}
    assert by_network[short_name(RED), "builtin", "no"][6] == mean([0.5, 0.0])  # n = 2, not 8
    assert by_network[short_name(RED), short_name(CORNER), "no"][6] == Estimate(1, 1, 1, 2)
    by_family = {row[1:4]: row for row in tables["families"].rows}
    # the mean of two networks' designs on two networks: (1 + 0.5 + 0 + 0) / 4, then (1 + 0 + 0 + 0) / 4
    assert by_family["colors", "places", "no"][4:8] == (0, 0.3125, mean([0.375, 0.25]), "none shown")
    assert by_family["places", "colors", "no"][6] == Estimate(0, 0, 0, 2)
    assert {row[3] for row in tables["families"].rows if row[1] == "without_colors" and row[2] == "colors"} == {"no"}
    assert {row[3] for row in tables["families"].rows if row[1] == "without_colors" and row[2] == "places"} == {"yes"}
    left_out = {row[2]: row for row in tables["left_out"].rows}
    assert left_out["builtin"][7] == pytest.approx(0.125)  # of the colors' designs alone, not of the corner's
    assert set(left_out) == {short_name(name) for name in networks}
    kept = [one for one in results if one.cell.values["seed"] == 0]
    assert not any(one.name == "objects" for one in transfer.tables(settings, kept))  # of one there is no interval


def test_every_network_is_in_one_family():
    for families in ({"a": (RED,)}, {"a": (RED, BLUE), "b": (BLUE,)}, {"a": (RED, BLUE, "builtin")}):
        with pytest.raises(Refused, match="families in which each of networks is once"):
            validate_model(
                transfer.TransferSettings, {"scenes": ["a"], "networks": [RED, BLUE], "families": families}, "x"
            )


def test_a_study_finds_what_optimize_and_evaluate_find_and_no_gain_of_a_design_that_did_not_move(tmp_path, monkeypatch):
    draw_nothing(monkeypatch)
    ways = '[ways.as_is]\n[ways.still]\noptimize = {optimizer = "sign", step_size = 1e-6}\n'
    config = written(tmp_path, "carton", f'networks = ["builtin"]\nn = 4\nlights = 1\nseeds = [3]\n{ways}')
    finished = run_study("transfer", config, tmp_path / "out")
    original, design, before, still = table(finished, "matrix")
    assert still["way"] == "still" and still["gain in rate"].value == 0 and still["shows"] == "none shown"
    assert still["gain in confidence"] == Estimate(0, 0, 0, 4)
    assert original["confidence"] == before["confidence"] == still["confidence"]
    names = {path.name for path in (tmp_path / "out").rglob("*.*")}
    assert {"texture.still.builtin.3.glb", "transfer_heat_texture_still.png", "transfer.html"} <= names

    optimize_scene(tmp_path / "texture.toml", tmp_path / "run", seed=3)
    found = evaluate(tmp_path / "run", n=4).models["builtin"]
    assert design["rate"].value == found.rate and original["rate"].value == found.controls["bare"].rate
    # cells keep five digits
    assert design["confidence"].value == pytest.approx(found.confidence, abs=1e-5)
    low, high = found.controls["bare"].difference_interval
    assert (design["gain in rate"].low, design["gain in rate"].high) == pytest.approx((low, high))
    glb = (tmp_path / "out/files/texture.as_is.builtin.3.glb").read_bytes()
    assert glb == (tmp_path / "run/object.glb").read_bytes()


def test_deceptive_textures_stand_beside_controls(tmp_path):
    config = written(tmp_path, config=f'networks = ["{RED}"]\nn = 4\n')
    finished = run_study("deceive", config, tmp_path / "out")
    rates, minus = table(finished, "rates"), table(finished, "differences")
    assert [row["way"] for row in rates] == ["free", "within_8"]
    assert rates[0]["design"].value == 0
    for row, less in zip(rates, minus, strict=True):
        for kind in deceive.CONTROLS:
            assert less[f"minus {kind}"].value == pytest.approx(row["design"].value - row[kind].value)
    with open(tmp_path / "out/cells/texture.within_8.fake_networks.red_against_blue.0.json") as file:
        assert json.load(file)["cell"]["scene"]["target"]["goal"] == "deceive"
    # the ball keeps the design near the original
    assert rates[0]["confidence"].value < rates[1]["confidence"].value


def test_each_class_asks_for_its_own_color(tmp_path):
    config = written(tmp_path, config=f'networks = ["{RED}"]\nn = 4\nclasses = ["red", "blue"]\n')
    finished = run_study("robust", config, tmp_path / "out")
    assert not finished.failed
    red, blue = table(finished, "colors")
    assert red["red"] > red["blue"] + 20 and blue["blue"] > blue["red"] + 20
    assert red["mean color"] == "#{:02x}{:02x}{:02x}".format(*(red[word] for word in ("red", "green", "blue")))
    assert all(row["design"].value == 1 for row in table(finished, "rates"))
    names = {path.name for path in (tmp_path / "out").glob("*.png")}
    assert {"robust_colors.png", "robust_sheet_texture_free.png"} == names


def test_the_mean_color_of_an_object_of_one_color_is_that_color(tmp_path):
    written(tmp_path, "carton")
    problem = set_problem(load_scene(tmp_path / "texture.toml"))
    design = torch.tensor([200, 100, 30]).view(3, 1, 1) / 255 * torch.ones_like(problem.subject.start())
    assert mean_color(problem, problem.subject.appearance(design), 4, 64) == (200, 100, 30)


def test_small_textures_are_those_of_original_and_design_alike(tmp_path):
    written(tmp_path)
    settings = TrainedSettings(scenes=("texture.toml",), networks=(RED,), texture_px=16)
    (cell,) = trained_cells(settings, tmp_path)
    problem = trained_problem(settings, tmp_path, cell)
    assert {max(mask.shape) for mask in problem.scene.canvas.mask} == {16}
    sizes = {max(material.texture_srgb.shape[:2]) for material in problem.scene.mesh.materials}
    texels = sum(int(mask.sum()) for mask in problem.scene.canvas.mask)
    assert sizes == {16} and problem.subject.start().shape == (3, 1, texels)
    whole = trained_problem(settings.changed(texture_px=None), tmp_path, cell)
    assert whole.subject.start().shape[2] > 2 * texels


def test_fixed_views_keep_their_pose_and_change_their_light(tmp_path):
    written(tmp_path, "carton")
    problem = set_problem(load_scene(tmp_path / "texture.toml"))
    views = views_in_drawn_light(problem, 4)
    assert sorted(set(views.pose.azimuth_deg.round(6))) == pytest.approx([-80 / 3, 0, 80 / 3])  # sixths of [-40, 40]
    assert len(set(views.light.directional)) == 12 and len(set(views.pose.distance_mm)) == 1
    still = views_from(problem, np.array([0.0, 90.0]))
    assert not still.light.directional.any() and not still.sensor.noise.any() and (still.light.ambient == 1).all()


def test_a_changed_scene_file_is_another_cell_and_ways_are_checked_early(tmp_path):
    config = written(tmp_path, config=f'networks = ["{RED}"]\n')
    settings = TrainedSettings(scenes=("texture.toml",), networks=(RED,))
    (before,) = trained_cells(settings, config.parent)
    scene = tmp_path / "texture.toml"
    scene.write_text(scene.read_text().replace("distance_mm = [600", "distance_mm = [500"))
    (after,) = trained_cells(settings, config.parent)
    assert before.name == after.name and before.values != after.values
    wrong = settings.changed(ways={"odd": {"optimize": {"stpes": 3}}})
    with pytest.raises(Refused, match=r'way odd, got "optimize\.stpes": did you mean "steps"'):
        trained_cells(wrong, config.parent)


def test_names_must_differ_and_ways_be_words():
    settings = TrainedSettings(scenes=("a.toml",), networks=("builtin",))
    with pytest.raises(Refused, match="different names"):
        settings.changed(networks=("file:a/net.onnx", "file:b/net.onnx"))
    with pytest.raises(Refused, match=r"ways\.a b"):
        validate_model(TrainedSettings, {"scenes": ["a"], "networks": ["b"], "ways": {"a b": {}}}, "config")


def test_pairs_are_those_of_seeds_that_both_have():
    def result(seed, hits):
        values = {"name": "scene", "seed": seed, "networks": ["net"]}
        return Result(Cell("c", values), {"hits": {"x": [hits]}, "confidence": {"x": [[0.5] * len(hits)]}}, Path())

    one = Record([result(0, "1100"), result(1, "1111")], "x")
    other = Record([result(1, "0001"), result(2, "0000")], "x")
    gain, _ = one.gain(other, "net")
    assert gain.n == 4 and gain.value == 0.75 and one.level("net")[0].n == 8
    assert one.gain(other) == one.gain(other, "net")  # the only network need not be named
    assert one.gain(Record([], "x"), "net") == (None, None) and gain_word(None) == "not measured"


def test_means_have_students_interval():
    # mean 0.5, standard error 0.5, t(1) at 97.5 % = 12.7062
    found = mean([0.0, 1.0])
    assert (found.low, found.high) == pytest.approx((0.5 - 6.3531, 0.5 + 6.3531), abs=1e-4)
    assert mean([0.3]) is None
