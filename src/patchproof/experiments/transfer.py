"""Study "transfer": train on each network, test on each, and on ensembles with one network left out.

In: scenes, ways (full texture, masked, many or few signed steps, patches, ...), networks and seeds. Out: the matrix of
rates and confidences with intervals, each beside the *original* object's on the same conditions; what a network gains
from designs that never saw it; three fixed views in changed light; heat maps and contact sheets; each design as a GLB
that opens elsewhere. A nil transfer is said, with its interval.

Source: Pestana et al., algorithm "Full Texture" and table "Transferability". Their ε is the signed step. Intervals are
over conditions, of the designs that were trained: another seed's design may do better or worse.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from patchproof.claims import Estimate, rate
from patchproof.experiments.turntable import contact_sheet, pictures, sides, three_views
from patchproof.optimizer.loop import best_design
from patchproof.optimizer.promise import judged, shown_with_controls
from patchproof.output import image_pixels
from patchproof.report.tables import Drawing, Table
from patchproof.scene.mesh_scene import MeshScene
from patchproof.study.study import Cell, Result, Study, short_name
from patchproof.study.trained import (
    ORIGINAL,
    Told,
    TrainedSettings,
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
    verdict,
)

_ALL, _WITHOUT = "all", "without_"
_SHEET_PX = 224


class TransferSettings(TrainedSettings):
    """As in all studies of trained designs."""

    ensembles: bool = True  # also trained on all networks but one, each in turn, and on all
    lights: Annotated[int, Field(ge=1)] = 20  # lights in each of three fixed views


def cells(settings: TransferSettings, base: Path) -> list[Cell]:
    """The original and every training set, per scene, way and seed."""
    networks, found = networks_of(settings, base), []
    rows = {ORIGINAL: (), **{short_name(name): (name,) for name in networks}}
    if settings.ensembles and len(networks) > 1:
        if len(networks) > 2:  # else one network is left, which is a row already
            rows |= {_WITHOUT + short_name(out): tuple(one for one in networks if one != out) for out in networks}
        rows[_ALL] = networks
    for _, _, values in scenes_of(settings, base):
        for row, trained in rows.items():
            found.extend(cell_of(values, row, trained, networks, seed) for seed in settings.seeds)
    return found


def run(settings: TransferSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Train where the cell says so, and test."""
    problem = problem_of(base, cell)
    files, things = {}, {"design": None}
    if cell.values["trained"]:
        design = best_design(trained_on(problem, cell))
        things = shown_with_controls(problem, design, ())
        files[f"{cell.name}.{'glb' if problem.scene.piece is None else 'png'}"] = object_file(problem, design)
    found = said(judged(problem, things, problem.scene.draw("evaluate", settings.n)))
    found["sheet"] = f"{cell.name}.sheet.png"
    files[found["sheet"]] = contact_sheet([pictures(problem, things["design"], sides(problem, 3), _SHEET_PX)])
    if isinstance(problem.scene, MeshScene):
        views = three_views(problem, settings.lights)
        found["views"] = said(judged(problem, things, views))["hits"]
        found["azimuths"] = views.pose.azimuth_deg[:: settings.lights].tolist()
    return found | files


def tables(settings: TransferSettings, results: Sequence[Result]) -> list[Table]:
    """The matrix, networks left out, and fixed views."""
    return [_matrix(settings, results), *_left_out(results), *_views(settings, results)]


def _matrix(settings: TransferSettings, results: Sequence[Result]) -> Table:
    rows = []
    for (scene, way), by_row in grouped(results).items():
        original = Told(by_row.get(ORIGINAL, ()), "design")
        for row, cells_of_row in by_row.items():
            told = Told(cells_of_row, "design")
            for network in tested_in(cells_of_row):
                (level, sure), (gain, surer) = told.level(network), told.gain(original, network)
                trained = network in cells_of_row[0].cell.values["trained"]
                start = (scene, way, row, short_name(network))
                if row == ORIGINAL:
                    rows.append((*start, "", level, None, "", sure, None))
                else:
                    rows.append((*start, "yes" if trained else "no", level, gain, verdict(gain), sure, surer))
    head = ("scene", "way", "trained on", "tested on", "seen", "rate", "gain in rate", "shows")
    head = (*head, "confidence", "gain in confidence")
    about = (
        f"Rates and mean confidences of the target over {settings.n} unseen conditions per seed"
        f" ({len(settings.seeds)} of them); gains are over the original on the same conditions, paired."
        f"{left_out_note(settings, results)}"
    )
    return Table("matrix", "Trained on one, tested on another", head, tuple(rows), about)


def _left_out(results: Sequence[Result]) -> list[Table]:
    rows = []
    for (scene, way), by_row in grouped(results).items():
        original = Told(by_row.get(ORIGINAL, ()), "design")
        for network in tested_in(results):
            if (without := by_row.get(_WITHOUT + short_name(network))) is None:
                continue
            told = Told(without, "design")
            gain, confidence = told.gain(original, network)
            before, after = original.level(network)[0], told.level(network)[0]
            single = _from_others(by_row, network)
            rows.append((scene, way, short_name(network), before, after, gain, confidence, single, verdict(gain)))
    head = ("scene", "way", "left out", "original", "ensemble of the others", "gain", "gain in confidence")
    head = (*head, "mean rate of one other", "shows")
    about = "Each network judges a design that was trained on all others together; beside it, those trained on one."
    return [Table("left_out", "Networks left out", head, tuple(rows), about)] if rows else []


def _from_others(by_row: dict[str, list[Result]], network: str) -> float | None:
    """The mean rate on a network of the designs trained on one of the others."""
    levels = [
        Told(results, "design").level(network)[0].value
        for results in by_row.values()
        if len(trained := results[0].cell.values["trained"]) == 1 and network not in trained
    ]
    return float(np.mean(levels)) if levels else None


def _views(settings: TransferSettings, results: Sequence[Result]) -> list[Table]:
    rows = []
    for (scene, way), by_row in grouped(results).items():
        for row, cells_of_row in by_row.items():
            for network in cells_of_row[0].cell.values["trained"]:
                for number, azimuth in enumerate(cells_of_row[0].found.get("azimuths", ())):
                    before = _in_view(settings, by_row.get(ORIGINAL, ()), network, number)
                    after = _in_view(settings, cells_of_row, network, number)
                    rows.append((scene, way, row, short_name(network), azimuth, before, after))
    head = ("scene", "way", "trained on", "tested on", "azimuth (deg)", "original", "design")
    about = f"Three fixed views, {settings.lights} drawn lights, backgrounds and cameras each, on training networks."
    return [Table("views", "Three views in changed light", head, tuple(rows), about)] if rows else []


def _in_view(settings: TransferSettings, results: Sequence[Result], network: str, number: int) -> Estimate | None:
    part = slice(number * settings.lights, (number + 1) * settings.lights)
    texts = [one.found["views"]["design"][one.cell.values["tested"].index(network)][part] for one in results]
    return rate([hit == "1" for text in texts for hit in text])


def figures(settings: TransferSettings, results: Sequence[Result]) -> list[Drawing]:
    """A heat map and a contact sheet per scene and way."""
    found = []
    for (scene, way), by_row in grouped(results).items():
        height = 1.2 + 0.33 * len(by_row)
        found.append(
            Drawing(
                f"heat_{scene}_{way}",
                f"Transfer: {scene}, {way}",
                lambda figure, by_row=by_row: _heat_map(figure, by_row),
                (3.0 + 1.9 * len(tested_in(results)), height + 0.9),
                "Rows: trained on. Columns: tested on. Below each rate, its gain over the original.",
            )
        )
        found.append(
            Drawing(
                f"sheet_{scene}_{way}",
                f"Designs: {scene}, {way}",
                lambda figure, by_row=by_row: _sheets(figure, by_row),
                (6.5, 1.75 * len(by_row)),
                "Three views in even light; the first seed.",
            )
        )
    return found


def _heat_map(figure, by_row: dict[str, list[Result]]) -> None:
    networks = tested_in([one for cells_of_row in by_row.values() for one in cells_of_row])
    original = Told(by_row.get(ORIGINAL, ()), "design")
    told = {row: Told(cells_of_row, "design") for row, cells_of_row in by_row.items()}
    panels = figure.subplots(1, 2, sharey=True)
    for which, (axes, title) in enumerate(zip(panels, ("rate", "mean confidence"), strict=True)):
        values = np.array([[one.level(network)[which].value for network in networks] for one in told.values()])
        axes.imshow(values, cmap="viridis", vmin=0, vmax=1, aspect="auto")
        for y, (row, one) in enumerate(told.items()):
            for x, network in enumerate(networks):
                gain = None if row == ORIGINAL else one.gain(original, network)[which]
                text = f"{values[y, x]:.2f}" + (f"\n{gain.value:+.2f}" if gain is not None else "")
                dark = values[y, x] < 0.6
                axes.text(x, y, text, ha="center", va="center", fontsize=6, color="white" if dark else "black")
        axes.set_xticks(range(len(networks)), [short_name(one) for one in networks], rotation=25, ha="right")
        axes.set_yticks(range(len(told)), list(told))
        axes.set_title(title)
    panels[0].set_ylabel("trained on")


def _sheets(figure, by_row: dict[str, list[Result]]) -> None:

    for axes, (row, cells_of_row) in zip(
        figure.subplots(len(by_row), 1, squeeze=False)[:, 0], by_row.items(), strict=True
    ):
        one = cells_of_row[0]
        content = (one.out / one.found[one.found["sheet"]]).read_bytes()
        axes.imshow(image_pixels(content))
        axes.set_title(row, fontsize=8, loc="left", pad=2)
        axes.set_axis_off()


STUDY = Study(
    "transfer",
    "Designs trained on each network and on ensembles, tested on every network, beside the original object.",
    TransferSettings,
    cells,
    run,
    tables,
    figures,
)
