"""Small plots of a report as inline SVG that follows the page's text color: recognition, gap ledger.

In: entries of a report as plain data. Out: SVG text. Points of recognition lie at 0 or 1 with a little fixed scatter;
the line is a running share over neighboring photographs, drawn from 24 photographs on.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from patchproof.report.page import draw_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_INK = "#010203"  # stands for the page's own text color and is replaced in the SVG
_YES, _NO = "#2a9d6f", "#d1495b"
_LEAST_FOR_LINE = 24
PlotRows = Sequence[Mapping]


def recognition_plot(photos: PlotRows, model: str, figure: str, label: str, promised: PlotRows) -> str | None:
    """Plot recognition over one figure of the photographs; None if fewer than two photographs have it."""
    x, y = _points(photos, figure, lambda photo: photo["predictions"].get(model, {}).get("recognized"))
    if len(x) < 2:
        return None
    px, py = _points(promised, figure, lambda condition: condition["recognized"])
    return _svg(lambda axes: _draw(axes, x, y, px, py, label))


def ledger_plot(ledger: Mapping) -> str:
    """Plot the gap ledger as a waterfall from the ideal picture's confidence to the photographs', with 95 % intervals.

    `ledger` holds `shares` {step: {share, interval}}, `ideal` and `photo` (mean confidence).
    """
    return _svg(lambda axes: _draw_ledger(axes, ledger))


def _draw_ledger(axes, ledger: Mapping) -> None:
    shares, ideal = ledger["shares"], ledger["ideal"]
    costs = np.array([share["share"] for share in shares.values()])
    # a positive share is a loss for the goal: for deceiving, a gain in confidence
    levels_after = ideal + np.sign(ledger["photo"] - ideal or -1) * np.sign(costs.sum() or 1) * np.cumsum(costs)
    starts = np.concatenate([[ideal], levels_after[:-1]])
    rows = np.arange(1, len(costs) + 1)
    axes.barh([0, len(costs) + 1], [ideal, ledger["photo"]], color=_INK, alpha=0.35, height=0.62)
    axes.barh(rows, levels_after - starts, left=starts, color=[_NO if c > 0 else _YES for c in costs], height=0.62)
    for row, start, end, share in zip(rows, starts, levels_after, shares.values(), strict=True):
        if share["interval"] is not None:
            ends = start + (np.sign(end - start) * np.sign(share["share"]) or -1) * np.array(share["interval"])
            axes.plot(ends, [row, row], color=_INK, linewidth=1.2)
    levels = [
        f"{100 * ideal:.0f} %",
        *(f"{round(100 * change, 1) + 0:+.1f}" for change in levels_after - starts),
        f"{100 * levels_after[-1]:.0f} %",
    ]
    for row, level in enumerate(levels):
        axes.text(1.02, row, level, va="center", transform=axes.get_yaxis_transform())
    axes.set_yticks([0, *rows, len(costs) + 1], ["ideal", *(_STEPS.get(s, s) for s in shares), "photographs"])
    axes.invert_yaxis()
    axes.set_xlabel("confidence in the target")


_STEPS = {
    "gamut": "gamut",
    "print": "print",
    "light_and_camera": "light, camera color",
    "print_light_and_camera": "print, light, camera",
    "blur_and_noise": "blur, noise",
    "photo": "not explained",
}


def _points(rows, figure, recognized) -> tuple[np.ndarray, np.ndarray]:
    pairs = [(row[figure], recognized(row)) for row in rows if row.get(figure) is not None]
    pairs = sorted((float(value), float(hit)) for value, hit in pairs if hit is not None)
    return np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])


def _draw(axes, x, y, promised_x, promised_y, label) -> None:
    scatter = ((np.arange(len(x)) * 0.618) % 1 - 0.5) * 0.12
    axes.scatter(x, y + scatter, s=16, c=[_YES if hit else _NO for hit in y], alpha=0.75, linewidths=0)
    for points, hits, style in ((promised_x, promised_y, ":"), (x, y, "-")):
        if len(points) >= _LEAST_FOR_LINE:
            window = np.ones(max(5, len(points) // 4))
            running = (np.convolve(values, window / len(window), "valid") for values in (points, hits))
            axes.plot(*running, style, color=_INK, linewidth=1.3)
    axes.set(xlabel=label, ylim=(-0.15, 1.15))
    axes.set_yticks([0, 0.5, 1], ["not recognized", "50 %", "recognized"])


def _svg(draw: "Callable[[Axes], None]") -> str:
    import matplotlib

    settings: Any = dict.fromkeys(
        ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color"), _INK
    )
    with matplotlib.rc_context(settings | {"axes.spines.top": False, "axes.spines.right": False}):
        options = {"transparent": True, "metadata": {"Date": None, "Creator": None}}
        text = draw_figure(lambda figure: draw(figure.add_subplot()), (4.2, 2.3), "svg", **options).decode()
    text = text[text.index("<svg") :]
    return text.replace(_INK, "currentColor").replace("font-family: 'DejaVu Sans', sans-serif", "font-family: inherit")
