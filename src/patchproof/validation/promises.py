"""Whether promises hold: many runs, each promised, printed, photographed by a renderer that is not ours, and verified.

In: scene files, networks, printers, seeds. Out: for every combination the promised rate, the interval of counts that
its photographs should show, and the count that they did show; the share of intervals that held, their widths, the bias
of each scene, and what a correction would be worth: a shift of the promise's log odds, fitted on every other scene and
judged on the rest. A cell runs the same commands as a user does: optimize, sheet, reprint, verify.

Photographs are path-traced (`path_traced`), since those of our own renderer would share the promise's mistakes; without
`path_traced = true` they are ours, and only sampling and the page in between are tested.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field

from patchproof.claims import mean, prediction_interval, rate
from patchproof.report.tables import Drawing, Table
from patchproof.settings import SceneSettings
from patchproof.strict import Strict, expand, read_toml, validated
from patchproof.study.study import Cell, Result, Study, short_name

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Names = Annotated[tuple[str, ...], Field(min_length=1)]
_LOW, _HIGH = 1e-3, 1 - 1e-3  # rates whose odds are taken


class PromisesSettings(Strict):
    """Every scene with every network, printer and seed; paths are relative to the config's folder."""

    scenes: Names  # scene files
    networks: Names  # each trains and judges its own designs
    printers: Names = ("coated",)  # that print the designs, and are known while optimizing
    seeds: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)] = (0,)  # of the optimizer
    photos: Annotated[int, Field(ge=10, le=1000)] = 40  # of each print
    path_traced: bool = True  # taken by Mitsuba 3, else by our renderer


def cells(settings: PromisesSettings, base: Path) -> list[Cell]:
    """One per combination, with the whole scene in it."""
    found = []
    for file in settings.scenes:
        path = Path(expand(file, base))
        data = read_toml(path)
        for network in settings.networks:
            for printer in settings.printers:
                tables = {"target": {"models": [network]}, "printer": {"profile": printer}}
                whole = data | {name: {**data.get(name, {}), **keys} for name, keys in tables.items()}
                scene = validated(SceneSettings, whole, path.name).model_dump(mode="json")
                for seed in settings.seeds:
                    words = (path.stem, short_name(network), short_name(printer), str(seed))
                    name = re.sub(r"[^\w=+.,-]", "-", ".".join(words))
                    values = {"name": path.stem, "file": file, "scene": scene, "seed": seed}
                    found.append(Cell(name, values | {"network": network, "printer": printer}))
    return found


def run(settings: PromisesSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Promise and count of one combination."""
    from patchproof.journey.verify import verify_photos
    from patchproof.optimizer.run import optimize_scene
    from patchproof.printing.sheet import sheet_of
    from patchproof.reprints.hung_sheet import Hanging
    from patchproof.reprints.reprint import reprint
    from patchproof.study.trained import scene_of

    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        # one control is enough for a page, and all of them would take most of a promise's time
        made = optimize_scene(scene_of(base, cell), folder / "run", controls=("bare",))
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
    """Shares that held, by scene and in all; the correction; every combination."""
    return _shares(settings, results), _correction(results), _each(results)


def interval_of(found, shift: float = 0.0) -> tuple[int, int]:
    """Counts that the promise allows, with its log odds shifted."""
    promised = round(float(shifted(found["rate"], shift)) * found["n"])
    return prediction_interval(promised, found["n"], found["judged"])


def held(found, shift: float = 0.0) -> bool:
    """Whether the count lies in the promise's interval."""
    low, high = interval_of(found, shift)
    return low <= found["recognized"] <= high


def shifted(rates, shift: float) -> np.ndarray:
    """Rates with their log odds shifted; 0 and 1 keep to a thousandth."""
    if shift == 0:
        return np.asarray(rates, float)
    rates = np.clip(rates, _LOW, _HIGH)
    return 1 / (1 + (1 / rates - 1) * np.exp(-shift))


def fitted_shift(founds: Sequence) -> float:
    """The shift that makes the counts most likely."""
    from scipy.optimize import minimize_scalar

    rates, hits, n = (np.array([found[key] for found in founds], float) for key in ("rate", "recognized", "judged"))

    def unlikely(shift: float) -> float:
        p = shifted(rates, shift or 1e-12)
        return -float((hits * np.log(p) + (n - hits) * np.log(1 - p)).sum())

    return float(minimize_scalar(unlikely, bounds=(-3, 3), method="bounded").x)


def _judged(results: Sequence[Result]) -> list[Result]:
    return [one for one in results if one.found["judged"]]


def _bias(founds: Sequence, shift: float = 0.0) -> list[float]:
    return [found["recognized"] / found["judged"] - float(shifted(found["rate"], shift)) for found in founds]


def _width(founds: Sequence, shift: float = 0.0) -> float:
    """The median width of the intervals, as a share of the photographs."""
    ends = [(interval_of(found, shift), found["judged"]) for found in founds]
    return float(np.median([(high - low) / judged for (low, high), judged in ends]))


def _by_scene(results: Sequence[Result]) -> dict[str, list]:
    found: dict[str, list] = {}
    for one in _judged(results):
        found.setdefault(one.cell.values["name"], []).append(one.found)
    return found


def _shares(settings: PromisesSettings, results: Sequence[Result]) -> Table:
    scenes = _by_scene(results)
    groups = {**scenes, "all": [found for some in scenes.values() for found in some]}
    rows = tuple(
        (name, rate([held(found) for found in some]), _width(some), mean(_bias(some))) for name, some in groups.items()
    )
    how = "path-traced" if settings.path_traced else "our own renderer's"
    about = f"{settings.photos} {how} photographs for each promise; width: median, as a share of the photographs; "
    about += "bias: recognized minus promised rate"
    return Table("held", "Promises that held", ("scene", "held", "width", "bias"), rows if scenes else (), about)


def _correction(results: Sequence[Result]) -> Table:
    scenes = list(_by_scene(results).items())
    halves = [[found for _, some in scenes[i::2] for found in some] for i in (0, 1)]
    head = ("fitted on", "judged on", "shift of the log odds", "held without", "held with", "bias without", "bias with")
    rows = []
    for fit, judge in ((0, 1), (1, 0)):
        if not halves[fit] or not halves[judge]:
            continue
        shift, others = fitted_shift(halves[fit]), halves[judge]
        names = [", ".join(name for name, _ in scenes[half::2]) for half in (fit, judge)]
        shares = [rate([held(found, by) for found in others]) for by in (0.0, shift)]
        rows.append((*names, shift, *shares, *(mean(_bias(others, by)) for by in (0.0, shift))))
    about = "one shift for all; verify does not use it"
    return Table("correction", "What a correction would be worth", head, tuple(rows), about)


def _each(results: Sequence[Result]) -> Table:
    head = ("scene", "network", "printer", "seed", "promised", "judged", "recognized", "low", "high")
    rows = []
    for one in _judged(results):
        values, found = one.cell.values, one.found
        who = (values["name"], short_name(values["network"]), short_name(values["printer"]), values["seed"])
        what = (found["rate"], found["judged"], found["recognized"], *interval_of(found))
        rows.append((*who, *what, held(found), found["verdict"]))
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
        for name, some in scenes.items():
            promised, seen = [f["rate"] for f in some], [f["recognized"] / f["judged"] for f in some]
            ends = np.array([np.array(interval_of(f)) / f["judged"] for f in some]).T
            middle = ends.mean(0)
            (line,) = axes.plot(promised, seen, "o", label=name, markersize=5)
            axes.errorbar(
                promised, middle, yerr=middle - ends[0], fmt="none", ecolor=line.get_color(), alpha=0.35, linewidth=3
            )
        axes.set(xlabel="promised rate", ylabel="share recognized in photographs", xlim=(0, 1.02), ylim=(-0.02, 1.04))
        axes.legend(loc="upper left", fontsize=8)

    about = "points: what the photographs showed; bars: the promises' 95 % prediction intervals"
    return (Drawing("calibration", "Promised and seen", draw, (6.0, 5.0), about),)


STUDY = Study(
    "promises",
    "Whether promised rates hold in independently rendered photographs.",
    PromisesSettings,
    cells,
    run,
    tables,
    figures,
)
