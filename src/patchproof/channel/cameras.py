"""Load a calibrated camera only if one is named: `lens` is imported with the first camera file."""

from pathlib import Path
from typing import TYPE_CHECKING

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
