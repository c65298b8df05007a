"""Find where networks fail on the clean object: black squares, maps of pose × light, worst pose and light.

In: scenes with a mesh, networks, seeds. Out, per cell: a black square over every position of the picture; maps of pose
× light; the worst pose and the worst light of a random search that narrows round by round, each with the condition
found and its confidence. Everything chosen as worst is measured again on draws of the evaluate stream that the choice
never saw, since the draws that chose it exaggerate. Cells of a map where the object is recognized no more often than
the background alone are marked “no effect”: a network may give the label to anything.

Sources: occlusion and maps as in Pestana et al., figures 1 and 2 (occlusion maps: Zeiler and Fergus, ECCV 2014); search
for poses that fail: Alcorn et al., Strike (with) a Pose, CVPR 2019, its random search.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field
from torch import Tensor

from patchlab.paper import stress_map
from patchlab.study.figures import contact_sheet, photographs, picture_sheet
from patchlab.study.grid import GridSettings, PositiveInt, cell_key, problem_of
from patchlab.study.record import hits_text, parse_hits
from patchlab.study.study import Cell, Result, Study
from patchproof.base.intervals import estimate_difference, paired_difference, rate
from patchproof.base.validation import Share, StrictModel
from patchproof.optimizer.problem import Problem
from patchproof.optimizer.responses import Responses, ask_networks, in_chunks, merge_responses
from patchproof.report.tables import Drawing, Table
from patchproof.scene.conditions import Conditions, fields_of, with_values

_MAP_HEAD = (
    *("pose", "from", "to", "light", "from ", "to "),
    *("rate", "background alone", "difference", "effect", "confidence"),
)
_VIEW_TITLES = ("typical", "worst pose", "worst light", "worst occlusion")
_FRESH_SEED_OFFSET = 3_000_001  # added to a seed: the evaluate stream's draws that measure what was chosen


class OcclusionSettings(StrictModel):
    """A black square at every position of a grid over the picture."""

    share: Annotated[Share, Field(gt=0)] = 0.3  # the square's side as a share of the picture's
    positions: Annotated[int, Field(ge=2)] = 7  # places from edge to edge, across and down
    n: PositiveInt = 32  # draws at each place


class WorstCaseSettings(StrictModel):
    """A random search from coarse to fine."""

    tries: PositiveInt = 48  # poses (or lights) in each round
    rounds: PositiveInt = 4  # the range around the best halves from round to round
    draws: PositiveInt = 4  # draws of everything else, the same for all tries
    n: PositiveInt = 64  # draws that measure what was found


class StressSettings(GridSettings):
    """Scenes, networks, seeds and the three tests."""

    maps: tuple[stress_map.MapSettings, ...] = (stress_map.MapSettings(),)  # of pose × light
    occlusion: OcclusionSettings = OcclusionSettings()  # a black square over the picture
    search: WorstCaseSettings = WorstCaseSettings()  # for the worst pose and light


def cells(settings: StressSettings, base: Path) -> list[Cell]:
    """A cell per scene, network and seed."""
    return stress_map.mesh_cells(settings, base)


def run(settings: StressSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Run all tests of one scene and one network."""
    problem, seed = problem_of(base, cell.values), cell.values["seed"]
    (pose, of_pose), (light, of_light) = (
        find_worst_case(problem, names, settings.search, seed)
        for names in (stress_map.POSE_FIELDS, stress_map.LIGHT_FIELDS)
    )
    occlusion, hidden = measure_occlusion(problem, settings.occlusion, seed)
    typical = problem.scene.draw("select", 1, seed)
    views = [_photographs(problem, with_values(typical, **changed))[0] for changed in ({}, pose, light)]
    return {
        "maps": [_measure_map(problem, options, seed) for options in settings.maps],
        "occlusion": occlusion,
        "pose": of_pose,
        "light": of_light,
        f"{cell.name}.png": contact_sheet([[*views, hidden]]),
    }


def _photographs(problem: Problem, conditions: Conditions) -> Tensor:
    return photographs(problem, None, conditions, problem.figure_px)


def _measure_again(problem: Problem, there: Conditions, anywhere: Conditions) -> dict[str, Any]:
    """Measure the clean object in the worst condition found, and under the same draws without it."""
    worst, usual = stress_map.clean_responses(problem, there), stress_map.clean_responses(problem, anywhere)
    return {
        "hits": hits_text(worst.recognized[0]),
        "confidence": float(worst.confidence.mean()),
        "hits_anywhere": hits_text(usual.recognized[0]),
        "confidence_anywhere": float(usual.confidence.mean()),
    }


def _measure_map(problem: Problem, options: stress_map.MapSettings, seed: int) -> dict[str, Any]:
    axes = stress_map.map_axes(problem.scene.settings, options)
    hits, confidence, alone = stress_map.measure_map(problem, axes, problem.scene.draw("select", options.n, seed))
    worst = stress_map.worst_cells(hits, confidence, problem.scene.settings.target.goal)
    fresh = problem.scene.draw("evaluate", options.n * len(worst), seed + _FRESH_SEED_OFFSET)
    return {
        "axes": {"names": [axis.name for axis in axes], "edges": [list(axis.edges) for axis in axes]},
        "hits": [[hits_text(place) for place in column] for column in hits],
        "alone": [[hits_text(place) for place in column] for column in alone],
        "confidence": confidence.mean(2).tolist(),
        "worst": [list(place) for place in worst],
        "again": _measure_again(problem, stress_map.spread_over_cells(fresh, axes, worst), fresh),
    }


def measure_occlusion(problem: Problem, settings: OcclusionSettings, seed: int) -> tuple[dict[str, Any], Tensor]:
    """Hits per position (row by row), those of the worst position on fresh draws, and a picture of it."""
    side = problem.figure_px
    square = max(round(settings.share * side), 1)
    corners = np.linspace(0, side - square, settings.positions).round().astype(int).tolist()
    boxes = [(x, y, x + square, y + square) for y in corners for x in corners]
    answers = _ask_under(problem, problem.scene.draw("select", settings.n, seed), boxes)
    sign = problem.scene.settings.target.goal.sign
    hits, sure = (
        np.array([getattr(answers[box], name).mean() for box in boxes]) for name in ("recognized", "confidence")
    )
    worst = int(np.lexsort((sign * sure, sign * hits))[0])
    fresh = problem.scene.draw("evaluate", settings.n, seed + _FRESH_SEED_OFFSET)
    again = _ask_under(problem, fresh, [None, boxes[worst]])
    picture = _photographs(problem, problem.scene.draw("select", 1, seed))
    answers_by_place = {
        "hits": [hits_text(answers[box].recognized[0]) for box in boxes],
        "worst": [worst % settings.positions, worst // settings.positions],
        "clean_again": hits_text(again[None].recognized[0]),
        "worst_again": hits_text(again[boxes[worst]].recognized[0]),
    }
    return answers_by_place, _blacken(picture, boxes[worst])[0]


PixelBox = tuple[int, int, int, int]  # first column and row, and those after the last


def _ask_under(
    problem: Problem, conditions: Conditions, boxes: Sequence[PixelBox | None]
) -> dict[PixelBox | None, Responses]:
    parts = []
    for part in in_chunks(conditions):
        pictures = _photographs(problem, part)
        around = problem.boxes(part)
        parts.append({box: ask_networks(problem, _blacken(pictures, box), around) for box in boxes})
    return merge_responses(parts)


def _blacken(pictures: Tensor, box: PixelBox | None) -> Tensor:
    if box is None:
        return pictures
    x0, y0, x1, y1 = box
    pictures = pictures.clone()
    pictures[:, :, y0:y1, x0:x1] = 0
    return pictures


def find_worst_case(
    problem: Problem, names: Sequence[str], settings: WorstCaseSettings, seed: int
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Search the values of the fields `names` with the largest mean loss of the clean object over `draws` of all else.

    Returns the values as arrays of one row, and the JSON record.
    """
    scene, best, best_loss, course = problem.scene, {}, -np.inf, []
    rest = scene.draw("select", settings.draws, seed)
    for number in range(settings.rounds):
        drawn = scene.draw("select", settings.tries, seed, settings.draws + number * settings.tries)
        # the ranges are a box, so points between two of its points lie in it
        fields = fields_of(drawn)
        drawn = with_values(drawn, **{n: v + 0.5**number * (fields[n] - v) for n, v in best.items()})
        losses = stress_map.clean_responses(
            problem, stress_map.combine_conditions(drawn, rest, names), problem.training_px
        ).loss.mean(0)
        losses = losses.reshape(settings.tries, settings.draws).mean(1)
        if losses.max() > best_loss:
            best_loss, row = float(losses.max()), int(losses.argmax())
            best = {name: fields_of(drawn)[name][row : row + 1] for name in names}
        course.append(best_loss)
    fresh = scene.draw("evaluate", settings.n, seed + _FRESH_SEED_OFFSET)
    drawn = fields_of(scene.draw("select", 64, seed))
    varied = [name for name in names if drawn[name].ndim == 1 and np.ptp(drawn[name]) > 0]
    condition = {name: float(best[name][0]) for name in varied}
    return best, {"condition": condition, "losses": course} | _measure_again(problem, with_values(fresh, **best), fresh)


def tables(settings: StressSettings, results: Sequence[Result]) -> tuple[Table, ...]:
    """Tables of worst cases, measured on fresh draws, and of every cell of the maps."""
    start = ("scene", "network", "seed")
    return (
        Table(
            "worst",
            "Worst cases of the clean object, measured on draws that did not choose them",
            (*start, "test", "found at", "rate", "rate anywhere", "difference", "confidence"),
            tuple(row for result in results for row in _worst_rows(result)),
            "Differences are paired by condition: the same draws with pose, light or square as found, and without.",
        ),
        Table(
            "maps",
            "Maps of pose × light",
            (*start, *_MAP_HEAD),
            tuple(row for result in results for map_ in result.answers["maps"] for row in _map_rows(result, map_)),
            "The clean object in every cell, beside the background without it; all cells of a map share their other "
            "draws. “no effect”: the 95 % interval of the paired difference does not lie above 0.",
        ),
    )


def _worst_rows(result: Result) -> Iterator[tuple]:
    def row(test: str, where: str, worst: str, usual: str, confidence: float | None) -> tuple:
        there, anywhere = parse_hits(worst), parse_hits(usual)
        rates = rate(there), rate(anywhere), estimate_difference(there, anywhere)
        return *cell_key(result), test, where, *rates, confidence

    for test in ("pose", "light"):
        of_test = result.answers[test]
        where = ", ".join(f"{stress_map.field_title(name)} {value:.4g}" for name, value in of_test["condition"].items())
        yield row(f"worst {test}", where, of_test["hits"], of_test["hits_anywhere"], of_test["confidence"])
    hidden = result.answers["occlusion"]
    where = "column {}, row {} of the grid".format(*(number + 1 for number in hidden["worst"]))
    yield row("black square", where, hidden["worst_again"], hidden["clean_again"], None)
    for map_ in result.answers["maps"]:
        where = f"{len(map_['worst'])} worst cells of {' × '.join(map(stress_map.field_title, map_['axes']['names']))}"
        again = map_["again"]
        yield row("map", where, again["hits"], again["hits_anywhere"], again["confidence"])


def _map_rows(result: Result, map_: Mapping[str, Any]) -> Iterator[tuple]:
    (pose, light), (poses, lights) = map_["axes"]["names"], map_["axes"]["edges"]
    empty = _empty_cells(map_)
    for i, column in enumerate(map_["hits"]):
        for j, hits in enumerate(map(parse_hits, column)):
            place = (pose, poses[i], poses[i + 1], light, lights[j], lights[j + 1])
            alone, effect = parse_hits(map_["alone"][i][j]), "no effect" if (i, j) in empty else "seen"
            beside = rate(alone), estimate_difference(hits, alone), effect
            yield (*cell_key(result), *place, rate(hits), *beside, map_["confidence"][i][j])


def _empty_cells(map_: Mapping[str, Any]) -> list[stress_map.MapCell]:
    """Cells in which the object is not shown to be recognized more often than the background alone."""
    return [
        (i, j)
        for i, columns in enumerate(zip(map_["hits"], map_["alone"], strict=True))
        for j, (hits, alone) in enumerate(zip(*columns, strict=True))
        if paired_difference(parse_hits(hits), parse_hits(alone))[1][0] <= 0
    ]


def figures(settings: StressSettings, results: Sequence[Result]) -> tuple[Drawing, ...]:
    """Per cell of the study: its maps, the map of positions, and pictures of the worst cases."""
    return tuple(drawing for result in results for drawing in _figures(settings, result))


def _figures(settings: StressSettings, result: Result) -> Iterator[Drawing]:
    name, title = result.cell.name, "{}, {}, seed {}: clean object".format(*cell_key(result))
    for number, (map_, options) in enumerate(zip(result.answers["maps"], settings.maps, strict=True)):
        rates = [[float(np.mean(parse_hits(hits))) for hits in column] for column in map_["hits"]]
        caption = (
            f"rate, n = {options.n} draws per cell; framed: the worst tenth\ngray: no effect over background alone"
        )
        ticks, empty = stress_map.map_ticks(map_["axes"]), _empty_cells(map_)
        yield stress_map.heat_map(f"map{number}_{name}", (title, caption), rates, map_["worst"], ticks, empty=empty)
    hidden, options = result.answers["occlusion"], settings.occlusion
    grid = np.reshape([np.mean(parse_hits(hits)) for hits in hidden["hits"]], (options.positions, options.positions)).T
    middles = [
        f"{options.share / 2 + (1 - options.share) * i / (options.positions - 1):.0%}" for i in range(options.positions)
    ]
    labels = ("middle of the square, from the left", "from the top")
    ticks = [(label, range(options.positions), middles) for label in labels]
    caption = f"black square, {options.share:.0%} of the side; n = {options.n}"
    yield stress_map.heat_map(
        f"occlusion_{name}", (title, caption), grid.tolist(), [hidden["worst"]], ticks, upward=False
    )
    files = [("", result.file(f"{name}.png"))]
    yield picture_sheet(f"views_{name}", title, files, (2.1 * len(_VIEW_TITLES), 2.4), columns=_VIEW_TITLES)


STUDY = Study("stress", StressSettings, cells, run, tables, figures)
