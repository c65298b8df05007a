"""The object's own texture optimized: what may change, what stays to the bit, and files that open elsewhere."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from console import command
from PIL import Image

from patchproof.mesh.load_mesh import write_glb
from patchproof.mesh.mesh import Material, MeshPart, mesh_from_parts
from patchproof.optimizer import loop, run
from patchproof.optimizer.evaluate import evaluate as evaluate_run
from patchproof.optimizer.problem import set_problem
from patchproof.optimizer.promise import PromiseOptions
from patchproof.optimizer.run import load_run
from patchproof.optimizer.run import optimize as optimize_scene
from patchproof.optimizer.subject import from_pixels
from patchproof.render.photograph import photograph
from patchproof.render.stage import set_stage
from patchproof.scene.conditions import with_values
from patchproof.scene.scene import load_scene
from patchproof.scene.texture_scene import texture_canvas

SCENE = """
[object]
mesh = "MESH"
length_mm = 300
up = "y"
[patch]
side = "+z"
PATCH
[target]
label = "carton"
models = ["builtin"]
[view]
azimuth_deg = [-40, 40]
elevation_deg = [0, 25]
distance_mm = [600, 800]
[background]
color = [0.5, 0.5, 0.5]
[camera]
photo_px = [64, 64]
[optimize]
steps = 4
views = 2
"""
PATCHES = {
    "texture": 'kind = "texture"\nepsilon = 0.1',
    "masked": 'kind = "masked"\nstart = "gray"\nmaterials = ["paint"]',
    "image": 'kind = "masked"\nmask = "half.png"',
}
BESIDE_BARE = PromiseOptions(controls=("bare",))  # where controls are not the point


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """A promise of few views, where its rate does not matter, and a checkpoint every other step."""
    monkeypatch.setattr(run, "PROMISE_VIEWS", 8)
    monkeypatch.setattr(loop, "SELECT_AFTER", 4)
    monkeypatch.setattr(loop, "SELECT_VIEWS", 4)


def textures():
    """Of "paint" and "trim"."""
    rng = np.random.default_rng(0)
    return rng.integers(60, 200, (32, 32, 3), np.uint8), rng.integers(60, 200, (16, 24, 3), np.uint8)


def given(canvas):
    """The same, in the order of a canvas; and where "paint" stands."""
    both = dict(zip(("paint", "trim"), textures(), strict=True))
    return [both[name] for name in canvas.names], canvas.names.index("paint")


def boxes():
    """A painted box on a box of trim, each with a texture of its own, every face the whole of it."""
    parts = []
    for name, texture, low in zip(("paint", "trim"), textures(), (0.0, -0.6), strict=True):
        box = trimesh.creation.box((1, 0.6, 0.8))
        corners = box.vertices[box.faces].reshape(-1, 3)
        normal, uv = np.repeat(box.face_normals, 3, 0), np.zeros((len(corners), 2))
        for axis in range(3):
            others = [i for i in range(3) if i != axis]
            side = abs(normal[:, axis]) > 0.5
            uv[side] = (corners[side][:, others] / box.extents[others]) + 0.5
        faces = np.arange(len(corners)).reshape(-1, 3)
        parts.append(MeshPart(corners + np.array([0, low, 0]), faces, Material(name, (1.0, 1.0, 1.0), texture), uv))
    return mesh_from_parts(parts, 300)


def scene_file(folder, kind, mesh="boxes.glb", **changes):
    write_glb(boxes(), textures(), folder / "boxes.glb")
    half = np.zeros((8, 8), np.uint8)
    half[:, :4] = 255
    Image.fromarray(half).save(folder / "half.png")
    path = folder / f"{kind}.toml"
    text = SCENE.replace("PATCH", PATCHES[kind]).replace("MESH", str(mesh))
    path.write_text(text, encoding="utf-8")
    return path


def read(folder, count=2):
    return [np.asarray(Image.open(folder / f"texture_{i}.png")) for i in range(count)]


@pytest.mark.parametrize("kind", ["texture", "masked", "image"])
def test_only_what_may_change_changes(tmp_path, kind):
    """To the bit outside the mask; within it by `epsilon` at most, in 8 bits."""
    finished = optimize_scene(scene_file(tmp_path, kind), tmp_path / "run", promise=BESIDE_BARE)
    names = {path.name for path in (tmp_path / "run").iterdir()}
    assert {"object.glb", "texture_0.png", "texture_1.png", "mask.png", "run.json", "views.png"} <= names
    assert "design.png" not in names
    shown = np.asarray(Image.open(tmp_path / "run" / "mask.png")) > 0
    canvas = finished.scene.canvas
    before, paint = given(canvas)
    first = len(canvas.mask[0])
    for mask, part in zip(canvas.mask, (shown[:first], shown[first:]), strict=True):
        np.testing.assert_array_equal(part[:, : mask.shape[1]], mask)
    changed = [(was != now).any(-1) for was, now in zip(before, read(tmp_path / "run"), strict=True)]
    for mask, one in zip(canvas.mask, changed, strict=True):
        assert not (one & ~mask).any()
    moved = [abs(was.astype(int) - now) for was, now in zip(before, read(tmp_path / "run"), strict=True)]
    if kind == "texture":
        assert all(mask.all() for mask in canvas.mask) and 0 < max(one.max() for one in moved) <= 25  # ⌊0.1 · 255⌋
    if kind == "masked":
        assert canvas.mask[paint].all() and not canvas.mask[1 - paint].any() and changed[paint].mean() > 0.9
    if kind == "image":
        assert all(0.4 < mask.mean() < 0.6 for mask in canvas.mask) and changed[paint].any()
        assert not any(one[:, one.shape[1] // 2 :].any() for one in changed)  # the mask's black half


def test_gray_is_where_a_gray_start_starts_and_the_original_elsewhere(tmp_path):
    problem = set_problem(load_scene(scene_file(tmp_path, "masked")))
    design = problem.subject.start()
    assert design.shape == (3, 1, 32 * 32) and torch.equal(design, torch.full_like(design, 128 / 255))
    shown = problem.subject.appearance(design).srgb
    both, paint = given(problem.scene.canvas)
    assert torch.equal(shown[1 - paint], torch.tensor(both[1 - paint], dtype=torch.float32) / 255)
    problem = set_problem(load_scene(scene_file(tmp_path, "texture")))
    for texture, was in zip(problem.subject.appearance(problem.subject.start()).srgb, both, strict=True):
        assert torch.equal(texture, torch.tensor(was, dtype=torch.float32) / 255)


def test_the_ball_holds_whatever_a_step_asks_for(tmp_path):
    problem = set_problem(load_scene(scene_file(tmp_path, "texture")))
    begun = problem.subject.pixels(problem.subject.start()).astype(int)
    for step in (-1.0, -0.099, 0.0999, 1.0):
        clipped = problem.subject.clip(problem.subject.start() + step)
        difference = problem.subject.pixels(clipped) - begun
        assert abs(difference).max() == 25 and (np.sign(difference) == np.sign(step)).all()


def test_the_gradient_of_a_texture_is_a_difference_of_pictures(tmp_path):
    """Along a random direction, through light and camera; texels that no view shows have none."""
    problem = set_problem(load_scene(scene_file(tmp_path, "texture")))
    conditions = with_values(problem.scene.draw("train", 2), noise=0)
    generator = torch.Generator().manual_seed(0)
    weight = torch.rand(2, 3, 96, 96, generator=generator)

    def value(design):
        return (
            weight * photograph(problem.stage, problem.subject.appearance(design), conditions, (96, 96), jpeg=False)
        ).sum()

    design = problem.subject.start().requires_grad_()
    (gradient,) = torch.autograd.grad(value(design), design)
    direction = torch.rand(design.shape, generator=generator) - 0.2
    with torch.no_grad():
        difference = (value(design + 0.01 * direction) - value(design - 0.01 * direction)) / 0.02
    assert float((gradient * direction).sum()) == pytest.approx(float(difference), rel=0.01)


def test_a_texture_run_is_read_back_evaluated_and_refused_a_sheet(tmp_path, capsys):
    finished = optimize_scene(scene_file(tmp_path, "texture"), tmp_path / "run")
    again = load_run(tmp_path / "run")
    np.testing.assert_array_equal(again.design, finished.design)
    assert again.promise == finished.promise and again.promise.n == 8
    assert set(again.promise.controls) == {"bare", "mean", "gray", "noise"}
    result = evaluate_run(tmp_path / "run", n=4)
    assert result.n == 4 and (tmp_path / "run" / "evaluate.json").is_file()
    assert command("sheet", tmp_path / "run", "--out", tmp_path / "sheet.pdf") == 1
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("Expected a run of a patch, got a run of the object's own texture:")
    assert not (tmp_path / "sheet.pdf").exists()


class Killed(Exception):
    pass


def test_a_texture_run_killed_and_resumed_gives_the_same_bytes(tmp_path, monkeypatch):
    """Adam's moments of both textures' levels go on as they were."""
    monkeypatch.setattr(loop, "SAVE_AFTER", 1)

    def kill(stage, done, total):
        if (stage, done) == ("optimize", 3):
            raise Killed

    scene = scene_file(tmp_path, "masked")
    optimize_scene(scene, tmp_path / "whole", promise=BESIDE_BARE)
    with pytest.raises(Killed):
        optimize_scene(scene, tmp_path / "cut", promise=BESIDE_BARE, progress=kill)
    optimize_scene(scene, tmp_path / "cut", promise=BESIDE_BARE, resume=True)
    files = sorted(path.name for path in (tmp_path / "whole").iterdir())
    assert files == sorted(path.name for path in (tmp_path / "cut").iterdir())
    for name in files:
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "cut" / name).read_bytes(), name


def test_the_object_in_the_file_is_the_object_that_was_optimized(tmp_path):
    """object.glb read back and photographed bare, against the run's textures shown on the scene's own mesh."""
    finished = optimize_scene(scene_file(tmp_path, "masked"), tmp_path / "run", promise=BESIDE_BARE)
    problem = set_problem(finished.scene)
    shown = problem.subject.appearance(from_pixels(finished.design))
    scene = load_scene(scene_file(tmp_path, "texture", tmp_path / "run" / "object.glb"))
    conditions = finished.scene.draw("promise", 4)
    read_back = photograph(set_stage(scene), None, conditions, (96, 96))
    difference = (read_back - photograph(problem.stage, shown, conditions, (96, 96))).abs()
    assert float(difference.mean()) < 1e-4 and float((difference > 1e-3).float().mean()) < 1e-3
    plain = photograph(problem.stage, None, conditions, (96, 96))
    assert float((read_back - plain).abs().mean()) > 0.005


def test_a_mesh_of_colored_vertices_is_unwrapped_and_optimized(tmp_path, monkeypatch):
    monkeypatch.setattr(texture_canvas, "__defaults__", (256,))  # texels of the side of a new texture
    box = trimesh.creation.box((300, 200, 200))
    colors = np.random.default_rng(0).integers(0, 256, (len(box.vertices), 3), np.uint8)
    trimesh.Trimesh(box.vertices, box.faces, vertex_colors=colors, process=False).export(tmp_path / "colored.ply")
    path = scene_file(tmp_path, "texture", "colored.ply")
    path.write_text(path.read_text().replace("steps = 4", "steps = 1"))
    finished = optimize_scene(path, tmp_path / "run", promise=BESIDE_BARE)
    assert any("unwrapped" in warning for warning in finished.scene.warnings)
    (texture,) = read(tmp_path / "run", 1)
    (mask,) = finished.scene.canvas.mask
    assert texture.shape == (*mask.shape, 3) and mask.mean() > 0.2
    original = finished.scene.canvas.mesh.materials[0].texture_srgb
    changed = (texture != original).any(-1)
    assert changed.any() and not (changed & ~mask).any()
    assert abs(texture.astype(int) - original).max() <= 25
