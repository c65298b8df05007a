"""What a calibration leaves over, as a picture: where, in which photographs, and what each rung of the ladder buys.

In: a finished calibration. Out: a PNG. Arrows in the first panel show a pattern where a lens term is missing, and
point every way where none is; a photograph that stands out in the second was moved or shows a bent board.
"""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from patchproof.calibrate.camera import Calibrated


def residual_picture(found: Calibrated) -> bytes:
    """Three panels: residuals over the picture, RMS of each photograph, held-out error of each rung."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    where, photos, rungs = figure.subplots(1, 3, width_ratios=(1.5, 1.2, 1))
    _arrows(where, found)
    fit = found.climbed.fit
    rms = [float(np.sqrt((residual**2).sum(1).mean())) for residual in fit.residuals_px]
    photos.bar(range(1, len(rms) + 1), rms, color="#4477aa")
    photos.set(xlabel="photograph, in the order of names", ylabel="rms [px]", title=f"{fit.rms_px:.3f} px in all")
    _ladder(rungs, found)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110, metadata={"Software": None})
    return buffer.getvalue()


def _arrows(axes, found: Calibrated) -> None:
    places = np.concatenate([view.px for view in found.views])
    residuals = np.concatenate(found.climbed.fit.residuals_px)
    width, height = found.camera.image_px
    typical = max(float(np.median(np.linalg.norm(residuals, axis=1))), 1e-6)
    times = 0.02 * width / typical
    colors = np.linalg.norm(residuals, axis=1)
    axes.quiver(
        *places.T, *residuals.T, colors, angles="xy", scale_units="xy", scale=1 / times, width=0.0025, cmap="viridis"
    )
    axes.set(xlim=(0, width), ylim=(height, 0), aspect="equal", title=f"residuals, {times:.0f} times as long")


def _ladder(axes, found: Calibrated) -> None:
    rungs = [rung for rung in found.climbed.rungs if np.isfinite(rung.held_out_px)]
    errors = [rung.held_out_px for rung in rungs]
    axes.errorbar(range(len(rungs)), errors, [rung.standard_error_px for rung in rungs], fmt="o-", color="#4477aa")
    names = [rung.name for rung in rungs]
    chosen = names.index(found.climbed.fit.rung)
    axes.plot(chosen, errors[chosen], "o", markersize=12, fillstyle="none", color="#cc3311")
    if max(errors) > 10 * min(errors):
        axes.set_yscale("log")
    axes.set_xticks(range(len(rungs)), [name.replace(" p1 p2", "\np1 p2") for name in names], fontsize=8)
    axes.set(ylabel="held-out error [px]", title=f"chosen: {found.climbed.fit.rung}")
