"""The box around the object in a picture, with which a detector's boxes are compared.

In: the object's outermost points and a camera. Out: (left, top, right, bottom) in pixels, clipped to the picture. The
whole object counts, including hidden parts: the box does not depend on the design. Left out on purpose: things that
stand in front of the object.
"""

from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from patchproof.base.geometry import project

if TYPE_CHECKING:
    from patchproof.channel.lens import Camera

MOST_POINTS = 500  # the box around this many points of a ball is 0.3 % too small


def hull_points(vertices_mm: np.ndarray) -> np.ndarray:
    """Return the vertices P×3 of a mesh's convex hull, which suffice for its box in any view. Of more than
    `MOST_POINTS`, return those farthest out in that many evenly spread directions.
    """
    from scipy.spatial import ConvexHull, QhullError

    points = np.unique(vertices_mm, axis=0)
    with suppress(QhullError):  # a flat mesh is its own hull
        points = points[ConvexHull(points).vertices]
    if len(points) <= MOST_POINTS:
        return points
    azimuth, height = np.arange(MOST_POINTS) * np.pi * (3 - 5**0.5), np.linspace(-1, 1, MOST_POINTS)
    directions = np.stack([np.cos(azimuth), np.sin(azimuth), height], 1)
    directions[:, :2] *= np.sqrt(1 - height**2)[:, None]
    return points[np.unique((points @ directions.T).argmax(0))]


def project_box(
    points_mm: np.ndarray,
    camera_from_world: np.ndarray,
    matrix_px: np.ndarray,
    size_px: tuple[int, int],
    camera: "Camera | None" = None,
) -> np.ndarray:
    """Return the box (4,) around world points P×3 in a picture of `size_px`, through a calibrated lens if given. Points
    behind the camera do not count; all zeros if no point is in the picture.
    """
    points_px = project(matrix_px, camera_from_world, points_mm)
    points_px = points_px[np.isfinite(points_px[:, 0])]
    if camera is not None and camera.has_distortion:
        half_size = np.array(size_px) / 2  # far outside the picture a lens's polynomial means nothing
        points_px = camera.distort_points(np.clip(points_px, -half_size, 3 * half_size), size_px)
    if not len(points_px):
        return np.zeros(4)
    box = np.concatenate([np.clip(points_px.min(0), 0, size_px), np.clip(points_px.max(0), 0, size_px)])
    return box if (box[2:] > box[:2]).all() else np.zeros(4)
