"""Study "deceive": textures that hide the object from networks, beside controls that were not trained to.

In: scenes that the networks read well, networks, seeds, and ways (by default a free texture and one within 8/255 of the
original). Out: rates of the design, the original object and gray, noise and shuffled controls on the same conditions;
the design minus each control, paired; contact sheets. The controls are the point: often plain gray alone hides an
object, and only what a texture does beyond that is owed to its training. Controls ignore the ball.

Source: Pestana et al., supplement, deceptive textures. For measuring the robustness of networks on objects that are
yours to test.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import Field

from patchproof.experiments.turntable import contact_sheet, pictures, sides
from patchproof.optimizer.loop import best_design
from patchproof.optimizer.promise import judged, shown_with_controls
from patchproof.output import image_pixels
from patchproof.report.tables import Drawing, Table
from patchproof.study.study import Cell, Result, Study, short_name
from patchproof.study.trained import (
    Told,
    TrainedSettings,
    Way,
    Word,
    cell_of,
    grouped,
    left_out_note,
    networks_of,
    object_file,
    problem_of,
    said,
    scenes_of,
    tested_in,
    trained_on,
)

CONTROLS = ("bare", "grey", "noise", "shuffled")
_SHEET_PX, _SHEET_VIEWS = 160, 4


class DeceiveSettings(TrainedSettings):
    """As in all studies of trained designs; each network trains alone and all of them test."""

    # By name: tables of the scene file with the keys that change.
    ways: dict[Word, Way] = Field(
        {"free": {"patch": {"kind": "texture"}}, "within_8": {"patch": {"kind": "texture", "epsilon": 8 / 255}}},
        min_length=1,
    )


def cells(settings: DeceiveSettings, base: Path) -> list[Cell]:
    """One per scene, way, network and seed; the goal is `deceive` whatever the scene file says."""
    networks, found = networks_of(settings, base), []
    for _, _, values in scenes_of(settings, base):
        scene = values["scene"] | {"target": {**values["scene"]["target"], "goal": "deceive"}}
        for network in networks:
            found.extend(
                cell_of(values | {"scene": scene}, short_name(network), (network,), networks, seed)
                for seed in settings.seeds
            )
    return found


def run(settings: DeceiveSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Train against one network, show design and controls to all."""
    problem = problem_of(base, cell)
    design = best_design(trained_on(problem, cell))
    things = shown_with_controls(problem, design, CONTROLS)
    found = said(judged(problem, things, problem.scene.draw("evaluate", settings.n)))
    sheet = f"{cell.name}.sheet.png"
    rows = [pictures(problem, one, sides(problem, _SHEET_VIEWS), _SHEET_PX) for one in things.values()]
    return {
        **found,
        "sheet": sheet,
        sheet: contact_sheet(rows),
        f"{cell.name}.{'glb' if problem.scene.piece is None else 'png'}": object_file(problem, design),
    }


def tables(settings: DeceiveSettings, results: Sequence[Result]) -> list[Table]:
    """Rates of everything shown, and the design minus each control."""
    rates, differences = [], []
    for (scene, way), by_row in grouped(results).items():
        for row, cells_of_row in by_row.items():
            told = {kind: Told(cells_of_row, kind) for kind in ("design", *CONTROLS)}
            for network in tested_in(cells_of_row):
                start = (scene, way, row, short_name(network))
                levels = [one.level(network) for one in told.values()]
                rates.append((*start, *(level[0] for level in levels), levels[0][1]))
                gains = [told["design"].gain(told[kind], network)[0] for kind in CONTROLS]
                differences.append((*start, *gains))
    head, n = ("scene", "way", "trained on", "tested on"), f"{settings.n} unseen conditions per seed"
    note = left_out_note(settings, results)
    return [
        Table("rates", "Rates", (*head, "design", *CONTROLS, "confidence"), tuple(rates), f"Over {n}.{note}"),
        Table(
            "differences",
            "The design minus each control",
            (*head, *(f"minus {kind}" for kind in CONTROLS)),
            tuple(differences),
            f"Of rates, paired over {n}: below zero hides the object better than what was not trained to.",
        ),
    ]


def figures(settings: DeceiveSettings, results: Sequence[Result]) -> list[Drawing]:
    """One contact sheet per scene, way and network: the design, then the controls."""
    return [
        Drawing(
            f"sheet_{scene}_{way}_{row}",
            f"{scene}, {way}, trained on {row}",
            lambda figure, one=cells_of_row[0]: _sheet(figure, one),
            (1.2 * _SHEET_VIEWS + 0.8, 1.2 * (1 + len(CONTROLS))),
            "In even light; the first seed.",
        )
        for (scene, way), by_row in grouped(results).items()
        for row, cells_of_row in by_row.items()
    ]


def _sheet(figure, one: Result) -> None:

    axes = figure.add_subplot()
    axes.imshow(image_pixels((one.out / one.found[one.found["sheet"]]).read_bytes()))
    kinds = ("design", *CONTROLS)
    axes.set_yticks([_SHEET_PX * (i + 0.5) for i in range(len(kinds))], kinds)
    axes.set_xticks([])


STUDY = Study(
    "deceive",
    "Textures that hide an object from networks, beside gray, noise and shuffled controls.",
    DeceiveSettings,
    cells,
    run,
    tables,
    figures,
)
