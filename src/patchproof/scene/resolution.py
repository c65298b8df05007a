"""How many pixels a scene's views have for the markers and for the design."""

from __future__ import annotations

import numpy as np

PX_PER_MODULE = 2.5  # a marker is read from about here on: 45 of 48 at 2.7 px with a blur of 0.7 px
READABLE_SHARE = 0.95  # of the views should show markers at least that large
_DESIGN_PX = (32, 512)


def design_grid(closest_px_per_mm: float, piece_mm: tuple[float, float]) -> tuple[int, int]:
    """(width, height) of a design, in multiples of 8: one texel per pixel of the closest view.

    Finer grids cost time and bought nothing that can be told from chance: after 60 steps before a network of 224 px the
    selection loss was 0.73, 0.79 and 0.75 with 0.7, 1 and 1.5 texels per pixel (one seed).
    """
    low, high = _DESIGN_PX
    scale = np.clip(closest_px_per_mm, low / min(piece_mm), high / max(piece_mm))
    width, height = (max(8, round(side * scale / 8) * 8) for side in piece_mm)
    return width, height
