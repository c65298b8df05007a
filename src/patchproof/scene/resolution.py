"""How many pixels a scene's views have for the markers and for the design."""

from __future__ import annotations

import numpy as np

PX_PER_MODULE = 2.5  # a marker is read from about here on: 45 of 48 at 2.7 px with a blur of 0.7 px
READABLE_SHARE = 0.95  # of the views should show markers at least that large
# Texels per pixel of the closest view at the network's size: finer ones average out before any network sees them.
_DESIGN_OVERSAMPLING = 1.5
_DESIGN_PX = (32, 512)


def design_grid(closest_px_per_mm: float, design_mm: tuple[float, float]) -> tuple[int, int]:
    """(width, height) of a design, in multiples of 8, for the closest view's pixels per millimetre."""
    low, high = _DESIGN_PX
    scale = np.clip(closest_px_per_mm * _DESIGN_OVERSAMPLING, low / min(design_mm), high / max(design_mm))
    return tuple(max(8, round(side * scale / 8) * 8) for side in design_mm)
