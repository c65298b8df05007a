"""What is known of the camera that took a photograph: its pinhole matrix, and the picture as a pinhole has it.

In: a photograph and, where there is one, a calibrated camera. Out: `PinholePhoto`. A camera file gives intrinsics and lens
terms, and the picture is resampled as a pinhole would have taken it: homographies are then those of that picture. Else
the matrix follows from EXIF's focal length with the principal point in the middle, or there is none. A photograph held
upright by turning the camera fits the file turned by 90° clockwise, as most phones are held.
"""

from __future__ import annotations

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
    """A photograph with straight lines straight, its matrix (None: unknown), whether a camera file says so, the
    standard deviation of the focal length's logarithm, and whether EXIF has one that is not this picture's.
    """

    srgb: np.ndarray
    matrix_px: np.ndarray | None
    calibrated: bool
    focal_spread: float = EXIF_SPREAD
    cropped: bool = False


def pinhole_photo(photo: Photo, camera: Camera | None) -> PinholePhoto:
    """The photograph as the camera file has it; as EXIF has it where there is none, or it is another camera's."""
    height, width = photo.srgb.shape[:2]
    if camera is not None and width != height:
        for held in (camera, _turned(camera)):
            if held.fits((width, height)):
                matrix = held.matrix_px((width, height))
                return PinholePhoto(_straightened(photo.srgb, held, matrix), matrix, True, FOCAL_ERROR / 1.96)
    focal = photo.focal_px
    matrix = None if focal is None else np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return PinholePhoto(photo.srgb, matrix, False, photo.focal_spread, photo.focal_rejected)


def _turned(camera: Camera) -> Camera:
    """The same camera whose pictures are turned by 90° clockwise: (x, y) becomes (height - y, x)."""
    (width, height), cx, cy = camera.image_px, camera.cx, camera.cy
    turned = camera.changed(image_px=(height, width), fx=camera.fy, fy=camera.fx, cx=height - cy, cy=cx)
    return turned.changed(p1=camera.p2, p2=-camera.p1)


def _straightened(srgb: np.ndarray, camera: Camera, matrix: np.ndarray) -> np.ndarray:
    """The picture through a pinhole of the same matrix."""
    if not camera.has_distortion:
        return srgb
    index = matrix.copy()
    index[:2, 2] -= 0.5  # OpenCV counts from pixel centers
    terms = np.array([camera.k1, camera.k2, camera.p1, camera.p2, camera.k3])
    picture = np.empty_like(srgb)
    for rows in row_strips(srgb):  # maps of the whole take 8 bytes a pixel
        part, of_part = picture[rows], index - np.array([[0, 0, 0], [0, 0, rows.start], [0, 0, 0]])
        size_px = part.shape[1], part.shape[0]
        maps = cv2.initUndistortRectifyMap(index, terms, None, of_part, size_px, cv2.CV_32FC1)
        cv2.remap(srgb, *maps, cv2.INTER_CUBIC, part, cv2.BORDER_REPLICATE)
    return picture
