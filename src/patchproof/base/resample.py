"""Downscale pictures by area, and convert coordinates and homographies to OpenCV's conventions.

Here pixel centers lie at .5; in OpenCV's warps they lie at whole numbers, so that its 0 is our .5, and its polygons are
given in sixteenths of a pixel.
Left out on purpose: the warps themselves, because each caller has its own interpolation and border.
"""

import cv2
import numpy as np

_PX_FROM_INDEX = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
_INDEX_FROM_PX = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1.0]])
_SMALL_PX = 256  # a picture whose shorter side is below this is not halved further


def downscale(pixels: np.ndarray, longest_px: int) -> np.ndarray:
    """Average a picture down until its longer side has at most `longest_px` pixels."""
    if max(pixels.shape[:2]) <= longest_px:
        return pixels
    return cv2.resize(pixels, downscaled_size(pixels.shape[1::-1], longest_px), interpolation=cv2.INTER_AREA)


def downscaled_size(size_px: tuple[int, ...], longest_px: float) -> tuple[int, int]:
    """Width and height in proportion, the longer side at most `longest_px`, neither below 1."""
    scale = min(1.0, longest_px / max(size_px))
    width, height = (max(1, round(side * scale)) for side in size_px)
    return width, height


def halving_pyramid(pixels: np.ndarray) -> list[np.ndarray]:
    """The picture, its half and so on, until the shorter side has less than 256 pixels."""
    levels = [pixels]
    while min(levels[-1].shape[:2]) >= _SMALL_PX:
        height, width = levels[-1].shape[:2]
        levels.append(cv2.resize(levels[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA))
    return levels


def index_homography(homography: np.ndarray) -> np.ndarray:
    """Convert a homography between pixels (centers at .5) to one between OpenCV's indices, for cv2.warpPerspective."""
    return _INDEX_FROM_PX @ (homography @ _PX_FROM_INDEX)


def to_sixteenths(points_px: np.ndarray) -> np.ndarray:
    """Convert points to int32 sixteenths of a pixel, for cv2.fillConvexPoly and cv2.polylines with shift=4."""
    return np.clip((points_px - 0.5) * 16, -1e6, 1e6).round().astype(np.int32)
