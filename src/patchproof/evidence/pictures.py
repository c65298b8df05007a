"""Small pictures of one photograph for the report: what was found, drawn on the photograph."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike

from patchproof.evidence.surface import Surface
from patchproof.geometry import apply_homography, rect_corners

THUMBNAIL_PX = 560  # longer side: enough for a phone's width at twice its density, some 40 kB as JPEG
_DESIGN_COLOR, _MARKER_COLOR = (255, 64, 129), (0, 200, 140)


def thumbnail(srgb: np.ndarray, px_from_mm: ArrayLike | None, surface: Surface) -> np.ndarray:
    """The photograph reduced, with the outline of the design and of the piece's markers where they are known to lie."""
    shrink = min(1.0, THUMBNAIL_PX / max(srgb.shape[:2]))
    size = max(1, round(srgb.shape[1] * shrink)), max(1, round(srgb.shape[0] * shrink))
    sparse = max(1, int(0.5 / shrink))  # all of 12 megapixels took a tenth of the whole measurement's time
    small = cv2.resize(srgb[::sparse, ::sparse], size, interpolation=cv2.INTER_AREA)
    if px_from_mm is None:
        return small
    small_from_mm = np.diag([shrink, shrink, 1.0]) @ np.asarray(px_from_mm)
    for marker_id in sorted(surface.piece_ids):
        _outline(small, small_from_mm, surface.corners_mm[marker_id], _MARKER_COLOR, 1)
    _outline(small, small_from_mm, rect_corners(surface.rect_mm), _DESIGN_COLOR, 2)
    return small


def _outline(picture: np.ndarray, px_from_mm: np.ndarray, corners_mm: np.ndarray, color, width: int) -> None:
    # OpenCV counts from pixel centers and takes sixteenths of pixels here
    points = np.clip((apply_homography(px_from_mm, corners_mm) - 0.5) * 16, -1e6, 1e6)
    cv2.polylines(picture, [points.round().astype(np.int32)], True, color, width, cv2.LINE_AA, 4)
