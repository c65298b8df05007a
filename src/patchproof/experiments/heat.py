"""Figures of stress tests: heat maps with a rate in every cell and the count of draws above, and strips of pictures.

In: the axes' names and edges, or a grid of positions; rates as lists, the first axis to the right. Out: `Drawing`s for
a study's page. All maps share one scale from 0 to 1, so that they can be laid side by side.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from patchproof.report.tables import Drawing

_UNITS = {"deg": "°", "mm": "mm", "ev": "EV"}


def heat_map(
    name: str,
    title: str,
    axes: Mapping[str, Any],
    rates: Sequence[Sequence[float]],
    n: int,
    worst: Sequence[Sequence[int]],
) -> Drawing:
    """Rates over two axes (`names`, and the `edges` of their cells); the `worst` cells are framed."""

    def draw(figure) -> None:
        plot = figure.add_subplot()
        _cells(plot, rates, worst)
        for axis, values in zip((plot.xaxis, plot.yaxis), axes["edges"], strict=True):
            axis.set_ticks([i - 0.5 for i in range(len(values))], [f"{value:.4g}" for value in values])
        plot.set_xlabel(said(axes["names"][0]))
        plot.set_ylabel(said(axes["names"][1]))
        plot.set_title(f"rate, n = {n} draws per cell; framed: the worst tenth")

    return Drawing(name, title, draw, _size(rates))


def position_map(
    name: str, title: str, share: float, rates: Sequence[Sequence[float]], n: int, worst: Sequence[int]
) -> Drawing:
    """Rates under a black square of `share` of the picture's side, by where its middle is; the picture's y is down."""

    def draw(figure) -> None:
        plot, count = figure.add_subplot(), len(rates)
        _cells(plot, rates, [worst])
        plot.invert_yaxis()
        middles = [f"{share / 2 + (1 - share) * i / (count - 1):.0%}" for i in range(count)]
        for axis in (plot.xaxis, plot.yaxis):
            axis.set_ticks(range(count), middles)
        plot.set_xlabel("middle of the square, from the left")
        plot.set_ylabel("from the top")
        plot.set_title(f"black square, {share:.0%} of the side; n = {n}")

    return Drawing(name, title, draw, _size(rates))


def picture_strip(name: str, title: str, path: Path, parts: Sequence[str]) -> Drawing:
    """Pictures of one size that lie side by side in one file, each under its name."""

    def draw(figure) -> None:
        from matplotlib.image import imread

        picture = imread(path)
        width = picture.shape[1] // len(parts)
        for plot, part, i in zip(figure.subplots(1, len(parts)), parts, range(len(parts)), strict=True):
            plot.imshow(picture[:, i * width : (i + 1) * width])
            plot.set_title(part)
            plot.set_axis_off()

    return Drawing(name, title, draw, (2.1 * len(parts), 2.4))


def said(name: str) -> str:
    """A condition's field as people read it: "azimuth (°)" for azimuth_deg."""
    words, unit = name.split("_"), ""
    if words[-1] in _UNITS:
        unit = f" ({_UNITS[words.pop()]})"
    return " ".join(words) + unit


def _cells(plot, rates: Sequence[Sequence[float]], framed: Sequence[Sequence[int]]) -> None:
    from matplotlib.patches import Rectangle

    columns = list(zip(*rates, strict=True))
    image = plot.imshow(columns, origin="lower", aspect="auto", vmin=0, vmax=1, cmap="viridis")
    for i, column in enumerate(rates):
        for j, value in enumerate(column):
            shade = "black" if value > 0.6 else "white"
            plot.text(i, j, f"{value:.2f}", ha="center", va="center", color=shade, fontsize=8)
    for i, j in framed:
        plot.add_patch(Rectangle((i - 0.46, j - 0.46), 0.92, 0.92, fill=False, edgecolor="red", linewidth=2))
    plot.figure.colorbar(image, ax=plot, label="rate")


def _size(rates: Sequence[Sequence[float]]) -> tuple[float, float]:
    return max(2.2 + 0.6 * len(rates), 5.5), max(1.6 + 0.42 * len(rates[0]), 3.2)
