"""What a knob's settings cost and how far off they are: points, the Pareto front, and claims that are tested.

In: points of cost and error. Out: tables as studies have them. The front is what nothing else beats in both; every
default is asked whether it lies there. Other claims that a chart is made to test stand in it as `Check`s.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from patchproof.base.intervals import Estimate
from patchproof.report.tables import Table, Value

MAX_EXCESS_PERCENT = (
    5.0  # % more error than the front's at its cost that a default may have, where intervals do not overlap
)


@dataclass(frozen=True)
class ChartPoint:
    """One setting of a knob: what it costs and how far off it is; a plain number is known, not estimated."""

    setting: str
    cost: Estimate | float
    error: Estimate | float
    default: bool = False

    @property
    def drawable(self) -> bool:
        """Whether its error is finite."""
        return bool(np.isfinite(value_and_ends(self.error)).all())

    @property
    def at(self) -> tuple[float, float]:
        """Cost and error without their intervals."""
        return value_and_ends(self.cost)[0], value_and_ends(self.error)[0]


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

    @property
    def bound(self) -> str:
        """The limit in words."""
        return f"at {'least' if self.at_least else 'most'} {self.limit:g}"


@dataclass(frozen=True)
class Chart:
    """A knob's settings by series. Cost to the right, error upwards.

    `one_front`: series are choices for one task, not tasks of their own. `about` says what was measured and on what.
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
        """Points among which one chooses, by task; those without a finite error are no choice."""
        tasks = {label: [p for p in points if p.drawable] for label, points in self.series.items()}
        return {self.name: [p for points in tasks.values() for p in points]} if self.one_front else tasks

    def front(self, points: Sequence[ChartPoint]) -> list[ChartPoint]:
        """Those of a task's points that no other beats, cheapest first."""
        kept = pareto_mask([p.at[0] for p in points], [p.at[1] for p in points])
        return sorted((p for p, is_kept in zip(points, kept, strict=True) if is_kept), key=lambda p: p.at[0])


def value_and_ends(figure: Estimate | float) -> tuple[float, float, float]:
    """A figure with the ends of its interval."""
    return (figure.value, figure.low, figure.high) if isinstance(figure, Estimate) else (figure, figure, figure)


def pareto_mask(cost: Sequence[float], error: Sequence[float]) -> np.ndarray:
    """Which points no other beats: none is as good in both and better in one; bool, one per point."""
    figures = np.stack([cost, error], 1).astype(float)
    own, other = figures[:, None], figures
    beaten = np.all(other <= own, axis=2) & np.any(other < own, axis=2)
    return np.logical_not(np.any(beaten, axis=1))


def all_checks(chart: Chart) -> list[Check]:
    """The chart's own checks, and for each default how much more error it has than the front's at its cost: 0 % where
    the two intervals overlap.
    """
    checks = list(chart.checks)
    for task, points in chart.tasks.items():
        for default in (p for p in points if p.default):
            rivals = [value_and_ends(p.error) for p in points if p.at[0] <= default.at[0]]
            claim = f"{task}: % more error of the default than of the front at its cost"
            checks.append(Check(claim, _excess(value_and_ends(default.error), min(rivals)), MAX_EXCESS_PERCENT))
    return checks


def _excess(default: tuple[float, float, float], front: tuple[float, float, float]) -> float:
    if default[1] <= front[2]:
        return 0.0
    return 100 * (default[0] / front[0] - 1) if front[0] > 0 else math.inf


def points_table(chart: Chart) -> Table:
    """The chart's points, with the front and the defaults marked."""
    on_front = [p for points in chart.tasks.values() for p in chart.front(points)]
    rows = []
    for label, points in chart.series.items():
        for p in points:
            marks = (("default", p.default), ("front", any(p is other for other in on_front)))
            mark = ", ".join(word for word, applies in marks if applies)
            rows.append((label, p.setting, p.cost, p.error if p.drawable else None, mark))
    head = ("series", "setting", "cost", "error", "")
    return Table(chart.name, f"{chart.title}: {chart.error}, by {chart.cost}", head, tuple(rows), chart.about)


def checks_table(charts: Iterable[Chart]) -> Table:
    """Every claim with its figure and whether it holds."""
    rows: list[tuple[Value, ...]] = [
        (chart.name, c.claim, c.figure if math.isfinite(c.figure) else None, c.bound, c.holds)
        for chart in charts
        for c in all_checks(chart)
    ]
    return Table("checks", "Claims", ("chart", "claim", "figure", "limit", "holds"), tuple(rows))


def failed_checks(charts: Iterable[Chart]) -> dict[str, str]:
    """A sentence for each claim that does not hold."""
    checks = [(chart, check) for chart in charts for check in all_checks(chart) if not check.holds]
    return {f"{chart.name}, {c.claim}": f"{c.figure:.3g}, {c.bound} was claimed" for chart, c in checks}
