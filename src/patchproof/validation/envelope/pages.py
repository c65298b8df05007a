"""Tables and figures of an operating envelope: breaking points, every point of every sweep, what was said beyond, maps.

In: finished cells. Out: tables, and drawings of which the first is one page to print beside the patch. Breaking points
come as values of their axis; one outside of the sweep is said to hold, and an interval that ends at the sweep's own end
is open there.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from patchproof.claims import Estimate, rate
from patchproof.goal import Goal
from patchproof.report.tables import Drawing, Table, Value
from patchproof.validation.envelope.axes import AXES
from patchproof.validation.envelope.fit import BEYOND, LEAST_LOST, NOT_MONOTONE

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from patchproof.study.study import Result

STAGES = {"recognized": "recognized", "found": "sheet found", "measured": "measured"}
_COLORS = {"recognized": "#2a6f97", "found": "#e09f3e", "measured": "#2a9d6f"}
HOLDS, NEVER = "holds", "never worked"
_PAGE_IN = (11.69, 8.27)  # A4, lying


def tables(settings: Any, results: Sequence[Result]) -> Sequence[Table]:
    """Breaking points, points of sweeps, codes beyond the breaking point, points of maps."""
    sweeps, maps = _split(results)
    ends = ("axis", "unit", "easy", "hard")
    all_tables = (
        Table(
            "breaks",
            "Breaking points",
            (*ends, *STAGES.values(), "not monotone"),
            tuple(_break_row(one) for one in sweeps),
            "Where a fitted falling curve has lost half of what it loses over the sweep: median of the bootstrap over "
            f"conditions, 95 % interval. “{HOLDS}”: it loses less than {LEAST_LOST:.0%} of its rate. n conditions: "
            f"{settings.n} shown to the network (a quarter where JPEG is varied), {settings.photos} photographed.",
        ),
        Table(
            "beyond",
            "What the tool says beyond",
            ("axis", "photographs", "measured all the same", "said of the others"),
            tuple(_beyond_row(one) for one in sweeps),
            "Photographs at points harder than the breaking point of measuring, or at the hardest point.",
        ),
        Table(
            "sweeps",
            "All points",
            ("axis", "value", *STAGES.values(), "median error mm", "largest error mm", "said"),
            tuple(row for one in sweeps for row in _point_rows(one)),
            "Errors are the largest of the design's four corners, against the simulation's truth, where a flat sheet "
            "was measured. Intervals: Wilson.",
        ),
        Table(
            "maps",
            "Maps",
            ("x", "y", "at x", "at y", *STAGES.values()),
            tuple(row for one in maps for row in _map_rows(one)),
            f"n per point: {settings.map_n} recognized, {settings.map_photos} photographed.",
        ),
    )
    return tuple(table for table in all_tables if table.rows)


def figures(settings: Any, results: Sequence[Result]) -> Sequence[Drawing]:
    """The page to print, and the curves behind it."""
    sweeps, maps = _split(results)
    page = Drawing(
        "page",
        "Operating envelope",
        lambda figure: _draw_page(figure, sweeps, maps),
        _PAGE_IN,
        "Bars run from the easy end to where half of what the sweep takes is lost; whiskers: 95 % intervals; →: it "
        "holds; !: not monotone; in brackets the fitted rates at both ends.",
    )
    if not sweeps:
        return (page,)
    rows = -(-len(sweeps) // 3)
    return page, Drawing(
        "curves",
        "Sweeps",
        lambda figure: _draw_curves(figure, sweeps, rows),
        (10.0, 2.4 * rows),
        "Shares of conditions with Wilson intervals, the fitted falling curves, breaking points (dotted).",
    )


def _split(results: Sequence[Result]) -> tuple[list[Result], list[Result]]:
    return [one for one in results if "y" not in one.cell.values], [one for one in results if "y" in one.cell.values]


def _worked(found: dict) -> dict[str, np.ndarray]:
    """P×N bool by stage."""
    status = np.array(found["status"])
    return {
        "recognized": np.array(found["recognized"], bool),
        "found": status != "rejected",
        "measured": status == "measured",
    }


def _break_row(one: Result) -> tuple[Value, ...]:
    x, breaks = one.cell.values["x"], one.found["breaks"]
    axis, worked = AXES[x["axis"]], _worked(one.found)
    rising = [f"{STAGES[name]} (p = {b['monotone_p']:.3f})" for name, b in breaks.items() if _rises(b)]
    values = [_break_value(x, breaks[name], worked[name].shape[1]) for name in STAGES]
    return axis.title, axis.unit, x["easy"], x["hard"], *values, ", ".join(rising)


def _rises(found_break: dict) -> bool:
    return found_break["monotone_p"] < NOT_MONOTONE


def _break_value(x: dict, found_break: dict, n: int) -> Value:
    if found_break["value"] is None:
        return NEVER
    if found_break["value"] >= BEYOND:
        return HOLDS
    ends = [_at(x, found_break[name]) for name in ("low", "high")]
    return Estimate(_at(x, found_break["value"]), min(ends), max(ends), n)


def _at(x: dict, position: float) -> float:
    return AXES[x["axis"]].value(x["easy"], x["hard"], min(position, 1.0))


def _beyond_row(one: Result) -> tuple[Value, ...]:
    x, found = one.cell.values["x"], one.found
    where = found["breaks"]["measured"]["value"]
    at = np.linspace(0, 1, x["points"])
    beyond = [i for i in range(x["points"]) if at[i] > min(1.0 if where is None else where, 1 - 1e-9)]
    if where is None:
        beyond = list(range(x["points"]))
    status = [s for i in beyond for s in found["status"][i]]
    codes = [c for i in beyond for s, c in zip(found["status"][i], found["code"][i], strict=True) if s != "measured"]
    return AXES[x["axis"]].title, len(status), status.count("measured"), _counted(codes)


def _counted(codes: Sequence[str | None]) -> str:
    return ", ".join(f"{code} {count}" for code, count in Counter(code for code in codes if code).most_common())


def _point_rows(one: Result) -> list[tuple[Value, ...]]:
    name, found = one.cell.values["x"]["axis"], one.found
    worked, rows = _worked(found), []
    for i, point in enumerate(found["points"]):
        errors = [e for e in found["error_mm"][i] if e is not None]
        median, largest = (float(np.median(errors)), max(errors)) if errors else (None, None)
        rates = [rate(worked[stage][i].tolist()) for stage in STAGES]
        rows.append((AXES[name].title, point[name], *rates, median, largest, _counted(found["code"][i])))
    return rows


def _map_rows(one: Result) -> list[tuple[Value, ...]]:
    x, y = (one.cell.values[key]["axis"] for key in ("x", "y"))
    worked = _worked(one.found)
    return [
        (AXES[x].title, AXES[y].title, point[x], point[y], *(rate(worked[stage][i].tolist()) for stage in STAGES))
        for i, point in enumerate(one.found["points"])
    ]


def _draw_page(figure, sweeps: Sequence[Result], maps: Sequence[Result]) -> None:
    found = (sweeps or maps)[0].found
    goal = "seen as" if Goal(found["goal"]).sign > 0 else "not seen as"
    figure.suptitle(f"Operating envelope of sheet {found['sheet']}: {goal} {found['label']} by {found['model']}")
    parts = figure.subfigures(1, 2, width_ratios=(1.15, 1)) if sweeps and maps else [figure, figure]
    if sweeps:
        _draw_bars(parts[0].add_subplot(), sweeps)
    if maps:
        rows = -(-len(maps) // 2)
        for axes, one in zip(parts[1].subplots(rows, 2, squeeze=False).flat, maps, strict=False):
            _draw_map(axes, one)
        for axes in parts[1].axes[len(maps) :]:
            axes.set_axis_off()
        note = "number: share recognized, %; ×: fewer than half of the photographs can be measured"
        parts[1].supxlabel(note, fontsize=7)


def _draw_bars(axes: Axes, sweeps: Sequence[Result]) -> None:
    for row, one in enumerate(sweeps):
        x = one.cell.values["x"]
        for k, (stage, color) in enumerate(_COLORS.items()):
            _draw_bar(
                axes, row + 0.24 * (k - 1), x, one.found["breaks"][stage], color, STAGES[stage] if not row else None
            )
        axis = AXES[x["axis"]]
        axes.text(-0.02, row, f"{axis.title}\n{axis.unit}", ha="right", va="center", fontsize=7.5)
        axes.text(0.0, row + 0.46, _short(x["easy"]), ha="left", va="center", fontsize=6, alpha=0.7)
        axes.text(1.0, row + 0.46, _short(x["hard"]), ha="right", va="center", fontsize=6, alpha=0.7)
    axes.set_xlim(-0.3, 1.22)
    axes.set_ylim(len(sweeps) - 0.3, -0.7)
    axes.set_axis_off()
    axes.legend(ncols=3, loc="upper center", bbox_to_anchor=(0.55, 1.04), frameon=False, fontsize=8)


def _draw_bar(axes: Axes, y: float, x: dict, found_break: dict, color: str, label: str | None) -> None:
    value, low, high = (found_break[name] for name in ("value", "low", "high"))
    axes.barh(y, min(value or 0.0, 1.0), height=0.2, color=color, alpha=0.75, label=label)
    if value is None:
        axes.text(0.01, y, NEVER, va="center", fontsize=6.5)
        return
    if value >= BEYOND:
        axes.text(1.01, y, "→", va="center", fontsize=8, color=color)
        return
    axes.plot([low, min(high, 1.0)], [y, y], color="black", linewidth=0.9)
    curve = found_break["curve"]
    text = f"{_short(_at(x, value))} ({curve[0]:.2f}–{curve[-1]:.2f})" + (" !" if _rises(found_break) else "")
    axes.text(min(high, 1.0) + 0.01, y, text, va="center", fontsize=6.5)


def _short(value: float) -> str:
    return f"{value:.2g}" if abs(value) < 100 else f"{value:.0f}"


def _draw_map(axes: Axes, one: Result) -> None:
    x, y = one.cell.values["x"], one.cell.values["y"]
    shape = (y["points"], x["points"])
    worked = _worked(one.found)
    share, can = (worked[stage].mean(1).reshape(shape) for stage in ("recognized", "measured"))
    axes.imshow(share, cmap="RdYlGn", vmin=0, vmax=1, origin="lower", aspect="auto", alpha=0.8)
    for (i, j), value in np.ndenumerate(share):
        axes.text(j, i, f"{100 * value:.0f}" + ("×" if can[i, j] < 0.5 else ""), ha="center", va="center", fontsize=6)
    for set_ticks, set_label, end in (
        (axes.set_xticks, axes.set_xlabel, x),
        (axes.set_yticks, axes.set_ylabel, y),
    ):
        axis = AXES[end["axis"]]
        values = axis.values(end["easy"], end["hard"], end["points"])
        set_ticks(range(end["points"]), [_short(v) for v in values], fontsize=6)
        set_label(f"{axis.title}, {axis.unit}", fontsize=7)


def _draw_curves(figure, sweeps: Sequence[Result], rows: int) -> None:
    grid = figure.subplots(rows, 3, squeeze=False)
    for axes, one in zip(grid.flat, sweeps, strict=False):
        _draw_sweep(axes, one)
    for axes in grid.flat[len(sweeps) :]:
        axes.set_axis_off()
    grid.flat[0].legend(fontsize=7, frameon=False)


def _draw_sweep(axes: Axes, one: Result) -> None:
    x, worked = one.cell.values["x"], _worked(one.found)
    at, fine = np.linspace(0, 1, x["points"]), np.linspace(0, 1, 101)
    for k, (stage, color) in enumerate(_COLORS.items()):
        shares = [rate(row.tolist()) for row in worked[stage]]
        ends = np.array([[s.value - s.low, s.high - s.value] for s in shares]).T
        here = at + 0.012 * (k - 1)
        axes.errorbar(
            here, [s.value for s in shares], ends.clip(0), fmt="o", ms=3, lw=0.8, color=color, label=STAGES[stage]
        )
        found_break = one.found["breaks"][stage]
        axes.plot(fine, found_break["curve"], color=color, linewidth=1)
        if found_break["value"] is not None and found_break["value"] < BEYOND:
            axes.axvline(found_break["value"], color=color, linestyle=":", linewidth=1)
    axis = AXES[x["axis"]]
    values = axis.values(x["easy"], x["hard"], x["points"])
    axes.set_xticks(at, [_short(v) for v in values], fontsize=7)
    axes.set_xlabel(f"{axis.title}, {axis.unit}", fontsize=8)
    axes.set_ylim(-0.05, 1.05)
    axes.spines[["top", "right"]].set_visible(False)
