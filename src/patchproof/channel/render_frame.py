"""The frame in which a picture is rendered before the lens bends it; needs nothing of lenses."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Frame:
    """A pinhole picture to render before the lens bends it, and how many pixels it extends beyond each side."""

    size_px: tuple[int, int]
    matrix_px: np.ndarray
    left: int
    top: int
    right: int
    bottom: int
