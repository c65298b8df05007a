"""Textures that hide an object from networks, beside gray and noise.

In: scenes that the networks read well, networks, seeds, and ways (by default a free texture and one within 8/255 of the
original). Out: rates of the design, the original object and gray and noise on the same conditions;
the design minus each control, paired; contact sheets. The controls are the point: often plain gray alone hides an
object, and only the difference is due to training. Controls ignore the ε-ball.

Source: Pestana et al., supplement, deceptive textures. For measuring the robustness of networks on objects that are
yours to test.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import Field

from patchlab.study import trained_designs
from patchlab.study.figures import picture_sheet
from patchlab.study.grid import by_values, group_by, short_name
from patchlab.study.record import Record
from patchlab.study.study import Cell, Result, Study
from patchlab.study.trained_designs import best_design, views_from_sides
from patchproof.optimizer.promise import pictures_with_controls
from patchproof.report.tables import Drawing, Table

CONTROLS = ("bare", "gray", "noise")
_SHOWN_KINDS = ("design", *CONTROLS)
_SHEET_PX, _SHEET_VIEWS = 160, 4


class DeceiveSettings(trained_designs.TrainedSettings):
    """Settings of a study of trained designs in which each network trains alone and all networks test."""

    # By name: tables of the scene file with the keys that change.
    ways: dict[trained_designs.NamePart, trained_designs.SceneVariant] = Field(
        {"free": {"patch": {"kind": "texture"}}, "within_8": {"patch": {"kind": "texture", "epsilon": 8 / 255}}},
        min_length=1,
    )


def cells(settings: DeceiveSettings, base: Path) -> list[Cell]:
    """A cell per scene, way, network and seed; the goal is `deceive`, whatever the scene file says."""
    return trained_designs.trained_cells(settings, base, variants=[({"target": {"goal": "deceive"}}, {})])


def run(settings: DeceiveSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Train against one network, and show the design and its controls to all networks."""
    problem = trained_designs.trained_problem(settings, base, cell)
    design = best_design(trained_designs.with_trainers(problem, cell))
    things = pictures_with_controls(problem, design, CONTROLS)
    sheet = views_from_sides(problem, _SHEET_VIEWS), _SHEET_PX
    return trained_designs.answers_and_files(problem, cell.name, things, settings.n, sheet, design)


def tables(settings: DeceiveSettings, results: Sequence[Result]) -> list[Table]:
    """Tables of rates, and of the design minus each control."""
    rates, differences = [], []
    for design, of_design in group_by(results, by_values("name", "way", "row")).items():
        records = {kind: Record(of_design, kind) for kind in _SHOWN_KINDS}
        for network in trained_designs.tested_networks(of_design):
            start = (*design, short_name(network))
            levels = [record.level(network) for record in records.values()]
            rates.append((*start, *(level[0] for level in levels), levels[0][1]))
            differences.append((*start, *(records["design"].gain(records[kind], network)[0] for kind in CONTROLS)))
    head, n = ("scene", "way", "trained on", "tested on"), f"{settings.n} unseen conditions per seed"
    return [
        Table("rates", "Rates", (*head, *_SHOWN_KINDS, "confidence"), tuple(rates), f"Over {n}."),
        Table(
            "differences",
            "The design minus each control",
            (*head, *(f"minus {kind}" for kind in CONTROLS)),
            tuple(differences),
            f"Of rates, paired over {n}: below zero hides the object better than what was not trained to.",
        ),
    ]


def figures(settings: DeceiveSettings, results: Sequence[Result]) -> list[Drawing]:
    """A contact sheet per scene, way and network: the design, then the controls."""
    return [
        picture_sheet(
            f"sheet_{scene}_{way}_{row}",
            f"{scene}, {way}, trained on {row}",
            [("", of_design[0].file(f"{of_design[0].cell.name}.sheet.png"))],
            (1.2 * _SHEET_VIEWS + 0.8, 1.2 * len(_SHOWN_KINDS)),
            "In even light; the first seed.",
            rows=_SHOWN_KINDS,
        )
        for (scene, way, row), of_design in group_by(results, by_values("name", "way", "row")).items()
    ]


STUDY = Study("deceive", DeceiveSettings, cells, run, tables, figures)
