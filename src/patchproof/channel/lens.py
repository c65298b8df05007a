"""A calibrated camera: the direction that each pixel looks in, and the lens's distortion of straight lines.

In: a camera file (JSON: intrinsics at `image_px`, Brown-Conrady distortion k1 k2 p1 p2 k3 as OpenCV defines it, and the
source of the numbers). Out: pinhole matrices for any size, points and pictures with the lens's distortion. Pixel
centers are at .5 here: OpenCV's calibration has its principal point (cx, cy) half a pixel lower.

A picture is rendered by a pinhole, a little larger than needed (`pinhole_frame`), and resampled once to bend it
(`distort_pictures`). That bilinear sample is the cost of distortion in accuracy: a blur of up to 1/4 px² of variance,
1/6 in the mean; a camera without distortion skips it and costs nothing. Left out on purpose: fisheye and rational
models, and chromatic aberration. Lenses that bend so far that one direction would be seen twice are refused.

Source: Brown, Close-Range Camera Calibration, 1971; OpenCV's documentation of calib3d.
"""

import math
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field

from patchproof.base.errors import Refused
from patchproof.base.geometry import Frame
from patchproof.base.input import read_json
from patchproof.base.packaged import named_path, packaged_path
from patchproof.base.validation import Finite, Positive, StrictModel, validate_model

if TYPE_CHECKING:
    from torch import Tensor

ASPECT_TOLERANCE = 0.002  # sizes are whole pixels: 1600 × 1067 is a picture of a camera of 6000 × 4000
_ITERATIONS = 100
_MAX_ERROR_PX = 1e-6  # at `image_px`: distance between a point and the same point undistorted and distorted again


class Camera(StrictModel):
    """A camera file; lengths are pixels of a picture of `image_px` (width, height), pixel centers at .5."""

    name: str
    method: Literal["measured", "assumed"]
    when: str  # the day of the measurement
    instrument: str  # the instrument of the measurement, or the basis of the assumption
    uncertainty: str
    image_px: tuple[Annotated[int, Field(ge=64, le=20000)], Annotated[int, Field(ge=64, le=20000)]]
    fx: Positive
    fy: Positive
    cx: Finite
    cy: Finite
    k1: Finite = 0.0
    k2: Finite = 0.0
    p1: Finite = 0.0
    p2: Finite = 0.0
    k3: Finite = 0.0

    @property
    def has_distortion(self) -> bool:
        """True if the lens has any distortion."""
        return any((self.k1, self.k2, self.p1, self.p2, self.k3))

    def fits(self, photo_px: tuple[int, int]) -> bool:
        """True if photographs of this size can be the camera's, held as it was when it was measured."""
        (width, height), (across, down) = self.image_px, photo_px
        return abs(across * height / (down * width) - 1) <= ASPECT_TOLERANCE

    def matrix_px(self, size_px: tuple[int, int]) -> np.ndarray:
        """Return the 3×3 pinhole matrix for the whole photograph at this size or, if square, its centered square."""
        width, height = self.image_px
        covered = (min(width, height),) * 2 if size_px[0] == size_px[1] else (width, height)
        sx, sy = size_px[0] / covered[0], size_px[1] / covered[1]
        cx, cy = self.cx - (width - covered[0]) / 2, self.cy - (height - covered[1]) / 2
        return np.array([[self.fx * sx, 0, cx * sx], [0, self.fy * sy, cy * sy], [0, 0, 1.0]])

    def distort_points(self, points_px: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
        """Return the points N×2 at which the lens shows pixels N×2 of the pinhole picture of this size."""
        matrix = self.matrix_px(size_px)
        return _from_unit(matrix, _distort(self, _to_unit(matrix, points_px)))

    def undistort_points(self, points_px: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
        """Return the pinhole picture's pixels N×2 that the lens shows at pixels N×2 of the photograph."""
        matrix = self.matrix_px(size_px)
        return _from_unit(matrix, _undistort(self, _to_unit(matrix, points_px)))

    def pinhole_frame(self, size_px: tuple[int, int]) -> Frame:
        """Return the frame that `distort_pictures` reads from; without distortion, the picture itself."""
        matrix = self.matrix_px(size_px)
        if not self.has_distortion:
            return Frame(size_px, matrix)
        x, y = (np.arange(side) + 0.5 for side in size_px)
        sides = (x, y[0]), (x, y[-1]), (x[0], y), (x[-1], y)
        edge_px = np.concatenate([np.stack(np.broadcast_arrays(*side), 1) for side in sides])
        edge = self.undistort_points(edge_px, size_px)
        # a bilinear sample between the centers of the outermost pixels reads no padding
        left, top = (max(0, math.ceil(0.5 - low)) for low in edge.min(0))
        right, bottom = (max(0, math.ceil(high + 0.5 - size)) for high, size in zip(edge.max(0), size_px, strict=True))
        matrix = matrix + np.array([[0, 0, left], [0, 0, top], [0, 0, 0]])
        return Frame((size_px[0] + left + right, size_px[1] + top + bottom), matrix, left, top, right, bottom)

    def distort_pictures(self, pictures: "Tensor", size_px: tuple[int, int]) -> "Tensor":
        """Bend pinhole pictures N×C×H×W of `pinhole_frame(...).size_px` as the lens does, to pictures of `size_px`.
        Differentiable. The input should be linear light, which is what passes through a lens.
        """
        import torch

        if not self.has_distortion:
            return pictures
        # pyright cannot know that frozen models have a hash
        grid = torch.as_tensor(_sampling_grid(self, size_px)).to(pictures)  # pyright: ignore[reportArgumentType]
        grid, sample = grid.expand(len(pictures), -1, -1, -1), torch.nn.functional.grid_sample
        return sample(pictures, grid, mode="bilinear", padding_mode="border", align_corners=False)


def load_camera(name_or_file: str | Path, base: Path | None = None, photo_px: tuple[int, int] | None = None) -> Camera:
    """Load a shipped camera by name, or a JSON file relative to `base`; refused if it cannot have taken `photo_px`."""
    path = named_path(name_or_file, base, "a camera", packaged_path("calibration", "cameras"), (".json",))
    camera = validate_model(Camera, read_json(path, "a camera file (JSON)", "calibrate again"), str(path))
    check_camera(camera, str(path))
    width, height = camera.image_px
    if photo_px is not None and not camera.fits(photo_px):
        expected = f"photographs with the aspect of {path} ({width} × {height} px)"
        remedy = "set camera.photo_px to that aspect or calibrate the camera as it is held"
        raise Refused(expected, f"photo_px = [{photo_px[0]}, {photo_px[1]}]", remedy)
    return camera


def check_camera(camera: Camera, where: str) -> None:
    """Refuse a principal point outside the picture, and distortion that cannot be undone: points that are undistorted
    and distorted again must return, so that no direction is seen twice.
    """
    width, height = camera.image_px
    if not (0 < camera.cx < width and 0 < camera.cy < height):
        expected = f"a principal point inside the picture of {width} × {height} px in {where}"
        raise Refused(expected, f"({camera.cx:g}, {camera.cy:g})", "give cx, cy and image_px in the same pixels")
    x, y = np.meshgrid(*(np.linspace(0.5, side - 0.5, 65) for side in camera.image_px))
    points = _to_unit(camera.matrix_px(camera.image_px), np.stack([x.ravel(), y.ravel()], 1))
    with np.errstate(over="ignore", invalid="ignore"):
        error_px = np.abs((_distort(camera, _undistort(camera, points)) - points) * [camera.fx, camera.fy]).max()
    if not error_px < _MAX_ERROR_PX:  # true also for NaN
        got = f"k1 k2 k3 = {camera.k1:g} {camera.k2:g} {camera.k3:g}, p1 p2 = {camera.p1:g} {camera.p2:g}"
        remedy = "calibrate again with the board in the picture's corners, or with fewer terms"
        raise Refused(f"distortion that can be undone in the whole picture in {where}", got, remedy)


@lru_cache(maxsize=4)
def _sampling_grid(camera: Camera, size_px: tuple[int, int]) -> np.ndarray:
    """Return 1×H×W×2 source coordinates in the pinhole picture, whose borders are at ±1."""
    width, height = size_px
    frame = camera.pinhole_frame(size_px)
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    source = camera.undistort_points(np.stack([x.ravel(), y.ravel()], 1), size_px) + np.array([frame.left, frame.top])
    return (2 * source / frame.size_px - 1).reshape(1, height, width, 2)


def _distort(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Distort points N×2 of the plane at distance 1 from the lens."""
    x, y = points.T
    r2 = x * x + y * y
    radial = 1 + r2 * (camera.k1 + r2 * (camera.k2 + r2 * camera.k3))
    distorted_x = x * radial + 2 * camera.p1 * x * y + camera.p2 * (r2 + 2 * x * x)
    distorted_y = y * radial + camera.p1 * (r2 + 2 * y * y) + 2 * camera.p2 * x * y
    return np.stack([distorted_x, distorted_y], 1)


def _undistort(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Invert `_distort` by fixed-point iteration, which converges where neighbors move less than their distance."""
    straight = points
    for _ in range(_ITERATIONS):
        change = points - _distort(camera, straight)
        straight = straight + change
        if np.abs(change).max(initial=0) < 1e-12:
            break
    return straight


def _to_unit(matrix: np.ndarray, points_px) -> np.ndarray:
    return (np.asarray(points_px, float) - matrix[:2, 2]) / [matrix[0, 0], matrix[1, 1]]


def _from_unit(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points * [matrix[0, 0], matrix[1, 1]] + matrix[:2, 2]
