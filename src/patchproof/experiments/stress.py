"""Study "stress": where a clean object fails before a network, and how badly.

In: scenes with a mesh, networks, seeds. Out, per cell: a black square over every position of the picture; maps of pose
× light; the worst pose and the worst light that a random search finds that closes in round by round, each with the
condition found and its confidence. Whatever was chosen for being worst is measured again on draws of the evaluate
stream that the choice never saw: the same draws flatter a choice.

Sources: occlusion and maps as in Pestana et al., figures 1 and 2 (occlusion maps: Zeiler and Fergus, ECCV 2014); search
for poses that fail: Alcorn et al., Strike (with) a Pose, CVPR 2019, its random search.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field

from patchproof.claims import difference, rate
from patchproof.experiments.hard_views import LIGHT, POSE, clean_losses, each_before_all
from patchproof.experiments.heat import heat_map, picture_strip, position_map, said
from patchproof.experiments.stress_map import (
    CHUNK,
    Count,
    MapSettings,
    ScenesSettings,
    axes,
    axes_said,
    bits,
    hits_of,
    in_cells,
    judge,
    map_of,
    problem_of,
    scene_cells,
    verdicts,
    worst_cells,
)
from patchproof.optimizer.pixels import as_pixels
from patchproof.optimizer.problem import Problem
from patchproof.render.photograph import expose
from patchproof.report.images import png
from patchproof.report.tables import Drawing, Table
from patchproof.scene.conditions import Conditions, fields_of, with_values
from patchproof.strict import Share, Strict
from patchproof.study.study import Cell, Result, Study

_PARTS = ("typical", "worst pose", "worst light", "worst occlusion")
_MEASURING = 3_000_001  # added to a seed: the evaluate stream's draws that measure what was chosen


class OcclusionSettings(Strict):
    """A black square in many places of the picture."""

    share: Annotated[Share, Field(gt=0)] = 0.3  # its side, as a share of the picture's
    positions: Annotated[int, Field(ge=2)] = 7  # places from edge to edge, across and down
    n: Count = 32  # draws at each place


class SearchSettings(Strict):
    """A search from coarse to fine."""

    tries: Count = 48  # poses (or lights) in each round
    rounds: Count = 4  # the reach round the best halves from one to the next
    draws: Count = 4  # of everything else, the same for all tries
    n: Count = 64  # draws that measure what was found


class StressSettings(ScenesSettings):
    """What is tried."""

    maps: tuple[MapSettings, ...] = (MapSettings(),)  # of pose × light
    occlusion: OcclusionSettings = OcclusionSettings()  # what is hidden
    search: SearchSettings = SearchSettings()  # for the worst pose and the worst light


def cells(settings: StressSettings, base: Path) -> list[Cell]:
    """A cell per scene, network and seed."""
    return scene_cells(settings, base)


def run(settings: StressSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """All tests of one scene before one network."""
    problem, seed = problem_of(cell, base), cell.values["seed"]
    poses, lights = (worst_case(problem, names, settings.search, seed) for names in (POSE, LIGHT))
    hidden, pictures = occluded(problem, settings.occlusion, seed)
    typical = problem.scene.draw("select", 1, seed)
    views = [_view(problem, _with(typical, one)) for one in ({}, poses[0], lights[0])]
    return {
        "maps": [_mapped(problem, one, seed) for one in settings.maps],
        "occlusion": hidden,
        "pose": poses[1],
        "light": lights[1],
        f"{cell.name}.png": png(np.concatenate([*views, pictures], 1)),
    }


# -------------------------------------------------------------------------------------------- maps of pose × light


def _mapped(problem: Problem, settings: MapSettings, seed: int) -> dict[str, Any]:
    both = axes(problem.scene.settings, settings)
    hits, confidence = map_of(problem, both, problem.scene.draw("select", settings.n, seed))
    worst = worst_cells(hits, confidence, problem.scene.settings.target.goal)
    fresh = problem.scene.draw("evaluate", settings.n * len(worst), seed + _MEASURING)
    there = judge(problem, {"clean": None}, in_cells(fresh, both, worst))["clean"]
    anywhere = judge(problem, {"clean": None}, fresh)["clean"]
    return {
        "axes": axes_said(both),
        "hits": [[bits(cell) for cell in column] for column in hits],
        "confidence": confidence.mean(2).tolist(),
        "worst": [list(one) for one in worst],
        "worst_again": bits(there.recognized),
        "anywhere_again": bits(anywhere.recognized),
        "worst_confidence": float(there.confidence.mean()),
    }


# -------------------------------------------------------------------------------------------- a black square


def occluded(problem: Problem, settings: OcclusionSettings, seed: int) -> tuple[dict[str, Any], np.ndarray]:
    """Hits per position (row by row), the worst position's on fresh draws, and a picture of it."""
    side = problem.figure_px
    square = max(round(settings.share * side), 1)
    corners = np.linspace(0, side - square, settings.positions).round().astype(int)
    boxes = [(x, y, x + square, y + square) for y in corners for x in corners]
    hits, confidence = _under(problem, problem.scene.draw("select", settings.n, seed), [None, *boxes])
    sign = problem.scene.settings.target.goal.sign
    order = np.lexsort((sign * confidence[1:].mean(1), sign * hits[1:].mean(1)))
    worst = boxes[order[0]]
    fresh = problem.scene.draw("evaluate", settings.n, seed + _MEASURING)
    again, _ = _under(problem, fresh, [None, worst])
    picture = _photographs(problem, problem.scene.draw("select", 1, seed))
    found = {
        "hits": [bits(one) for one in hits[1:]],
        "worst": [int(order[0] % settings.positions), int(order[0] // settings.positions)],
        "clean_again": bits(again[0]),
        "worst_again": bits(again[1]),
    }
    return found, as_pixels(_blackened(picture, worst)[0])


def _under(problem: Problem, conditions: Conditions, boxes: Sequence) -> tuple[np.ndarray, np.ndarray]:
    """Hits (bool) and confidence, boxes × draws."""
    parts = []
    for first in range(0, len(conditions), CHUNK):
        pictures = _photographs(problem, conditions[first : first + CHUNK])
        parts.append(np.stack([verdicts(problem, _blackened(pictures, box)) for box in boxes], 1))
    both = np.concatenate(parts, 2)
    return both[0] > 0.5, both[1]


def _blackened(pictures: torch.Tensor, box: tuple[int, int, int, int] | None) -> torch.Tensor:
    if box is None:
        return pictures
    x0, y0, x1, y1 = box
    pictures = pictures.clone()
    pictures[:, :, y0:y1, x0:x1] = 0
    return pictures


def _photographs(problem: Problem, conditions: Conditions) -> torch.Tensor:
    """The clean object's."""
    with torch.no_grad():
        return expose(problem.see(None, conditions, problem.figure_px), None)


def _view(problem: Problem, conditions: Conditions) -> np.ndarray:
    return as_pixels(_photographs(problem, conditions)[0])


# -------------------------------------------------------------------------------------------- search


def worst_case(
    problem: Problem, names: Sequence[str], settings: SearchSettings, seed: int
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The values of the fields `names` under which the clean object does worst: as arrays of one row, and as found.

    Worst is the largest mean loss over `draws` of everything else.
    """
    scene, best, best_loss, course = problem.scene, None, -np.inf, []
    rest = scene.draw("select", settings.draws, seed)
    for number in range(settings.rounds):
        drawn = scene.draw("select", settings.tries, seed, settings.draws + number * settings.tries)
        if best is not None:  # between two points of a box all lies within it
            fields = fields_of(drawn)
            nearer = {name: best[name] + 0.5**number * (fields[name] - best[name]) for name in names}
            drawn = with_values(drawn, **nearer)
        losses = clean_losses(problem, each_before_all(drawn, rest, names))
        losses = losses.reshape(settings.tries, settings.draws).mean(1)
        if losses.max() > best_loss:
            best_loss, row = float(losses.max()), int(losses.argmax())
            best = {name: fields_of(drawn)[name][row : row + 1] for name in names}
        course.append(best_loss)
    fresh = scene.draw("evaluate", settings.n, seed + _MEASURING)
    there = judge(problem, {"clean": None}, _with(fresh, best))["clean"]
    anywhere = judge(problem, {"clean": None}, fresh)["clean"]
    return best, {
        "condition": {name: float(best[name][0]) for name in _varied(scene.draw("select", 64, seed), names)},
        "losses": course,
        "hits": bits(there.recognized),
        "confidence": float(there.confidence.mean()),
        "hits_anywhere": bits(anywhere.recognized),
        "confidence_anywhere": float(anywhere.confidence.mean()),
    }


def _varied(drawn: Conditions, names: Sequence[str]) -> list[str]:
    """Fields of one figure whose range is more than a value; a lamp's only where there are lamps."""
    lamps, fields = drawn.light.point.max() > 0, fields_of(drawn)
    figures = {name: fields[name] for name in names if lamps or not name.startswith("point")}
    return [name for name, values in figures.items() if values.ndim == 1 and np.ptp(values) > 0]


def _with(conditions: Conditions, values: Mapping[str, np.ndarray]) -> Conditions:
    """`conditions` with the same one row of some fields everywhere."""
    return with_values(conditions, **values)


# -------------------------------------------------------------------------------------------- tables and figures


def tables(settings: StressSettings, results: Sequence[Result]) -> tuple[Table, ...]:
    """What was worst, measured anew; and every cell of the maps."""
    who = ("scene", "network", "seed")
    worst = tuple(row for one in results for row in _worst_rows(one))
    cells_of = tuple(row for one in results for found in one.found["maps"] for row in _map_rows(one, found))
    return (
        Table(
            "worst",
            "Worst cases of the clean object, measured on draws that did not choose them",
            (*who, "test", "found at", "rate", "rate anywhere", "difference", "confidence"),
            worst,
            "Differences are paired by condition: the same draws with pose, light or square as found, and without.",
        ),
        Table(
            "maps",
            "Maps of pose × light",
            (*who, "pose", "from", "to", "light", "from ", "to ", "rate", "confidence"),
            cells_of,
            "The clean object in every cell; all cells of a map share their other draws.",
        ),
    )


def _who(one: Result) -> tuple:
    return tuple(one.cell.values[key] for key in ("scene", "network", "seed"))


def _worst_rows(one: Result):
    for what in ("pose", "light"):
        found = one.found[what]
        where = ", ".join(f"{said(name)} {value:.4g}" for name, value in found["condition"].items())
        there, anywhere = hits_of(found["hits"]), hits_of(found["hits_anywhere"])
        rates = (rate(there), rate(anywhere), difference(there, anywhere))
        yield (*_who(one), f"worst {what}", where, *rates, found["confidence"])
    hidden = one.found["occlusion"]
    there, anywhere = hits_of(hidden["worst_again"]), hits_of(hidden["clean_again"])
    where = "column {}, row {} of the grid".format(*(number + 1 for number in hidden["worst"]))
    yield (*_who(one), "black square", where, rate(there), rate(anywhere), difference(there, anywhere), None)
    for found in one.found["maps"]:
        where = f"{len(found['worst'])} worst cells of {' × '.join(map(said, found['axes']['names']))}"
        there, anywhere = hits_of(found["worst_again"]), hits_of(found["anywhere_again"])
        rates = (rate(there), rate(anywhere), difference(there, anywhere))
        yield (*_who(one), "map", where, *rates, found["worst_confidence"])


def _map_rows(one: Result, found: Mapping[str, Any]):
    (pose, light), (poses, lights) = found["axes"]["names"], found["axes"]["edges"]
    for i, column in enumerate(found["hits"]):
        for j, cell in enumerate(column):
            place = (pose, poses[i], poses[i + 1], light, lights[j], lights[j + 1])
            yield (*_who(one), *place, rate(hits_of(cell)), found["confidence"][i][j])


def figures(settings: StressSettings, results: Sequence[Result]) -> tuple[Drawing, ...]:
    """Per cell of the study: its maps, the map of positions, and what the worst cases look like."""
    return tuple(drawing for one in results for drawing in _figures(settings, one))


def _figures(settings: StressSettings, one: Result):
    name, title = one.cell.name, "{}, {}, seed {}: clean object".format(*_who(one))
    for number, (found, asked) in enumerate(zip(one.found["maps"], settings.maps, strict=True)):
        rates = [[np.mean(hits_of(cell)) for cell in column] for column in found["hits"]]
        yield heat_map(f"map{number}_{name}", title, found["axes"], rates, asked.n, found["worst"])
    hidden, asked = one.found["occlusion"], settings.occlusion
    grid = np.reshape([np.mean(hits_of(cell)) for cell in hidden["hits"]], (asked.positions, asked.positions)).T
    yield position_map(f"occlusion_{name}", title, asked.share, grid.tolist(), asked.n, hidden["worst"])
    yield picture_strip(f"views_{name}", title, one.out / one.found[f"{name}.png"], _PARTS)


STUDY = Study(
    "stress",
    "Where the clean object fails: black squares, maps of pose × light, worst pose and worst light.",
    StressSettings,
    cells,
    run,
    tables,
    figures,
)
