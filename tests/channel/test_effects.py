"""The table of effects: draws that never move, and no effect forgotten in a record, the settings, plan or ablation."""

from __future__ import annotations

import hashlib
from dataclasses import fields

import numpy as np
import pytest
import torch
from tolerances import BY_TABLE, FLOAT32
from torch.utils._python_dispatch import TorchDispatchMode

from patchlab.validation import ablation
from patchproof.app.plan.errors import PRINTER, Setup, scene_terms
from patchproof.base.settings import CameraSettings, LightSettings, PrinterSettings
from patchproof.channel.effects import (
    EFFECT_BY_NAME,
    EFFECTS,
    FIELDS,
    RECORD_OF,
    RECORDS,
    Light,
    Pose,
    Sensor,
    ViewEffect,
)
from patchproof.optimizer.problem import set_problem
from patchproof.render import photograph
from patchproof.render.photograph import affected_windows, expose
from patchproof.render.views import render_views
from patchproof.scene.conditions import (
    Conditions,
    conditions_from_fields,
    draw,
    fields_of,
    sample_fields,
    without_effect,
)
from test_conditions import EVERYTHING, STREAMS
from test_optimize import scene_with

# Of the fields below in rows 0 to 39 of seed 3, as they were drawn when one function sampled all of them in order.
DIGESTS = {
    "train": "f9bec02f97978c8a",
    "select": "90b23a191db63d0a",
    "promise": "307e9b39852505e2",
    "reprint": "be0eb8781b6bf200",
    "evaluate": "58eb0640fa29260f",
}
SWITCHED = [effect for effect in EFFECTS if effect.can_be_off]
# Those without which a step takes fewer operations.
SLOWS = {"mottle", "motion blur", "blur", "noise", "JPEG"}
MADE_UP = ViewEffect("smell", {"smell": "light.ambient", "sweetness": (0.0, 1.0)})
# Settings of light, print and camera that are no ranges of an effect.
NO_RANGES = {"printer.profile", "camera.photo_px", "camera.file"}


def digest(values) -> str:
    """Rounded, since the last digits of a cosine differ between processors."""
    every = [(name, np.round(values[name].astype(float), 9) + 0.0) for name in sorted(values)]
    return hashlib.sha256(b"".join(name.encode() + array.tobytes() for name, array in every)).hexdigest()[:16]


@pytest.mark.parametrize("stream", STREAMS)
def test_draws_are_those_of_all_runs_before(stream):
    drawn = fields_of(draw(EVERYTHING, stream, 40, 3))
    assert digest({name: drawn[name] for e in EFFECTS if e.first is not None for name in e.fields}) == DIGESTS[stream]


@pytest.mark.parametrize("stream", STREAMS)
@pytest.mark.parametrize("place", [0, len(EFFECTS) // 2, len(EFFECTS)])
def test_an_effect_more_moves_no_other_draw(stream, place):
    before = sample_fields(EFFECTS, EVERYTHING, stream, 20, 5, 3)
    after = sample_fields((*EFFECTS[:place], MADE_UP, *EFFECTS[place:]), EVERYTHING, stream, 20, 5, 3)
    low, high = EVERYTHING.light.ambient
    smell, sweetness = after.pop("smell"), after.pop("sweetness")
    assert (low <= smell).all() and (smell <= high).all() and np.ptp(smell) > 0.5 * (high - low)
    assert np.ptp(sweetness) > 0.5 and abs(np.corrcoef(smell, sweetness)[0, 1]) < 0.8
    assert list(after) == list(before) and all(after[name].tobytes() == before[name].tobytes() for name in before)


def test_a_new_effects_draws_depend_on_index_stream_seed_and_name_alone():
    def smell(name="smell", stream="train", seed=5, start=0):
        effect = ViewEffect(name, MADE_UP.columns)
        return sample_fields([effect], EVERYTHING, stream, 20 - start, seed, start)["smell"]

    np.testing.assert_array_equal(smell(start=7), smell()[7:])
    for other in (smell("taste"), smell(stream="select"), smell(seed=6)):
        assert not np.isin(other, smell()).any()


def test_every_field_has_one_effect_and_no_two_share_a_column():
    assert sorted(FIELDS) == sorted(RECORD_OF) and len(set(FIELDS)) == len(FIELDS)
    assert set(FIELDS) == {part.name for kind in RECORDS.values() for part in fields(kind)}
    assert len(EFFECT_BY_NAME) == len(EFFECTS) and all(
        len({RECORD_OF[name] for name in e.fields}) == 1 for e in EFFECTS
    )
    taken = [e.first + i for e in EFFECTS if e.first is not None for i in range(len(e.columns))]
    assert len(set(taken)) == len(taken) and max(taken) == 48


def test_every_range_is_read_by_an_effect():
    tables = {"light": LightSettings, "printer": PrinterSettings, "camera": CameraSettings}
    asked = {f"{table}.{name}" for table, settings in tables.items() for name in settings.model_fields}
    read = {key for effect in EFFECTS for key in effect.keys}
    assert asked - read == NO_RANGES and {key for key in read if not key.startswith("view.")} <= asked


@pytest.mark.parametrize(("effect", "key"), [(e, key) for e in EFFECTS for key in e.keys], ids=lambda v: str(v)[:20])
def test_a_range_moves_the_fields_of_its_effect_and_no_others(effect, key):
    table, name = key.split(".")
    value = getattr(getattr(EVERYTHING, table), name)
    other = value / 2 if isinstance(value, float) else (value[0], (value[0] + value[1]) / 2)
    other = tuple(map(int, other)) if key == "camera.jpeg" else other
    changed = EVERYTHING.changed(**{table: {name: other}})
    before, after = (fields_of(draw(settings, "promise", 30, 0)) for settings in (EVERYTHING, changed))
    moved = {field for field in FIELDS if not np.array_equal(before[field], after[field])}
    assert moved, f"give {key} a range in EVERYTHING"
    assert moved <= {field for other in EFFECTS if key in other.keys for field in other.fields}


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    """A scene in which every effect is on and shows."""
    folder = tmp_path_factory.mktemp("scene")
    camera = {"blur_px": [2, 3], "noise": [0.05, 0.1], "motion_px": [5, 6], "photo_px": [160, 120]}
    tables = {"printer": {"scale": [0.9, 0.95], "density": [0.1, 0.2], "mottle": [0.02, 0.04]}, "camera": camera}
    return set_problem(
        scene_with(folder, **{f"{t}__{k}": v for t, values in tables.items() for k, v in values.items()})
    )


@pytest.fixture(scope="module")
def setup(problem):
    return Setup(problem.stage, problem.subject.appearance(problem.subject.start()), problem.scene.draw("select", 4))


@pytest.fixture(scope="module")
def whole(problem, setup):
    """Operations and photographs with every effect; the first time, the scene's own textures are made."""
    photographed(problem, setup.conditions, setup.appearance)
    return photographed(problem, setup.conditions, setup.appearance)


def test_plan_and_ablation_know_every_effect(problem):
    terms = {term.name: term for term in scene_terms(problem, problem.subject.start(), None)}
    assert {effect.name for effect in SWITCHED} <= set(terms)
    assert {term.key for term in terms.values()} >= {effect.keys[0] for effect in SWITCHED}
    left_out = {name for names in ablation.EFFECTS for name in names.split(" + ")}
    assert left_out == {effect.name for effect in SWITCHED} - {"JPEG"} | {PRINTER}
    for effect in SWITCHED:
        assert ablation.simplify_problem(problem, effect.name).changes


@pytest.mark.parametrize("effect", SWITCHED, ids=lambda effect: effect.name)
def test_an_effect_that_is_switched_off_is_off_and_the_rest_of_its_table_stays(problem, setup, whole, effect):
    (term,) = (t for t in scene_terms(problem, problem.subject.start(), None) if t.name == effect.name)
    less = term.change(setup)
    assert less is not None, f"give {term.key} a range in the problem of these tests"
    assert term.change(less) is None
    before, after = fields_of(setup.conditions), fields_of(less.conditions)
    moved = {name for name in FIELDS if not np.array_equal(before[name], after[name])}
    # light that is left out is made up for by other light
    others = {"ambient", "directional"} if effect.replacement else set()
    assert effect.fields[0] in moved <= {effect.fields[0]} | others
    less_count, plain = photographed(problem, less.conditions, setup.appearance)
    # sizes of prints change in how many groups their mottle is looked up
    assert (less_count < whole[0] - 12) == (effect.name in SLOWS) and not torch.equal(whole[1], plain)


def photographed(problem, conditions, shown) -> tuple[int, torch.Tensor]:
    """How many tensor operations whole photographs take, and the photographs."""

    class Counter(TorchDispatchMode):
        count = 0

        def __torch_dispatch__(self, func, types, args=(), kwargs=None):
            Counter.count += 1
            return func(*args, **(kwargs or {}))

    with torch.no_grad(), Counter():
        pictures = expose(render_views(problem.stage, shown, conditions, problem.scene.settings.camera.photo_px), shown)
    return Counter.count, pictures


@pytest.mark.parametrize("effect", SWITCHED, ids=lambda effect: effect.name)
def test_the_short_way_to_small_pictures_knows_every_effect(problem, effect, monkeypatch):
    """Where each pixel is developed alone, only the piece's are developed anew; alone, each effect looks the same."""
    shown = problem.subject.appearance(problem.subject.start())
    conditions = problem.scene.draw("select", 4)
    for other in SWITCHED:
        if other not in (effect, EFFECT_BY_NAME["ambient light"]):
            conditions = without_effect(conditions, other, lambda azimuth_deg, elevation_deg: np.ones(4)) or conditions
    views = render_views(problem.stage, shown, conditions, (96, 96))
    cut = torch.zeros(4 * 96 * 96, dtype=torch.bool)
    cut[views.on_piece.pixel], cut[views.on_piece.back_pixel] = views.on_piece.share[:, 0] < 1 - FLOAT32, True
    cut[views.outlines.pixel] = True
    ways = [expose(views, shown)]
    monkeypatch.setattr(photograph, "is_pointwise", lambda *arguments: False)
    ways.append(expose(views, shown))
    quick, slow = (pictures.permute(0, 2, 3, 1).reshape(-1, 3)[~cut] for pictures in ways)
    torch.testing.assert_close(quick, slow, atol=BY_TABLE, rtol=0)


def test_what_is_not_given_is_off_and_one_row_stands_for_all():
    pose = Pose(distance_mm=np.array([500.0, 600.0, 700.0]))
    conditions = Conditions(pose=pose, light=Light(ambient=np.ones(1)))
    assert len(conditions) == len(conditions.sensor) == 3 and conditions.light.ambient.tolist() == [1, 1, 1]
    assert conditions[1:].pose.distance_mm.tolist() == [600, 700] and len(conditions[[0]]) == 1
    for effect in SWITCHED:
        record = getattr(conditions, RECORD_OF[effect.fields[0]])
        assert (effect.switch_off(record, lambda *angles: np.ones(3)) is None) == (effect.name != "ambient light")
    again = fields_of(conditions_from_fields(fields_of(conditions)))
    assert all(values.tobytes() == again[name].tobytes() for name, values in fields_of(conditions).items())
    with pytest.raises(ValueError, match=r"fields of one record have \[2, 3\] rows"):
        Sensor(noise=np.zeros(2), blur_px=np.zeros(3))


@pytest.mark.parametrize("effect", SWITCHED, ids=lambda effect: effect.name)
def test_windows_hold_all_that_a_design_changes(problem, effect):
    """Outside of them pictures are the same to the bit, whatever hangs there; they are no larger than it takes."""
    conditions = problem.scene.draw("select", 6)
    for other in SWITCHED:
        if other not in (effect, EFFECT_BY_NAME["ambient light"]):
            conditions = without_effect(conditions, other, lambda azimuth_deg, elevation_deg: np.ones(6)) or conditions
    designs = [torch.full_like(problem.subject.start(), value) for value in (0.0, 1.0)]
    black, white = (problem.subject.appearance(design) for design in designs)
    views = render_views(problem.stage, black, conditions, (96, 96))
    windows = affected_windows(views)
    if effect.name == "JPEG":
        assert windows is None
        return
    changed = (expose(views, black) != expose(views, white)).any(1)
    for picture, (left, top, right, bottom) in zip(changed, windows.tolist(), strict=True):
        rows, columns = (picture.any(axis).nonzero()[:, 0] for axis in (1, 0))
        for found, first, end in ((rows, top, bottom), (columns, left, right)):
            margins = int(found.min()) - first, end - 1 - int(found.max())
            assert 0 <= min(margins) and max(margins) <= (12 if effect.name == "motion blur" else 8), margins
