"""A pinhole picture with room for what a lens will bring into it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Frame:
    """The pinhole picture to render before the lens bends it: its size and matrix, and how far it reaches out of the
    picture on each side.
    """

    size_px: tuple[int, int]
    matrix_px: np.ndarray
    left: int
    top: int
    right: int
    bottom: int
