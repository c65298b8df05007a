"""The plan: figures checked by hand, terms that matter and terms that do not, and every kind of scene."""

from __future__ import annotations

import math
import re
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from conftest import SCENE
from PIL import Image

from patchproof.app import cli
from patchproof.app.plan import errors
from patchproof.app.plan.errors import Setup, measure_terms, scene_terms
from patchproof.app.plan.plan import measure_cost, measured_lines, needed_marker_mm, plan_geometry, resolution_plan
from patchproof.base.errors import Refused
from patchproof.base.settings import SceneSettings
from patchproof.base.validation import validate_model
from patchproof.channel.effects import EFFECTS, RECORD_OF
from patchproof.optimizer import loop
from patchproof.optimizer.problem import set_problem
from patchproof.optimizer.subject import from_pixels
from patchproof.photo.paper_light import PaperLight
from patchproof.scene.bent_scene import placement_with_other_bend
from patchproof.scene.conditions import draw
from patchproof.scene.photo_scene import BasePhoto, PhotoScene
from patchproof.scene.scene import build_scene, load_scene
from patchproof.sheets.piece import lay_out_piece
from test_conditions import SETTINGS


def scene_with(tmp_path, **changes):
    """A carton before "red against blue"; keys are table__name."""
    data = {
        "object": {"mesh": "primitive:carton", "length_mm": 300, "up": "y"},
        "patch": {"side": "+z", "width_mm": 90, "height_mm": 90},
        "target": {"label": "red", "models": ["module:fake_networks.red_against_blue"]},
        "view": {"azimuth_deg": [-30, 30], "elevation_deg": [0, 20], "distance_mm": [500, 600]},
        "camera": {"photo_px": [400, 300], "blur_px": [0, 0], "noise": [0, 0]},
        "optimize": {"steps": 2, "views": 2},
    }
    for key, value in changes.items():
        table, name = key.split("__")
        data.setdefault(table, {})[name] = value
    return build_scene(validate_model(SceneSettings, data, "test"), tmp_path)


STRAIGHT = {
    "view__azimuth_deg": [0, 0],
    "view__elevation_deg": [0, 0],
    "view__roll_deg": [0, 0],
    "view__look_at_jitter": 0,
    "view__fov_deg": 90,
}


def errors_of(scene, other=None):
    """The errors by name, with a noise design in 2 views, and the rest."""
    problem = set_problem(scene)
    width, height = problem.subject.design_px
    pixels = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    terms = measure_terms(problem, from_pixels(pixels), scene.draw("select", 2), 64, other)
    return terms["errors"], terms


def quick_plan(path) -> SimpleNamespace:
    """The problem, the lines and the measured terms, with a small selection set, rendered two views at a time."""
    terms = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "patchproof.app.plan.plan.measure_terms", lambda *each: terms.update(measure_terms(*each)) or terms
        )
        patch.setattr(loop, "SELECT_VIEWS", 4)
        patch.setattr(errors, "_chunks", lambda views, side_px: [slice(0, 2), slice(2, views)])
        patch.setattr("patchproof.app.plan.plan.PROOF_VIEWS", 8)
        patch.setattr("patchproof.app.plan.plan.REPEATS", 1)
        calls = []
        problem, lines = plan_geometry(path)
        lines = lines + measured_lines(problem, views=3, progress=lambda *call: calls.append(call))
    assert {name for name, _, _ in calls} == {"draft", "terms", "photographs", "cost"}
    assert all(done <= total for _, done, total in calls)
    return SimpleNamespace(problem=problem, lines=lines, **terms)


@pytest.fixture(scope="module")
def plan(tmp_path_factory) -> SimpleNamespace:
    path = tmp_path_factory.mktemp("plan") / "scene.toml"
    path.write_text(SCENE.replace("[800, 600]", "[400, 300]"), encoding="utf-8")
    return quick_plan(path)


def test_a_plan_is_short(plan):
    lines = plan.lines
    assert len(lines) < 45 and max(len(line) for line in lines if not line.startswith("  off: ")) < 300
    assert lines[2].startswith("  card, 90 × 90 mm: gap 0.17 mm at most") and plan.problem.scene.warnings
    assert sum(line.startswith("  ") for line in lines) > 15 and any("draft of 3 steps" in line for line in lines)
    assert "not measured" not in "".join(lines) and len({*lines}) == len(lines)


def test_what_can_go_adds_up_to_less_than_selection_can_tell(plan):
    errors = plan.errors.values()
    gone = [error["confidence"] for error in errors if error["verdict"] == "can go" and error["key"]]
    assert gone and sum(gone) < plan.threshold
    assert all(abs(error["bias"]) <= error["confidence"] + 1e-12 for error in errors if error["verdict"] != "off")


def test_a_plan_says_how_many_photographs_prove_what_its_draft_promises(plan):
    line = plan.lines[plan.lines.index("photographs, by the promise of this draft") + 1]
    assert re.fullmatch(r"  (Even 150|Take at least \d+) photographs .*\.", line), line


def test_a_classifier_that_answers_alike_to_every_view_lets_no_term_go(tmp_path, monkeypatch):
    monkeypatch.setattr(errors, "_confidence", lambda problem, pictures, boxes: torch.full((len(pictures),), 0.25))
    found, terms = errors_of(scene_with(tmp_path, camera__blur_px=[1, 1]))
    assert {error["verdict"] for error in found.values()} <= {"off", "unknown"}
    assert found["blur"]["verdict"] == "unknown" and "is 0.25, whatever" in terms["unknown"]


def test_terms_that_are_off_are_named_with_the_key_that_turns_them_on(plan):
    off = {name: e["key"] for name, e in plan.errors.items() if e["verdict"] == "off"}
    drawn = draw(SETTINGS, "select", 4, 0)  # of the defaults
    assert off.pop("lens distortion") == "camera.file"
    switched = [(effect, getattr(drawn, RECORD_OF[effect.fields[0]])) for effect in EFFECTS if effect.can_be_off]
    assert off == {e.name: e.keys[0] for e, record in switched if e.switch_off(record, lambda *at: np.ones(4)) is None}
    off |= {"lens distortion": "camera.file"}
    assert set(off) >= {"motion blur", "print scale"}
    (line,) = (line for line in plan.lines if line.startswith("  off: "))
    assert all(key in line for key in off.values())


def test_pixels_per_millimeter_by_hand(tmp_path):
    """Straight on with 90 degrees across 300 px: the focal length is 150 px, over the distance to the piece."""
    scene = scene_with(tmp_path, **STRAIGHT, view__distance_mm=[500, 500])
    away_mm = 500 - scene.placement.center_mm @ scene.frame.normal
    assert scene.px_per_mm((400, 300)) == pytest.approx(150 / away_mm, rel=0.02)  # the piece's middle is off the axis
    found = resolution_plan(set_problem(scene))
    assert found["px_per_mm_photo"] == pytest.approx([150 / away_mm] * 2, rel=0.02)
    assert found["px_per_mm_network"] == pytest.approx([16 / away_mm] * 2, rel=0.02) and found["network_px"] == 32
    width = found["design_px"][0]
    assert found["texels_per_px"] == pytest.approx(width / 90 / found["closest_px_per_mm"])
    assert found["printed_px"][0] % width == 0 and found["printed_px_per_mm"] >= 2


def test_the_marker_rule_by_hand(tmp_path):
    """7 modules of 2.5 px at the only scale there is; from far away none that fits is readable."""
    scene = scene_with(tmp_path, **STRAIGHT, view__distance_mm=[400, 400], camera__photo_px=[1600, 1200])
    away_mm = 400 - scene.placement.center_mm @ scene.frame.normal
    needed_mm = needed_marker_mm(scene)
    assert needed_mm == pytest.approx(max(8, 7 * 2.5 * away_mm / 600), rel=0.03)
    assert scene.piece.marker_mm == pytest.approx(needed_mm, rel=0.03) and scene.unreadable_share == 0
    distant = scene_with(tmp_path, **STRAIGHT, view__distance_mm=[9000, 9000])
    assert distant.piece.marker_mm < needed_marker_mm(distant) / 2 and distant.unreadable_share == 1


def test_stronger_terms_leave_more_and_small_views_may_not_show_them(tmp_path):
    """A blur of 1 px at 300 px is 0.4 px at training's 128, which is rendered; at 600 px it would be 0.2."""
    weak, _ = errors_of(scene_with(tmp_path, camera__blur_px=[1, 1], camera__noise=[0.01, 0.01]))
    strong, _ = errors_of(scene_with(tmp_path, camera__blur_px=[3, 3], camera__noise=[0.1, 0.1]))
    for name in ("blur", "noise"):
        assert strong[name]["codes_mean"] > 2 * weak[name]["codes_mean"] > 0
    small = {"camera__photo_px": [800, 600], "camera__blur_px": [1, 1]}
    unseen, _ = errors_of(scene_with(tmp_path, **small))
    assert weak["blur"]["in_training"] is True and unseen["blur"]["in_training"] is False
    assert unseen["blur"]["codes_mean"] > 0 and unseen["noise"]["verdict"] == "off"


def test_a_term_that_the_classifier_lives_on_is_kept(tmp_path):
    """Red against blue has nothing but color to go by."""
    errors, terms = errors_of(scene_with(tmp_path, camera__white_balance=0.5))
    assert errors["white balance"]["verdict"] == "keep" and errors["white balance"]["confidence"] > 0.05
    assert terms["threshold"] < errors["white balance"]["confidence"]


def test_even_light_in_place_of_the_sun_is_as_strong_on_the_patch(tmp_path):
    scene = scene_with(tmp_path)
    problem = set_problem(scene)
    setup = Setup(problem.stage, None, scene.draw("select", 8))
    terms = {term.name: term for term in scene_terms(problem, problem.subject.start(), None)}
    before, without = setup.conditions, terms["directional light"].change(setup).conditions
    assert not without.light.directional.any() and scene.white_light(without) == pytest.approx(
        scene.white_light(before)
    )
    assert terms["directional light"].change(replace(setup, conditions=without)) is None  # it is off already


def test_bent_pieces_are_weighed_against_cards(tmp_path):
    settings = {"object__mesh": "primitive:mug", "patch__side": "-x", "patch__width_mm": 50, "patch__height_mm": 40}
    settings |= {"camera__photo_px": [800, 600], "view__distance_mm": [350, 400]}
    bent = scene_with(tmp_path, **settings, patch__bend=True)
    card, sentence = placement_with_other_bend(bent)
    assert card.is_flat and not bent.placement.is_flat and sentence.startswith("bend = false would be a card")
    errors, _ = errors_of(bent, card)
    (name,) = (name for name in errors if name.endswith("not a card"))
    assert errors[name]["codes_mean"] > 0.1 and errors[name]["verdict"] in {"keep", "can go"}
    flat = scene_with(tmp_path, **settings)
    other, sentence = placement_with_other_bend(flat)
    assert not other.is_flat and f"bend = true would be a {other.family}" in sentence
    problem = set_problem(flat)
    assert not scene_terms(problem, problem.subject.start(), other)[-1].modeled


def test_a_refused_bend_is_said_in_its_own_sentence(tmp_path):
    wide = {"patch__width_mm": 150, "patch__height_mm": 150}  # beyond the carton's rounded edges
    other, sentence = placement_with_other_bend(scene_with(tmp_path, **wide))
    assert other is None and sentence.startswith("bend = true is refused. Expected ")


def test_scenes_of_images_have_no_light_of_ours(tmp_path):
    (tmp_path / "images").mkdir()
    for i in range(3):
        picture = np.random.default_rng(i).integers(0, 256, (60, 90, 3), np.uint8)
        Image.fromarray(picture).save(tmp_path / "images" / f"{i}.png")
    (tmp_path / "labels.csv").write_text("file,label\n" + "".join(f"{i}.png,mug\n" for i in range(3)))
    lines = ['[object]\nimages = "images"\nlabels = "labels.csv"\n[target]\nlabel = "mug"\nmodels = ["builtin"]']
    lines += [
        "[patch]\nwidth_mm = 60\nheight_mm = 40\n[camera]\nphoto_px = [320, 240]\n[optimize]\nsteps = 1\nviews = 2"
    ]
    (tmp_path / "scene.toml").write_text("\n".join(lines))
    plan = quick_plan(tmp_path / "scene.toml")
    names = set(plan.errors)
    assert "assist mug, 3 images, seen by" in plan.lines[0] and plan.lines[3] == "resolution"
    assert plan.lines[2].startswith("  plane, 60 × 40 mm: pictures say nothing of a surface: the piece is a plane that")
    assert "blur" in names and not names & {"directional light", "lens distortion"}
    assert len(plan.lines) < 45 and "pictures" in plan.lines[plan.lines.index("not modeled") + 1]


def photo_scene(tmp_path, blur_px: float, noise: float) -> PhotoScene:
    """Two gray photographs of 200 × 150 px with a piece in the middle, lit from the left."""
    tables = {"object": {"photos": "p", "sheet": "s"}, "camera": {"photo_px": (200, 150)}, "patch": {}}
    tables["target"] = {"label": "red", "models": ["module:fake_networks.red_against_blue"]}
    piece = lay_out_piece((60, 60), 12, "A" * 10, "design")
    light = PaperLight(np.array([[0.5, -0.2, 0, 0, 0, 0]] * 3), 0.0, noise)
    where = np.array([[1.0, 0, 50], [0, 1, 25], [0, 0, 1]])
    photos = [BasePhoto(str(i), [np.full((150, 200, 3), 90 + i, np.uint8)], where, light, blur_px) for i in range(2)]
    return PhotoScene(validate_model(SceneSettings, tables, "test"), tmp_path, 0, "A" * 10, piece, tuple(photos))


def test_photographs_have_light_blur_and_noise_of_their_own(tmp_path):
    own = ("uneven light on paper", "photographs' own blur", "photographs' own noise")
    errors, _ = errors_of(photo_scene(tmp_path, 1.5, 0.05))
    assert all(errors[name]["codes_mean"] > 0 and errors[name]["verdict"] != "off" for name in own)
    errors, _ = errors_of(photo_scene(tmp_path, 0.0, 0.0))
    assert [errors[name]["verdict"] == "off" for name in own] == [False, True, True]


def test_textures_have_no_markers_and_no_printer(tmp_path):
    path = tmp_path / "scene.toml"
    tables = SCENE.replace('side = "+z"\nwidth_mm = 90\nheight_mm = 90', 'kind = "texture"')
    path.write_text(tables, encoding="utf-8")
    scene = load_scene(path)
    problem = set_problem(scene)
    terms = {term.name for term in scene_terms(problem, problem.subject.start(), None)}
    assert not terms & {"printer's colors", "dot gain"} and "directional light" in terms
    found = resolution_plan(problem)
    assert found["design_px"] is None and found["texels"] == sum(int(mask.sum()) for mask in scene.canvas.mask)
    mean_mm = float(np.mean(scene.draw("select", 1024, 0).pose.distance_mm))
    focal_px = 48 / math.tan(math.radians(25))
    assert found["px_per_mm_network"][0] < focal_px / mean_mm < found["px_per_mm_network"][1]


def test_the_parts_of_a_step_add_up(tmp_path):
    problem = set_problem(scene_with(tmp_path))
    cost = measure_cost(problem, problem.subject.start())
    assert sum(cost["parts"].values()) == pytest.approx(cost["ms"]) and min(cost["parts"].values()) >= 0


def test_geometry_is_said_before_anything_is_measured(scene_file, monkeypatch, capsys):
    def measured(*arguments, **options):
        raise Refused("a plan", "an end", "look at what was said before")

    monkeypatch.setattr("patchproof.app.plan.plan.measured_lines", measured)
    monkeypatch.setattr(sys, "argv", ["patchproof", "plan", str(scene_file)])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    said = capsys.readouterr()
    assert stop.value.code == 1 and "look at what was said before" in said.err
    heads = [line for line in said.out.splitlines() if not line.startswith("  ")]
    assert [head.partition(":")[0] for head in heads] == ["scene.toml", "surface", "resolution", "markers"]
