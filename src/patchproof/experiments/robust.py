"""Free textures from gray: what networks ask for when an object should be read as a class.

In: scenes, classes (labels), networks and seeds. Every texture is free and starts from gray, so that whatever color and
pattern it has, a network asked for. Out: rates on all networks beside the untrained gray, a turntable contact sheet,
the mean color per class (which color is preferred), and what of the change did it (see `turntable`).

Source: Pestana et al., robust designs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field

from patchproof.color import linear_from_srgb, srgb_from_linear
from patchproof.experiments.turntable import attributions, goal_log, heat, mean_color, sides, turn
from patchproof.optimizer.loop import best_design
from patchproof.optimizer.pixels import from_pixels
from patchproof.optimizer.responses import responses
from patchproof.report.tables import Drawing, Table
from patchproof.study.figures import picture_sheet
from patchproof.study.grid import grouped, of_values, problem_of, short_name
from patchproof.study.pictures import contact_sheet, photographs
from patchproof.study.record import Record, recorded
from patchproof.study.study import Cell, Result, Study
from patchproof.study.trained import (
    TrainedSettings,
    Way,
    Word,
    left_out_note,
    tested_in,
    trained_cells,
    trained_on,
    verdict,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SHEET_PX, _TURN_VIEWS, _SIDES = 160, 8, 3


class RobustSettings(TrainedSettings):
    """Each network trains alone for each class, and all of them test."""

    classes: Annotated[tuple[str | int, ...], Field(min_length=1)]  # in place of the scene's label
    # By name: tables of the scene file with the keys that change.
    ways: dict[Word, Way] = Field({"free": {"patch": {"kind": "texture", "start": "gray"}}}, min_length=1)


def cells(settings: RobustSettings, base: Path) -> list[Cell]:
    """One per scene, way, class, network and seed."""
    variants = [
        ({"target": {"label": label, "accept": [], "goal": "assist"}}, {"class": str(label)})
        for label in settings.classes
    ]
    return trained_cells(settings, base, variants=variants)


def run(settings: RobustSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Train for one class on one network; rates on all, pictures, mean color, attributions."""
    problem = problem_of(base, cell.values)
    training, subject = trained_on(problem, cell), problem.subject
    design = best_design(training)
    things = {"start": subject.shown(subject.start()), "design": subject.shown(from_pixels(design, problem.device))}
    views = sides(problem, _SIDES)
    before, after = (photographs(problem, thing, views, training.training_px) for thing in things.values())
    attributed = attributions(training, before, after)
    suffix, content = problem.subject.file(design)
    turned = [turn(problem, thing, _TURN_VIEWS, _SHEET_PX) for thing in things.values()]
    return {
        **recorded(responses(problem, things, problem.scene.draw("evaluate", settings.n))),
        "color": mean_color(problem, things["design"], _TURN_VIEWS, _SHEET_PX),
        "attributed": attributed.sum((1, 2)).tolist(),
        "change": (goal_log(training, after) - goal_log(training, before)).tolist(),
        f"{cell.name}.turn.png": contact_sheet(turned),
        f"{cell.name}.changed.png": contact_sheet([before, after, heat(attributed)]),
        f"{cell.name}.{suffix}": content,
    }


Key = tuple  # scene, way, class, trained on
_HEAD = ("scene", "way", "class", "trained on")


def _by_design(results: Sequence[Result]) -> Mapping[Key, Sequence[Result]]:
    return grouped(results, of_values("name", "way", "class", "row"))


def tables(settings: RobustSettings, results: Sequence[Result]) -> list[Table]:
    """Rates on all networks beside gray; the mean color of each class; how much of the change attributions explain,
    which is a check of them, not of the design.
    """
    rates, colors, sums = [], [], []
    for key, of_key in _by_design(results).items():
        design, begun = Record(of_key, "design"), Record(of_key, "start")
        for network in tested_in(of_key):
            gain = design.gain(begun, network)[0]
            levels = begun.level(network)[0], *design.level(network)
            rates.append((*key, short_name(network), *levels, gain, verdict(gain)))
        codes = _mean_codes(of_key)
        colors.append((*key, _hex(codes), *codes))
        sums += [
            (*key, *(sum(result.answers[what]) / _SIDES for what in ("change", "attributed"))) for result in of_key
        ]
    about = f"Over {settings.n} unseen conditions per seed, paired with the untrained start."
    about += left_out_note(settings, results)
    of_colors = "Mean light of the object's pixels over a full turn in even white light, as sRGB codes."
    of_sums = "Of the log of the class's confidence, mean of three views: the two should agree."
    head = (*_HEAD, "tested on", "gray", "design", "confidence", "gain", "shows")
    named = (*_HEAD, "mean color", "red", "green", "blue")
    summed = (*_HEAD, "change", "sum of attributions")
    return [
        Table("rates", "Rates", head, tuple(rates), about),
        Table("colors", "Mean colors", named, tuple(colors), of_colors),
        Table("attributions", "What the attributions add up to", summed, tuple(sums), of_sums),
    ]


def _mean_codes(results: Sequence[Result]) -> tuple[int, int, int]:
    """The mean over designs, in light."""
    light = linear_from_srgb(np.array([result.answers["color"] for result in results]) / 255).mean(0)
    red, green, blue = (int(code) for code in np.rint(srgb_from_linear(light) * 255))
    return red, green, blue


def _hex(codes: tuple[int, int, int]) -> str:
    return "#{:02x}{:02x}{:02x}".format(*codes)


# what of a cell's pictures, title, inches of one picture, about
_SHEETS = (
    ("turn", "A full turn", (7.0, 1.8), "Above the start, below the design, in even light; the first seed."),
    (
        "changed",
        "What of the change counts",
        (3.4, 3.4),
        "Start, design, integrated gradients between them: red raised the class's confidence, blue lowered it.",
    ),
)


def figures(settings: RobustSettings, results: Sequence[Result]) -> list[Drawing]:
    """Colors of all classes, and per scene and way what the designs look like and what of them counts."""
    by_design = _by_design(results)
    rows, networks = list(dict.fromkeys(key[:3] for key in by_design)), list(dict.fromkeys(key[3] for key in by_design))
    drawings = [
        Drawing(
            "colors",
            "Preferred colors",
            lambda figure: _color_grid(figure, by_design, rows, networks),
            (2.0 + 1.3 * len(networks), 1.0 + 0.5 * len(rows)),
            "Mean color of free textures that started from gray: classes by training network.",
        )
    ]
    for scene, way in dict.fromkeys(row[:2] for row in rows):
        firsts = {f"{key[2]}, {key[3]}": some[0] for key, some in by_design.items() if key[:2] == (scene, way)}
        for what, title, (wide, high), about in _SHEETS:
            files = [(label, first.file(f"{first.cell.name}.{what}.png")) for label, first in firsts.items()]
            columns = max(1, min(len(files), int(10 / wide)))
            size = (wide * columns, (high + 0.3) * math.ceil(len(files) / columns))
            name = f"{what}_{scene}_{way}"
            drawings.append(picture_sheet(name, f"{title}: {scene}, {way}", files, size, about, columns))
    return drawings


def _color_grid(
    figure: Figure, by_design: Mapping[Key, Sequence[Result]], rows: Sequence[tuple], networks: Sequence[str]
) -> None:
    picture, axes = np.ones((len(rows), len(networks), 3)), figure.add_subplot()
    for key, of_key in by_design.items():
        y, x, codes = rows.index(key[:3]), networks.index(key[3]), _mean_codes(of_key)
        picture[y, x] = np.array(codes) / 255
        ink = "white" if sum(codes) < 380 else "black"
        axes.text(x, y, _hex(codes), ha="center", va="center", fontsize=7, color=ink)
    axes.imshow(picture, aspect="auto")
    axes.set_xticks(range(len(networks)), networks, rotation=20, ha="right")
    several = len({row[:2] for row in rows}) > 1
    axes.set_yticks(range(len(rows)), [", ".join(row) if several else row[2] for row in rows])


STUDY = Study("robust", RobustSettings, cells, run, tables, figures)
