"""Charts of benchmarks as PNG: cost to the right, error upwards with intervals, the front and the default marked.

In: a `Chart`. Out: a file. Points on the Pareto front are filled and joined, the others are hollow; a ring is the
default. Settings that all cost the same stand side by side. Machine, threads and date stand in the corner.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import singledispatch
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np

from patchproof.bench.chart import Chart, Growth, Point, Series, Shares
from patchproof.bench.measure import describe

Box = tuple[float, float, float, float]  # left, bottom, right, top as shares of the chart
_COLORS = ("#1f5fa8", "#c2571a", "#2a8f62", "#8a4fa3", "#6b6b6b")
_LINE = 48  # characters of an axis label in one line
_CHARACTER = 0.0115  # width of a letter, as a share of the chart's
_TOGETHER = (0.03, 0.03)  # of the chart's sides: points as near as that share a text
_MANY = 2000  # times the smallest: decades alone are written at the axis
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
        axes.set_xlabel(axes.get_xlabel() or chart.cost_label)
        axes.set_ylabel(fill(chart.error_label, _LINE))
        axes.set_axisbelow(True)
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(edgecolor="none", framealpha=0.8, fontsize=10)
        figure.supxlabel(describe(about), fontsize=7.5, color="0.35", x=0.995, ha="right")
        figure.savefig(path, dpi=130, metadata={"Software": None})


@singledispatch
def _draw(chart: Chart, axes) -> None:
    if len({point.cost for series in chart.series for point in series.points}) == 1:
        _draw_columns(chart, axes)
        return
    for series, color, marker in zip(chart.series, _COLORS, _MARKERS, strict=False):
        _draw_points(axes, series, color, marker)
        if not chart.one_front:
            _draw_front(axes, series.points, color)
    points = [point for series in chart.series for point in series.points]
    if chart.one_front:
        _draw_front(axes, points, "0.4")
    axes.plot([], [], color="0.4", lw=1, ls="--", label="Pareto front (filled)")
    axes.plot([], [], "o", ms=11, mfc="none", mec="black", mew=1.3, ls="none", label="default")
    costs, errors = [p.cost for p in points], [p.error for p in points]
    if max(costs) > 4 * min(costs):
        _plain_log(axes.xaxis, axes.set_xscale, max(costs) / min(costs))
    if 0 < 20 * min(errors) < max(errors) < np.inf:
        _plain_log(axes.yaxis, axes.set_yscale, max(errors) / min(errors))
    _write_settings(axes, chart)
    if chart.target is not None:
        axes.axhline(chart.target, color="0.5", lw=1, ls=":", label=f"target {chart.target:g}")


def _draw_columns(chart: Chart, axes) -> None:
    """Settings that cost the same, side by side."""
    points = [point for series in chart.series for point in series.points]
    place = {id(point): at for at, point in enumerate(points)}
    for series, color, marker in zip(chart.series, _COLORS, _MARKERS, strict=False):
        beside = (replace(p, cost=place[id(p)], cost_interval=(place[id(p)],) * 2) for p in series.points)
        _draw_points(axes, replace(series, points=tuple(beside)), color, marker)
    axes.plot([], [], "o", ms=11, mfc="none", mec="black", mew=1.3, ls="none", label="default")
    axes.set_xticks(range(len(points)), [point.setting for point in points])
    axes.margins(x=0.1)
    axes.set_xlabel(f"{chart.cost_label}: {points[0].cost:g} for each")


def _draw_front(axes, points: Sequence[Point], color: str) -> None:
    front = sorted((point for point in points if point.front), key=lambda point: point.cost)
    axes.plot([p.cost for p in front], [p.error for p in front], color=color, lw=1, ls="--", zorder=1)


def _draw_points(axes, series: Series, color: str, marker: str) -> None:
    for i, p in enumerate(series.points):
        x, y, face = p.cost, p.error, color if p.front else "white"
        bars = {"xerr": _off(x, p.cost_interval), "yerr": _off(y, p.error_interval)}
        axes.errorbar(x, y, **bars, fmt="none", ecolor=color, elinewidth=1, capsize=2.5, alpha=0.6)
        axes.plot(x, y, marker, color=color, markerfacecolor=face, ms=6, label=None if i else series.label)
        if p.default:
            axes.plot(x, y, "o", ms=14, mfc="none", mec="black", mew=1.3)


def _write_settings(axes, chart: Chart) -> None:
    """What each point is, beside it; points that fall together share one text."""
    to_share = axes.transData + axes.transAxes.inverted()
    axes.autoscale_view()
    groups: list[list[tuple[Point, str, np.ndarray]]] = []
    for series, color in zip(chart.series, _COLORS, strict=False):
        for p in (point for point in series.points if np.isfinite(point.error)):
            at = to_share.transform((p.cost, p.error))
            near = (g for g in groups if (np.abs(g[0][2] - at) < _TOGETHER).all())
            group = next(near, None)
            groups.append([(p, color, at)]) if group is None else group.append((p, color, at))
    taken = [(*(at - 0.01), *(at + 0.01)) for group in groups for _, _, at in group]
    for group in groups:
        colors = {color for _, color, _ in group}
        text = ", ".join(dict.fromkeys(p.setting for p, _, _ in group))
        ends = sorted(group, key=lambda one: one[0].cost)
        right, up, box = _room(text, ends[0][2], ends[-1][2], taken)
        taken.append(box)
        place = ends[-1 if right else 0][0]
        style = {"fontsize": 9.5, "color": colors.pop() if len(colors) == 1 else "0.25", "ha": "left", "va": "bottom"}
        style |= ({} if right else {"ha": "right"}) | ({} if up else {"va": "top"})
        offset = (6 if right else -6, 3 if up else -3)
        axes.annotate(text, (place.cost, place.error), xytext=offset, textcoords="offset points", **style)


def _room(text: str, first: np.ndarray, last: np.ndarray, taken: Sequence[Box]) -> tuple[bool, bool, Box]:
    """Whether a text goes to the right (else the left) of its points and above (else below): where it hides least."""
    width, height = _CHARACTER * len(text) + 0.012, 0.045
    found = []
    for right, up in ((True, True), (True, False), (False, True), (False, False)):
        x = last[0] if right else first[0] - width
        y = first[1] if up else first[1] - height
        box = (x, y, x + width, y + height)
        outside = max(0.0, box[2] - 1.05) + max(0.0, -box[0])
        hidden = sum(
            max(0, min(box[2], b[2]) - max(box[0], b[0])) * max(0, min(box[3], b[3]) - max(box[1], b[1])) for b in taken
        )
        found.append((hidden + outside * height, not right, not up, box))
    _, left, down, box = min(found, key=lambda one: one[0])
    return not left, not down, box


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


def _plain_log(axis, set_scale, span: float) -> None:
    """A logarithmic axis with ratios written out."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    set_scale("log")
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if span < _MANY else (1,)))
    axis.set_major_formatter(FuncFormatter(lambda value, position: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())
