"""`place = "auto"`: where pieces can lie, which place is chosen, and that a run keeps it."""

from __future__ import annotations

import functools
import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from fake_networks import Bright
from matplotlib import colormaps
from matplotlib.figure import Figure
from PIL import Image

import patchproof as pp
from patchproof.app.compare import _views_of
from patchproof.app.plan.plan import plan_geometry
from patchproof.base.errors import Refused
from patchproof.base.intervals import student_mean
from patchproof.base.settings import SceneSettings
from patchproof.base.validation import validate_model
from patchproof.classifier.load import load_classifier
from patchproof.optimizer import place_files, place_search, run
from patchproof.optimizer.place_files import read_place, save_place
from patchproof.optimizer.place_search import choose_place, place_lines
from patchproof.scene.candidate_places import MIN_DISTANCE_SHARE, PlaceFinder
from patchproof.scene.interface import Scene, require_piece
from patchproof.scene.patch_scene import require_patch
from patchproof.scene.placement import WARN_OVERHANG_SHARE

PLATE = (300, 300, 20)  # mm: its front fills the pictures
STRAIGHT = {"azimuth_deg": [-5, 5], "elevation_deg": [-5, 5], "distance_mm": [300, 330], "look_at_jitter": 0}
SETTINGS = {
    "object": {"mesh": "python:plate", "length_mm": 300, "up": "y"},
    "patch": {"place": "auto", "side": "+z", "width_mm": 60, "height_mm": 60},
    "target": {"label": "bright", "models": ["module:fake_networks.bright"]},
    "view": STRAIGHT,
    "background": {"color": [0.5, 0.5, 0.5]},
    "camera": {"photo_px": [64, 64]},
    "optimize": {"steps": 1, "views": 2, "gamut": 0.0},
}
SHARP = {"camera__photo_px": [1600, 1200]}  # photographs in which small markers are read: a piece hardly larger


def open_scene(base=".", mesh=None, seed=0, **changes):
    """A plate in front of the camera, or another mesh; `table__key` changes a setting."""
    data = {key: dict(value) for key, value in SETTINGS.items()}
    for key, value in changes.items():
        table, name = key.split("__")
        data.setdefault(table, {})[name] = value
    mesh = trimesh.creation.box(PLATE) if mesh is None else mesh
    return pp.make_scene(data, mesh, base, seed)


@pytest.fixture(autouse=True)
def few_views_for_the_size_of_markers_and_few_points(monkeypatch):
    monkeypatch.setattr("patchproof.scene.patch_scene.SCALE_VIEWS", 32)
    monkeypatch.setattr("patchproof.scene.candidate_places._POOL", 32)


@pytest.fixture
def a_small_run(monkeypatch, a_small_search):
    """Such a search, and a promise and pictures to match."""
    monkeypatch.setattr(run, "PROMISE_VIEWS", 8)
    monkeypatch.setattr(place_files, "_SIDE_PX", 64)


class Counted(Bright):
    """Counts pictures on their way through, and gradients on their way back."""

    def __init__(self):
        super().__init__()
        self.passes = 0

    def forward(self, photos):
        self.passes += len(photos)
        if photos.requires_grad:
            photos.register_hook(lambda gradient: self.count(len(gradient)))
        return super().forward(photos)

    def count(self, number):
        self.passes += number


@functools.cache
def searched():
    """The place that a search of a third of the default one's passes chooses, and those of its network in it."""
    network = Counted()
    classifier = pp.classifier_of(network, 32, ["bright", "dark"], "python:bright")
    network.passes = 0
    load_classifier(classifier, Path())
    doubting, network.passes = network.passes, 0  # whether the network can be trusted is asked first
    with pytest.MonkeyPatch.context() as patch:
        for name, count in (("MAX_PASSES", 200), ("SCREENED_PLACES", 12), ("TURNED_PLACES", 2), ("HELD_OUT_VIEWS", 8)):
            patch.setattr(place_search, name, count)
        place = choose_place(open_scene(), models=[classifier])
    return place, network.passes - doubting


def test_the_place_is_where_the_network_looks():
    """It looks at the picture's upper left quarter alone; as one faces +z, left is -x."""
    place, _ = searched()
    x, y, z = place.at
    assert x < -30 and y > 30 and z == 10 and place.front == "+z"
    assert place.candidates[0].at == place.at and place.candidates[0].draft is not None
    gains = [candidate.draft for candidate in place.candidates if candidate.draft is not None]
    assert gains == sorted(gains) and gains[0] < -0.1


def test_another_side_is_chosen_where_the_views_show_it_better(monkeypatch):
    for name, count in (("MAX_PASSES", 120), ("SCREENED_PLACES", 8), ("TURNED_PLACES", 1), ("HELD_OUT_VIEWS", 8)):
        monkeypatch.setattr(place_search, name, count)
    scene = open_scene(mesh=trimesh.creation.box((300, 300, 300)), view__azimuth_deg=[65, 75])
    assert choose_place(scene).at[0] == 150  # azimuth 90 faces +x where 0 faces +z


def test_places_fit_are_apart_the_same_for_the_same_seed_and_no_farther_off_than_asked(monkeypatch):
    monkeypatch.setattr("patchproof.scene.candidate_places._SAMPLE_DISTANCE_SHARE", 1 / 8)
    ball, small = trimesh.creation.icosphere(3, 150), SHARP | {"patch__width_mm": 30, "patch__height_mm": 30}
    scene = open_scene(mesh=ball, **small)
    spots = PlaceFinder(scene).candidates(12)
    assert 3 < len(spots) <= 12
    for spot in spots:
        assert spot.placement.overhang_share <= WARN_OVERHANG_SHARE and not spot.placement.warnings
    middles = np.array([spot.placement.center_mm for spot in spots])
    distances = np.linalg.norm(middles[:, None] - middles, axis=2) + 1e9 * np.eye(len(spots))
    assert distances.min() > MIN_DISTANCE_SHARE * 30 / 2
    assert [spot.at for spot in PlaceFinder(scene).candidates(12)] == [spot.at for spot in spots]
    other = PlaceFinder(open_scene(mesh=ball, seed=1, **small)).candidates(12)
    assert [spot.at for spot in other] != [spot.at for spot in spots]
    with pytest.raises(
        Refused, match=r"a place for a piece of .* that views face, got \d+ places at which it does not"
    ):
        PlaceFinder(open_scene(mesh=ball, **SHARP, patch__width_mm=280, patch__height_mm=280)).candidates(12)


def test_a_piece_that_fits_only_in_one_spot_finds_it():
    """A face hardly larger than the piece: points elsewhere on it move to where the piece does not overhang."""
    size = PlaceFinder(open_scene(**SHARP)).size_mm
    ground = PlaceFinder(open_scene(mesh=trimesh.creation.box((size[0] + 4, size[1] + 4, 300)), **SHARP))
    frames, spins = ground._frames_to_try, ground._spins[:2]
    moved = [ground._candidate_near(frame, spin) for frame in frames for spin in spins]  # not middles of sides
    assert [spot for spot in moved if spot is not None and np.abs(spot.at[:2]).max() < 4]


def test_views_do_not_turn_with_the_place():
    around = {"azimuth_deg": [-60, 60], "elevation_deg": [0, 60], "distance_mm": [600, 700]}
    box = trimesh.creation.box((300, 300, 300))
    scene = open_scene(mesh=box, **SHARP, **{f"view__{key}": value for key, value in around.items()})
    conditions = scene.draw("train", 4)
    poses = scene.camera_from_world(conditions)
    for at_mm in ((150, 0, 0), (0, 150, 0), (20, 30, 150)):
        hung = scene.with_piece_at(at_mm, 45)
        np.testing.assert_array_equal(hung.camera_from_world(conditions), poses)
        np.testing.assert_array_equal(hung.frame.normal, [0, 0, 1])  # lights count from here, too
        assert hung.settings.patch.place == "given" and hung.settings.view.front == "+z"
    np.testing.assert_allclose(scene.with_piece_at((150, 0, 0), 0).placement.normal, [1, 0, 0], atol=1e-12)


def test_with_front_left_out_views_face_the_patch_as_before():
    settings = SETTINGS | {"patch": {"at_mm": (100, 0, 0), "width_mm": 60, "height_mm": 60}}
    scene = pp.make_scene(settings, trimesh.creation.box((200, 200, 200)))
    np.testing.assert_allclose(scene.frame.normal, [1, 0, 0], atol=1e-12)


def test_the_search_counts_its_passes_and_keeps_to_a_quarter_of_a_run():
    place, passes = searched()
    assert place.passes == passes
    assert 200 - 3 * 2 * place_search.DRAFT_VIEWS < place.passes <= 200
    screens = (
        place_search.SCREENED_PLACES + 3 * place_search.TURNED_PLACES
    ) * 2 * place_search.SCREEN_VIEWS + place_search.SCREEN_VIEWS
    drafts = (
        place_search.DRAFTED_PLACES * (18 * 2 * place_search.DRAFT_VIEWS + place_search.HELD_OUT_VIEWS)
        + place_search.HELD_OUT_VIEWS
    )
    default_run = 240 * 4 * 2 + 4 * 64 + 200 + 4 * 100  # training views, also back; selections; a promise cut short
    assert screens + drafts <= place_search.MAX_PASSES <= default_run / 4


def test_a_single_place_needs_no_runner_up(monkeypatch, a_small_search):
    monkeypatch.setattr(place_search, "SCREENED_PLACES", 1)
    monkeypatch.setattr(place_search, "TURNED_PLACES", 0)
    place = choose_place(open_scene())
    assert place.lead is None and len(place.candidates) == 1
    assert "the only place" in place_lines(place)[1]


def test_how_sure_the_choice_is_follows_from_the_paired_interval(monkeypatch, a_small_search):
    place = choose_place(open_scene())
    for differences, word in (([0.5, 0.6, 0.7, 0.6], "surely"), ([0.5, -0.6, 0.7, -0.4], "not surely")):
        line = place_lines(place.changed(lead=student_mean(differences)))[1]
        assert line.startswith(f"{word} better than the next: loss lower by {np.mean(differences):.2f} [")


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"patch__kind": "texture"}, 'takes place = "auto" with kind = "patch" only'),
        ({"patch__at_mm": [0, 0, 1]}, 'takes at_mm, offset_mm and spin_deg with place = "given" only'),
        ({"patch__spin_deg": 5}, 'takes at_mm, offset_mm and spin_deg with place = "given" only'),
        ({"view__look_at": "patch"}, "views then refer to patch.side"),
        ({"view__front": "+x"}, "views then refer to patch.side"),
        ({"object__mesh": None, "object__length_mm": None, "object__photos": "p", "object__sheet": "s"}, "only a mesh"),
        ({"patch__width_mm": 400}, "."),
    ],
)
def test_what_cannot_be_searched_is_refused_in_one_sentence(changes, sentence):
    with pytest.raises(Refused) as refused:
        choose_place(open_scene(**changes))
    assert sentence in str(refused.value) and "\n" not in str(refused.value)


def test_a_scene_without_a_place_says_so_and_one_with_it_needs_no_search():
    scene = open_scene()
    for needs in (require_piece, require_patch, Scene.object_canvas):
        with pytest.raises(Refused, match=r'Expected a scene whose piece has a place, got patch.place = "auto"'):
            needs(scene)
    with pytest.raises(Refused, match=r'Expected a scene with patch.place = "auto", got a mesh of 12 faces'):
        choose_place(scene.with_piece_at((0, 0, 10), 0))


def scene_file(folder, **patch):
    """A scene in a file, with the plate as a PLY beside it."""
    trimesh.creation.box(PLATE).export(folder / "plate.ply")
    data = {key: dict(value) for key, value in SETTINGS.items()}
    data["object"]["mesh"], data["patch"] = "plate.ply", data["patch"] | patch
    lines = []
    for table, values in data.items():
        lines += [f"[{table}]", *(f"{name} = {json.dumps(value)}" for name, value in values.items())]
    (folder / "scene.toml").write_text("\n".join(lines), encoding="utf-8")
    return folder / "scene.toml"


def no_search(*_, **__):
    raise AssertionError("searched again")


def test_a_run_keeps_its_place_and_neither_loads_nor_resumes_by_searching(tmp_path, monkeypatch, a_small_run):
    path, out = scene_file(tmp_path), tmp_path / "run"
    first = pp.optimize(path, out)
    place = read_place(out)
    assert first.scene.settings.patch.at_mm == place.at and (out / "place.png").stat().st_size > 500
    monkeypatch.setattr(place_search, "choose_place", no_search)
    loaded = pp.load_run(out)
    np.testing.assert_array_equal(loaded.scene.placement.world_from_piece, first.scene.placement.world_from_piece)
    details = json.loads((out / "run.json").read_text())
    again = pp.make_scene(validate_model(SceneSettings, details["settings"], "run"), base=tmp_path)
    assert loaded.scene.sheet_id == first.scene.sheet_id == again.sheet_id, "its settings are a scene with that place"
    monkeypatch.setattr(place_files, "_draw", lambda *_: Figure())
    design = (out / "design.png").read_bytes()
    (out / "run.json").unlink()
    again = pp.optimize(path, out, resume=True)
    assert again.scene.sheet_id == first.scene.sheet_id and (out / "design.png").read_bytes() == design
    with pytest.raises(Refused, match="Expected the place of this scene and seed, got a place of sheet"):
        pp.optimize(scene_file(tmp_path, width_mm=50), out, resume=True)
    (out / "place.json").write_text("{")
    with pytest.raises(Refused, match="Expected the record of a search"):
        pp.optimize(scene_file(tmp_path), out, resume=True)


def test_the_picture_shows_the_places_and_the_chosen_outline(tmp_path, monkeypatch):
    monkeypatch.setattr(place_files, "_SIDE_PX", 128)
    scene = open_scene()
    spots = PlaceFinder(scene).candidates(3)
    candidates = tuple(place_search.Candidate(at=spot.at, spin_deg=0, gray=0, outlook=0) for spot in spots)
    place = place_search.Place(
        sheet_id=scene.sheet_id,
        front="+z",
        at=spots[0].at,
        spin_deg=0,
        lead=None,
        passes=0,
        candidates=candidates,
    )
    save_place(place, scene.with_piece_at(place.at, 0), tmp_path)
    assert read_place(tmp_path, scene) == place
    shown = {color for _, color in Image.open(tmp_path / "place.png").convert("RGB").getcolors(1 << 20)}
    ranks = np.rint(255 * colormaps["viridis_r"]([0.0, 0.5, 1.0]))[:, :3].astype(int).tolist()
    assert {*map(tuple, ranks), (230, 0, 90)} <= shown


def test_plan_reports_the_search(tmp_path, a_small_run):
    problem, lines = plan_geometry(scene_file(tmp_path))
    place = problem.scene.settings.patch
    assert f"chosen: at_mm = [{place.at_mm[0]:g}" in lines[lines.index("place") + 1]
    assert lines[lines.index("surface") + 1].startswith("  card")


def test_the_middle_of_a_side_keeps_to_the_limits_of_other_places():
    """A step of 40 mm goes through the middle of the front: a card there would stand off by as much."""
    step = trimesh.util.concatenate([trimesh.creation.box((150, 300, 20)), trimesh.creation.box((150, 300, 100))])
    step.vertices[:8, 0] -= 75
    step.vertices[8:, 0] += 75
    spots = PlaceFinder(open_scene(mesh=step)).candidates(8)
    assert spots and all(spot.placement.gap_mm <= 0.15 * 60 for spot in spots)


def test_a_searched_place_and_the_default_side_have_the_same_views():
    scene = open_scene()
    default = scene.settings.changed(patch={"place": "given"})
    side = pp.make_scene(default, trimesh.creation.box(PLATE), ".", 0)
    assert _views_of(scene.with_piece_at((0.0, 20.0, 10.0), 0.0), True) == _views_of(side, True)


def test_middles_of_sides_that_views_face_are_places_where_the_piece_fits():
    scene = open_scene()
    spots = PlaceFinder(scene).candidates(12)
    named = [spot for spot in spots if isinstance(spot.at, str)]
    assert spots[: len(named)] == tuple(named) and scene.settings.patch.side in [spot.at for spot in named]
    hung = scene.with_piece_at(named[0].at, 0.0)
    assert hung.settings.patch.side == named[0].at and hung.settings.view.front == scene.settings.patch.side
    np.testing.assert_allclose(hung.placement.center_mm, named[0].placement.center_mm)
