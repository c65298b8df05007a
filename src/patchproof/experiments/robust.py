"""Study "robust": what a texture looks like that makes an object read as a class, from gray, for classes and networks.

In: scenes, classes (labels), networks and seeds. Every texture is free and starts from gray, so that whatever color and
pattern it has, a network asked for. Out: rates on all networks beside the untrained gray, a turntable contact sheet,
the mean color per class (which color is preferred), and what of the change did it (see `turntable`).

Source: Pestana et al., robust designs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from patchproof.color import codes_of, linear_from_srgb, srgb_from_linear
from patchproof.experiments.turntable import (
    attributions,
    contact_sheet,
    goal_log,
    heat,
    mean_color,
    pictures,
    sides,
    turn,
)
from patchproof.optimizer.loop import best_design
from patchproof.optimizer.pixels import from_pixels
from patchproof.optimizer.promise import judged
from patchproof.output import image_pixels
from patchproof.report.tables import Drawing, Table
from patchproof.settings import SceneSettings
from patchproof.strict import validated
from patchproof.study.study import Cell, Result, Study, short_name
from patchproof.study.trained import (
    Told,
    TrainedSettings,
    Way,
    Word,
    cell_of,
    left_out_note,
    networks_of,
    object_file,
    problem_of,
    said,
    scenes_of,
    tested_in,
    trained_on,
    verdict,
)

_SHEET_PX, _TURN_VIEWS, _SIDES = 160, 8, 3


class RobustSettings(TrainedSettings):
    """As in all studies of trained designs, for every class."""

    classes: Annotated[tuple[str | int, ...], Field(min_length=1)]  # in place of the scene's label
    # By name: tables of the scene file with the keys that change.
    ways: dict[Word, Way] = Field({"free": {"patch": {"kind": "texture", "start": "grey"}}}, min_length=1)


def cells(settings: RobustSettings, base: Path) -> list[Cell]:
    """One per scene, way, class, network and seed."""
    networks, found = networks_of(settings, base), []
    for name, way, values in scenes_of(settings, base):
        for label in settings.classes:
            target = {**values["scene"]["target"], "label": label, "accept": [], "goal": "assist"}
            scene = validated(SceneSettings, values["scene"] | {"target": target}, name).model_dump(mode="json")
            one = {**values, "name": name, "way": way, "scene": scene, "class": str(label)}
            for network in networks:
                row = f"{str(label)[:24]}.{short_name(network)}"
                found.extend(cell_of(one, row, (network,), networks, seed) for seed in settings.seeds)
    return found


def run(settings: RobustSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Train for one class on one network; rates on all, pictures, mean color, attributions."""
    problem = problem_of(base, cell)
    training, subject = trained_on(problem, cell), problem.subject
    design = best_design(training)
    things = {"start": subject.shown(subject.start()), "design": subject.shown(from_pixels(design, problem.device))}
    found = said(judged(problem, things, problem.scene.draw("evaluate", settings.n)))
    views = sides(problem, _SIDES)
    before, after = (pictures(problem, one, views, training.training_px) for one in things.values())
    attributed = attributions(training, before, after)
    change = goal_log(training, after) - goal_log(training, before)
    files = {
        "turn": contact_sheet([turn(problem, one, _TURN_VIEWS, _SHEET_PX) for one in things.values()]),
        "changed": contact_sheet([before, after, heat(attributed)]),
    }
    return {
        **found,
        "color": mean_color(problem, things["design"], _TURN_VIEWS, _SHEET_PX),
        "attributed": attributed.sum((1, 2)).tolist(),
        "change": change.tolist(),
        **{key: f"{cell.name}.{key}.png" for key in files},
        **{f"{cell.name}.{key}.png": content for key, content in files.items()},
        f"{cell.name}.glb": object_file(problem, design),
    }


Key = tuple[str, str, str, str]  # scene, way, class, trained on


def tables(settings: RobustSettings, results: Sequence[Result]) -> list[Table]:
    """Rates on all networks beside gray; the mean color of each class."""
    rates = []
    for key, of_key in _by_design(results).items():
        design, begun = Told(of_key, "design"), Told(of_key, "start")
        for network in tested_in(of_key):
            gain = design.gain(begun, network)[0]
            level = design.level(network)
            rates.append((*key, short_name(network), begun.level(network)[0], *level, gain, verdict(gain)))
    start = ("scene", "way", "class", "trained on")
    head = (*start, "tested on", "gray", "design", "confidence", "gain", "shows")
    about = f"Over {settings.n} unseen conditions per seed, paired with the untrained start."
    about += left_out_note(settings, results)
    colors = [(*key, *_color_row(_mean_codes(of_key))) for key, of_key in _by_design(results).items()]
    named = (*start, "mean color", "red", "green", "blue")
    said_of_colors = "Mean light of the object's pixels over a full turn in even white light, as sRGB codes."
    return [
        Table("rates", "Rates", head, tuple(rates), about),
        Table("colors", "Mean colors", named, tuple(colors), said_of_colors),
        _shares(results),
    ]


def _by_design(results: Sequence[Result]) -> dict[Key, list[Result]]:
    found: dict[Key, list[Result]] = {}
    for one in results:
        values = one.cell.values
        key = (values["name"], values["way"], values["class"], short_name(values["trained"][0]))
        found.setdefault(key, []).append(one)
    return found


def _mean_codes(results: Sequence[Result]) -> tuple[int, int, int]:
    """The mean over designs, in light."""
    light = linear_from_srgb(np.array([one.found["color"] for one in results]) / 255).mean(0)
    return tuple(codes_of(srgb_from_linear(light)).tolist())


def _color_row(codes: tuple[int, int, int]) -> tuple[str, int, int, int]:
    return (_hex(codes), *codes)


def _hex(codes: tuple[int, int, int]) -> str:
    return "#{:02x}{:02x}{:02x}".format(*codes)


def _shares(results: Sequence[Result]) -> Table:
    """How much of the change the attributions explain: a check of them, not of the design."""
    rows = [
        (*key, sum(one.found["change"]) / _SIDES, sum(one.found["attributed"]) / _SIDES)
        for key, of_key in _by_design(results).items()
        for one in of_key
    ]
    head = ("scene", "way", "class", "trained on", "change", "sum of attributions")
    about = "Of the log of the class's confidence, mean of three views: the two should agree."
    return Table("attributions", "What the attributions add up to", head, tuple(rows), about)


def figures(settings: RobustSettings, results: Sequence[Result]) -> list[Drawing]:
    """Colors of all classes, and per scene and way what the designs look like and what of them counts."""
    by_design, found = _by_design(results), []
    rows = list(dict.fromkeys((key[0], key[1], key[2]) for key in by_design))
    found.append(
        Drawing(
            "colors",
            "Preferred colors",
            lambda figure: _color_grid(figure, by_design),
            (2.0 + 1.3 * len({key[3] for key in by_design}), 1.0 + 0.5 * len(rows)),
            "Mean color of free textures that started from gray: classes by training network.",
        )
    )
    for scene, way in dict.fromkeys((key[0], key[1]) for key in by_design):
        mine = {key[2:]: of_key[0] for key, of_key in by_design.items() if key[:2] == (scene, way)}
        for what, title, wide, high, about in _SHEETS:
            found.append(
                Drawing(
                    f"{what}_{scene}_{way}",
                    f"{title}: {scene}, {way}",
                    lambda figure, what=what, mine=mine: _sheets(figure, mine, what),
                    (wide * _columns(mine, wide), (high + 0.3) * math.ceil(len(mine) / _columns(mine, wide))),
                    about,
                )
            )
    return found


_SHEETS = (
    ("turn", "A full turn", 7.0, 1.8, "Above the start, below the design, in even light; the first seed."),
    (
        "changed",
        "What of the change counts",
        3.4,
        3.4,
        "Start, design, integrated gradients between them: red raised the class's confidence, blue lowered it.",
    ),
)


def _columns(mine: dict, wide: float) -> int:
    return max(1, min(len(mine), int(10 / wide)))


def _color_grid(figure, by_design: dict[Key, list[Result]]) -> None:
    rows = list(dict.fromkeys(key[:3] for key in by_design))
    networks = list(dict.fromkeys(key[3] for key in by_design))
    picture = np.ones((len(rows), len(networks), 3))
    axes = figure.add_subplot()
    for (*row, network), of_key in by_design.items():
        y, x, codes = rows.index(tuple(row)), networks.index(network), _mean_codes(of_key)
        picture[y, x] = np.array(codes) / 255
        dark = sum(codes) < 380
        axes.text(x, y, _hex(codes), ha="center", va="center", fontsize=7, color="white" if dark else "black")
    axes.imshow(picture, aspect="auto")
    axes.set_xticks(range(len(networks)), networks, rotation=20, ha="right")
    several = len({row[:2] for row in rows}) > 1
    axes.set_yticks(range(len(rows)), [", ".join(row) if several else row[2] for row in rows])


def _sheets(figure, mine: dict[tuple[str, str], Result], what: str) -> None:

    columns = _columns(mine, next(sheet[2] for sheet in _SHEETS if sheet[0] == what))
    panels = figure.subplots(math.ceil(len(mine) / columns), columns, squeeze=False).ravel()
    for axes in panels:
        axes.set_axis_off()
    for axes, ((label, network), one) in zip(panels, mine.items(), strict=False):
        axes.imshow(image_pixels((one.out / one.found[one.found[what]]).read_bytes()))
        axes.set_title(f"{label}, {network}", fontsize=8, loc="left", pad=2)


STUDY = Study(
    "robust",
    "Free textures from gray: what networks ask for when an object should be read as a class.",
    RobustSettings,
    cells,
    run,
    tables,
    figures,
)
