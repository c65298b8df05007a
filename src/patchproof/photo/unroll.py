"""Sheets that are no plane in the photograph: curled paper is unrolled, a lens's bending taken out, where that pays.

In: marker corners in pixels and page millimeters, and the flat fit's word that they do not agree. Out: `Unrolled`: a
picture in which the sheet is flat, with its homography, so that whatever measures flat sheets measures this one. Two
explanations are tried against the plane: paper rolled round a cylinder of any radius and direction, seen by a pinhole
camera (nine parameters, the focal length held near the file's own where there is one), and a plane seen through a lens
with one radial term. One is believed where it leaves less than half of the plane's residual. Left out on purpose:
cones, folds and dents; those stay unexplained and are refused as `curled` where they matter.

Source of the shape: paper bends without stretching, so a sheet with straight rulings that are parallel is a cylinder
(do Carmo, Differential Geometry of Curves and Surfaces, 5-8).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from patchproof.geometry import apply_homography, fit_homography, plane_pose, rect_corners
from patchproof.photo.edges import GRID, REACH, border_frame, meet
from patchproof.photo.rectify import (
    CORNER_NOISE_PX,
    PageFit,
    common_corners,
    covariance_of,
    largest_shift_mm,
    part_around,
    rms_length_mm,
    root_of,
)

FLAT_PX = 0.15  # rms per coordinate up to which a plane needs no better explanation: three times the corners' own noise
PAYS = 0.5  # of the plane's residual
LEAST_MARKERS = 4
_TYPICAL_FOCAL = 0.7  # of the picture's diagonal, between a phone's 26 mm (0.6) and 35 mm (0.8)
_FOCAL_SPREAD = {True: 0.1, False: 0.5}  # of its logarithm: by whether the file names a focal length
_FIRST_BEND = (0.02, 0.6)  # radians over half the sheet, least and most, from which fits start
_ANY_BEND = [(bend, direction) for direction in np.radians([0, 45, 90, 135]) for bend in (-0.3, 0.3)]
_LOST_PX = 1.0  # rms of a fit that ended in the wrong place, as 2 of 378 did, all of strong bends, before _ANY_BEND

Project = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Unrolled:
    """`srgb` shows the sheet flat, `fit` is its homography there; `radius_mm` of the paper, positive where it bulges
    towards the camera, None where a lens explains the picture.
    """

    srgb: np.ndarray
    fit: PageFit
    uncertainty_mm: float
    radius_mm: float | None


@dataclass(frozen=True)
class Shape:
    """A fitted model: `project(parameters, mm)`, the parameters with their covariance, what it leaves."""

    project: Project
    parameters: np.ndarray
    covariance: np.ndarray
    rms_px: float
    radius_mm: float | None

    def px(self, mm: np.ndarray) -> np.ndarray:
        """Pixels N×2 of page points N×2."""
        return self.project(self.parameters, np.asarray(mm, float))


@dataclass(frozen=True)
class Explained:
    """What a better explanation than a plane was found from, corners mended, and the explanation."""

    flat: np.ndarray  # 3×3 homography of the corners as they were
    mm: np.ndarray
    px: np.ndarray
    shape: Shape


def explain(
    corners_px: Mapping[int, np.ndarray],
    corners_mm: Mapping[int, np.ndarray],
    size_px: tuple[int, int],
    focal_px: float | None = None,
) -> Explained | None:
    """A cylinder or a lens that explains the corners in a picture of this size; None where a plane does as well."""
    ids, px, mm = common_corners(corners_px, corners_mm)
    if len(ids) < LEAST_MARKERS:
        return None
    flat = fit_homography(mm, px)
    plain = _rms(apply_homography(flat, mm) - px)
    if not plain > FLAT_PX:
        return None
    best = _best(flat, mm, px, size_px, focal_px)
    if best.rms_px > PAYS * plain:
        return None
    # the borders were fitted as straight lines, which on strongly bent paper misses the corners where they meet
    px = px - _chord_shift(best, mm)
    return Explained(flat, mm, px, _best(flat, mm, px, size_px, focal_px))


def unroll(
    srgb: np.ndarray,
    corners_px: Mapping[int, np.ndarray],
    corners_mm: Mapping[int, np.ndarray],
    sheet_mm,
    rect_mm,
    focal_px: float | None = None,
) -> Unrolled | None:
    """The sheet (a rectangle x, y, width, height on the page) made flat; None where a plane explains it as well.

    The uncertainty is that of the corners of `rect_mm`.
    """
    explained = explain(corners_px, corners_mm, (srgb.shape[1], srgb.shape[0]), focal_px)
    if explained is None:
        return None
    flat, mm, px, best = explained.flat, explained.mm, explained.px, explained.shape
    grid = sheet_mm[:2] + np.multiply(sheet_mm[2:], GRID)
    straight = fit_homography(grid, best.px(grid))
    error = np.linalg.norm(apply_homography(flat, mm) - px, axis=1).max()  # what is moved lies this near, about
    picture = _straightened(srgb, best.px, straight, sheet_mm, margin_px=error)
    # the covariance of the homography alone says nothing about the bend: `uncertainty_mm` has it all
    ids = common_corners(corners_px, corners_mm)[0]
    fit = PageFit(straight, np.zeros((8, 8)), rms_length_mm(_mm_from_px(best.px, mm), best.px(mm) - px), ids)
    return Unrolled(picture, fit, _uncertainty_mm(best, rect_corners(rect_mm)), best.radius_mm)


def _best(flat, mm, px, size, focal_px) -> Shape:
    """The explanation that leaves least."""
    paper, lens = rolled(flat, mm, px, size, focal_px), through_lens(flat, mm, px, size)
    return lens if paper is None or lens.rms_px < paper.rms_px else paper


def _chord_shift(shape: Shape, mm: np.ndarray) -> np.ndarray:
    """How far corners where straight lines along a marker's bent borders meet lie from the marker's own, N×2 px."""
    quads = mm.reshape(-1, 4, 2)
    corners = shape.px(mm).reshape(-1, 4, 2)
    s = np.linspace(-REACH, REACH, 9)
    along = (1 + s[:, None]) / 2
    points = quads[:, :, None] * (1 - along) + np.roll(quads, -1, axis=1)[:, :, None] * along
    bent = shape.px(points.reshape(-1, 2)).reshape(*quads.shape[:2], len(s), 2)
    middle, half, normal = border_frame(corners)
    off = np.einsum("mksi,mki->mks", bent - middle[:, :, None], normal)
    offset, slope = off.mean(2), (off * s).sum(2) / (s * s).sum()
    ends = [middle + sign * half + (offset + sign * slope)[..., None] * normal for sign in (-1, 1)]
    return (meet(*ends) - corners).reshape(-1, 2)


def rolled(flat, mm, px, size, focal_px) -> Shape | None:
    """Paper round a cylinder, the best of the fits from `_starts`."""
    center, reach = mm.mean(0), np.ptp(mm, axis=0).max() / 2
    middle = np.array(size) / 2
    focal = focal_px or _TYPICAL_FOCAL * np.hypot(*size)

    def project(p, points):
        # p: rotation vector, the page center in the camera (mm), log of focal / guess, bend, direction of the bend
        c, s = np.cos(p[8]), np.sin(p[8])
        x, y = ((points - center) @ [[c, -s], [s, c]]).T  # along the bend, along the rulings
        turn = p[7] * x / reach
        across = x * np.sinc(turn / np.pi)
        depth = x * np.sinc(turn / 2 / np.pi) * np.sin(turn / 2)  # (1 - cos t) / t, without its hole at 0
        world = np.column_stack([c * across - s * y, s * across + c * y, depth])
        camera = Rotation.from_rotvec(p[:3]).apply(world) + p[3:6]
        return focal * np.exp(p[6]) * camera[:, :2] / np.maximum(camera[:, 2:], 1e-3) + middle

    matrix = np.array([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1.0]])
    pose = plane_pose(flat @ np.array([[1, 0, center[0]], [0, 1, center[1]], [0, 0, 1.0]]), matrix)
    begin = [*Rotation.from_matrix(pose[:3, :3]).as_rotvec(), *pose[:3, 3], 0.0]
    prior = CORNER_NOISE_PX / _FOCAL_SPREAD[focal_px is not None]
    rows = lambda p: np.append((project(p, mm) - px).ravel(), prior * p[6])  # noqa: E731
    fits = []
    for starts in (_starts(flat, mm, px, matrix @ pose[:3], center, reach), _ANY_BEND):
        for bend, direction in starts:
            start = np.array([*begin, bend, direction])
            # how far each parameter may be off, about
            scales = np.array([0.1, 0.1, 0.1, *[0.05 * max(abs(start[5]), 1.0)] * 3, 0.2, 0.2, 0.5])
            fits.append(least_squares(rows, start, x_scale=scales, max_nfev=40, method="lm"))
        best = min(fits, key=lambda fit: fit.cost)
        if _rms(best.fun) < _LOST_PX:
            break
    bend = best.x[7]
    if abs(bend) < 1e-6 or abs(bend) > np.pi / 2:
        return None
    return _shape(project, best, mm, px, reach / bend)


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


def through_lens(flat, mm, px, size) -> Shape:
    """A plane seen through a lens that bends about the picture's middle by one radial term."""
    middle, half = np.array(size) / 2, np.hypot(*size) / 2

    def project(p, points):
        straight = apply_homography(np.append(p[:8] * unit, 1).reshape(3, 3), points) - middle
        return straight * (1 + p[8] * (straight**2).sum(1, keepdims=True) / half**2) + middle

    unit = np.maximum(np.abs(flat.ravel()[:8]), 1e-9)
    start = np.append(flat.ravel()[:8] / unit, 0.0)
    rows = lambda p: (project(p, mm) - px).ravel()  # noqa: E731
    return _shape(project, least_squares(rows, start, max_nfev=40, method="lm"), mm, px, None)


def _shape(project: Project, fit, mm, px, radius_mm) -> Shape:
    left = project(fit.x, mm) - px
    noise = max(CORNER_NOISE_PX, float(np.sqrt((left**2).sum() / (left.size - len(fit.x)))))
    return Shape(project, fit.x, covariance_of(fit.jac, noise, 1e-9), _rms(left), radius_mm)


def _uncertainty_mm(shape: Shape, corners: np.ndarray) -> float:
    """Of the first-order spread."""
    here, rows = shape.px(corners), []
    spread = np.sqrt(np.maximum(np.diag(shape.covariance), 1e-30))
    for i, sigma in enumerate(spread):
        step = np.zeros(len(spread))
        step[i] = 0.1 * sigma
        rows.append((shape.project(shape.parameters + step, corners) - here).ravel() / (0.1 * sigma))
    root = spread[:, None] * root_of(shape.covariance / np.outer(spread, spread))
    return largest_shift_mm(root, np.array(rows), _mm_from_px(shape.px, corners))


def _mm_from_px(project: Callable[[np.ndarray], np.ndarray], mm: np.ndarray) -> np.ndarray:
    """N×2×2 derivatives of page millimeters by pixels, by central differences over a tenth of a millimeter."""
    steps = 0.05 * np.eye(2)
    columns = [(project(mm + step) - project(mm - step)) / 0.1 for step in steps]
    return np.linalg.inv(np.stack(columns, -1))


def _straightened(srgb, project, px_from_mm, sheet_mm, margin_px: float) -> np.ndarray:
    """The photograph with the sheet's part resampled as if it were flat."""
    box = part_around(apply_homography(px_from_mm, rect_corners(sheet_mm)), margin_px, srgb.shape)
    y, x = np.mgrid[box] + 0.5
    mm = apply_homography(np.linalg.inv(px_from_mm), np.column_stack([x.ravel(), y.ravel()]))
    left, top, width, height = sheet_mm
    on_sheet = ((mm >= [left, top]) & (mm <= [left + width, top + height])).all(1)
    where = on_sheet.reshape(x.shape)
    source = np.full((*x.shape, 2), -1, np.float32)
    source[where] = project(mm[on_sheet]) - 0.5
    part = cv2.remap(srgb, source[..., 0], source[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    picture = srgb.copy()
    picture[box][where] = part[where]
    return picture


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
