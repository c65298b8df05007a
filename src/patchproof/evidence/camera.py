"""A photograph as a pinhole camera would have taken it, and that camera's matrix as far as it is known.

In: a photograph and optionally a calibrated camera. Out: `PinholePhoto`. A camera file gives intrinsics and lens terms,
and the picture is resampled without lens distortion: homographies are then of the resampled picture. Without a file the
matrix follows from EXIF's focal length with the principal point in the middle, or is unknown. A camera file also fits
upright photographs, as those of a camera that was turned by 90° clockwise, as most phones are.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from patchproof.photo.detect import row_strips
from patchproof.photo.exif import EXIF_SPREAD
from patchproof.photo.read import Photo

if TYPE_CHECKING:
    from patchproof.channel.lens import Camera

FOCAL_ERROR = 0.005  # relative, 95 %, of a camera file


@dataclass(frozen=True)
class PinholePhoto:
    """A photograph uint8 H×W×3 without lens distortion, its camera matrix (None: unknown), whether a camera file gave
    it, the standard deviation of the focal length's logarithm, and whether EXIF's focal length is of an uncropped file.
    """

    srgb: np.ndarray
    matrix_px: np.ndarray | None
    calibrated: bool
    focal_spread: float = EXIF_SPREAD
    cropped: bool = False


def pinhole_photo(photo: Photo, camera: "Camera | None") -> PinholePhoto:
    """Remove the distortion by the camera file; use EXIF if there is no file, or if it is of another picture size."""
    height, width = photo.srgb.shape[:2]
    if camera is not None and width != height:
        for candidate in (camera, _turn_clockwise(camera)):
            if candidate.fits((width, height)):
                matrix = candidate.matrix_px((width, height))
                return PinholePhoto(_undistort(photo.srgb, candidate, matrix), matrix, True, FOCAL_ERROR / 1.96)
    focal = photo.focal_px
    matrix = None if focal is None else np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return PinholePhoto(photo.srgb, matrix, False, photo.focal_spread, photo.focal_rejected)


def _turn_clockwise(camera: "Camera") -> "Camera":
    """Turn a camera's pictures by 90° clockwise: (x, y) becomes (height - y, x)."""
    (width, height), cx, cy = camera.image_px, camera.cx, camera.cy
    turned = camera.changed(image_px=(height, width), fx=camera.fy, fy=camera.fx, cx=height - cy, cy=cx)
    return turned.changed(p1=camera.p2, p2=-camera.p1)


def _undistort(srgb: np.ndarray, camera: "Camera", matrix: np.ndarray) -> np.ndarray:
    """Resample a picture as a pinhole of the same matrix takes it."""
    if not camera.has_distortion:
        return srgb
    index = matrix.copy()
    index[:2, 2] -= 0.5  # OpenCV counts from pixel centers
    terms = np.array([camera.k1, camera.k2, camera.p1, camera.p2, camera.k3])
    picture = np.empty_like(srgb)
    for rows in row_strips(srgb):  # maps take 8 bytes a pixel: in strips they stay small
        strip, strip_matrix = picture[rows], index - np.array([[0, 0, 0], [0, 0, rows.start], [0, 0, 0]])
        size_px = strip.shape[1], strip.shape[0]
        maps = cv2.initUndistortRectifyMap(index, terms, None, strip_matrix, size_px, cv2.CV_32FC1)
        cv2.remap(srgb, *maps, cv2.INTER_CUBIC, strip, cv2.BORDER_REPLICATE)
    return picture
