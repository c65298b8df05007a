"""Free textures trained from gray: the colors and patterns that networks prefer for a class.

In: scenes, classes (labels), networks and seeds. Every texture is free and starts from gray, so its colors and patterns
come from the network. Out: rates on all networks beside the untrained gray, the mean color per class, and a contact
sheet.

Source: Pestana et al., robust designs.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field

from patchlab.study import trained_designs
from patchlab.study.figures import picture_sheet
from patchlab.study.grid import by_values, group_by, short_name
from patchlab.study.record import Record
from patchlab.study.study import Cell, Result, Study
from patchlab.study.trained_designs import best_design, mean_color, views_from_sides
from patchproof.base.color import linear_from_srgb, srgb_from_linear
from patchproof.optimizer.subject import from_pixels
from patchproof.report.tables import Drawing, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SHEET_PX, _TURN_VIEWS, _SHEET_VIEWS = 160, 8, 3
_KINDS = ("start", "design")


class RobustSettings(trained_designs.TrainedSettings):
    """Settings: each network trains alone for each class, and all networks test."""

    classes: Annotated[tuple[str | int, ...], Field(min_length=1)]  # in place of the scene's label
    # By name: tables of the scene file with the keys that change.
    ways: dict[trained_designs.NamePart, trained_designs.SceneVariant] = Field(
        {"free": {"patch": {"kind": "texture", "start": "gray"}}}, min_length=1
    )


def cells(settings: RobustSettings, base: Path) -> list[Cell]:
    """A cell per scene, way, class, network and seed."""
    variants = [
        ({"target": {"label": label, "accept": [], "goal": "assist"}}, {"class": str(label)})
        for label in settings.classes
    ]
    return trained_designs.trained_cells(settings, base, variants=variants)


def run(settings: RobustSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Train for one class on one network; record rates on all networks, pictures and mean color."""
    problem = trained_designs.trained_problem(settings, base, cell)
    subject = problem.subject
    design = best_design(trained_designs.with_trainers(problem, cell))
    pixels = (subject.start(), from_pixels(design, problem.device))
    things = {kind: subject.appearance(each) for kind, each in zip(_KINDS, pixels, strict=True)}
    sheet = views_from_sides(problem, _SHEET_VIEWS), _SHEET_PX
    answers = trained_designs.answers_and_files(problem, cell.name, things, settings.n, sheet, design)
    return answers | {"color": mean_color(problem, things["design"], _TURN_VIEWS, _SHEET_PX)}


DesignKey = tuple  # scene, way, class, trained on
_HEAD = ("scene", "way", "class", "trained on")


def _by_design(results: Sequence[Result]) -> Mapping[DesignKey, Sequence[Result]]:
    return group_by(results, by_values("name", "way", "class", "row"))


def tables(settings: RobustSettings, results: Sequence[Result]) -> list[Table]:
    """Tables of rates on all networks beside gray, and of each class's mean color."""
    rates, colors = [], []
    for key, of_key in _by_design(results).items():
        design, start = Record(of_key, "design"), Record(of_key, "start")
        for network in trained_designs.tested_networks(of_key):
            gain = design.gain(start, network)[0]
            levels = start.level(network)[0], *design.level(network)
            rates.append((*key, short_name(network), *levels, gain, trained_designs.gain_word(gain)))
        codes = _mean_codes(of_key)
        colors.append((*key, _hex(codes), *codes))
    about = f"Over {settings.n} unseen conditions per seed, paired with the untrained start."
    of_colors = "Mean light of the object's pixels over a full turn in even white light, as sRGB codes."
    head = (*_HEAD, "tested on", "gray", "design", "confidence", "gain", "shows")
    named = (*_HEAD, "mean color", "red", "green", "blue")
    return [
        Table("rates", "Rates", head, tuple(rates), about),
        Table("colors", "Mean colors", named, tuple(colors), of_colors),
    ]


def _mean_codes(results: Sequence[Result]) -> tuple[int, int, int]:
    light = linear_from_srgb(np.array([result.answers["color"] for result in results]) / 255).mean(0)
    red, green, blue = (int(code) for code in np.rint(srgb_from_linear(light) * 255))
    return red, green, blue


def _hex(codes: tuple[int, int, int]) -> str:
    return "#{:02x}{:02x}{:02x}".format(*codes)


def figures(settings: RobustSettings, results: Sequence[Result]) -> list[Drawing]:
    """A grid of all classes' colors, and a contact sheet of designs per scene and way."""
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
        files = [(label, first.file(f"{first.cell.name}.sheet.png")) for label, first in firsts.items()]
        about = "Above the start, below the design, in even light; the first seed."
        title = f"Designs: {scene}, {way}"
        drawings.append(picture_sheet(f"sheet_{scene}_{way}", title, files, (3.6, 2.7 * len(files)), about))
    return drawings


def _color_grid(
    figure: "Figure", by_design: Mapping[DesignKey, Sequence[Result]], rows: Sequence[tuple], networks: Sequence[str]
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
