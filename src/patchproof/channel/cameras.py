"""Calibrated cameras where there is one, and the picture that they bend: what knows lenses (`lens`) is loaded with the
first camera file.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from patchproof.channel.lens import Camera


@dataclass(frozen=True)
class Frame:
    """The pinhole picture to render before the lens bends it, and how far it reaches beyond each of its sides."""

    size_px: tuple[int, int]
    matrix_px: np.ndarray
    left: int
    top: int
    right: int
    bottom: int


def camera_of(
    name_or_file: str | None, base: Path | None = None, photo_px: tuple[int, int] | None = None
) -> Camera | None:
    """The camera of that name or file, as `lens.load_camera` reads it; None where none is named."""
    if name_or_file is None:
        return None
    from patchproof.channel.lens import load_camera  # most photographs are of cameras that nobody calibrated

    return load_camera(name_or_file, base, photo_px)
