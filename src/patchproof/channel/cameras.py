"""What pictures need of cameras where none is calibrated: `lens` is imported with the first camera file."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from patchproof.channel.lens import Camera


def load_optional_camera(
    name_or_file: str | Path | None, base: Path | None = None, photo_px: tuple[int, int] | None = None
) -> "Camera | None":
    """Return the camera of that name or file, as `lens.load_camera` reads it; None if no camera is named."""
    if name_or_file is None:
        return None
    from patchproof.channel.lens import load_camera  # most photographs are of cameras that nobody calibrated

    return load_camera(name_or_file, base, photo_px)


@dataclass(frozen=True)
class Frame:
    """A pinhole picture to render before the lens bends it, and how many pixels it extends beyond each side."""

    size_px: tuple[int, int]
    matrix_px: np.ndarray
    left: int
    top: int
    right: int
    bottom: int
