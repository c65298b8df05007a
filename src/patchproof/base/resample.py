"""Reduce pictures by area, and state maps between pixels in OpenCV's terms.

Here pixel centers lie at .5; OpenCV's warps count from pixel centers, so that their 0 is our .5, and its polygons come
in sixteenths of a pixel.
Left out on purpose: the warps themselves, which differ in interpolation and border from place to place.
"""

from __future__ import annotations

import cv2
import numpy as np

_PX_FROM_INDEX = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
_INDEX_FROM_PX = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1.0]])
_SMALL_PX = 256  # a picture whose shorter side is below this is not halved further


def downscale(pixels: np.ndarray, longest_px: int) -> np.ndarray:
    """A picture averaged down until its longer side has no more pixels than that."""
    if max(pixels.shape[:2]) <= longest_px:
        return pixels
    return cv2.resize(pixels, downscaled_size(pixels.shape[1::-1], longest_px), interpolation=cv2.INTER_AREA)


def downscaled_size(size_px: tuple[int, ...], longest_px: int) -> tuple[int, int]:
    """Width and height in the same proportion, the longer one no more than that, neither below 1."""
    scale = min(1.0, longest_px / max(size_px))
    width, height = (max(1, round(side * scale)) for side in size_px)
    return width, height


def halving_pyramid(pixels: np.ndarray) -> list[np.ndarray]:
    """The picture, its half, and so on while its shorter side has 256 pixels or more."""
    levels = [pixels]
    while min(levels[-1].shape[:2]) >= _SMALL_PX:
        height, width = levels[-1].shape[:2]
        levels.append(cv2.resize(levels[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA))
    return levels


def index_homography(homography: np.ndarray) -> np.ndarray:
    """3×3 between OpenCV's pixel indices, of a 3×3 between pixels: what cv2.warpPerspective takes."""
    return _INDEX_FROM_PX @ (homography @ _PX_FROM_INDEX)


def to_sixteenths(points_px: np.ndarray) -> np.ndarray:
    """Points as cv2.fillConvexPoly and cv2.polylines take them with a shift of 4: int32, in sixteenths of a pixel."""
    return np.clip((points_px - 0.5) * 16, -1e6, 1e6).round().astype(np.int32)
