"""What a calibration leaves over, as a picture: where, in which photographs, and what each rung of the ladder buys.

In: a finished calibration. Out: a PNG. Arrows in the first panel show a pattern where a lens term is missing, and
point every way where none is; a photograph that stands out in the second was moved or shows a bent board.
"""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np

from patchproof.calibrate.boards import View
from patchproof.calibrate.ladder import Rung
from patchproof.calibrate.lens_ladder import Fit


def residual_picture(views: Sequence[View], rungs: Sequence[Rung], fit: Fit) -> bytes:
    """Three panels: residuals over the picture, RMS of each photograph, held-out error of each rung."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    where, photos, ladder = figure.subplots(1, 3, width_ratios=(1.5, 1.2, 1))
    _arrows(where, views, np.concatenate(fit.residuals_px))
    photos.bar(range(1, len(views) + 1), fit.photo_rms_px, color="#4477aa")
    photos.set(xlabel="photograph, in the order of names", ylabel="rms [px]", title=f"{fit.rms_px:.3f} px in all")
    _ladder(ladder, rungs, fit.rung)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110, metadata={"Software": None})
    return buffer.getvalue()


def _arrows(axes, views: Sequence[View], residuals: np.ndarray) -> None:
    places = np.concatenate([view.px for view in views])
    width, height = views[0].size_px
    lengths = np.linalg.norm(residuals, axis=1)
    times = 0.02 * width / max(float(np.median(lengths)), 1e-6)
    axes.quiver(
        *places.T, *residuals.T, lengths, angles="xy", scale_units="xy", scale=1 / times, width=0.0025, cmap="viridis"
    )
    axes.set(xlim=(0, width), ylim=(height, 0), aspect="equal", title=f"residuals, {times:.0f} times as long")


def _ladder(axes, rungs: Sequence[Rung], chosen_name: str) -> None:
    """Bars are the standard error of the difference from the best rung."""
    rungs = [rung for rung in rungs if np.isfinite(rung.error)]
    names, errors = [rung.name for rung in rungs], [rung.error for rung in rungs]
    axes.errorbar(range(len(rungs)), errors, [rung.standard_error for rung in rungs], fmt="o-", color="#4477aa")
    chosen = names.index(chosen_name)
    axes.plot(chosen, errors[chosen], "o", markersize=12, fillstyle="none", color="#cc3311")
    if max(errors) > 10 * min(errors):
        axes.set_yscale("log")
    axes.set_xticks(range(len(rungs)), [name.replace(" p1 p2", "\np1 p2") for name in names], fontsize=8)
    axes.set(ylabel="held-out error [px]", title=f"chosen: {chosen_name}")
