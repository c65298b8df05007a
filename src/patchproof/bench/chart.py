"""What a benchmark found: points of cost and error, with the Pareto front, the default, and claims that were tested.

In: points, each saying how far it could be off. Out: charts as data and as lines of text. The front is what nothing
else beats in both cost and error; the default is marked, so that one sees whether it lies there. Claims that a chart is
made to test stand in it as `Check`s.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

Interval = tuple[float, float]
OnStage = Callable[[str, int, int], None]


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
    """Cost to the right, error upwards, or where `higher_is_better` a quality such as PSNR; `target` is a line across.

    `notes` say what was measured and on what.
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
    """The chart with the points of each series' Pareto front marked."""
    if isinstance(chart, Growth | Shares):
        return chart
    sign, marked = (-1 if chart.higher_is_better else 1), []
    for one in chart.series:
        front = pareto([p.cost for p in one.points], [sign * p.error for p in one.points]).tolist()
        points = (replace(point, front=on) for point, on in zip(one.points, front, strict=True))
        marked.append(replace(one, points=tuple(points)))
    return replace(chart, series=tuple(marked))


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
