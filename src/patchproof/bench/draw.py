"""Charts of benchmarks as PNG: cost to the right, error upwards with intervals, the front and the default marked.

In: a `Chart`. Out: a file. Points on the Pareto front are filled and joined, the others are hollow; a ring is the
default. Machine, threads and date stand in the corner.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import singledispatch
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np

from patchproof.bench.chart import Chart, Growth, Point, Series, Shares
from patchproof.bench.measure import describe

_COLORS = ("#1f5fa8", "#c2571a", "#2a8f62", "#8a4fa3", "#6b6b6b")
_LINE = 48  # characters of an axis label in one line
_MARKERS = ("o", "s", "^", "D", "v")


def save_chart(chart: Chart, about: Mapping[str, Any], path: Path) -> None:
    """Draw a chart into a PNG file."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context({"font.size": 11, "axes.labelsize": 11}):
        figure = Figure(figsize=(8, 5), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        _draw(chart, axes)
        figure.suptitle(chart.title, x=0.01, ha="left", fontsize=12)
        axes.set_xlabel(chart.cost_label)
        axes.set_ylabel(fill(chart.error_label, _LINE))
        axes.set_axisbelow(True)
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(frameon=False, fontsize=10)
        figure.supxlabel(describe(about), fontsize=7.5, color="0.35", x=0.995, ha="right")
        figure.savefig(path, dpi=130, metadata={"Software": None})


@singledispatch
def _draw(chart: Chart, axes) -> None:
    for series, color, marker in zip(chart.series, _COLORS, _MARKERS, strict=False):
        _draw_points(axes, series, color, marker)
        front = sorted((point for point in series.points if point.front), key=lambda point: point.cost)
        axes.plot([p.cost for p in front], [p.error for p in front], color=color, lw=1, ls="--", zorder=1)
    axes.plot([], [], color="0.4", lw=1, ls="--", label="Pareto front (filled)")
    axes.plot([], [], "o", ms=11, mfc="none", mec="black", mew=1.3, ls="none", label="default")
    costs = [point.cost for series in chart.series for point in series.points]
    if max(costs) > 4 * min(costs):
        _plain_log(axes)
    errors = [point.error for series in chart.series for point in series.points]
    if 0 < 20 * min(errors) < max(errors) < np.inf:
        axes.set_yscale("log")
    if chart.target is not None:
        axes.axhline(chart.target, color="0.5", lw=1, ls=":", label=f"target {chart.target:g}")


def _draw_points(axes, series: Series, color: str, marker: str) -> None:
    for i, p in enumerate(series.points):
        x, y, face = p.cost, p.error, color if p.front else "white"
        bars = {"xerr": _off(x, p.cost_interval), "yerr": _off(y, p.error_interval)}
        axes.errorbar(x, y, **bars, fmt="none", ecolor=color, elinewidth=1, capsize=2.5, alpha=0.6)
        axes.plot(x, y, marker, color=color, markerfacecolor=face, ms=6, label=None if i else series.label)
        if p.default:
            axes.plot(x, y, "o", ms=14, mfc="none", mec="black", mew=1.3)

    for text, at in _labels(series.points):
        axes.annotate(text, at, xytext=(6, 5), textcoords="offset points", fontsize=9.5, color=color)


def _labels(points: tuple[Point, ...]) -> list[tuple[str, tuple[float, float]]]:
    """What to write where; points that fall together share one text."""
    height = max(p.error for p in points) - min(p.error for p in points)
    groups: list[list[Point]] = []
    for p in points:
        near = (g for g in groups if abs(g[0].error - p.error) <= 0.03 * height and 0.85 < g[0].cost / p.cost < 1.18)
        group = next(near, None)
        groups.append([p]) if group is None else group.append(p)
    return [(", ".join(p.setting for p in g), (max(p.cost for p in g), g[0].error)) for g in groups]


def _off(middle: float, interval: tuple[float, float]) -> list[list[float]]:
    """How far an interval reaches below and above, as matplotlib wants it."""
    return [[middle - interval[0]], [interval[1] - middle]]


@_draw.register
def _(chart: Growth, axes) -> None:
    for series, color, marker in zip(chart.series, _COLORS, _MARKERS, strict=False):
        x, y = [p.cost for p in series.points], [p.error for p in series.points]
        up = np.concatenate([_off(p.error, p.error_interval) for p in series.points], 1)
        label = f"{series.label} (slope {series.slope:.2f})"
        axes.errorbar(x, y, yerr=up, fmt=f"-{marker}", color=color, ms=5, lw=1.3, capsize=2.5, label=label)
    x = [p.cost for series in chart.series for p in series.points]
    y = [p.error for series in chart.series for p in series.points]
    axes.set_xscale("log")
    axes.set_yscale("log")
    low, high = min(x), max(x)
    axes.plot([low, high], [max(y) * low / high, max(y)], color="0.6", lw=1, ls=":", label="slope 1")
    axes.set_ylim(min(y) / 1.6, max(y) * 1.6)


@_draw.register
def _(chart: Shares, axes) -> None:
    labels, row = {}, 0
    for series, color in zip(chart.series, _COLORS, strict=False):
        for i, p in enumerate(series.points):
            style = {"color": color, "alpha": 0.75, "height": 0.7, "error_kw": {"lw": 1, "capsize": 2.5}}
            axes.barh(row, p.cost, xerr=_off(p.cost, p.cost_interval), label=None if i else series.label, **style)
            axes.annotate(f"{p.cost:.1f}", (p.cost_interval[1], row), xytext=(6, -4), textcoords="offset points")
            labels[row] = p.setting
            row += 1
        row += 1
    axes.set_yticks(list(labels), list(labels.values()))
    axes.invert_yaxis()
    axes.margins(x=0.12)


def _plain_log(axes) -> None:
    """A logarithmic axis with ratios written out."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, position: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
