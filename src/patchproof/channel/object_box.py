"""Where an object lies in a picture: the box around it, which a detector's boxes are compared with.

In: the object's outermost points, a camera. Out: (left, top, right, bottom) in pixels, clipped to the picture. The
whole object counts, with what a piece or another of its parts hides, so that the box does not depend on what is shown.
Left out on purpose: what stands in front of the object.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from patchproof.base.geometry import project

if TYPE_CHECKING:
    from patchproof.channel.lens import Camera

MOST_POINTS = 500  # of a ball: their box lacks 0.3 % of its size


def hull_points(vertices_mm: np.ndarray) -> np.ndarray:
    """The vertices P×3 of a mesh's convex hull, which alone make its box in any view; of more than `MOST_POINTS` those
    that lie farthest out in as many directions, spread evenly.
    """
    from scipy.spatial import ConvexHull, QhullError

    points = np.unique(vertices_mm, axis=0)
    try:
        points = points[ConvexHull(points).vertices]
    except QhullError:  # a flat mesh is its own hull
        pass
    if len(points) <= MOST_POINTS:
        return points
    turn, height = np.arange(MOST_POINTS) * np.pi * (3 - 5**0.5), np.linspace(-1, 1, MOST_POINTS)
    directions = np.stack([np.cos(turn), np.sin(turn), height], 1)
    directions[:, :2] *= np.sqrt(1 - height**2)[:, None]
    return points[np.unique((points @ directions.T).argmax(0))]


def project_box(
    points_mm: np.ndarray,
    camera_from_world: np.ndarray,
    matrix_px: np.ndarray,
    size_px: tuple[int, int],
    camera: Camera | None = None,
) -> np.ndarray:
    """The box (4,) of world points P×3 in a picture of `size_px`, through a calibrated lens where there is one. Points
    behind the camera do not count; all zeros where nothing is seen.
    """
    points_px = project(matrix_px, camera_from_world, points_mm)
    points_px = points_px[np.isfinite(points_px[:, 0])]
    if camera is not None and camera.bends:
        middle = np.array(size_px) / 2  # far outside the picture a lens's polynomial means nothing
        points_px = camera.distort_points(np.clip(points_px, -middle, 3 * middle), size_px)
    if not len(points_px):
        return np.zeros(4)
    low, high = points_px.min(0), points_px.max(0)
    box = np.concatenate([np.clip(low, 0, size_px), np.clip(high, 0, size_px)])
    return box if (box[2:] > box[:2]).all() else np.zeros(4)
