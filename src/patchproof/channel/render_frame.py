"""The frame that a camera's picture is rendered in before its lens bends it; without anything of lenses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Frame:
    """The pinhole picture to render before the lens bends it, and how far it reaches beyond each of its sides."""

    size_px: tuple[int, int]
    matrix_px: np.ndarray
    left: int
    top: int
    right: int
    bottom: int
