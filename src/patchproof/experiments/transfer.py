"""Designs trained on each network and on ensembles, tested on every network, beside the original object.

In: scenes, ways (full texture, masked, many or few signed steps, patches, ...), networks and seeds. Out: the matrix of
rates and confidences with intervals, each beside the *original* object's on the same conditions; what a network gains
from designs that never saw it; three fixed views in changed light; heat maps and contact sheets; each design as a GLB
that opens elsewhere. A nil transfer is said, with its interval.

Source: Pestana et al., algorithm "Full Texture" and table "Transferability". Their ε is the signed step, here
`optimize.step_size`; a ball round the start is `patch.epsilon`. Intervals are over conditions, of the designs that were
trained: another seed's design may do better or worse.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from patchproof.claims import rate
from patchproof.experiments.sides import sides, three_views
from patchproof.optimizer.loop import best_design
from patchproof.optimizer.promise import shown_with_controls
from patchproof.optimizer.responses import responses
from patchproof.render.photograph import Shown
from patchproof.report.tables import Drawing, Table
from patchproof.study.figures import number_grid, picture_sheet
from patchproof.study.grid import Count, grouped, of_values, problem_of, short_name
from patchproof.study.pictures import contact_sheet, photographs
from patchproof.study.record import Record, recorded
from patchproof.study.study import Cell, Result, Study
from patchproof.study.trained import (
    ORIGINAL,
    TrainedSettings,
    alone,
    tested_in,
    trained_cells,
    trained_on,
    verdict,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_ALL, _WITHOUT = "all", "without_"
_SHEET_PX = 224


class TransferSettings(TrainedSettings):
    """As in all studies of trained designs."""

    ensembles: bool = True  # also trained on all networks but one, each in turn, and on all
    lights: Count = 20  # lights in each of three fixed views


def cells(settings: TransferSettings, base: Path) -> list[Cell]:
    """The original and every training set, per scene, way and seed."""

    def rows(networks: Sequence[str]) -> dict[str, Sequence[str]]:
        ensembles: dict[str, Sequence[str]] = {}
        if settings.ensembles and len(networks) > 1:
            if len(networks) > 2:  # else one network is left, which is a row already
                ensembles = {_WITHOUT + short_name(out): [name for name in networks if name != out] for out in networks}
            ensembles[_ALL] = networks
        return {ORIGINAL: (), **alone(networks), **ensembles}

    return trained_cells(settings, base, rows)


def run(settings: TransferSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Train where the cell says so, and test."""
    problem = problem_of(base, cell.values)
    answers: dict[str, Any] = {}
    things: dict[str, Shown] = {"design": None}
    if cell.values["trained"]:
        design = best_design(trained_on(problem, cell))
        things = shown_with_controls(problem, design, ())
        suffix, content = problem.subject.file(design)
        answers[f"{cell.name}.{suffix}"] = content
    answers |= recorded(responses(problem, things, problem.scene.draw("evaluate", settings.n)))
    views = photographs(problem, things["design"], sides(problem, 3), _SHEET_PX)
    answers[f"{cell.name}.sheet.png"] = contact_sheet([views])
    if problem.scene.HAS_OBJECT:
        fixed = three_views(problem, settings.lights)
        answers["views"] = recorded(responses(problem, things, fixed))
        answers["azimuths"] = fixed.pose.azimuth_deg[:: settings.lights].tolist()
    return answers


def tables(settings: TransferSettings, results: Sequence[Result]) -> list[Table]:
    """The matrix, networks left out, and fixed views."""
    rows = _rows(results)
    return [_matrix(settings, rows), *_left_out(results, rows), *_views(settings, rows)]


Rows = Mapping[tuple, Mapping[str, Sequence[Result]]]  # results by (scene, way), then by row


def _rows(results: Sequence[Result]) -> Rows:
    groups = grouped(results, of_values("name", "way"))
    return {key: grouped(group, lambda result: result.cell.values["row"]) for key, group in groups.items()}


def _matrix(settings: TransferSettings, groups: Rows) -> Table:
    rows = []
    for key, by_row in groups.items():
        original = Record(by_row.get(ORIGINAL, ()), "design")
        for row, of_row in by_row.items():
            record = Record(of_row, "design")
            for network in tested_in(of_row):
                (level, sure), (gain, surer) = record.level(network), record.gain(original, network)
                trained = network in of_row[0].cell.values["trained"]
                start = (*key, row, short_name(network))
                if row == ORIGINAL:
                    rows.append((*start, "", level, None, "", sure, None))
                else:
                    rows.append((*start, "yes" if trained else "no", level, gain, verdict(gain), sure, surer))
    head = ("scene", "way", "trained on", "tested on", "seen", "rate", "gain in rate", "shows")
    about = (
        f"Rates and mean confidences of the target over {settings.n} unseen conditions per seed"
        f" ({len(settings.seeds)} of them); gains are over the original on the same conditions, paired."
    )
    head = (*head, "confidence", "gain in confidence")
    return Table("matrix", "Trained on one, tested on another", head, tuple(rows), about)


def _left_out(results: Sequence[Result], groups: Rows) -> list[Table]:
    rows = []
    for key, by_row in groups.items():
        original = Record(by_row.get(ORIGINAL, ()), "design")
        for network in tested_in(results):
            if (without := by_row.get(_WITHOUT + short_name(network))) is None:
                continue
            record = Record(without, "design")
            gain, confidence = record.gain(original, network)
            before, after = original.level(network)[0], record.level(network)[0]
            single = _from_others(by_row, network)
            rows.append((*key, short_name(network), before, after, gain, confidence, single, verdict(gain)))
    head = ("scene", "way", "left out", "original", "ensemble of the others", "gain", "gain in confidence")
    head = (*head, "mean rate of one other", "shows")
    about = "Each network judges a design that was trained on all others together; beside it, those trained on one."
    return [Table("left_out", "Networks left out", head, tuple(rows), about)] if rows else []


def _from_others(by_row: Mapping[str, Sequence[Result]], network: str) -> float | None:
    """The mean rate on a network of the designs trained on one of the others."""
    rates = [
        np.mean(Record(results, "design").hits(network))
        for results in by_row.values()
        if len(trained := results[0].cell.values["trained"]) == 1 and network not in trained
    ]
    return float(np.mean(rates)) if rates else None


def _views(settings: TransferSettings, groups: Rows) -> list[Table]:
    rows = []
    for key, by_row in groups.items():
        for row, of_row in by_row.items():
            for network in of_row[0].cell.values["trained"] if "views" in of_row[0].answers else ():
                records = (Record(some, "design", "views") for some in (by_row.get(ORIGINAL, ()), of_row))
                before, after = (np.reshape(record.hits(network), (-1, 3, settings.lights)) for record in records)
                for i, azimuth in enumerate(of_row[0].answers["azimuths"]):
                    rates = (rate(hits[:, i].ravel().tolist()) for hits in (before, after))
                    rows.append((*key, row, short_name(network), azimuth, *rates))
    head = ("scene", "way", "trained on", "tested on", "azimuth (deg)", "original", "design")
    about = f"Three fixed views, {settings.lights} drawn lights, backgrounds and cameras each, on training networks."
    return [Table("views", "Three views in changed light", head, tuple(rows), about)] if rows else []


def figures(settings: TransferSettings, results: Sequence[Result]) -> list[Drawing]:
    """A heat map and a contact sheet per scene and way."""
    networks, drawings = tested_in(results), []
    for (scene, way), by_row in _rows(results).items():
        drawings += [
            Drawing(
                f"heat_{scene}_{way}",
                f"Transfer: {scene}, {way}",
                lambda figure, by_row=by_row: _heat_map(figure, by_row, networks),
                (3.0 + 1.9 * len(networks), 2.1 + 0.33 * len(by_row)),
                "Rows: trained on. Columns: tested on. Below each rate, its gain over the original.",
            ),
            picture_sheet(
                f"sheet_{scene}_{way}",
                f"Designs: {scene}, {way}",
                [(row, of_row[0].file(f"{of_row[0].cell.name}.sheet.png")) for row, of_row in by_row.items()],
                (6.5, 1.75 * len(by_row)),
                "Three views in even light; the first seed.",
            ),
        ]
    return drawings


def _heat_map(figure: Figure, by_row: Mapping[str, Sequence[Result]], networks: Sequence[str]) -> None:
    original = Record(by_row.get(ORIGINAL, ()), "design")
    records = {row: Record(of_row, "design") for row, of_row in by_row.items()}
    panels = figure.subplots(1, 2, sharey=True)
    for which, (axes, title) in enumerate(zip(panels, ("rate", "mean confidence"), strict=True)):
        values, texts = np.full((len(records), len(networks)), np.nan), []
        for y, (row, record) in enumerate(records.items()):
            texts.append([])
            for x, network in enumerate(networks):
                level, gain = record.level(network)[which], record.gain(original, network)[which]
                values[y, x] = np.nan if level is None else level.value
                texts[y].append(
                    f"{values[y, x]:.2f}" + ("" if row == ORIGINAL or gain is None else f"\n{gain.value:+.2f}")
                )
        number_grid(axes, values, texts, fontsize=6)
        axes.set_xticks(range(len(networks)), [short_name(name) for name in networks], rotation=25, ha="right")
        axes.set_yticks(range(len(records)), list(records))
        axes.set_title(title)
    panels[0].set_ylabel("trained on")


STUDY = Study("transfer", TransferSettings, cells, run, tables, figures)
