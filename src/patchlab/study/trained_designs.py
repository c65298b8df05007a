"""Parts that the studies of trained designs share: train a scene on some networks, measure it on all.

In: a grid with ways to vary each scene, and networks. Out: cells that name the networks that train and those that test;
tables that group by what was trained. Left out on purpose: promises, which belong to runs that get printed.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from patchlab.study.figures import contact_sheet, photographs
from patchlab.study.grid import GridSettings, Names, SceneChanges, make_cell, scene_values, short_name, with_changes
from patchlab.study.record import to_record
from patchlab.study.study import Cell, Result
from patchproof.base.intervals import Estimate
from patchproof.optimizer.problem import Problem
from patchproof.optimizer.responses import responses
from patchproof.render.photograph import Appearance
from patchproof.scene.conditions import Conditions

SceneVariant = dict[str, dict[str, Any]]  # tables of a scene file with the keys that change
NamePart = Annotated[str, Field(pattern=r"^[\w=+,-]{1,24}$")]  # part of a file's name
ORIGINAL = "original"  # the row of the unchanged object


class TrainedSettings(GridSettings):
    """Settings: every scene in every way, and networks that train and test."""

    networks: Names = Field(...)  # networks to train on and to test
    # By name: tables of the scene file with the keys that change.
    ways: dict[NamePart, SceneVariant] = Field({"as_is": {}}, min_length=1)
    n: Annotated[int, Field(ge=2)] = 400  # unseen conditions that measure


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


def with_trainers(problem: Problem, cell: Cell) -> Problem:
    """The problem with the cell's training networks only."""
    return problem.with_classifiers([cell.values["networks"].index(name) for name in cell.values["trained"]])


def test_and_draw(
    problem: Problem, name: str, things: Mapping[str, Appearance], n: int, sheet: tuple[Conditions, int]
) -> dict[str, Any]:
    """Record all networks' answers to `things` in n unseen conditions; draw a contact sheet (views, side in px)."""
    answers = to_record(responses(problem, things, problem.scene.draw("evaluate", n)))
    return answers | {
        f"{name}.sheet.png": contact_sheet([photographs(problem, each, *sheet) for each in things.values()])
    }


def tested_networks(results: Sequence[Result]) -> list[str]:
    """All networks that a cell was tested on."""
    return list(dict.fromkeys(name for result in results for name in result.cell.values["networks"]))


def gain_word(gain: Estimate | None) -> str:
    """The word for a difference by its interval: "gain", "loss" or "none shown"."""
    if gain is None:
        return "not measured"
    return "gain" if gain.low > 0 else "loss" if gain.high < 0 else "none shown"
