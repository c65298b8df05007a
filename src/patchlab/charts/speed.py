"""Chart speed against accuracy: whole runs beside other methods, and verification beside other detectors.

In: scenes with one network each. A cell is one method on one pair of object and network: seconds of one core from the
scene to the design (ours: with its promise), and hits in fresh views that all methods share. Cells of the ceiling train
with ten times the steps, from several seeds, at the scene's own place and the best ones of a search; the best is chosen
in views of the promise's stream. A cell of photographs tries one detector on paper that our renderer did not draw.
Out: seconds and gain over the best control by method, with the front; photographs a second, corner errors and the share
that is right by detector. Left out on purpose: seconds that a process takes to start.
"""

from collections.abc import Mapping, Sequence
from functools import lru_cache, partial
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from patchlab.charts.detect import FINDERS, try_finder
from patchlab.charts.drawing import COLORS, label_points, log_axis, pareto_mask, rows_of, value_and_ends
from patchlab.charts.methods import METHODS
from patchlab.study import grid
from patchlab.study.estimates import cluster_mean, mean, median
from patchlab.study.measure import time_call
from patchlab.study.record import hits_text, parse_hits
from patchlab.study.study import Cell, Result, Study
from patchlab.study.trained_designs import best_design
from patchproof.base.goal import Goal
from patchproof.base.intervals import Estimate
from patchproof.base.validation import StrictModel
from patchproof.optimizer.place_search import Candidate, choose_place
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.optimizer.promise import VIEWS_PER_SESSION, PromiseOptions, pictures_with_controls
from patchproof.optimizer.responses import responses
from patchproof.optimizer.run import DRAFT_EFFORT, THOROUGH_EFFORT
from patchproof.optimizer.run import optimize as optimize_scene
from patchproof.report.tables import Drawing, Table
from patchproof.scene.patch_scene import require_unplaced

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DEFAULT, CEILING, CONTROLS = "default", "ceiling", ("bare", "gray")
MAX_RIGHT_PX = 2.0  # of a corner that is found right
# By method: the name in the chart. Efforts are whole runs with a promise; the others make a design alone.
NAMES = {
    **{"draft": "--draft", DEFAULT: "default", "thorough": "--thorough", "sign": "signed steps", "flat": "2D patch"},
    **{"art": "ART", "unadversarial": "unadversarial"},
}


class Ceiling(StrictModel):
    """Designs of the ceiling: the first `pairs`, so many steps, seeds, and places (the first is the scene's own)."""

    pairs: int = 0  # of the scenes, the first ones; four take longer than the rest of all charts
    steps: int = 2400  # of each design
    seeds: int = 3  # of each place
    places: int = 3  # the scene's own, then the best of a search


class SpeedSettings(grid.GridSettings):
    """Pairs, and the size of everything that is tried on them."""

    efforts: dict[str, tuple[int, int | None]] = Field(
        {"draft": DRAFT_EFFORT, DEFAULT: (240, None), "thorough": THOROUGH_EFFORT}
    )  # steps, and views of the promise (None: as many as the scene's half width needs)
    methods: tuple[str, ...] = ("sign", "flat", "art", "unadversarial")  # beside ours
    n: grid.PositiveInt = 300  # fresh views
    ceiling: Ceiling = Ceiling()
    photos: grid.PositiveInt = 24  # for each detector and size
    sizes_px: tuple[tuple[int, int], ...] = ((1600, 1200), (4000, 3000))  # of photographs


def cells(settings: SpeedSettings, base: Path) -> list[Cell]:
    """Cells of methods, of the ceiling, and of detectors; ART and AprilTag's library only where they are installed."""
    pairs, found = list(grid.scene_network_pairs(settings, base)), []
    methods = [name for name in (*settings.efforts, *settings.methods) if name != "art" or find_spec("art")]
    for values in pairs:
        values = grid.with_changes(values, {"optimize": {"steps": settings.efforts[DEFAULT][0]}})
        found += [grid.make_cell(values | {"method": name}, 0, values["network"], name) for name in methods]
    for values in pairs[: settings.ceiling.pairs]:
        values = grid.with_changes(values, {"optimize": {"steps": settings.ceiling.steps}}) | {"method": CEILING}
        for place in range(settings.ceiling.places):
            words = values["network"], f"{CEILING}{place}"
            seeds = range(settings.ceiling.seeds)
            found += [grid.make_cell(values | {"place": place}, seed, *words) for seed in seeds]
    finders = [name for name in FINDERS if name != "AprilTag" or find_spec("pupil_apriltags")]
    return found + [
        Cell(f"photos-{name.replace(' ', '_')}-{size[0]}", {"finder": name, "size_px": list(size)})
        for size in settings.sizes_px
        for name in finders
    ]


def run(settings: SpeedSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Make and judge a design, or try a detector."""
    if "finder" in cell.values:
        trial = try_finder(cell.values["finder"], settings.photos, tuple(cell.values["size_px"]))
        errors = [error if np.isfinite(error) else None for error in trial.errors_px]
        return {"milliseconds": trial.milliseconds, "errors_px": errors}
    if cell.values["method"] == CEILING:
        return _run_ceiling(settings, base, cell.values)
    method, problem = cell.values["method"], grid.problem_of(base, cell.values)
    if method in settings.efforts:
        pixels, milliseconds = _make_run(settings.efforts[method], base, cell.values)
    else:
        design, milliseconds = time_call(lambda: METHODS[method](grid.problem_of(base, cell.values)))
        pixels = design.pixels
    hits = _hits(problem, pixels, CONTROLS if method == DEFAULT else (), settings.n)
    return {"seconds": milliseconds / 1000, "hits": hits}


def _make_run(effort: tuple[int, int | None], base: Path, values: Mapping[str, Any]) -> tuple[np.ndarray, float]:
    scene = grid.scene_of(base, grid.with_changes(dict(values), {"optimize": {"steps": effort[0]}}))
    with TemporaryDirectory() as folder:
        networks = grid.network_names(base, values)
        made = partial(optimize_scene, scene, Path(folder) / "run", models=networks, promise=PromiseOptions(effort[1]))
        patch_run, milliseconds = time_call(made)
        return patch_run.design, milliseconds


def _hits(problem: Problem, pixels: np.ndarray, controls: Sequence[str], n: int, own: bool = False) -> dict[str, str]:
    """Hits in fresh views, or in those of a promise of its own."""
    shown = pictures_with_controls(problem, pixels, controls)
    conditions = (
        problem.scene.draw("promise", n, per_session=VIEWS_PER_SESSION) if own else problem.scene.draw("evaluate", n)
    )
    answers = responses(problem, shown, conditions)
    return {thing: hits_text(answer.recognized[0]) for thing, answer in answers.items()}


def _run_ceiling(settings: SpeedSettings, base: Path, values: Mapping[str, Any]) -> dict[str, Any]:
    networks = grid.network_names(base, values)
    scene, place = grid.scene_of(base, values), values["place"]
    if place:
        patch = {"place": "auto", "offset_mm": (0, 0), "spin_deg": 0, "at_mm": None}
        unplaced = require_unplaced(grid.scene_of(base, grid.with_changes(dict(values), {"patch": patch})))
        best = _best_places(str(base), values["file"], networks)
        chosen = best[min(place, len(best)) - 1]  # a small surface has fewer: its last again
        scene = unplaced.with_piece_at(chosen.at, chosen.spin_deg)
    problem = set_problem(scene, models=networks)
    pixels = best_design(problem)
    chosen_by = _hits(problem, pixels, (), settings.n, own=True)["design"]
    return {"chosen_by": chosen_by, "hits": _hits(problem, pixels, (), settings.n)}


@lru_cache(maxsize=8)
def _best_places(base: str, file: str, networks: tuple[str, ...]) -> tuple[Candidate, ...]:
    values = grid.scene_values(file, Path(base), {"patch": {"place": "auto", "offset_mm": (0, 0), "spin_deg": 0}})
    scene = grid.scene_of(Path(base), values | {"seed": 0})
    return choose_place(scene, models=networks).candidates


def _share(text: str) -> float:
    return float(np.mean(parse_hits(text)))


def _gains(results: Sequence[Result]) -> dict[str, dict[str, tuple[float, float | None]]]:
    """By pair and method (gain over the pair's best control, seconds); the ceiling's best design has no seconds."""
    gains = {}
    pairs = grid.group_by([r for r in results if "method" in r.cell.values], grid.by_values("name", "network"))
    for pair, group in pairs.items():
        default = [result for result in group if result.cell.values["method"] == DEFAULT]
        if not default:
            continue
        sign = Goal(default[0].cell.values["scene"]["target"]["goal"]).sign
        best = max(sign * _share(default[0].answers["hits"][name]) for name in CONTROLS)
        ceiling = [result for result in group if result.cell.values["method"] == CEILING]
        shown = [result for result in group if result not in ceiling]
        if ceiling:
            shown.append(max(ceiling, key=lambda result, sign=sign: sign * _share(result.answers["chosen_by"])))
        gains[" before ".join(pair)] = {
            r.cell.values["method"]: (sign * _share(r.answers["hits"]["design"]) - best, r.answers.get("seconds"))
            for r in shown
        }
    return gains


def _seconds(values: Sequence[float]) -> Estimate:
    """The geometric mean, with a bootstrap over pairs."""
    logs = cluster_mean(np.log(values).tolist())
    value, low, high = np.exp(value_and_ends(logs)).tolist()
    return Estimate(value, low, high, len(values))


def tables(settings: SpeedSettings, results: Sequence[Result]) -> tuple[Table, ...]:
    """Tables of methods, of the ceiling, of every pair, and of detectors."""
    gains, rows = _gains(results), []
    for method, name in NAMES.items():
        some = [found[method] for found in gains.values() if method in found]
        if some:
            rows.append([name, _seconds([s for _, s in some if s is not None]), cluster_mean([g for g, _ in some])])
    centers = [(row[1].value, -value_and_ends(row[2])[0]) for row in rows]
    rows = [(*row, bool(on)) for row, on in zip(rows, pareto_mask(*zip(*centers, strict=True)), strict=True)]
    above = {pair: f[CEILING][0] - f[DEFAULT][0] for pair, f in gains.items() if CEILING in f}
    lines = tuple((pair, gains[pair][DEFAULT][0], gains[pair][CEILING][0], more) for pair, more in above.items())
    every = tuple(
        (p, NAMES.get(m, m), seconds, gain) for p, found in gains.items() for m, (gain, seconds) in found.items()
    )
    count, line = len(gains), mean(list(above.values()))
    about = f"{count} pairs of object and network, {settings.n} fresh views each; seconds of one core, geometric mean; "
    about += "gain over the better of the bare object and a gray piece; intervals over pairs. Ours end with a promise."
    c = settings.ceiling
    line_about = f"{c.steps} steps, the best of {c.seeds} seeds at {c.places} places, chosen in other views"
    if line:
        line_about += f"; beyond the default {100 * line.value:+.1f} points"
        line_about += f" [{100 * line.low:.1f}, {100 * line.high:.1f}]"
    return (
        Table("methods", "Seconds of a run against gain", ("method", "seconds", "gain", "front"), tuple(rows), about),
        Table("ceiling", "How far the default is from it", ("pair", "default", "ceiling", "beyond"), lines, line_about),
        _photo_table(settings, results),
        Table("pairs", "Every pair", ("pair", "method", "seconds", "gain"), every),
    )


def _photo_table(settings: SpeedSettings, results: Sequence[Result]) -> Table:
    rows = []
    for result in results:
        if "finder" in result.cell.values:
            (width, height), errors = result.cell.values["size_px"], np.array(result.answers["errors_px"], float)
            worst, ms = np.nan_to_num(errors, nan=np.inf).reshape(-1, 4).max(1), median(result.answers["milliseconds"])
            off = median(errors[np.isfinite(errors)]) if np.isfinite(errors).any() else None
            speed = Estimate(1000 / ms.value, 1000 / ms.high, 1000 / ms.low, ms.n)
            size = f"{width} × {height}"
            rows.append((result.cell.values["finder"], size, speed, off, float((worst < MAX_RIGHT_PX).mean())))
    about = (
        f"{settings.photos} photographs of flat paper with eight markers, tilt to 60°, blur to 1.2 px, JPEG 60 to 95; "
        f"one core, decoding not counted; right: all four corners of the design within {MAX_RIGHT_PX:g} px"
    )
    head = ("detector", "photograph", "photographs a second", "corner error, px", "share right")
    return Table("photos", "Speed of finding a sheet against its error", head, tuple(rows), about)


def figures(settings: SpeedSettings, results: Sequence[Result]) -> tuple[Drawing, ...]:
    """The chart: runs to the left, verification to the right."""
    methods, ceiling, photos, _ = tables(settings, results)

    def draw(figure: "Figure") -> None:
        left, right = figure.subplots(1, 2, width_ratios=(1.25, 1))
        _draw_methods(figure, left, methods, ceiling)
        _draw_photos(figure, right, photos)

    return (Drawing("chart", "Speed against accuracy", draw, (8.3, 4.3), methods.about),)


def _draw_methods(figure: "Figure", axes: "Axes", table: Table, ceiling: Table) -> None:
    points = []
    for (name, seconds, gain, front), color in zip(rows_of(table), COLORS, strict=False):
        x, (y, low, high) = seconds.value, (100 * v for v in value_and_ends(gain))
        axes.errorbar(x, y, [[y - low], [high - y]], fmt="o", color=color, mfc=color if front else "white", ms=7)
        points.append((x, y, name, color))
    on_front = sorted((x, y) for (x, y, *_), row in zip(points, table.rows, strict=True) if row[3])
    axes.plot(*zip(*on_front, strict=True), color="0.5", lw=1, ls="--", zorder=0)
    default = next((y for _, y, name, _ in points if name == NAMES[DEFAULT]), None)
    if ceiling.rows and default is not None:
        level = default + 100 * float(np.mean([row[3] for row in rows_of(ceiling)]))
        axes.axhline(level, color="0.25", lw=1.2, ls=":")
        text = f"ceiling (ten times the steps, {len(ceiling.rows)} of the pairs)"
        axes.annotate(text, (0.02, level), xycoords=("axes fraction", "data"), va="bottom", fontsize=9)
    log_axis(axes, "x", [x for x, *_ in points])
    axes.set(xlabel="seconds of the whole run, one core", ylabel="recognition gained, points")
    axes.set_title("Filled: on the front", fontsize=10, loc="left")
    label_points(figure, axes, points)


def _draw_photos(figure: "Figure", axes: "Axes", table: Table) -> None:
    rows = rows_of(table)
    points, names, sizes = [], *(list(dict.fromkeys(row[i] for row in rows)) for i in (0, 1))
    for name, size, speed, error, right in rows:
        color, marker = COLORS[names.index(name)], "os^"[sizes.index(size)]
        if error is not None:
            axes.plot(speed.value, error.value, marker, color=color, ms=7)
            points.append((speed.value, error.value, f"{name} {100 * right:.0f} %", color))
    for size, marker in zip(sizes, "os^", strict=False):
        axes.plot([], [], marker, color="0.4", ls="none", label=size)
    log_axis(axes, "x", [x for x, *_ in points])
    log_axis(axes, "y", [y for _, y, *_ in points])
    axes.set(xlabel="photographs a second, one core", ylabel="corner error, px (median)")
    axes.set_title(f"%: right within {MAX_RIGHT_PX:g} px", fontsize=10, loc="left")
    axes.legend(fontsize=9, frameon=False)
    label_points(figure, axes, points)


STUDY = Study("speed", SpeedSettings, cells, run, tables, figures)
