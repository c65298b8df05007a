"""Draw a chart: cost to the right, error upwards with intervals, the front and the default marked.

In: a `Chart`. Out: a `Drawing` as studies have them. Points on the Pareto front are filled and joined, the others are
hollow; a ring marks the default. A corner names the machine.
"""

from functools import partial
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np

from patchlab.bench.chart import Chart, ChartPoint, value_and_ends
from patchproof.report.tables import Drawing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.transforms import Bbox

_COLORS = ("#1f5fa8", "#c2571a", "#2a8f62", "#8a4fa3", "#6b6b6b")
_LABEL_CHARACTERS = 60  # characters of an axis label in one line
_DECADES_ONLY_RATIO = 2000  # largest over smallest figure from which on only decades get ticks
_MARKERS = ("o", "s", "^", "D", "v")
_RING = {"marker": "o", "ms": 12, "mfc": "none", "mec": "black", "mew": 1.2, "ls": "none"}


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
        text = axes.annotate(
            point.setting, point.center, xytext=(0, 0), textcoords="offset points", color=color, fontsize=8
        )
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
