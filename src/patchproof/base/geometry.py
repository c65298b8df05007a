"""Poses, pinhole cameras and homographies, in float64 numpy.

Frames. World: millimeters, right-handed, y up, origin at the center of the object's bounding box. Camera: x right, y
down, z forward. Page and piece: millimeters, x right, y down. Image: pixels, pixel centers at .5. `camera_from_world`
is 4×4, and `camera_from_world @ [X, 1]` is the point in camera coordinates; such names read from right to left. Left
out on purpose: lens distortion, which is applied only where a camera file has it.

Source of homographies and of the normalized DLT: Hartley and Zisserman, Multiple View Geometry, 2nd ed., 4.1 and 8.1.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import ArrayLike

if TYPE_CHECKING:
    from torch import Tensor

UP = (0.0, 1.0, 0.0)
MM_PER_INCH = 25.4

Numbers = TypeVar("Numbers", "np.ndarray", "Tensor")


@dataclass(frozen=True)
class Frame:
    """A pinhole picture to render before the lens bends it, and how many pixels it extends beyond each side."""

    size_px: tuple[int, int]
    matrix_px: np.ndarray
    left: int = 0
    top: int = 0
    right: int = 0
    bottom: int = 0


def cross(a: Sequence[Numbers], b: Sequence[Numbers]) -> list[Numbers]:
    """Cross products of N vectors, given and returned by coordinate; `np.cross` takes four times as long."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def dot(a: Sequence[Numbers], b: Sequence[Numbers]) -> Numbers:
    """Inner products of N vectors, given by coordinate."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def orbit(azimuth_deg: ArrayLike, elevation_deg: ArrayLike, forward: ArrayLike, up: ArrayLike = UP) -> np.ndarray:
    """Unit direction (3,) or N×3 to a camera; azimuth is positive to the right of a viewer who faces the side."""
    forward, up = _unit(forward), _unit(up)
    right = np.cross(up, forward)  # the viewer who faces the side has this on the right hand
    azimuth, elevation = np.radians(azimuth_deg)[..., None], np.radians(elevation_deg)[..., None]
    return np.cos(elevation) * (np.cos(azimuth) * forward + np.sin(azimuth) * right) + np.sin(elevation) * up


def look_at(eye_mm: ArrayLike, target_mm: ArrayLike, roll_deg: ArrayLike = 0.0, up: ArrayLike = UP) -> np.ndarray:
    """`camera_from_world` (N×)4×4 of a camera at `eye_mm` that looks at `target_mm`, turned clockwise by `roll_deg`."""
    eye, target, roll = np.asarray(eye_mm, float), np.asarray(target_mm, float), np.radians(roll_deg)[..., None]
    z = _unit(target - eye)
    side = np.cross(z, _unit(up))
    # looking straight up or down any right direction will do: take world x
    side = np.where(np.linalg.norm(side, axis=-1, keepdims=True) < 1e-9, np.cross(z, [0.0, 0.0, 1.0]), side)
    x = _unit(side)
    y = np.cross(z, x)  # down
    rotation = np.stack([np.cos(roll) * x - np.sin(roll) * y, np.sin(roll) * x + np.cos(roll) * y, z], -2)
    pose = np.zeros((*eye.shape[:-1], 4, 4))
    pose[..., :3, :3], pose[..., :3, 3:], pose[..., 3, 3] = rotation, -rotation @ eye[..., None], 1
    return pose


def intrinsics(fov_deg: float, size_px: tuple[int, int]) -> np.ndarray:
    """Pinhole matrix 3×3 of a picture of (width, height) pixels whose *shorter* side spans `fov_deg`."""
    width, height = size_px
    focal_px = min(width, height) / 2 / np.tan(np.radians(fov_deg) / 2)
    return np.array([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1.0]])


def project(matrix_px, camera_from_world, points_mm) -> np.ndarray:
    """Project world points N×3 to pixels ...×N×2 of cameras ...×4×4; points behind a camera give NaN."""
    camera = transform_points(camera_from_world, points_mm)
    camera = np.where(camera[..., 2:] > 0, camera, np.nan)
    image = camera @ np.asarray(matrix_px).T
    return image[..., :2] / image[..., 2:]


def transform_points(matrix, points_mm) -> np.ndarray:
    """Transform points N×3 by rigid or affine matrices ...×4×4."""
    return np.asarray(points_mm, float) @ matrix[..., :3, :3].swapaxes(-1, -2) + matrix[..., None, :3, 3]


def camera_centers(poses) -> np.ndarray:
    """World positions N×3 of cameras with `camera_from_world` N×4×4."""
    return -(poses[:, :3, :3].transpose(0, 2, 1) @ poses[:, :3, 3:])[..., 0]


def plane_homography(matrix_px, camera_from_world, world_from_plane) -> np.ndarray:
    """(N×)3×3 homography from plane millimeters to pixels; `world_from_plane` 4×4 has the plane's axes and origin."""
    return normalize_homography(matrix_px @ (camera_from_world @ world_from_plane)[..., :3, [0, 1, 3]])


def scaling_about(middle, scale) -> np.ndarray:
    """Matrices ...×(D+1)×(D+1) that scale by `scale` (...) about `middle` (D values)."""
    middle, scale = np.asarray(middle, float), np.asarray(scale, float)[..., None]
    matrix = np.tile(np.eye(len(middle) + 1), (*scale.shape[:-1], 1, 1))
    matrix[..., :-1, :-1] *= scale[..., None]
    matrix[..., :-1, -1] = (1 - scale) * middle
    return matrix


def normalize_homography(homography) -> np.ndarray:
    """Divide a homography, or each of N×3×3, by its last entry, or by its norm where that entry vanishes."""
    homography = np.asarray(homography, float)
    last, largest = homography[..., 2, 2], np.abs(homography).max((-2, -1))
    scale = np.where(np.abs(last) > 1e-12 * largest, last, np.linalg.norm(homography, axis=(-2, -1)))
    return homography / scale[..., None, None]


def apply_homography(homography, points) -> np.ndarray:
    """Map points N×2 by a homography."""
    points = np.asarray(points, float)
    mapped = points @ homography[:, :2].T + homography[:, 2]
    return mapped[:, :2] / mapped[:, 2:]


def fit_homography(source, target) -> np.ndarray:
    """Fit a homography source → target to N ≥ 4 point pairs by least squares (normalized DLT), without outliers."""
    source, target = np.asarray(source, float), np.asarray(target, float)
    to_a, to_b = _conditioner(source), _conditioner(target)
    a, b = apply_homography(to_a, source), apply_homography(to_b, target)
    ones, zeros = np.ones((len(a), 1)), np.zeros((len(a), 3))
    a1 = np.hstack([a, ones])
    rows = np.vstack([np.hstack([a1, zeros, -b[:, :1] * a1]), np.hstack([zeros, a1, -b[:, 1:] * a1])])
    return normalize_homography(np.linalg.inv(to_b) @ np.linalg.svd(rows)[2][-1].reshape(3, 3) @ to_a)


def corner_turns(quad) -> np.ndarray:
    """Twice the area of the triangle at each corner of a polygon N×2, positive where it turns clockwise (y down)."""
    sides = np.roll(quad, -1, axis=0) - quad
    following = np.roll(sides, -1, axis=0)
    return sides[:, 0] * following[:, 1] - sides[:, 1] * following[:, 0]


def local_scale(homography, point) -> np.ndarray:
    """(px_per_mm, tilt_deg), ...×2, of page→image homographies ...×3×3 at a page point, by its derivative's singular
    values: their geometric mean, and arccos of their ratio, which is the tilt exactly for a distant camera.
    """
    homography = np.asarray(homography)
    image = homography @ np.array([*point, 1.0])
    pixel, w = image[..., :2] / image[..., 2:], image[..., 2, None, None]
    jacobian = (homography[..., :2, :2] - pixel[..., None] * homography[..., None, 2, :2]) / w
    large, small = np.moveaxis(np.linalg.svd(jacobian, compute_uv=False), -1, 0)
    return np.stack([np.sqrt(large * small), np.degrees(np.arccos(np.clip(small / large, 0, 1)))], -1)


def plane_pose(homography, matrix_px) -> np.ndarray:
    """`camera_from_plane` 4×4 from a page→image homography and a pinhole matrix, with the page in front."""
    columns = np.linalg.inv(matrix_px) @ homography
    columns /= np.linalg.norm(columns[:, :2], axis=0).mean()
    if columns[2, 2] < 0:
        columns = -columns
    u, _, vt = np.linalg.svd(columns[:, :2], full_matrices=False)
    xy = u @ vt  # the nearest pair of orthonormal axes
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.column_stack([xy, np.cross(xy[:, 0], xy[:, 1])]), columns[:, 2]
    return pose


def view_angles(camera_from_plane, point) -> tuple[float, float, float]:
    """(azimuth_deg, elevation_deg, distance_mm) of the camera from a page point; positive right of and above it."""
    x, y, z = -camera_from_plane[:3, :3].T @ camera_from_plane[:3, 3] - np.array([point[0], point[1], 0.0])
    distance = float(np.sqrt(x * x + y * y + z * z))
    # plane z points into the paper (x right, y down, right-handed)
    return float(np.degrees(np.arctan2(x, -z))), float(np.degrees(np.arcsin(-y / distance))), distance


def rect_corners(rect) -> np.ndarray:
    """The 4×2 corners of [x, y, width, height]: top-left, top-right, bottom-right, bottom-left."""
    x, y, w, h = rect
    return np.array([[x, y], [x + w, y], [x + w, y + h], [x, y + h]], float)


def is_inside(points: np.ndarray, rect) -> np.ndarray:
    """True for points N×2 in [x, y, width, height]."""
    low, high = rect_corners(rect)[[0, 2]]
    return ((points >= low) & (points <= high)).all(1)


def rotated_extent(size, degrees: float) -> np.ndarray:
    """Width and height of the bounding box of a rectangle that is rotated by `degrees`."""
    c, s = abs(np.cos(np.radians(degrees))), abs(np.sin(np.radians(degrees)))
    return np.array([c * size[0] + s * size[1], s * size[0] + c * size[1]])


def rect_border(rect, steps: int) -> np.ndarray:
    """Points N×2 along the border of [x, y, width, height] from its top-left corner, `steps` on each side."""
    corners, shares = rect_corners(rect), np.linspace(0, 1, steps, endpoint=False)[:, None]
    return np.concatenate([a + shares * (b - a) for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)])


def _conditioner(points) -> np.ndarray:
    """Similarity that centers points and brings them to mean distance √2 (Hartley's conditioning)."""
    center = points.mean(0)
    spread = np.sqrt(2) / max(np.linalg.norm(points - center, axis=1).mean(), 1e-300)
    return np.array([[spread, 0, -spread * center[0]], [0, spread, -spread * center[1]], [0, 0, 1.0]])


def _unit(vector) -> np.ndarray:
    vector = np.asarray(vector, float)
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)
