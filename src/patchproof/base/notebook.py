"""Results as a notebook shows them: a heading, figures, rates as bars with intervals, and a picture.

In: text, rates in [0, 1] by name, and pictures. Out: HTML without requests, or a matplotlib figure. Loaded by the
notebook's own calls only.
"""

import html
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from patchproof.base.output import data_uri, image_bytes, rate_text
from patchproof.base.text import printable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Rates = Mapping[str, tuple[float, tuple[float, float]]]  # a rate and its interval, the design's first
PATCH_COLOR, CONTROL_COLOR = "#2457c5", "#b0713c"
_PICTURE_PX, _BAR_PX = 160, 200  # a design's own pixels are larger blocks


def notebook_html(heading: str, rows: Mapping[str, str], rates: Rates, picture: np.ndarray | None = None) -> str:
    """Return a heading, a table of `rows`, bars of `rates`, and `picture` (uint8 H×W×3 sRGB) beside them."""
    cells = [(printable(key), html.escape(printable(value))) for key, value in rows.items()]
    cells += [(name, f"{_bar(number, *rate)} {rate_text(*rate)}") for number, (name, rate) in enumerate(rates.items())]
    table = "".join(
        f'<tr><th style="text-align:left">{html.escape(key)}</th><td style="text-align:left">{value}</td></tr>'
        for key, value in cells
    )
    image = ""
    if picture is not None:
        uri = data_uri(image_bytes(picture, "PNG"))
        image = f'<img alt="design" src="{uri}" style="height:{_PICTURE_PX}px;image-rendering:pixelated">'
    return f"<div><b>{html.escape(printable(heading))}</b><table>{table}</table>{image}</div>"


def rates_figure(heading: str, rates: Rates, picture: np.ndarray | None = None) -> "Figure":
    """Draw bars of `rates` with their intervals, the design's on top, and `picture` (uint8 H×W×3 sRGB) beside them."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 0.4 * len(rates) + 1.6), layout="constrained")
    draw_rates(figure.subplots(1, 2, width_ratios=(1, 2)), rates, picture)
    figure.suptitle(printable(heading), fontsize=10)
    return figure


def draw_rates(pair: Any, rates: Rates, picture: np.ndarray | None) -> None:
    """Fill the first of two matplotlib axes with the picture, the second with the bars of `rates_figure`."""
    photo, axes = pair
    photo.set_axis_off()
    if picture is not None:
        photo.imshow(picture, interpolation="nearest")
    names, values = [*rates], np.array([100 * rate for rate, _ in rates.values()])
    ends = 100 * np.array([interval for _, interval in rates.values()]).reshape(-1, 2).T
    colors = [PATCH_COLOR, *[CONTROL_COLOR] * (len(names) - 1)][: len(names)]
    errors = np.abs(ends - values)  # an interval from another model of chance may lie beside its rate
    axes.barh(range(len(names)), values, xerr=errors, color=colors, capsize=3)
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set(xlim=(0, 100), xlabel="recognized, % with 95 % interval")


def _bar(number: int, rate: float, interval: tuple[float, float]) -> str:
    """Return a bar of the rate, and its interval as a line over it."""
    low, high, width = (round(_BAR_PX * share) for share in (*interval, rate))
    color = CONTROL_COLOR if number else PATCH_COLOR
    return (
        f'<svg width="{_BAR_PX}" height="12" style="vertical-align:middle"><rect width="{width}" height="12" '
        f'fill="{color}" opacity=".55"/><rect x="{low}" y="5" width="{max(high - low, 1)}" height="2" '
        f'fill="{color}"/></svg>'
    )
