"""The operating envelope of a small scene: axes do what they say, gains are over controls, the study is written."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from patchlab.study.study import Cell, Result, Work, run_study
from patchlab.validation.envelope.axes import AXES, conditions_at, scene_at
from patchlab.validation.envelope.simulation import (
    Measurement,
    measure_photos,
    open_simulation,
    piece_at,
    recognize_target,
)
from patchlab.validation.envelope.sweeps import EnvelopeSettings, cells, figures, gains_in, sweep_bars
from patchproof.base import geometry
from patchproof.base.errors import Refused
from patchproof.base.intervals import paired_difference
from patchproof.optimizer.run import optimize
from patchproof.report.page import draw_figure as drawing_of
from patchproof.scene.conditions import with_values
from undrawn import draw_nothing


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    import conftest

    folder = tmp_path_factory.mktemp("envelope")
    scene = conftest.SCENE.replace("steps = 3", "steps = 1").replace("views = 4", "views = 1")
    (folder / "scene.toml").write_text(scene)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("patchproof.optimizer.run.PROMISE_VIEWS", 8)
        patch.setattr("patchproof.optimizer.loop.SELECT_VIEWS", 4)
        optimize(folder / "scene.toml", folder / "run")
    return open_simulation(folder / "run", None)


def rows_of(path):
    return list(csv.DictReader(path.read_text("utf-8").splitlines()))


@pytest.fixture(scope="module")
def drawn(world):
    return world.scene.draw("evaluate", 4)


def test_a_value_replaces_one_condition_and_leaves_the_others(drawn):
    changed = with_values(drawn, jpeg=12.0)
    assert changed.sensor.jpeg.tolist() == [12] * 4 and changed.sensor.jpeg.dtype == drawn.sensor.jpeg.dtype
    assert np.array_equal(changed.sensor.blur_px, drawn.sensor.blur_px) and changed.pose.background.flags.writeable
    assert with_values(drawn, blur_px=np.arange(4)).sensor.blur_px.tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("tilt_deg", [0.0, 35.0, 88.0])
def test_tilt_is_the_angle_from_the_patch_s_axis_and_keeps_its_direction(world, drawn, tilt_deg):
    moved, frame = conditions_at(drawn, {"tilt": tilt_deg}), world.scene.frame
    before = geometry.orbit(drawn.pose.azimuth_deg, drawn.pose.elevation_deg, frame.normal, frame.up)
    after = geometry.orbit(moved.pose.azimuth_deg, moved.pose.elevation_deg, frame.normal, frame.up)
    assert np.degrees(np.arccos((after @ frame.normal).clip(-1, 1))) == pytest.approx(np.full(4, tilt_deg), abs=1e-5)
    if tilt_deg:
        sides = [np.arctan2(d @ frame.up, d @ frame.right) for d in (before, after)]
        assert sides[0] == pytest.approx(sides[1])


def test_curled_paper_keeps_its_lengths_and_its_middle(world):
    flat, radius = world.scene.placement, 60.0
    bent = scene_at(world.scene, {"curl": radius}).placement
    assert bent.center_mm == pytest.approx(flat.center_mm, abs=0.05)
    grid = bent.vertices_mm.reshape(33, 33, 3)
    # chords of 32 arcs: 2 R sin(w / 64 R) each
    chord = 2 * radius * np.sin(flat.size_mm[0] / 32 / 2 / radius)
    assert np.linalg.norm(np.diff(grid, axis=1), axis=2) == pytest.approx(np.full((33, 32), chord))
    height = (bent.vertices_mm - flat.center_mm) @ flat.normal
    assert height.max() == pytest.approx(radius * (1 - np.cos(flat.size_mm[0] / 2 / radius))) and height.min() > -1e-9
    with pytest.raises(Refused, match="a flat card to curl"):
        scene_at(replace(world.scene, placement=bent), {"curl": 50.0})


def test_gap_moves_the_piece_along_its_normal_and_size_shrinks_it(world):
    flat = world.scene.placement
    off = scene_at(world.scene, {"gap": 30.0}).placement
    assert off.center_mm - flat.center_mm == pytest.approx(30 * flat.normal)
    assert off.vertices_mm - flat.vertices_mm == pytest.approx(np.tile(30 * flat.normal, (4, 1)))
    drawn = world.scene.draw("evaluate", 2)
    small = conditions_at(drawn, {"size": 0.5})
    assert small.pose.printed_scale == pytest.approx(drawn.pose.printed_scale / 2)


@pytest.mark.parametrize("quarters", [0.0, 1.0, 2.5, 4.0])
def test_hidden_corners_cover_their_share_of_the_piece(world, quarters):
    bare, hidden = (piece_at(world, "hidden", q, 1).srgb for q in (0.0, quarters))
    assert float((hidden != bare).any(-1).float().mean()) == pytest.approx(quarters / 4, abs=0.01)


def test_mismatch_begins_at_the_run_s_printer_and_is_the_other_one_at_one(world):
    assert torch.equal(piece_at(world, "mismatch", 0.0, 0).srgb, piece_at(world, "blur", 3.0, 0).srgb)
    other = world.other.apply(world.sheet.sent_srgb)[0].permute(1, 2, 0)
    assert torch.allclose(piece_at(world, "mismatch", 1.0, 0).srgb, other, atol=1e-6)


def test_the_gray_piece_is_the_printed_control_and_suffers_what_the_design_does(world):
    design, gray = (piece_at(world, "blur", 1.0, 0, gray=is_gray).srgb for is_gray in (False, True))
    middle = gray[len(gray) // 2, len(gray) // 2]
    assert gray.shape == design.shape and float(middle.max() - middle.min()) < 0.05  # as this printer makes gray
    assert not torch.equal(piece_at(world, "mismatch", 1.0, 0, gray=True).srgb, gray)
    taped = [piece_at(world, "hidden", 4.0, 0, gray=is_gray).srgb for is_gray in (False, True)]
    assert torch.equal(*taped)


def test_measuring_works_at_the_easy_end_and_says_why_not_at_the_hard_one(world, drawn):
    (hidden,) = measure_photos(world, "hidden", [4.0], drawn[:2])
    sharp, blurred = measure_photos(world, "blur", [0.1, 12.0], drawn[:1])
    (tilted,) = measure_photos(world, "tilt", [86.0], drawn[:1])
    assert all(one.status == "measured" and one.error_mm < 0.3 for one in sharp)
    for row in (tilted, blurred, hidden):
        assert all(one.status != "measured" and one.code for one in row)
    assert {one.code for one in hidden} == {"too_few_markers"}


def test_points_see_common_conditions_whatever_their_neighbors_are(world, drawn):
    for axis, values, some in (("distance", (600.0, 4000.0), drawn[:2]), ("jpeg", (90.0, 2.0), drawn[:1])):
        together = recognize_target(world, axis, values, some)
        alone = [recognize_target(world, axis, [value], some) for value in values]
        assert list(together) == ["design", "bare", "gray"]
        for kind, hits in together.items():
            assert np.array_equal(hits, np.concatenate([each[kind] for each in alone]))


def test_the_study_writes_breaks_points_codes_and_one_page(world, tmp_path):
    config = tmp_path / "envelope.toml"
    config.write_text(
        f'run = "{world.run.folder}"\nn = 4\nphotos = 2\n'
        'sweeps = [{axis = "blur", easy = 0.5, hard = 16, points = 3}]\n'
    )
    said: list[str] = []
    finished = run_study("envelope", config, tmp_path / "out", Work(on_start=said.append))
    assert not finished.failed
    assert said == ["this renders 36 views for the network, and 6 whole photographs to measure"]
    assert [table.name for table in finished.tables] == ["breaks", "sweeps"]
    rows = rows_of(tmp_path / "out/envelope_sweeps.csv")
    assert [float(row["value"]) for row in rows] == pytest.approx([0.5, 8**0.5, 16])
    assert float(rows[0]["measured"]) == 1 and float(rows[2]["measured"]) == 0
    gains, found, measured = rows_of(tmp_path / "out/envelope_breaks.csv")
    assert [row["method"] for row in (gains, found, measured)] == ["design gains", "sheet found", "measured"]
    assert 0.5 <= float(measured["last good"]) < float(measured["first bad"]) <= 16
    assert measured["said there"] and "too_few_markers" in found["said there"]
    assert (tmp_path / "out/envelope_page.png").is_file()


# ------------------------------------------------------------------------------------------------ beside controls


def sweep(design, bare, gray, *statuses: str) -> Result:
    """A sweep of four values of blur; photographs with a code of their own where they are not measured."""
    controls = {kind: np.array(hits, int).tolist() for kind, hits in (("bare", bare), ("gray", gray))}
    status = [list(each) for each in statuses or ["m"] * len(design)]
    words = {"m": ("measured", None), "j": ("judged", "blurred"), "r": ("rejected", "too_few_markers")}
    told = [[[words[letter][i] for letter in row] for row in status] for i in (0, 1)]
    answers = {"recognized": np.array(design, int).tolist(), "controls": controls, "status": told[0], "code": told[1]}
    return Result(Cell("a", {"x": {"axis": "blur"}}), answers | {"values": [1.0, 2.0, 4.0, 8.0][: len(design)]}, Path())


def test_a_gain_is_over_the_control_that_is_hardest_to_beat_at_that_point():
    design = np.array([[1] * 20, [1] * 20, [1] * 20], bool)
    bare = np.array([[0] * 20, [0] * 15 + [1] * 5, [1] * 20], bool)
    gray = np.array([[0] * 10 + [1] * 10, [0] * 20, [0] * 20], bool)
    gains = gains_in(sweep(design, bare, gray).answers)
    assert [gain.value for gain in gains] == [0.5, 0.75, 0.0]
    assert (gains[0].low, gains[0].high) == pytest.approx(paired_difference(design[0].tolist(), gray[0].tolist())[1])
    gaining, *_ = sweep_bars(sweep(design, bare, gray))
    assert (gaining.last_good, gaining.first_bad, gaining.said) == (1, 2, "no gain shown")
    # last that shows a gain and first that does not: of 20 conditions 5 more, and 3 more
    for more, shown in ((5, True), (3, False)):
        other = np.arange(20)[None] >= more
        assert sweep_bars(sweep(design[:1], other, other))[0].points[0].good == shown
    assert not sweep_bars(sweep(bare[:1], design[:1], design[:1]))[0].points[0].good  # it does harm


def test_a_sheet_is_good_where_four_of_five_photographs_are_and_codes_of_the_others_are_said():
    hits = np.ones((4, 4), bool)
    _, found, measured = sweep_bars(sweep(hits, ~hits, ~hits, "mmmmm", "mmmmj", "mmmjj", "mrrrj"))
    assert (found.last_good, found.first_bad, found.said, found.n) == (2, 3, "too_few_markers", 5)
    assert (measured.last_good, measured.first_bad, measured.said) == (1, 2, "blurred, too_few_markers")


@pytest.fixture(scope="module")
def blue_run(tmp_path_factory):
    """Of a network that tells red from blue and has no other answer: of noise it says blue half of the time."""
    import conftest

    folder = tmp_path_factory.mktemp("blue")
    scene = conftest.SCENE.replace('"carton"\nmodels = ["builtin"]', BLUE).replace("[800, 600]", "[96, 96]")
    scene = scene.replace("steps = 3", STRIDES).replace("[500, 900]", "[330, 340]")
    (folder / "scene.toml").write_text(
        scene + '\n[printer]\nprofile = "coated"\nveil = [0, 0]\nchroma = [0, 0]\n', encoding="utf-8"
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("patchproof.optimizer.run.PROMISE_VIEWS", 8)
        patch.setattr("patchproof.optimizer.loop.SELECT_VIEWS", 4)
        optimize(folder / "scene.toml", folder / "run")
    return folder / "run"


STRIDES = 'steps = 4\noptimizer = "sign"\nstep_size = 0.15'
BLUE = '"blue"\nmodels = ["module:fake_networks.red_against_blue"]'


def test_where_nothing_is_left_of_the_object_the_page_says_no_gain_whatever_is_recognized(
    blue_run, tmp_path, monkeypatch
):
    draw_nothing(monkeypatch)  # but the page, below
    unseen = Measurement("rejected", "too_few_markers", None)  # a search of noise for markers takes seconds
    monkeypatch.setattr(
        "patchlab.validation.envelope.sweeps.measure_photos", lambda _, __, values, ___: [[unseen]] * len(values)
    )
    config, out = tmp_path / "envelope.toml", tmp_path / "out"
    config.write_text(
        f'run = "{blue_run}"\nn = 6\nphotos = 1\n'
        'sweeps = [{axis = "noise", points = 3}, {axis = "blur", easy = 0.1, hard = 60, points = 3}]\n'
    )
    finished = run_study("envelope", config, out)
    assert not finished.failed
    noise, blur = np.reshape(rows_of(out / "envelope_sweeps.csv"), (2, 3))
    for easy, _, hard in (noise, blur):
        assert easy["effect"] == "gains" and float(easy["gain_low"]) > 0
        assert hard["effect"] == "no gain shown" and float(hard["gain_low"]) <= 0 <= float(hard["gain_high"])
    assert 0.2 < float(noise[2]["recognized"]) < 0.8
    for row in rows_of(out / "envelope_breaks.csv")[:2]:
        assert row["method"] == "design gains" and row["last good"] and row["said there"] == "no gain shown"
    (page,) = figures(None, finished.results)
    assert drawing_of(page.draw, (8, 6), "svg").decode().count("no gain shown<") == 2
    assert "no gain shown" in (out / "envelope.html").read_text("utf-8")


@pytest.mark.parametrize(
    ("changed", "match"),
    [
        ({"sweeps": ({"axis": "tlit"},)}, 'did you mean "tilt"'),
        ({"sweeps": ({"axis": "blur", "easy": 0.0},)}, "above 0"),
    ],
)
def test_axes_and_ends_that_make_no_sense_are_refused(world, changed, match):
    settings = EnvelopeSettings.model_validate({"run": str(world.run.folder)} | changed)
    with pytest.raises(Refused, match=match):
        cells(settings, world.run.folder)


def test_every_axis_has_a_sweep(world):
    named = [cell.name for cell in cells(EnvelopeSettings(run="run"), world.run.folder.parent)]
    assert named == [f"sweep-{name}" for name in AXES]
