"""Heat maps of stress tests: a rate in every cell, and the worst cells framed.

In: rates as lists, the first axis to the right, and what its axes say. Out: `Drawing`s for a study's page. All maps
share one scale from 0 to 1, so that they can be laid side by side.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from patchproof.report.tables import Drawing
from patchproof.study.figures import number_grid

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Ticks = tuple[str, Sequence[float], Sequence[str]]  # an axis's label, where its ticks are, and what they say
_UNITS = {"deg": "°", "mm": "mm", "ev": "EV"}


def heat_map(
    name: str,
    titles: tuple[str, str],
    rates: Sequence[Sequence[float]],
    framed: Sequence[Sequence[int]],
    ticks: Sequence[Ticks],
    upward: bool = True,
) -> Drawing:
    """Rates over two axes, the second one upward or down; `titles` are the drawing's and the plot's own."""

    def draw(figure: Figure) -> None:
        plot, values = figure.add_subplot(), np.array(rates).T
        texts = [[f"{value:.2f}" for value in row] for row in values]
        image = number_grid(plot, values, texts, [(y, x) for x, y in framed], fontsize=8)
        figure.colorbar(image, ax=plot, label="rate")
        for axis, (label, places, words) in zip((plot.xaxis, plot.yaxis), ticks, strict=True):
            axis.set_ticks(places, words)
            axis.set_label_text(label)
        if upward:
            plot.invert_yaxis()
        plot.set_title(titles[1])

    size = max(2.2 + 0.6 * len(rates), 5.5), max(1.6 + 0.42 * len(rates[0]), 3.2)
    return Drawing(name, titles[0], draw, size)


def map_ticks(axes: Mapping[str, Any]) -> list[Ticks]:
    """Of a map's axes (`names`, and the `edges` of their cells)."""
    return [
        (words_of(name), [i - 0.5 for i in range(len(edges))], [f"{value:.4g}" for value in edges])
        for name, edges in zip(axes["names"], axes["edges"], strict=True)
    ]


def words_of(name: str) -> str:
    """A condition's field as people read it: "azimuth (°)" for azimuth_deg."""
    words, unit = name.split("_"), ""
    if words[-1] in _UNITS:
        unit = f" ({_UNITS[words.pop()]})"
    return " ".join(words) + unit
