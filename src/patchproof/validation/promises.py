"""Whether promised rates hold in independently rendered photographs.

Many runs are promised, printed, photographed by a renderer that is not ours, and verified.
In: scene files, networks, printers, seeds. Out: for every combination the promised rate, the interval of counts that
its photographs should show, and the count that they did show; the share of intervals that held, their widths, and the
bias of each scene. A cell runs the same commands as a user does: optimize, sheet, reprint, verify.

Photographs are path-traced (`path_traced`), since those of our own renderer would share the promise's mistakes; without
`path_traced = true` they are ours, and only sampling and the page in between are tested.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field

from patchproof.claims import mean, prediction_interval, rate
from patchproof.report.tables import Drawing, Table
from patchproof.study.grid import (
    GridSettings,
    Names,
    cell_of,
    networks_at,
    pairs,
    scene_of,
    short_name,
    with_tables,
)
from patchproof.study.study import Cell, Result, Study

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class PromisesSettings(GridSettings):
    """A run for each scene, network, printer and seed."""

    printers: Names = ("coated",)  # that print the designs, and are known while optimizing
    photos: Annotated[int, Field(ge=10, le=1000)] = 40  # of each print
    path_traced: bool = True  # taken by Mitsuba 3, else by our renderer


def cells(settings: PromisesSettings, base: Path) -> list[Cell]:
    """One per combination, with the whole scene in it."""
    return [
        cell_of(
            with_tables(values, {"target": {"models": values["networks"]}, "printer": {"profile": printer}}),
            seed,
            values["network"],
            short_name(printer),
        )
        for values in pairs(settings, base)
        for printer in settings.printers
        for seed in settings.seeds
    ]


def run(settings: PromisesSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Promise and count of one combination."""
    from patchproof.journey.verify import verify_photos
    from patchproof.optimizer.run import optimize_scene
    from patchproof.printing.sheet import sheet_of
    from patchproof.reprints.hung_sheet import Hanging
    from patchproof.reprints.reprint import reprint

    scene = scene_of(base, cell.values)
    scene = replace(scene, settings=scene.settings.changed(target={"models": networks_at(base, cell.values)}))
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        # one control is enough for a page, and all of them would take most of a promise's time
        made = optimize_scene(scene, folder / "run", controls=("bare",))
        sheet_of(made, folder / "sheet.pdf")
        pdf, photos = folder / "sheet.pdf", folder / "photos"
        reprint(pdf, made, settings.photos, photos, Hanging(path_traced=settings.path_traced))
        report = verify_photos(photos, folder / "sheet.json", folder / "report")
    summary = report.summary
    return {
        "rate": made.promise.rate,
        "n": made.promise.n,
        "judged": summary.judged,
        "recognized": round((summary.rate or 0) * summary.judged),
        "verdict": summary.verdict,
    }


def tables(settings: PromisesSettings, results: Sequence[Result]) -> tuple[Table, ...]:
    """Shares that held, by scene and in all; every combination."""
    return _shares(settings, results), _each(results)


Count = Mapping[str, Any]  # what a cell counted: promised rate and its n, photographs judged and recognized


def interval_of(count: Count) -> tuple[int, int]:
    """Counts that the promise allows."""
    return prediction_interval(round(count["rate"] * count["n"]), count["n"], count["judged"])


def held(count: Count) -> bool:
    """Whether the count lies in the promise's interval."""
    low, high = interval_of(count)
    return low <= count["recognized"] <= high


def _bias(counts: Sequence[Count]) -> list[float]:
    return [count["recognized"] / count["judged"] - count["rate"] for count in counts]


def _width(counts: Sequence[Count]) -> float:
    """The median width of the intervals, as a share of the photographs."""
    ends = [(interval_of(count), count["judged"]) for count in counts]
    return float(np.median([(high - low) / judged for (low, high), judged in ends]))


def _by_scene(results: Sequence[Result]) -> dict[str, list[Count]]:
    """By scene the counts of those that could be judged."""
    scenes: dict[str, list[Count]] = {}
    for result in results:
        if result.answers["judged"]:
            scenes.setdefault(result.cell.values["name"], []).append(result.answers)
    return scenes


def _shares(settings: PromisesSettings, results: Sequence[Result]) -> Table:
    scenes = _by_scene(results)
    groups = {**scenes, "all": [count for counts in scenes.values() for count in counts]} if scenes else {}
    rows = tuple((name, rate(list(map(held, some))), _width(some), mean(_bias(some))) for name, some in groups.items())
    how = "path-traced" if settings.path_traced else "our own renderer's"
    about = f"{settings.photos} {how} photographs for each promise; width: median, as a share of the photographs; "
    about += "bias: recognized minus promised rate"
    return Table("held", "Promises that held", ("scene", "held", "width", "bias"), rows, about)


def _each(results: Sequence[Result]) -> Table:
    head = ("scene", "network", "printer", "seed", "promised", "judged", "recognized", "low", "high")
    rows = []
    for result in results:
        values, count = result.cell.values, result.answers
        if count["judged"]:
            printer = short_name(values["scene"]["printer"]["profile"])
            start = (values["name"], values["network"], printer, values["seed"])
            what = (count["rate"], count["judged"], count["recognized"], *interval_of(count))
            rows.append((*start, *what, held(count), count["verdict"]))
    unseen = len(results) - len(rows)
    about = f"{unseen} combinations without a photograph that could be judged are left out" if unseen else ""
    return Table("promises", "Every promise", (*head, "held", "verdict"), tuple(rows), about)


def figures(settings: PromisesSettings, results: Sequence[Result]) -> tuple[Drawing, ...]:
    """The calibration plot."""
    scenes = _by_scene(results)
    if not scenes:
        return ()

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.plot([0, 1], [0, 1], color="0.6", linewidth=1)
        for name, counts in scenes.items():
            promised = [count["rate"] for count in counts]
            shares = [count["recognized"] / count["judged"] for count in counts]
            low, high = np.array([np.array(interval_of(count)) / count["judged"] for count in counts]).T
            (line,) = axes.plot(promised, shares, "o", label=name, markersize=5)
            axes.vlines(promised, low, high, colors=line.get_color(), alpha=0.35, linewidth=3)
        axes.set(xlabel="promised rate", ylabel="share recognized in photographs", xlim=(0, 1.02), ylim=(-0.02, 1.04))
        axes.legend(loc="upper left", fontsize=8)

    about = "points: what the photographs showed; bars: the promises' 95 % prediction intervals"
    return (Drawing("calibration", "Promised and seen", draw, (6.0, 5.0), about),)


STUDY = Study("promises", PromisesSettings, cells, run, tables, figures)
