"""Studies of patches: the same terms for both worlds, whose images are whose, and tables checked by hand."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from patchlab.paper import patch2d, patch3d
from patchlab.paper.image_classes import ImageClass, class_scene, list_classes, scene_settings, write_renders
from patchlab.study.estimates import cluster_mean, clustered_mean
from patchlab.study.grid import scene_values
from patchlab.study.record import hits_text
from patchlab.study.study import Cell, Result, run_study
from patchproof.base.errors import Refused
from patchproof.base.geometry import local_scale
from patchproof.base.intervals import MIN_CLUSTERS
from patchproof.base.validation import read_toml, validate_model
from patchproof.optimizer import loop
from patchproof.optimizer.problem import set_problem
from patchproof.scene.scene import load_scene


@pytest.fixture
def short_loop(monkeypatch):
    """Fewer selection views: these tests are about what surrounds the loop."""
    monkeypatch.setattr(loop, "SELECT_VIEWS", 8)


def pixels_of(path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image)


def test_the_cluster_interval_is_that_of_the_mean_and_repeats():
    values = np.random.default_rng(3).normal(0.2, 0.1, 400)
    mean, (low, high) = clustered_mean(values)
    half = 1.96 * values.std() / 20  # of the mean of 400
    assert mean == pytest.approx(values.mean()) and (low, high) == pytest.approx((mean - half, mean + half), abs=1e-3)
    assert clustered_mean(values) == clustered_mean(values)


def test_few_clusters_have_no_interval():
    values = [0.1] * MIN_CLUSTERS
    assert cluster_mean(values).low == pytest.approx(0.1) and cluster_mean(values).n == MIN_CLUSTERS
    assert cluster_mean(values[1:]) == pytest.approx(0.1) and cluster_mean([]) is None
    with pytest.raises(ValueError, match="at least 5 clusters, got 4"):
        clustered_mean(values[1:])


def test_patches_3d_and_2d_on_the_same_terms(scene_file, short_loop, tmp_path):
    config = tmp_path / "study.toml"
    config.write_text('scenes = ["scene.toml"]\nseeds = [0]\nn = 12\nrenders = 8\n')
    finished = run_study("patch3d", config, tmp_path / "out")
    assert not finished.failed
    found = finished.results[0].answers
    assert found["passes"] == {"3d": 3 * 4 + 8, "2d": 3 * 4 + 8}
    assert all(len(found["hits"][kind][0]) == len(found["confidence"][kind][0]) == 12 for kind in patch3d.KINDS)
    sizes = [pixels_of(tmp_path / "out/files" / f"scene.builtin.0-{kind}.png").shape for kind in ("2d", "3d")]
    assert sizes[0] == sizes[1] and sizes[0][0] >= 180  # 90 mm at 2 pixels per mm
    rows = list(csv.reader((tmp_path / "out/patch3d_views.csv").read_text().splitlines()))
    assert [row[1] for row in rows] == ["view", "left", "middle", "right"]
    assert sum(int(row[rows[0].index("3d_n")]) for row in rows[1:]) == 12


def test_the_flat_twin_is_as_large_in_its_pictures_as_the_patch_in_its_views(scene_file, tmp_path):
    settings = patch3d.Patch3dSettings(scenes=("scene.toml",), renders=2, n=1)
    problem = set_problem(load_scene(scene_file))
    twin = patch3d.flat_twin(problem, settings, tmp_path)
    sizes = []
    for scene in (problem.scene, twin.scene):
        matrices = scene.piece_homographies(scene.draw("select", 64), (96, 96))
        middle = np.array(scene.piece.size_mm) / 2
        sizes.append([local_scale(one, middle)[0] * 90 for one in matrices])
    assert min(sizes[1]) >= min(sizes[0]) * 0.98 and max(sizes[1]) <= max(sizes[0]) * 1.02
    assert np.median(sizes[1]) == pytest.approx(np.median(sizes[0]), rel=0.1)
    assert twin.subject.design_px == problem.subject.design_px and twin.printer is problem.printer
    kept = ("camera", "printer", "optimize", "target", "light")
    assert all(getattr(twin.scene.settings, key) == getattr(problem.scene.settings, key) for key in kept)


def test_a_patch_too_large_for_turned_pictures_is_shown_at_the_largest_size_that_fits(scene_file):
    wide = (-180.0, 180.0)
    near = scene_file.read_text().replace("[500, 900]", "[240, 300]").replace("_mm = 90", "_mm = 115")
    scene_file.write_text(near)
    scene, settings = load_scene(scene_file), patch3d.Patch3dSettings(scenes=("scene.toml",), roll_deg=wide)
    share = patch3d.flat_settings(scene, settings).view.patch_share
    assert share[1] < np.quantile(patch3d.design_shares(scene), 0.95)
    # a square turned by 45 degrees
    assert share[1] == pytest.approx(1 / 2**0.5, abs=1e-3) and share[0] <= share[1]


def test_renders_show_the_bare_object_and_never_an_evaluated_view(scene_file, tmp_path):
    problem = set_problem(load_scene(scene_file))
    names = write_renders(problem.stage, 3, 64, tmp_path)
    pictures = [pixels_of(tmp_path / name) for name in names]
    assert len(set(names)) == 3 and all(one.shape == (64, 64, 3) for one in pictures)
    assert not np.array_equal(pictures[0], pictures[1])
    drawn = {stream: problem.scene.draw(stream, 64).pose.azimuth_deg for stream in ("train", "evaluate")}
    assert not np.isin(drawn["evaluate"], drawn["train"]).any()
    # the camera's exposure is not in them: the plain background keeps its color
    assert (pictures[0][0, 0] == 128).all()


def result3d(scene, model, seed, **kinds):
    """A result whose kinds were recognized in so many of four conditions."""
    hits = {kind: [hits_text(i < kinds.get(kind, 0) for i in range(4))] for kind in patch3d.KINDS}
    record = {"hits": hits, "confidence": {kind: [[0.5] * 4] for kind in patch3d.KINDS}}
    answers = {
        **record,
        "in_images": record,
        "three": {
            "hits": {kind: ["110" if kind == "3d" else "100"] for kind in patch3d.KINDS},
            "confidence": {kind: [[0.9, 0.5, 0.1]] for kind in patch3d.KINDS},
        },
        "azimuth_deg": [-30.0, -5.0, 5.0, 30.0],
        "azimuth_range_deg": (-45.0, 45.0),
        "passes": {"3d": 1, "2d": 1},
    }
    values = {"name": scene, "networks": [model], "network": model, "seed": seed}
    return Result(Cell(f"{scene}-{model}-{seed}", values), answers, Path())


def test_clusters_are_objects_before_networks_and_hard_ones_are_told_apart():
    easy = [result3d("a.toml", f"m{m}", s, **{"bare": 3, "2d": 3, "3d": 4}) for m in range(5) for s in (0, 1)]
    hard = [result3d("b.toml", f"m{m}", s, **{"bare": 0, "2d": 1, "3d": 3}) for m in range(5) for s in (0, 1)]
    pooled, meshes, views, three, _, cells = patch3d.tables(patch3d.Patch3dSettings(scenes=("a.toml",)), easy + hard)
    label, whole, misread = pooled.rows[0]
    assert label == "3d minus 2d" and whole.n == 10 and misread.n == 5
    assert whole.value == pytest.approx((0.25 + 0.5) / 2) and misread.value == pytest.approx(0.5)
    assert whole.low < whole.value < whole.high and misread.low == pytest.approx(misread.high)
    assert [row[-1].value for row in meshes.rows] == pytest.approx([0.25, 0.5])
    assert meshes.rows[1][1].n == 40 and len(cells.rows) == 20
    # only the first condition, at -30 degrees, lies in the left third: recognized in both worlds
    left = next(row for row in views.rows if row[:2] == ("m0", "left"))
    assert left[-1].value == pytest.approx(0) and left[-1].n == 4
    assert sum(row[-1].n for row in views.rows) == 80
    rows = {row[:3]: row[3:] for row in three.rows}
    assert rows["a.toml", "m0", "3d"][:7] == (2, 2, 2, 0, 0.9, 0.5, pytest.approx(0.1))
    assert rows["a.toml", "m0", "2d"][-1].value == pytest.approx(1 / 3) and len(rows) == 30


def test_views_may_be_named():
    settings = patch3d.Patch3dSettings(scenes=("a.toml",), views={"front": (-10, 10)})
    views = patch3d.tables(settings, [result3d("a.toml", "m", 0, **{"3d": 4, "2d": 1})])[2]
    (row,) = views.rows
    assert row[1] == "front" and row[-1].n == 2 and row[-1].value == 1  # the conditions at -5 and 5: 2D has neither


@pytest.mark.parametrize(
    ("scene", "match"),
    [('kind = "texture"', "a mesh and a printed patch, got scene.toml"), ("width_mm = 90\nheight_mm = 90", None)],
)
def test_only_printed_patches_on_meshes_are_compared(scene_file, scene, match):
    text = scene_file.read_text().replace("width_mm = 90\nheight_mm = 90", scene)
    scene_file.write_text(text)
    settings = patch3d.Patch3dSettings(scenes=("scene.toml",))
    if match is None:
        assert [one.name for one in patch3d.cells(settings, scene_file.parent)] == [
            f"scene.builtin.{seed}" for seed in (0, 1, 2)
        ]
        return
    with pytest.raises(Refused, match=match):
        patch3d.cells(settings, scene_file.parent)


def two_classes(tmp_path, scene_file, more=""):
    """A config of photographs labeled "mug" and "12", and renders of the scene's carton."""
    folder = tmp_path / "images"
    folder.mkdir()
    for i in range(4):
        Image.new("RGB", (80, 60), (60 * i, 90, 30)).save(folder / f"{i}.png")
    (folder / "labels.csv").write_text("file,label\n0.png,mug\n1.png,mug\n2.png,2\n9.png,gone\n")
    config = tmp_path / "study.toml"
    config.write_text(
        'images = "images"\nlabels = "images/labels.csv"\nrenders = ["scene.toml"]\nrenders_each = 8\n'
        'networks = ["builtin"]\nn = 8\nshown_px = 20\n' + more + "\n[optimize]\nsteps = 1\nviews = 2\n"
    )
    return config


def test_gain_and_harm_of_a_2d_patch(scene_file, short_loop, tmp_path):
    config = two_classes(tmp_path, scene_file, 'targets = ["carton"]\nunrestricted = true')
    finished = run_study("patch2d", config, tmp_path / "out")
    assert not finished.failed
    pooled, gain, harm = finished.tables
    assert gain.rows[0][:4] == ("carton (renders)", "builtin", 8, True) and gain.rows[0][4].n == 8
    assert [row[2] for row in harm.rows] == ["mug", "traffic cone"]  # every other class, and the target is none of them
    called = finished.results[0].answers["classes"][2]
    assert called["same"] and all(own == target for own, target in called["hits"].values())
    assert isinstance(pooled.rows[0][1], float)  # one cluster: no interval
    assert pooled.head[-1] == "patch minus unrestricted" and called["hits"].keys() == {*patch2d.KINDS, "unrestricted"}


def test_classes_are_those_of_the_table_that_have_images_and_of_the_scenes(scene_file, tmp_path):
    config = two_classes(tmp_path, scene_file)
    settings = validate_model(patch2d.Patch2dSettings, read_toml(config), "study.toml")
    renders = [scene_values(file, tmp_path) for file in settings.renders]
    classes = list_classes(settings.images, settings.labels, renders, tmp_path)
    assert [one.label for one in classes] == ["mug", 2, "carton"]
    assert [cell.values["target"] for cell in patch2d.cells(settings, tmp_path)] == ["mug", 2, "carton"]
    with pytest.raises(Refused, match='"cartoon": did you mean "carton"'):
        patch2d.cells(settings.changed(targets=("cartoon",)), tmp_path)
    before = patch2d.cells(settings, tmp_path)
    scene_file.write_text(scene_file.read_text().replace("[500, 900]", "[500, 800]"))
    after = patch2d.cells(settings, tmp_path)
    assert before[0].name == after[0].name and before[0].values != after[0].values  # a changed scene is done again


def test_a_2d_patch_has_its_size_in_the_networks_pixels_and_no_frame(scene_file, tmp_path):
    config = two_classes(tmp_path, scene_file)
    settings = validate_model(patch2d.Patch2dSettings, read_toml(config), "study.toml")
    (tmp_path / "work").mkdir()
    classifier = patch2d.cached_network("builtin", tmp_path)
    one = ImageClass("mug")
    scene = class_scene(settings, tmp_path, one, classifier, 0, tmp_path / "work")
    side = classifier.input_px
    widths = [
        local_scale(matrix, np.array([30.0, 30.0]))[0] * 60
        for matrix in scene.piece_homographies(scene.draw("evaluate", 200), (side, side))
    ]
    assert min(widths) >= 16 - 1e-6 and max(widths) <= 25 + 1e-6  # 20 times 0.8 to 1.25
    assert np.median(widths) == pytest.approx(20, rel=0.05)
    problem = patch2d.flat_problem(settings, tmp_path, scene, classifier, one)
    shown = patch2d.pasted_by_kind(problem, problem.subject.pixels(torch.full((3, 60, 60), 0.25)))
    assert shown["patch"].srgb.shape == shown["gray"].srgb.shape == (120, 120, 3)  # printed pixels, and no frame
    largest = replace(classifier, input_px=30)
    with pytest.raises(Refused, match="pixels before a network of 30"):
        scene_settings(settings, one, largest, "images", "images/labels.csv")


def test_images_or_renders_are_asked_for(tmp_path):
    for text, match in (("", "takes images and labels, or renders"), ('images = "a"\n', "images and labels together")):
        (tmp_path / "study.toml").write_text(text + 'networks = ["builtin"]\n')
        with pytest.raises(Refused, match=match):
            run_study("patch2d", tmp_path / "study.toml", tmp_path / "out")
