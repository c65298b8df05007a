"""Scans: pictures of known resolution, the one thing from which a print's absolute size can be read.

In: the homography of a picture and the DPI that the user states (never the file's own claim). Out: whether the
picture can be a scan, and the print's scale along the page's x and y.
"""

from __future__ import annotations

import numpy as np

from patchproof.evidence.results import Scale
from patchproof.evidence.surface import Surface
from patchproof.geometry import apply_homography, rect_corners

_MOST_PERSPECTIVE = 0.005  # relative change of length between opposite sides; scanners have none
_SIZES = (0.8, 1.25)  # prints off by more than this are no prints of this page


def scan_scale(px_from_mm: np.ndarray, surface: Surface, scan_dpi: float) -> Scale | None:
    """The print's scale through the middle of the design; None where the picture has perspective or another
    resolution. Prints stretched along one axis are scans, too.
    """
    corners = apply_homography(px_from_mm, rect_corners(surface.rect_mm))
    sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    perspective = max(abs(sides[0] / sides[2] - 1), abs(sides[1] / sides[3] - 1))
    x, y, w, h = surface.rect_mm
    ends = np.array([[x, y + h / 2], [x + w, y + h / 2], [x + w / 2, y], [x + w / 2, y + h]])
    px = apply_homography(px_from_mm, ends)
    px_per_mm = scan_dpi / 25.4
    across, down = np.linalg.norm(px[1] - px[0]), np.linalg.norm(px[3] - px[2])
    scales = float(across / w / px_per_mm), float(down / h / px_per_mm)
    if perspective < _MOST_PERSPECTIVE and all(_SIZES[0] < scale < _SIZES[1] for scale in scales):
        return Scale(scale_x=scales[0], scale_y=scales[1])
    return None
