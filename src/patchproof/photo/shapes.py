"""Shapes of a sheet that explain marker corners which no plane does: paper round a cylinder, a plane behind a lens.

In: corners in pixels and page millimeters, their homography. Out: `Shape`: where any page point lies in the picture,
how sure that is, where the camera stood, what is left unexplained. Left out on purpose: cones, folds and dents.

Source of the cylinder: paper bends without stretching, so a sheet with straight rulings that are parallel is one
(do Carmo, Differential Geometry of Curves and Surfaces, 5-8).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from patchproof.base.geometry import apply_homography, plane_pose
from patchproof.photo.rectify import CORNER_NOISE_PX, covariance_of, noise_and_bend

UNKNOWN_FOCAL = 0.5  # of its logarithm, where no file names one
_TYPICAL_FOCAL = 0.7  # of the picture's diagonal, between a phone's 26 mm (0.6) and 35 mm (0.8)
_FIRST_BEND = (0.02, 0.6)  # radians over half the sheet, least and most, from which fits start
_ANY_BEND = [(bend, direction) for direction in np.radians([0, 45, 90, 135]) for bend in (-0.3, 0.3)]
_STEP = np.finfo(float).eps ** 0.5  # of a parameter, as MINPACK takes it
_LOST_PX = 1.0  # rms of a fit that ended in the wrong place, as 2 of 378 did, all of strong bends, before _ANY_BEND

Project = Callable[[np.ndarray, np.ndarray], np.ndarray]
Tangent = Callable[[np.ndarray, np.ndarray, float], np.ndarray]


@dataclass(frozen=True)
class Shape:
    """A fitted model: `project(parameters, mm)`, the parameters with their covariance, what it leaves.

    `radius_mm` of the paper is positive where it bulges towards the camera, None where a lens explains the picture.
    `tangent(parameters, point_mm, turned_rad)` is `camera_from_tangent` 4×4 of the paper's tangent plane there, turned
    about the rulings; None for a lens, whose first eight parameters times `unit` are a homography. `hidden_turn_rad` is
    by how much the paper turns from its middle to the nearest marker. `bend_px` is what is left and is no noise.
    """

    project: Project
    parameters: np.ndarray
    covariance: np.ndarray
    rms_px: float
    radius_mm: float | None
    bend_px: float
    tangent: Tangent | None = None
    unit: np.ndarray | None = None
    hidden_turn_rad: float = 0.0

    def px(self, mm: np.ndarray) -> np.ndarray:
        """Pixels N×2 of page points N×2."""
        return self.project(self.parameters, np.asarray(mm, float))


def fit_cylinder(flat, mm, px, size, focal_px, focal_spread=UNKNOWN_FOCAL, floor_px=CORNER_NOISE_PX) -> Shape | None:
    """Paper round a cylinder, the best of the fits from `_starts`."""
    center, reach = mm.mean(0), np.ptp(mm, axis=0).max() / 2
    middle = np.array(size) / 2
    focal = focal_px or _TYPICAL_FOCAL * np.hypot(*size)

    def project(p, points):
        # p: rotation vector, the page center in the camera (mm), log of focal / guess, bend, direction of the bend; of
        # several, one to a row
        turned = np.swapaxes(Rotation.from_rotvec(p[..., :3]).as_matrix(), -1, -2)
        camera = in_space(p, points)[0] @ turned + p[..., None, 3:6]
        return focal * np.exp(p[..., 6, None, None]) * camera[..., :2] / np.maximum(camera[..., 2:], 1e-3) + middle

    def in_space(p, points):
        c, s = np.cos(p[..., 8:]), np.sin(p[..., 8:])
        right, down = (points - center).T
        x, y = c * right + s * down, c * down - s * right  # along the bend, along the rulings
        turn = p[..., 7:8] * x / reach
        across = x * np.sinc(turn / np.pi)
        depth = x * np.sinc(turn / 2 / np.pi) * np.sin(turn / 2)  # (1 - cos t) / t, without its hole at 0
        return np.stack([c * across - s * y, s * across + c * y, depth], -1), turn

    def tangent(p, point, turned_rad):
        (place,), (turn,) = in_space(p, np.asarray(point, float)[None])
        c, s = np.cos(p[8]), np.sin(p[8])
        slope, rulings = turn + turned_rad, np.array([-s, c, 0.0])
        along = np.array([c * np.cos(slope), s * np.cos(slope), np.sin(slope)])
        x, y = c * along - s * rulings, s * along + c * rulings
        turned, pose = Rotation.from_rotvec(p[:3]).as_matrix(), np.eye(4)
        pose[:3, :3] = turned @ np.column_stack([x, y, np.cross(x, y)])
        pose[:3, 3] = turned @ place + p[3:6]
        return pose

    matrix = np.array([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1.0]])
    pose = plane_pose(flat @ np.array([[1, 0, center[0]], [0, 1, center[1]], [0, 0, 1.0]]), matrix)
    begin = [*Rotation.from_matrix(pose[:3, :3]).as_rotvec(), *pose[:3, 3], 0.0]
    prior = CORNER_NOISE_PX / (UNKNOWN_FOCAL if focal_px is None else focal_spread)

    def rows(p):
        off = (project(p, mm) - px).reshape(*p.shape[:-1], -1)
        return np.concatenate([off, prior * p[..., 6:7]], -1)

    def slopes(p):
        steps = _STEP * np.where(p == 0, 1, np.abs(p))
        left = rows(np.vstack([p, p + np.diag(steps)]))  # together: so few points cost no more than one
        return ((left[1:] - left[0]) / steps[:, None]).T

    fits = []
    for starts in (_starts(flat, mm, px, matrix @ pose[:3], center, reach), _ANY_BEND):
        for bend, direction in starts:
            start = np.array([*begin, bend, direction])
            # how far each parameter may be off, about
            scales = np.array([0.1, 0.1, 0.1, *[0.05 * max(abs(start[5]), 1.0)] * 3, 0.2, 0.2, 0.5])
            fit = least_squares(rows, start, slopes, x_scale=scales, max_nfev=40, method="lm")  # pyright: ignore[reportArgumentType]
            fits.append(fit)
        best = min(fits, key=lambda fit: fit.cost)
        if rms(best.fun) < _LOST_PX:
            break
    bend = best.x[7]
    if abs(bend) < 1e-6 or abs(bend) > np.pi / 2:
        return None
    turns = in_space(best.x, mm)[1].reshape(-1, 4)
    hidden = np.maximum(turns.min(1), -turns.max(1)).min()  # of markers to either side of the middle, 0 of one over it
    shape = _shape(project, best, mm, px, reach / bend, floor_px)
    return replace(shape, tangent=tangent, hidden_turn_rad=max(0.0, float(hidden)))


def _starts(flat, mm, px, camera, center, reach) -> list[tuple[float, float]]:
    """Bends, in radians over half the sheet, and their directions, from which to fit.

    A little bent, paper lies off its plane by a quadratic form of where one is on it, which moves pixels in proportion:
    form and homography come from one linear fit. Of a cylinder's form one eigenvalue is 0; what noise makes of that is
    tried too, and so is the first one's other sign, which a distant camera hardly tells apart.
    """
    at = mm - center
    base = np.column_stack([at, np.zeros(len(at))])
    images = ((base + np.array([0, 0, off])) @ camera[:, :3].T + camera[:, 3] for off in (0.01 * reach, -0.01 * reach))
    farther, nearer = (image[:, :2] / image[:, 2:] for image in images)
    by_depth = (farther - nearer) / (0.02 * reach)
    x, y = at.T / reach
    form = [by_depth * (term * reach)[:, None] for term in (x * x, x * y, y * y)]
    plain = apply_homography(flat, mm)
    left = px - plain
    u, v = ((plain - plain.mean(0)) / np.ptp(plain, axis=0).max()).T
    ones, no = np.ones_like(u), np.zeros_like(u)
    plane = [ones, u, v, no, no, no, u * u, u * v], [no, no, no, ones, u, v, u * v, v * v]  # near homographies
    columns = [np.column_stack([np.array(plane[i]).T, *[f[:, i] for f in form]]) for i in (0, 1)]
    xx, xy, yy = np.linalg.lstsq(np.concatenate(columns), left.T.ravel(), rcond=1e-6)[0][8:]
    values, vectors = np.linalg.eigh([[xx, xy / 2], [xy / 2, yy]])
    order = np.argsort(-np.abs(values))
    starts = []
    for i, sign in ((order[0], 1), (order[0], -1), (order[1], 1)):
        bend = sign * np.copysign(np.clip(abs(2 * values[i]), *_FIRST_BEND), values[i])
        starts.append((float(bend), float(np.arctan2(vectors[1, i], vectors[0, i]))))
    return starts


def fit_radial_lens(flat, mm, px, size) -> Shape:
    """A plane seen through a lens that bends about the picture's middle by one radial term."""
    middle, half = np.array(size) / 2, np.hypot(*size) / 2

    def project(p, points):
        straight = apply_homography(np.append(p[:8] * unit, 1).reshape(3, 3), points) - middle
        return straight * (1 + p[8] * (straight**2).sum(1, keepdims=True) / half**2) + middle

    unit = np.maximum(np.abs(flat.ravel()[:8]), 1e-9)
    start = np.append(flat.ravel()[:8] / unit, 0.0)
    rows = lambda p: (project(p, mm) - px).ravel()  # noqa: E731
    fit = least_squares(rows, start, max_nfev=40, method="lm")
    return replace(_shape(project, fit, mm, px, None, CORNER_NOISE_PX), unit=unit)


def _shape(project: Project, fit, mm, px, radius_mm, floor_px) -> Shape:
    left = project(fit.x, mm) - px
    noise, bend = noise_and_bend(left, left.reshape(-1, 4, 2), left.size - len(fit.x), floor_px)
    return Shape(project, fit.x, covariance_of(fit.jac, noise, 1e-9), rms(left), radius_mm, bend)


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))
