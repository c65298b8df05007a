"""Parts that the studies of trained designs share: train a scene on some networks, measure it on all.

In: a grid with ways to vary each scene, and networks. Out: cells that name the networks that train and those that test;
tables that group by what was trained. Left out on purpose: promises, which belong to runs that get printed.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field

from patchlab.study.figures import contact_sheet, photographs
from patchlab.study.grid import (
    GridSettings,
    Names,
    SceneChanges,
    make_cell,
    problem_of,
    scene_values,
    short_name,
    with_changes,
)
from patchlab.study.record import to_record
from patchlab.study.study import Cell, Result
from patchproof.base.color import srgb_from_linear
from patchproof.base.intervals import Estimate
from patchproof.base.resample import downscale
from patchproof.channel.effects import EFFECT_BY_NAME, Light, Pose, Sensor
from patchproof.mesh.mesh import Material
from patchproof.optimizer import loop
from patchproof.optimizer.problem import Problem
from patchproof.optimizer.responses import responses
from patchproof.optimizer.subject import DESIGN_FILE, OBJECT_FILE
from patchproof.optimizer.texture import Texture
from patchproof.render.photograph import Appearance, shade
from patchproof.render.stage import set_stage
from patchproof.scene.conditions import Conditions, with_values
from patchproof.scene.texture_scene import TextureScene, texture_canvas

SceneVariant = dict[str, dict[str, Any]]  # tables of a scene file with the keys that change
NamePart = Annotated[str, Field(pattern=r"^[\w=+,-]{1,24}$")]  # part of a file's name
ORIGINAL = "original"  # the row of the unchanged object


class TrainedSettings(GridSettings):
    """Settings: every scene in every way, and networks that train and test."""

    networks: Names = Field(...)  # networks to train on and to test
    # By name: tables of the scene file with the keys that change.
    ways: dict[NamePart, SceneVariant] = Field({"as_is": {}}, min_length=1)
    n: Annotated[int, Field(ge=2)] = 400  # unseen conditions that measure
    # Longest side of the object's textures, original and design alike, when they are the design; by default the mesh's.
    texture_px: Annotated[int, Field(ge=16)] | None = None


def single_network_rows(networks: Sequence[str]) -> dict[str, Sequence[str]]:
    """Rows in which a single network trains, by its short name."""
    return {short_name(name): (name,) for name in networks}


def trained_cells(
    settings: TrainedSettings,
    base: Path,
    rows: Callable[[Sequence[str]], Mapping[str, Sequence[str]]] = single_network_rows,
    variants: Sequence[tuple[SceneChanges, Mapping[str, str]]] = (({}, {}),),
) -> list[Cell]:
    """A cell per scene, way, variant, row and seed; all networks test. `rows` names those that train (none for the
    original); a variant is changes of the scene, and values that describe it.
    """
    networks, cells = settings.networks, []
    for file, (way, changed), (tables, more) in product(settings.scenes, settings.ways.items(), variants):
        values = with_changes(scene_values(file, base, changed, f", way {way}"), tables)
        for (row, trained), seed in product(rows(networks).items(), settings.seeds):
            row_values, words = {"way": way, **more, "row": row}, (way, *(text[:24] for text in more.values()), row)
            networks_of_cell = {"trained": list(trained), "networks": list(networks), "of_scene": False}
            cells.append(make_cell(values | row_values | networks_of_cell, seed, *words))
    return cells


def trained_problem(settings: TrainedSettings, base: Path, cell: Cell) -> Problem:
    """The problem of a cell, its textures at most `texture_px` wide and high: a step costs as much as its texels."""
    problem = problem_of(base, cell.values)
    scene, most = problem.scene, settings.texture_px
    if most is None or not isinstance(scene, TextureScene):
        return problem

    def small(material: Material) -> Material:
        texture = material.texture_srgb
        return material if texture is None else replace(material, texture_srgb=downscale(texture, most))

    mesh = replace(scene.mesh, materials=tuple(map(small, scene.mesh.materials)))
    canvas = texture_canvas(mesh, scene.settings.patch, scene.base, most)
    scene = replace(scene, mesh=canvas.mesh, canvas=canvas)
    subject = Texture(scene, canvas, problem.device)
    return replace(problem, scene=scene, stage=set_stage(scene, problem.device), subject=subject)


def with_trainers(problem: Problem, cell: Cell) -> Problem:
    """The problem with the cell's training networks only."""
    numbers = [cell.values["networks"].index(name) for name in cell.values["trained"]]
    classifiers, indices = (tuple(each[i] for i in numbers) for each in (problem.classifiers, problem.indices))
    return replace(problem, classifiers=classifiers, indices=indices)


def best_design(problem: Problem) -> np.ndarray:
    """Run the whole loop; the pixels of the design that was best on the selection set."""
    state = loop.start(problem)
    for step in loop.steps(problem, state):
        state = step.state
    return problem.subject.pixels(state.best)


def answers_and_files(
    problem: Problem,
    name: str,
    things: Mapping[str, Appearance],
    n: int,
    sheet: tuple[Conditions, int],
    design: np.ndarray | None,
) -> dict[str, Any]:
    """All networks' answers to `things` in n unseen conditions, a contact sheet (views, side in px), a design's file:
    a PNG, or the object with its new textures as GLB.
    """
    answers = to_record(responses(problem, things, problem.scene.draw("evaluate", n)))
    pictures = [photographs(problem, each, *sheet) for each in things.values()]
    files = {f"{name}.sheet.png": contact_sheet(pictures)}
    if design is not None:
        with TemporaryDirectory() as folder:
            problem.subject.save(design, Path(folder))
            path = Path(folder) / (DESIGN_FILE if problem.scene.HAS_PIECE else OBJECT_FILE)
            files[f"{name}{path.suffix}"] = path.read_bytes()
    return answers | files


def tested_networks(results: Sequence[Result]) -> list[str]:
    """All networks that a cell was tested on."""
    return list(dict.fromkeys(name for result in results for name in result.cell.values["networks"]))


def gain_word(gain: Estimate | None) -> str:
    """The word for a difference by its interval: "gain", "loss" or "none shown"."""
    if gain is None:
        return "not measured"
    return "gain" if gain.low > 0 else "loss" if gain.high < 0 else "none shown"


def views_from(problem: Problem, azimuth_deg: np.ndarray) -> Conditions:
    """Views from these azimuths in even light, at the middle of all other ranges, with one background."""
    drawn, view = problem.scene.draw("evaluate", 1), problem.scene.settings.view
    pose = Pose(
        azimuth_deg=np.asarray(azimuth_deg, float),
        elevation_deg=np.array([np.mean(view.elevation_deg)]),
        distance_mm=np.array([np.mean(view.distance_mm)]),
        background=drawn.pose.background,
        printed_scale=drawn.pose.printed_scale,
    )
    light, sensor = Light(ambient=np.ones(1)), Sensor(jpeg=np.array([95]), noise_seed=drawn.sensor.noise_seed)
    return Conditions(pose=pose, light=light, print=drawn.print, sensor=sensor)


def views_from_sides(problem: Problem, count: int) -> Conditions:
    """Views for a contact sheet: evenly through the scene's azimuths, or drawn where the scene has no mesh."""
    if not problem.scene.HAS_OBJECT:
        return problem.scene.draw("evaluate", count)
    low, high = problem.scene.settings.view.azimuth_deg
    return views_from(problem, low + (high - low) * (np.arange(count) + 0.5) / count)


def views_in_drawn_light(problem: Problem, lights: int) -> Conditions:
    """Three fixed views of a mesh (`views_from_sides`), each in `lights` drawn lights, backgrounds and cameras:
    3 · lights conditions, view by view.
    """
    poses = views_from_sides(problem, 3)[np.repeat(np.arange(3), lights)]
    drawn = problem.scene.draw("evaluate", 3 * lights)
    return with_values(drawn, **{name: getattr(poses.pose, name) for name in EFFECT_BY_NAME["viewpoint"].fields})


def mean_color(problem: Problem, shown: Appearance, views: int, side_px: int) -> tuple[int, int, int]:
    """sRGB codes of the object's mean light, without its outlines, over a full turn in even white light."""
    turned = problem.see(shown, views_from(problem, np.arange(views) * 360 / views), side_px)
    with torch.no_grad():
        light = shade(turned, shown).permute(0, 2, 3, 1).reshape(-1, 3)
    within = torch.zeros(len(light), dtype=torch.bool, device=light.device)
    within[turned.on_object.pixel] = True
    if turned.outlines is not None:
        within[turned.outlines.pixel] = False
    light = light[within]
    red, green, blue = (srgb_from_linear(light.double().mean(0)) * 255).round().clamp(0, 255).int().tolist()
    return red, green, blue
