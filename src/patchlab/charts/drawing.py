"""Draw charts of points: colors that are told apart without red and green, the front, and labels beside points."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from patchproof.base.intervals import Estimate
from patchproof.report.tables import Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito, Color Universal Design (2008), darkened where white lies behind
COLORS = ("#0072b2", "#000000", "#56a0d0", "#d55e00", "#009e73", "#b8860b", "#a8518a", "#6b6b6b")
_LABEL_GAP_PX = 7


def pareto_mask(cost: Sequence[float], error: Sequence[float]) -> np.ndarray:
    """N bool: no other point is as good in both and better in one."""
    figures = np.stack([cost, error], 1).astype(float)
    each, other = figures[:, None], figures
    beaten = np.all(other <= each, axis=2) & np.any(other < each, axis=2)
    return np.logical_not(np.any(beaten, axis=1))


def value_and_ends(figure: Estimate | float | None) -> tuple[float, float, float]:
    """(value, low, high); a plain number is its own interval, None is 0."""
    if isinstance(figure, Estimate):
        return figure.value, figure.low, figure.high
    return figure or 0.0, figure or 0.0, figure or 0.0


def rows_of(table: Table) -> list[list[Any]]:
    """Rows whose columns are of types that the caller knows."""
    return [list(row) for row in table.rows]


def log_axis(axes: "Axes", name: str, values: Sequence[float]) -> None:
    """A logarithmic axis with plain numbers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis = axes.xaxis if name == "x" else axes.yaxis
    (axes.set_xscale if name == "x" else axes.set_yscale)("log")
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if max(values) < 60 * min(values) else (1,)))
    axis.set_major_formatter(FuncFormatter(lambda value, position: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def label_points(figure: "Figure", axes: "Axes", points: Sequence[tuple[float, float, str, str]]) -> None:
    """Write a text beside each point (x, y, text, color), at the one of eight places where it hides least."""
    from matplotlib.patheffects import withStroke
    from matplotlib.transforms import Bbox

    axes.grid(alpha=0.25)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(0.12)
    figure.draw_without_rendering()  # positions are known only after the layout
    taken = [Bbox([xy - 6, xy + 6]) for xy in axes.transData.transform([point[:2] for point in points])]
    taken += [text.get_window_extent() for text in axes.texts]
    for x, y, words, color in points:
        text = axes.annotate(words, (x, y), (0, 0), textcoords="offset points", color=color, fontsize=9)
        text.set(in_layout=False, path_effects=[withStroke(linewidth=2.5, foreground="white")])  # above lines
        places = [(right, up) for right in (1, -1, 0) for up in (0, 1, -1) if right or up]

        def box_at(place: tuple[int, int], text=text) -> Bbox:
            right, up = place
            text.set(ha=("center", "left", "right")[right], va=("center", "bottom", "top")[up])
            text.set_position((_LABEL_GAP_PX * right, _LABEL_GAP_PX * up * (0.5 if right else 1)))
            return text.get_window_extent()

        areas = [_hidden_area(box_at(place), taken, axes.bbox) for place in places]
        taken.append(box_at(places[int(np.argmin(areas))]))


def _hidden_area(box, taken, frame) -> float:
    """The area of a text's box that lies on taken boxes or outside the axes."""
    shared = (box.intersection(box, other) for other in taken)
    inside = box.intersection(box, frame)
    outside = box.width * box.height - (inside.width * inside.height if inside else 0.0)
    return outside + sum(part.width * part.height for part in shared if part)
