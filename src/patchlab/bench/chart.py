"""Charts of cost against error: their points, the Pareto front, and claims that are checked.

In: points with a cost and an error. Out: tables as studies have them. The front holds the points that no other point
beats in both; every default is checked against it. A chart lists the other claims that it tests as `Check`s.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from patchproof.base.intervals import Estimate
from patchproof.report.tables import Table, Value

MAX_EXCESS_PERCENT = 5.0  # % by which a default's error may exceed the front's at its cost, if the intervals are apart


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
