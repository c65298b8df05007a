"""What stress tests share: scenes before one network each, cells of pose × light, and what the network says there.

In: a study's settings (scene files, networks, seeds) and draws of a scene's own streams. Out: a problem; draws whose
pose and light lie in one cell of a map while everything else stays as drawn; recognized and confidence per draw; and
the worst tenth of a map's cells. All cells of a map share the same draws of background, camera and whatever is no axis,
so that cells differ in pose and light alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field, model_validator

from patchproof.channel.effects import EFFECTS
from patchproof.goal import Goal
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.render.photograph import Shown, expose
from patchproof.scene.conditions import Conditions, fields_of, of_fields, with_values
from patchproof.scene.scene import build_scene
from patchproof.settings import SceneSettings
from patchproof.strict import Refused, Strict, expand, read_toml, validated
from patchproof.study.study import Cell, short_name

PoseAxis = Literal["azimuth_deg", "elevation_deg", "distance_mm", "roll_deg"]
LightAxis = Literal["ambient", "directional", "light_azimuth_deg", "light_elevation_deg", "exposure_ev"]
Count = Annotated[int, Field(ge=1)]
Seed = Annotated[int, Field(ge=0)]
WORST_SHARE = 0.1
CHUNK = 16


class MapSettings(Strict):
    """A map of pose × light."""

    pose: PoseAxis = "azimuth_deg"  # the axis across
    light: LightAxis = "light_azimuth_deg"  # the axis upwards
    pose_cells: Count = 10  # cells of equal width across the scene's own range
    light_cells: Count = 6  # likewise
    n: Count = 32  # draws in each cell


class ScenesSettings(Strict):
    """Every scene with every network and seed; paths are relative to the config's folder."""

    scenes: Annotated[tuple[str, ...], Field(min_length=1)]  # scene files
    networks: tuple[str, ...] = ()  # in place of each scene's own
    seeds: Annotated[tuple[Seed, ...], Field(min_length=1)] = (0,)  # of the optimizer and the draws

    @model_validator(mode="after")
    def _have_different_names(self):
        for key in ("scenes", "networks", "seeds"):
            names = [short_name(str(one)) for one in getattr(self, key)]
            if len(set(names)) < len(names):
                raise ValueError(f"takes {key} with different names")
        return self


@dataclass(frozen=True)
class Axis:
    """One axis of a map: a field of the conditions and the edges of its cells."""

    name: str
    edges: tuple[float, ...]

    def __len__(self) -> int:
        return len(self.edges) - 1


@dataclass(frozen=True)
class Said:
    """What one network said per draw."""

    recognized: np.ndarray
    confidence: np.ndarray


def scene_cells(settings: ScenesSettings, base: Path) -> list[Cell]:
    """A cell per scene, network and seed, with the whole scene in it: where the file changes it is done again."""
    found = []
    for file in settings.scenes:
        path = Path(expand(file, base))
        scene = validated(SceneSettings, read_toml(path), path.name)
        if scene.object.mesh is None:
            raise Refused("scenes with a mesh, whose pose and light can be set", path.name, "name object.mesh in it")
        # names in the config are relative to the config, those in a scene to the scene
        networks = [(name, base) for name in settings.networks] or [(scene.target.models[0], path.parent)]
        for network, folder in networks:
            for seed in settings.seeds:
                values = {
                    "scene": short_name(file),
                    "network": short_name(network),
                    "seed": seed,
                    "file": file,
                    "settings": scene.model_dump(mode="json"),
                    "model": network,
                    "of_config": folder == base,
                }
                found.append(Cell(f"{values['scene']}.{values['network']}.{seed}", values))
    return found


def problem_of(cell: Cell, base: Path, **optimize: int) -> Problem:
    """The cell's scene before its network; `optimize` replaces settings of the loop."""
    values = cell.values
    folder = Path(expand(values["file"], base)).resolve().parent
    settings = validated(SceneSettings, values["settings"], values["file"])
    settings = settings.model_copy(update={"optimize": settings.optimize.model_copy(update=optimize)})
    scene = build_scene(settings, folder, values["seed"])
    model = expand(values["model"], base if values["of_config"] else folder)
    return set_problem(scene, models=(model,))


def axes(settings: SceneSettings, asked: MapSettings) -> tuple[Axis, Axis]:
    """The map's axes, pose and light, over the scene's ranges; refused where a range is a single value."""

    def axis(name: str, count: int) -> Axis:
        low, high = next(effect.range(settings, name) for effect in EFFECTS if name in effect.columns)
        if low == high:
            do = "widen it, or choose another axis"
            raise Refused(f"a range of {name} that a map can be cut from", f"[{low:g}, {high:g}]", do)
        return Axis(name, tuple(np.linspace(low, high, count + 1).tolist()))

    return axis(asked.pose, asked.pose_cells), axis(asked.light, asked.light_cells)


def in_cell(conditions: Conditions, both: tuple[Axis, Axis], cell: tuple[int, int]) -> Conditions:
    """`conditions` with pose and light moved into a cell (its numbers), each as far in as it lay in its range."""
    changed, fields = {}, fields_of(conditions)
    for axis, number in zip(both, cell, strict=True):
        first, last, low, high = axis.edges[0], axis.edges[-1], axis.edges[number], axis.edges[number + 1]
        share = (fields[axis.name] - first) / (last - first)
        changed[axis.name] = low + (high - low) * share
    return with_values(conditions, **changed)


def in_cells(conditions: Conditions, both: tuple[Axis, Axis], cells: Sequence[tuple[int, int]]) -> Conditions:
    """`conditions` moved into cells, an equal share of the rows into each, in order; no draw serves two cells."""
    n = len(conditions) // len(cells)
    parts = [fields_of(in_cell(conditions[i * n : (i + 1) * n], both, cell)) for i, cell in enumerate(cells)]
    return of_fields({name: np.concatenate([part[name] for part in parts]) for name in parts[0]})


def judge(problem: Problem, things: Mapping[str, Shown], conditions: Conditions) -> dict[str, Said]:
    """What the problem's first network says of each thing (None: the bare object) under the same conditions."""
    parts: dict[str, list[np.ndarray]] = {name: [] for name in things}
    seen_with = next((one for one in things.values() if one is not None), None)
    with torch.no_grad():
        for first in range(0, len(conditions), CHUNK):
            seen = problem.see(seen_with, conditions[first : first + CHUNK], problem.figure_px)
            for name, thing in things.items():
                parts[name].append(verdicts(problem, expose(seen, thing)))
    both = {name: np.concatenate(part, -1) for name, part in parts.items()}
    return {name: Said(one[0] > 0.5, one[1]) for name, one in both.items()}


def verdicts(problem: Problem, pictures: torch.Tensor) -> np.ndarray:
    """2×N: recognized (0 or 1) and confidence, by the problem's first network."""
    classifier, indices = problem.classifiers[0], problem.indices[0]
    with torch.no_grad():
        logits = classifier.logits(pictures)
        recognized, confidence = classifier.recognized(logits, indices), classifier.confidence(logits, indices)
    return torch.stack([recognized.double(), confidence.double()]).cpu().numpy()


def map_of(problem: Problem, both: tuple[Axis, Axis], drawn: Conditions) -> tuple[np.ndarray, np.ndarray]:
    """The clean object's hits (bool) and confidence, each P×L×N: poses, lights, draws."""
    cells = [(i, j) for i in range(len(both[0])) for j in range(len(both[1]))]
    said = [judge(problem, {"clean": None}, in_cell(drawn, both, cell))["clean"] for cell in cells]
    shape = (len(both[0]), len(both[1]), len(drawn))
    hits, confidence = ([getattr(one, name) for one in said] for name in ("recognized", "confidence"))
    return np.reshape(hits, shape), np.reshape(confidence, shape)


def worst_cells(hits: np.ndarray, confidence: np.ndarray, goal: Goal = Goal.assist) -> list[tuple[int, int]]:
    """The worst tenth of a map's cells, at least one: by rate, among equals by mean confidence, then in their order."""
    rate, sure = goal.sign * hits.mean(2).ravel(), goal.sign * confidence.mean(2).ravel()
    order = np.lexsort((np.arange(rate.size), sure, rate))[: math.ceil(WORST_SHARE * rate.size)]
    return [(int(i), int(j)) for i, j in zip(*np.unravel_index(order, hits.shape[:2]), strict=True)]


def bits(hits: Sequence[bool] | np.ndarray) -> str:
    """Hits as a text of 0 and 1, which JSON keeps short."""
    return "".join("01"[int(hit)] for hit in hits)


def hits_of(text: str) -> list[bool]:
    """The hits of `bits`."""
    return [one == "1" for one in text]


def axes_said(both: tuple[Axis, Axis]) -> dict[str, Any]:
    """The axes as JSON values."""
    return {"names": [axis.name for axis in both], "edges": [list(axis.edges) for axis in both]}
