"""What a benchmark found: points of cost and error, with the Pareto front, the default, and claims that were tested.

In: points, each saying how far it could be off. Out: charts as data and as lines of text. The front is what nothing
else beats in both cost and error; the default is marked, and `with_default_checks` asks whether it lies there. Claims
that a chart is made to test stand in it as `Check`s.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

Interval = tuple[float, float]
OnStage = Callable[[str, int, int], None]
OFF_FRONT = 5.0  # % more error than the front's at its cost that a default may have, where intervals do not overlap


@dataclass(frozen=True)
class Point:
    """One setting of a knob: what it costs and how far off it is, each with an interval."""

    setting: str
    cost: float
    error: float
    cost_interval: Interval
    error_interval: Interval
    default: bool = False
    front: bool = False


@dataclass(frozen=True)
class Series:
    """Points that belong together: a knob's settings, or the sizes of a growing task with the slope of its cost."""

    label: str
    points: tuple[Point, ...]
    slope: float | None = None  # of log time over log size, over the larger half of the sizes


@dataclass(frozen=True)
class Check:
    """A claim with its figure: it holds where the figure is `at_least` or `at_most` the limit."""

    claim: str
    figure: float
    limit: float
    at_least: bool = False

    @property
    def holds(self) -> bool:
        """Whether the figure keeps the limit; one that is no number does not."""
        return self.figure >= self.limit if self.at_least else self.figure <= self.limit


@dataclass(frozen=True)
class Table:
    """Figures behind a chart, as text."""

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Chart:
    """Cost to the right, error upwards, or where `higher_is_better` a quality in dB; `target` is a line across.

    `notes` say what was measured and on what. `one_front`: series are choices for one task, not tasks of their own.
    """

    name: str
    title: str
    cost_label: str
    error_label: str
    series: tuple[Series, ...]
    notes: tuple[str, ...] = ()
    checks: tuple[Check, ...] = ()
    tables: tuple[Table, ...] = ()
    higher_is_better: bool = False
    one_front: bool = False
    target: float | None = None


@dataclass(frozen=True)
class Growth(Chart):
    """The size of a task to the right (as `cost`), its time upwards (as `error`); both over decades."""


@dataclass(frozen=True)
class Shares(Chart):
    """Parts of a cost as bars: the share to the right; `error` is 0."""


def pareto(cost: Sequence[float], error: Sequence[float]) -> np.ndarray:
    """Which points no other beats: none is as good in both and better in one; bool, one per point."""
    both = np.stack([cost, error], 1).astype(float)
    no_worse = (both[None] <= both[:, None]).all(2)
    better = (both[None] < both[:, None]).any(2)
    return ~(no_worse & better).any(1)


def with_front(chart: Chart) -> Chart:
    """The chart with the points of each task's Pareto front marked."""
    if isinstance(chart, Growth | Shares):
        return chart
    sign, on_front = (-1 if chart.higher_is_better else 1), set()
    for _, points in _tasks(chart):
        front = pareto([p.cost for p in points], [sign * p.error for p in points])
        on_front |= {id(point) for point, on in zip(points, front, strict=True) if on}
    marked = (
        replace(one, points=tuple(replace(point, front=id(point) in on_front) for point in one.points))
        for one in chart.series
    )
    return replace(chart, series=tuple(marked))


def with_default_checks(chart: Chart) -> Chart:
    """The chart with a check for each default: how much more error it has than the front's at its cost.

    0 % where the two intervals overlap. Of a quality in dB the error is its root mean square.
    """
    if isinstance(chart, Growth | Shares):
        return chart
    checks = []
    for label, points in _tasks(chart):
        for default in (p for p in points if p.default):
            rivals = [_error(p, chart.higher_is_better) for p in points if p.cost <= default.cost]
            claim = f"{label}: % more error of the default than of the front at its cost"
            checks.append(Check(claim, _beyond(_error(default, chart.higher_is_better), min(rivals)), OFF_FRONT))
    return replace(chart, checks=(*chart.checks, *checks))


def _tasks(chart: Chart) -> list[tuple[str, list[Point]]]:
    """Points among which one chooses, each with its name."""
    if chart.one_front:
        return [(chart.name, [point for one in chart.series for point in one.points])]
    return [(one.label, list(one.points)) for one in chart.series]


def _error(point: Point, is_decibel: bool) -> tuple[float, float, float]:
    """Error with its lower and upper end."""
    if not is_decibel:
        return (point.error, *point.error_interval)
    low, high = point.error_interval
    return tuple(10 ** (-value / 20) for value in (point.error, high, low))


def _beyond(default: tuple[float, float, float], front: tuple[float, float, float]) -> float:
    if default[1] <= front[2]:
        return 0.0
    return 100 * (default[0] / front[0] - 1) if front[0] > 0 else float("inf")


def text(chart: Chart) -> list[str]:
    """The chart as lines of a table, its notes and its checks."""
    lines = [chart.title, f"  x: {chart.cost_label}", *([f"  y: {chart.error_label}"] if chart.error_label else [])]
    for table in (_points_table(chart), *chart.tables):
        lines += _aligned(table)
    lines += [f"  note: {note}" for note in chart.notes]
    lines += [f"  slope of {one.label}: {one.slope:.2f}" for one in chart.series if one.slope is not None]
    return lines + [
        f"  {'holds' if c.holds else 'FAILS'}: {c.claim}: {c.figure:.3g} "
        f"({'at least' if c.at_least else 'at most'} {c.limit:g})"
        for c in chart.checks
    ]


def _points_table(chart: Chart) -> Table:
    rows = []
    for series in chart.series:
        for p in series.points:
            mark = ", ".join(word for word, is_so in (("default", p.default), ("front", p.front)) if is_so)
            y = ("", "") if isinstance(chart, Shares) else (_number(p.error), _span(p.error_interval))
            rows.append((f"{series.label}: {p.setting}", _number(p.cost), _span(p.cost_interval), *y, mark))
    y = ("", "") if isinstance(chart, Shares) else ("y", "from - to")
    return Table(("", "x", "from - to", *y, ""), tuple(rows))


def _aligned(table: Table) -> list[str]:
    widths = [max(map(len, column)) for column in zip(table.head, *table.rows, strict=True)]
    lines = []
    for row in (table.head, *table.rows):
        cells = [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))]
        lines.append("  " + "  ".join(cells).rstrip())
    return lines


def _number(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:,.0f}"


def _span(interval: Interval) -> str:
    low, high = map(_number, interval)
    return "" if low == high else f"{low} - {high}"
