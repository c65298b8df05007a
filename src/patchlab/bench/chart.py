"""Charts of cost against error: their points, the Pareto front, and claims that are checked.

In: points with a cost and an error. Out: tables as studies have them. The front holds the points that no other point
beats in both; every default is checked against it. A chart lists the other claims that it tests as `Check`s.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np

from patchproof.base.intervals import Estimate
from patchproof.report.tables import Drawing, Table, Value

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.transforms import Bbox

MAX_EXCESS_PERCENT = 5.0  # % by which a default's error may exceed the front's at its cost, if the intervals are apart
_COLORS = ("#1f5fa8", "#c2571a", "#2a8f62", "#8a4fa3", "#6b6b6b")
_LABEL_CHARACTERS = 60  # characters of an axis label in one line
_DECADES_ONLY_RATIO = 2000  # largest over smallest figure from which on only decades get ticks
_MARKERS = ("o", "s", "^", "D", "v")
_RING = {"marker": "o", "ms": 12, "mfc": "none", "mec": "black", "mew": 1.2, "ls": "none"}


@dataclass(frozen=True)
class ChartPoint:
    """A setting with its cost and its error; plain numbers are exact, an `Estimate` has an interval."""

    setting: str
    cost: Estimate | float
    error: Estimate | float
    default: bool = False

    @property
    def is_drawable(self) -> bool:
        """True if the error is finite."""
        return bool(np.isfinite(value_and_ends(self.error)).all())

    @property
    def center(self) -> tuple[float, float]:
        """Cost and error without their intervals."""
        return value_and_ends(self.cost)[0], value_and_ends(self.error)[0]


@dataclass(frozen=True)
class Check:
    """A claim about a figure: that it is at most `limit`, or at least `limit` if `at_least`."""

    claim: str
    figure: float
    limit: float
    at_least: bool = False

    @property
    def holds(self) -> bool:
        """True if the figure keeps the limit; NaN never does."""
        return self.figure >= self.limit if self.at_least else self.figure <= self.limit

    @property
    def bound(self) -> str:
        """The limit in words."""
        return f"at {'least' if self.at_least else 'most'} {self.limit:g}"


@dataclass(frozen=True)
class Chart:
    """Points by series, drawn with cost to the right and error upwards.

    `one_front`: all series are choices for one task; else each series is a task. `about` says what was measured.
    """

    name: str
    title: str
    cost: str
    error: str
    series: Mapping[str, Sequence[ChartPoint]]
    about: str
    checks: tuple[Check, ...] = ()
    tables: tuple[Table, ...] = ()
    one_front: bool = False

    @property
    def tasks(self) -> dict[str, list[ChartPoint]]:
        """By task the points that one can choose from; points without a finite error are left out."""
        tasks = {label: [p for p in points if p.is_drawable] for label, points in self.series.items()}
        return {self.name: [p for points in tasks.values() for p in points]} if self.one_front else tasks

    def front(self, points: Sequence[ChartPoint]) -> list[ChartPoint]:
        """The Pareto front of a task's points, cheapest first."""
        on_front = pareto_mask([p.center[0] for p in points], [p.center[1] for p in points])
        return sorted((p for p, keep in zip(points, on_front, strict=True) if keep), key=lambda p: p.center[0])


def value_and_ends(figure: Estimate | float) -> tuple[float, float, float]:
    """(value, low, high); a plain number is its own interval."""
    return (figure.value, figure.low, figure.high) if isinstance(figure, Estimate) else (figure, figure, figure)


def pareto_mask(cost: Sequence[float], error: Sequence[float]) -> np.ndarray:
    """N bool: no other point is as good in both and better in one."""
    figures = np.stack([cost, error], 1).astype(float)
    each, other = figures[:, None], figures
    beaten = np.all(other <= each, axis=2) & np.any(other < each, axis=2)
    return np.logical_not(np.any(beaten, axis=1))


def all_checks(chart: Chart) -> list[Check]:
    """The chart's checks, and one per default: the % by which its error exceeds the front's, 0 if intervals overlap."""
    checks = list(chart.checks)
    for task, points in chart.tasks.items():
        for default in (p for p in points if p.default):
            rivals = [value_and_ends(p.error) for p in points if p.center[0] <= default.center[0]]
            claim = f"{task}: % more error of the default than of the front at its cost"
            checks.append(Check(claim, _excess(value_and_ends(default.error), min(rivals)), MAX_EXCESS_PERCENT))
    return checks


def _excess(default: tuple[float, float, float], front: tuple[float, float, float]) -> float:
    if default[1] <= front[2]:
        return 0.0
    return 100 * (default[0] / front[0] - 1) if front[0] > 0 else math.inf


def points_table(chart: Chart) -> Table:
    """A table of the chart's points that marks the front and the defaults."""
    on_front = [p for points in chart.tasks.values() for p in chart.front(points)]
    rows = []
    for label, points in chart.series.items():
        for p in points:
            marks = (("default", p.default), ("front", any(p is other for other in on_front)))
            mark = ", ".join(word for word, applies in marks if applies)
            rows.append((label, p.setting, p.cost, p.error if p.is_drawable else None, mark))
    head = ("series", "setting", "cost", "error", "")
    return Table(chart.name, f"{chart.title}: {chart.error}, by {chart.cost}", head, tuple(rows), chart.about)


def checks_table(charts: Iterable[Chart]) -> Table:
    """A table of all claims with their figures and whether they hold."""
    rows: list[tuple[Value, ...]] = [
        (chart.name, c.claim, c.figure if math.isfinite(c.figure) else None, c.bound, c.holds)
        for chart in charts
        for c in all_checks(chart)
    ]
    return Table("checks", "Claims", ("chart", "claim", "figure", "limit", "holds"), tuple(rows))


def failed_checks(charts: Iterable[Chart]) -> dict[str, str]:
    """By chart and claim a sentence for each claim that does not hold."""
    checks = [(chart, check) for chart in charts for check in all_checks(chart) if not check.holds]
    return {f"{chart.name}, {c.claim}": f"{c.figure:.3g}, {c.bound} was claimed" for chart, c in checks}


def chart_drawing(chart: Chart, machine: str) -> Drawing:
    """The chart's figure; `machine` is the text in its corner."""
    return Drawing(chart.name, chart.title, partial(_draw, chart, machine), (7.0, 4.4), chart.about)


def _draw(chart: Chart, machine: str, figure: "Figure") -> None:
    axes, fronts = figure.add_subplot(), {task: chart.front(points) for task, points in chart.tasks.items()}
    filled = [p for front in fronts.values() for p in front]
    for (label, points), color, marker in zip(chart.series.items(), _COLORS, _MARKERS, strict=False):
        axes.plot([], [], marker, color=color, mfc="white", ms=5, label=label)
        for p in (p for p in points if p.is_drawable):
            _draw_point(axes, p, color, marker, any(p is other for other in filled))
    for front, color in zip(fronts.values(), ("0.4",) if chart.one_front else _COLORS, strict=False):
        axes.plot(*np.array([p.center for p in front]).T, color=color, lw=1, ls="--", zorder=1)
    axes.plot([], [], color="0.4", lw=1, ls="--", label="Pareto front (filled)")
    axes.plot([], [], **_RING, label="default")
    _set_scales(axes, [p for points in chart.series.values() for p in points if p.is_drawable])
    figure.suptitle(chart.title, x=0.01, ha="left")
    figure.supxlabel(machine, fontsize=6.5, color="0.35", x=0.995, ha="right")
    axes.set_xlabel(fill(chart.cost, _LABEL_CHARACTERS))
    axes.set_ylabel(fill(chart.error, _LABEL_CHARACTERS))
    axes.set_axisbelow(True)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(edgecolor="none", fontsize=8, loc="upper left", bbox_to_anchor=(1, 1))  # inside it would hide points
    _write_settings(figure, axes, chart)


def _draw_point(axes: "Axes", point: ChartPoint, color: str, marker: str, filled: bool) -> None:
    (x, *x_ends), (y, *y_ends) = value_and_ends(point.cost), value_and_ends(point.error)
    bars = [[[middle - low], [high - middle]] for middle, (low, high) in ((y, y_ends), (x, x_ends))]
    axes.errorbar(x, y, *bars, fmt="none", ecolor=color, elinewidth=1, capsize=2.5, alpha=0.6)
    axes.plot(x, y, marker, color=color, mfc=color if filled else "white", ms=5)
    if point.default:
        axes.plot(x, y, **_RING)


def _set_scales(axes: "Axes", points: list[ChartPoint]) -> None:
    costs, errors = zip(*(p.center for p in points), strict=True)
    if max(costs) > 4 * min(costs) > 0:
        _plain_log(axes.xaxis, axes.set_xscale, max(costs) / min(costs))
    if max(errors) > 20 * min(errors) > 0:
        _plain_log(axes.yaxis, axes.set_yscale, max(errors) / min(errors))


def _plain_log(axis, set_scale, ratio: float) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    set_scale("log")
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if ratio < _DECADES_ONLY_RATIO else (1,)))
    axis.set_major_formatter(FuncFormatter(lambda value, position: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _write_settings(figure: "Figure", axes: "Axes", chart: Chart) -> None:
    """Write each point's setting beside it, in the one of four corners where the text hides least."""
    from matplotlib.transforms import Bbox

    figure.draw_without_rendering()  # positions are known only after the layout
    colored = zip(chart.series.values(), _COLORS, strict=False)
    named = [(p, color) for points, color in colored for p in points if p.is_drawable]
    points_px = axes.transData.transform([p.center for p, _ in named])
    taken = [Bbox([xy - 6, xy + 6]) for xy in points_px]
    for point, color in named:
        style = {"textcoords": "offset points", "color": color, "fontsize": 8}
        text = axes.annotate(point.setting, point.center, xytext=(0, 0), **style)
        text.set_in_layout(False)

        def move(right: bool, up: bool, text=text) -> "Bbox":
            sides = {"ha": "left" if right else "right", "va": "bottom" if up else "top"}
            text.set(position=(6 if right else -6, 2 if up else -2), **sides)
            return text.get_window_extent()

        corners = [(right, up) for right in (True, False) for up in (True, False)]
        areas = [_covered_area(move(*corner), taken, axes.bbox) for corner in corners]
        taken.append(move(*corners[int(np.argmin(areas))]))


def _covered_area(box: "Bbox", taken: "list[Bbox]", frame: "Bbox") -> float:
    """The area of a text's box that lies on taken boxes or outside the axes."""
    shared = (box.intersection(box, other) for other in taken)
    inside = box.intersection(box, frame)
    outside = box.width * box.height - (inside.width * inside.height if inside else 0.0)
    return outside + sum(part.width * part.height for part in shared if part)
