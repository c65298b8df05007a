"""Maps of stress tests: conditions in cells of pose × light, a network's answers there, and heat maps.

In: a problem with a mesh and one network, and draws of its streams. Out: draws whose pose and light lie in one cell of
a map while everything else stays as drawn; recognized and confidence per draw, also for the background alone; the worst
tenth of a map's cells; and `Drawing`s with one scale from 0 to 1. All cells of a map share their draws of background,
camera and everything else, so that they differ in pose and light only.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch

from patchlab.study.figures import number_grid
from patchlab.study.grid import GridSettings, PositiveInt, grid_cells
from patchlab.study.study import Cell
from patchproof.base.errors import Refused
from patchproof.base.goal import Goal
from patchproof.base.settings import SceneSettings
from patchproof.base.validation import StrictModel
from patchproof.channel.effects import EFFECT_BY_NAME, EFFECTS
from patchproof.optimizer.problem import Problem
from patchproof.optimizer.responses import Responses, ask_networks, in_chunks, merge_responses, responses
from patchproof.render.photograph import expose
from patchproof.report.tables import Drawing
from patchproof.scene.conditions import Conditions, conditions_from_fields, fields_of, with_values

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PoseAxis = Literal["azimuth_deg", "elevation_deg", "distance_mm", "roll_deg"]
LightAxis = Literal["ambient", "directional", "light_azimuth_deg", "light_elevation_deg", "exposure_ev"]
# fields of conditions that are pose and light; the rest is background, print and camera
POSE_FIELDS = EFFECT_BY_NAME["viewpoint"].fields
_LIGHT_EFFECTS = ("ambient light", "directional light", "exposure")
LIGHT_FIELDS = tuple(name for effect in _LIGHT_EFFECTS for name in EFFECT_BY_NAME[effect].fields)
WORST_SHARE = 0.1


class MapSettings(StrictModel):
    """A map's axes, each cut into equal cells of the scene's own range."""

    pose: PoseAxis = "azimuth_deg"  # the axis across
    light: LightAxis = "light_azimuth_deg"  # the axis upwards
    pose_cells: PositiveInt = 10  # cells of equal width across the scene's own range
    light_cells: PositiveInt = 6  # cells of equal height upwards
    n: PositiveInt = 32  # draws in each cell


@dataclass(frozen=True)
class MapAxis:
    """One axis of a map: a field of the conditions and the edges of its cells."""

    name: str
    edges: tuple[float, ...]

    def __len__(self) -> int:
        return len(self.edges) - 1


AxisTicks = tuple[str, Sequence[float], Sequence[str]]  # an axis's label, tick positions, tick texts
_UNIT_SYMBOLS = {"deg": "°", "mm": "mm", "ev": "EV"}
MapCell = tuple[int, int]  # indices of a map's cell: pose, light


def mesh_cells(settings: GridSettings, base: Path) -> list[Cell]:
    """A cell per scene, network and seed; refuses scenes without a mesh, whose pose and light cannot be set."""
    cells = grid_cells(settings, base)
    if flat := [cell.values["file"] for cell in cells if cell.values["scene"]["object"]["mesh"] is None]:
        raise Refused("scenes with a mesh, whose pose and light can be set", flat[0], "name object.mesh in it")
    return cells


def map_axes(settings: SceneSettings, options: MapSettings) -> tuple[MapAxis, MapAxis]:
    """The map's axes, pose and light, over the scene's ranges; refuses a range that is a single value."""

    def axis(name: str, count: int) -> MapAxis:
        low, high = next(effect.range(settings, name) for effect in EFFECTS if name in effect.columns)
        if low == high:
            do = "widen it, or choose another axis"
            raise Refused(f"a range of {name} that a map can be cut from", f"[{low:g}, {high:g}]", do)
        return MapAxis(name, tuple(np.linspace(low, high, count + 1).tolist()))

    return axis(options.pose, options.pose_cells), axis(options.light, options.light_cells)


def move_into_cell(conditions: Conditions, axes: tuple[MapAxis, MapAxis], place: MapCell) -> Conditions:
    """Conditions with pose and light moved into a cell, linearly from the whole range."""
    changed, fields = {}, fields_of(conditions)
    for axis, number in zip(axes, place, strict=True):
        first, last, low, high = axis.edges[0], axis.edges[-1], axis.edges[number], axis.edges[number + 1]
        share = (fields[axis.name] - first) / (last - first)
        changed[axis.name] = low + (high - low) * share
    return with_values(conditions, **changed)


def spread_over_cells(conditions: Conditions, axes: tuple[MapAxis, MapAxis], places: Sequence[MapCell]) -> Conditions:
    """Conditions moved into cells: an equal number of rows into each, in order, no row into two."""
    n = len(conditions) // len(places)
    parts = [fields_of(move_into_cell(conditions[i * n : (i + 1) * n], axes, place)) for i, place in enumerate(places)]
    return conditions_from_fields({name: np.concatenate([part[name] for part in parts]) for name in parts[0]})


def combine_conditions(tries: Conditions, rest: Conditions, names: Sequence[str]) -> Conditions:
    """Every row of `tries` with every row of `rest`: fields `names` from `tries`, all others from `rest`."""
    rows = np.tile(np.arange(len(rest)), len(tries))
    fields = fields_of(tries)
    return with_values(rest[rows], **{name: fields[name].repeat(len(rest), 0) for name in names})


def clean_responses(problem: Problem, conditions: Conditions, side_px: int | None = None) -> Responses:
    """Responses to the clean object, bare or with its texture."""
    return responses(problem, {"clean": None}, conditions, side_px)["clean"]


def responses_and_background(problem: Problem, conditions: Conditions) -> tuple[Responses, Responses]:
    """Responses to the clean object, and to the background alone through the same camera."""
    parts: list[dict[str, Responses]] = []
    with torch.no_grad():
        for part in in_chunks(conditions):
            views = problem.see(None, part, problem.figure_px)
            shown = {"clean": views, "alone": replace(views, object=None)}
            pictures = {name: expose(each, None) for name, each in shown.items()}
            parts.append({name: ask_networks(problem, each, problem.boxes(part)) for name, each in pictures.items()})
    answers = merge_responses(parts)
    return answers["clean"], answers["alone"]


def measure_map(
    problem: Problem, axes: tuple[MapAxis, MapAxis], drawn: Conditions
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Hits (bool) and confidence of the clean object, and hits of the background alone, each poses × lights × draws."""
    shape = (len(axes[0]), len(axes[1]), len(drawn))
    cells = (move_into_cell(drawn, axes, place) for place in np.ndindex(*shape[:2]))
    answers = [responses_and_background(problem, cell) for cell in cells]
    hits, confidence = ([getattr(clean, name)[0] for clean, _ in answers] for name in ("recognized", "confidence"))
    alone = [background.recognized[0] for _, background in answers]
    return np.reshape(hits, shape), np.reshape(confidence, shape), np.reshape(alone, shape)


def worst_cells(hits: np.ndarray, confidence: np.ndarray, goal: Goal = Goal.assist) -> list[MapCell]:
    """The worst tenth of a map's cells, at least one: by rate, then by mean confidence, then by index."""
    rate, sure = goal.sign * hits.mean(2).ravel(), goal.sign * confidence.mean(2).ravel()
    order = np.lexsort((sure, rate))[: math.ceil(WORST_SHARE * rate.size)]
    return [(int(i), int(j)) for i, j in zip(*np.unravel_index(order, hits.shape[:2]), strict=True)]


def heat_map(
    name: str,
    titles: tuple[str, str],
    rates: Sequence[Sequence[float]],
    framed: Sequence[Sequence[int]],
    ticks: Sequence[AxisTicks],
    upward: bool = True,
    empty: Sequence[MapCell] = (),
) -> Drawing:
    """Draw rates over two axes, the second one upward or downward; `titles` are the drawing's and the plot's. `empty`
    cells, whose rates mean nothing, are gray.
    """

    def draw(figure: "Figure") -> None:
        plot, values = figure.add_subplot(), np.array(rates).T
        texts = [[f"{value:.2f}" for value in row] for row in values]
        gray = [(y, x) for x, y in empty]
        image = number_grid(plot, values, texts, [(y, x) for x, y in framed], fontsize=8, empty=gray)
        figure.colorbar(image, ax=plot, label="rate")
        for axis, (label, places, words) in zip((plot.xaxis, plot.yaxis), ticks, strict=True):
            axis.set_ticks(places, words)
            axis.set_label_text(label)
        if upward:
            plot.invert_yaxis()
        plot.set_title(titles[1])

    size = max(2.2 + 0.6 * len(rates), 5.5), max(1.6 + 0.42 * len(rates[0]), 3.2)
    return Drawing(name, titles[0], draw, size)


def map_ticks(axes: Mapping[str, Any]) -> list[AxisTicks]:
    """Ticks of both axes from their JSON values (`names`, and the `edges` of cells)."""
    return [
        (field_title(name), [i - 0.5 for i in range(len(edges))], [f"{value:.4g}" for value in edges])
        for name, edges in zip(axes["names"], axes["edges"], strict=True)
    ]


def field_title(name: str) -> str:
    """The title of a condition's field: "azimuth (°)" for azimuth_deg."""
    words, unit = name.split("_"), ""
    if words[-1] in _UNIT_SYMBOLS:
        unit = f" ({_UNIT_SYMBOLS[words.pop()]})"
    return " ".join(words) + unit
