"""Flatten curled paper or a lens's distortion in a photograph, if that explains the markers better than a plane.

In: marker corners in pixels and page millimeters that fit no plane. Out: `LocatedSheet`: a picture in which the sheet
is flat, with its homography, so that it can be measured like flat sheets. Two models are compared with the plane: paper
on a cylinder of any radius and direction, seen by a pinhole camera (nine parameters, the focal length held near the
file's within its uncertainty), and a plane seen through a lens with one radial term. A model is accepted if its
residual is less than half of the plane's; a photograph with too much residual beyond noise is still rejected as
`curled`. Left out on purpose: cones, folds and dents.

Source of the cylinder: do Carmo, Differential Geometry of Curves and Surfaces, 5-8 (a sheet that bends without
stretching, and whose straight rulings are parallel, is a cylinder).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from patchproof.base.geometry import apply_homography, fit_homography, is_inside, plane_pose, rect_corners
from patchproof.photo import rectify
from patchproof.photo.detect import row_strips
from patchproof.photo.edges import BORDER_SHARE, RECT_GRID, border_frame, intersect_borders
from patchproof.photo.rectify import CORNER_NOISE_PX, PageFit, Quads, covariance_of, homography_jacobian, noise_and_bend

MAX_FLAT_RMS_PX = 0.15  # per coordinate, up to which a sheet counts as flat: three times the corners' noise
MAX_RESIDUAL_SHARE = 0.5  # of the plane's residual, for a model to be accepted
LEAST_MARKERS = 4
_CORRECTION_ERROR = 0.3  # of the correction for bent borders that were fitted as straight lines
UNKNOWN_FOCAL = 0.5  # spread of the focal length's logarithm if no file states one
_TYPICAL_FOCAL = 0.7  # of the picture's diagonal, between a phone's 26 mm (0.6) and 35 mm (0.8)
_START_BENDS = (0.02, 0.6)  # smallest and largest bend from which fits start, radians over half the sheet
_FALLBACK_STARTS = [(bend, direction) for direction in np.radians([0, 45, 90, 135]) for bend in (-0.3, 0.3)]
_STEP = np.finfo(float).eps ** 0.5  # relative step of a parameter, as in MINPACK
_FAILED_PX = 1.0  # rms of a fit in a wrong minimum: without the fallback starts 2 of 378, all with strong bends

Project = Callable[[np.ndarray, np.ndarray], np.ndarray]
Tangent = Callable[[np.ndarray, np.ndarray, float], np.ndarray]


@dataclass(frozen=True)
class Shape:
    """A fitted model of the sheet: `project(parameters, mm)`, and the parameters with their covariance.

    `radius_mm` is positive if paper bulges towards the camera, None for a lens. `tangent(parameters, point_mm,
    turn_rad)` is the 4×4 `camera_from_tangent` of rolled paper at a point, turned about the rulings, else None; of flat
    paper the first eight parameters times `unit` are a homography. `hidden_turn_rad` is the paper's turn from its
    middle to the nearest marker, `bend_px` the part of the residual that is no noise.
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


@dataclass(frozen=True)
class LocatedSheet:
    """A picture in which the sheet is flat, with its homography `fit` there and the uncertainty of its corners; `shape`
    is that of the sheet in the photograph, which is the same picture unless `unrolled`.
    """

    srgb: np.ndarray
    fit: PageFit
    uncertainty_mm: float
    shape: Shape
    unrolled: bool = True


def flat_sheet(srgb: np.ndarray, fit: PageFit, rect_mm) -> LocatedSheet:
    """The sheet in a photograph of flat paper, with the piece at `rect_mm`."""
    project = lambda p, mm: apply_homography(np.append(p, 1.0).reshape(3, 3), mm)  # noqa: E731
    shape = Shape(project, fit.px_from_mm.ravel()[:8], fit.covariance, 0.0, None, 0.0, unit=np.ones(8))
    return LocatedSheet(srgb, fit, rectify.corner_uncertainty_mm(fit, rect_mm), shape, False)


def fit_shape(
    corners_px: Quads, corners_mm: Quads, size_px: tuple[int, int], focal_px: float | None, focal_spread: float
) -> tuple[Shape, np.ndarray, np.ndarray, np.ndarray] | None:
    """Fit a cylinder or a lens to the corners in a picture of this size; None if a plane fits as well. Returns the
    shape, the corners' 3×3 homography, and the corners in mm and in px, corrected for bent borders.
    """
    ids, px, mm = rectify.common_corners(corners_px, corners_mm)
    if len(ids) < LEAST_MARKERS:
        return None
    flat = fit_homography(mm, px)
    flat_rms = rms(apply_homography(flat, mm) - px)
    if not flat_rms > MAX_FLAT_RMS_PX:
        return None
    best = _best_shape(flat, mm, px, size_px, focal_px, focal_spread)
    if best.rms_px > MAX_RESIDUAL_SHARE * flat_rms:
        return None
    # the borders were fitted as straight lines, which on strongly bent paper meet beside the corners
    shift = _chord_shift(best, mm)
    px, floor = px - shift, float(np.hypot(CORNER_NOISE_PX, _CORRECTION_ERROR * rms(shift)))
    return _best_shape(flat, mm, px, size_px, focal_px, focal_spread, floor), flat, mm, px


def unroll(
    srgb: np.ndarray,
    corners_px: Quads,
    corners_mm: Quads,
    rect_mm,
    focal_px: float | None = None,
    focal_spread: float = UNKNOWN_FOCAL,
) -> LocatedSheet | None:
    """Flatten the piece (x, y, width, height on the page) in the photograph; None if a plane fits as well.
    `focal_spread` is the spread of the focal length's logarithm.
    """
    shape_fit = fit_shape(corners_px, corners_mm, (srgb.shape[1], srgb.shape[0]), focal_px, focal_spread)
    if shape_fit is None:
        return None
    shape, flat, mm, px = shape_fit
    grid = rect_mm[:2] + np.multiply(rect_mm[2:], RECT_GRID)
    px_from_mm = fit_homography(grid, shape.px(grid))
    margin = np.linalg.norm(apply_homography(flat, mm) - px, axis=1).max()  # pixels move about that far
    picture = _flatten(srgb, shape.px, px_from_mm, rect_mm, margin_px=margin)
    # the homography's covariance would not cover the bend, so it is 0 and `uncertainty_mm` covers everything
    ids = rectify.common_corners(corners_px, corners_mm)[0]
    residual = shape.px(mm) - px
    length = rectify.rms_length_mm(_mm_by_px(shape.px, mm), residual)
    fit = PageFit(px_from_mm, np.zeros((8, 8)), length, ids, rectify.bend_mm(shape.bend_px, residual, length))
    return LocatedSheet(picture, fit, _uncertainty_mm(shape, rect_corners(rect_mm)), shape)


def _best_shape(flat, mm, px, size, focal_px, focal_spread, floor_px=CORNER_NOISE_PX) -> Shape:
    paper = fit_cylinder(flat, mm, px, size, focal_px, focal_spread, floor_px)
    lens = fit_radial_lens(flat, mm, px, size)
    return lens if paper is None or lens.rms_px < paper.rms_px else paper


def _chord_shift(shape: Shape, mm: np.ndarray) -> np.ndarray:
    """The shift N×2 px from a marker's corners to the intersections of straight lines along its bent borders."""
    quads = mm.reshape(-1, 4, 2)
    corners = shape.px(mm).reshape(-1, 4, 2)
    s = np.linspace(-BORDER_SHARE, BORDER_SHARE, 9)
    along = (1 + s[:, None]) / 2
    points = quads[:, :, None] * (1 - along) + np.roll(quads, -1, axis=1)[:, :, None] * along
    bent = shape.px(points.reshape(-1, 2)).reshape(*quads.shape[:2], len(s), 2)
    middle, half, normal = border_frame(corners)
    distance = np.einsum("mksi,mki->mks", bent - middle[:, :, None], normal)
    offset, slope = distance.mean(2), (distance * s).sum(2) / (s * s).sum()
    ends = [middle + sign * half + (offset + sign * slope)[..., None] * normal for sign in (-1, 1)]
    return (intersect_borders(*ends) - corners).reshape(-1, 2)


def _uncertainty_mm(shape: Shape, corners: np.ndarray) -> float:
    """The uncertainty of the corners, by first-order propagation of the shape's covariance."""
    px, rows = shape.px(corners), []
    spread = np.sqrt(np.maximum(np.diag(shape.covariance), 1e-30))
    for i, sigma in enumerate(spread):
        step = np.zeros(len(spread))
        step[i] = 0.1 * sigma
        rows.append((shape.project(shape.parameters + step, corners) - px).ravel() / (0.1 * sigma))
    root, mm_by_px = rectify.root_of_scaled(shape.covariance), _mm_by_px(shape.px, corners)
    return rectify.largest_shift_mm(root, np.array(rows), mm_by_px)


def _mm_by_px(project: Callable[[np.ndarray], np.ndarray], mm: np.ndarray) -> np.ndarray:
    """Derivatives N×2×2 of page millimeters by pixels, by central differences over a tenth of a millimeter."""
    return np.linalg.inv(np.stack([(project(mm + step) - project(mm - step)) / 0.1 for step in 0.05 * np.eye(2)], -1))


def _flatten(srgb, project, px_from_mm, rect_mm, margin_px: float) -> np.ndarray:
    """The photograph with the rectangle of the page resampled as if the sheet were flat."""
    rows, columns = rectify.region_around(apply_homography(px_from_mm, rect_corners(rect_mm)), margin_px, srgb.shape)
    picture = srgb.copy()
    for strip in row_strips(srgb[rows]):  # in strips, because coordinates of a whole large picture take gigabytes
        region = slice(rows.start + strip.start, min(rows.start + strip.stop, rows.stop)), columns
        y, x = np.mgrid[region] + 0.5
        mm = apply_homography(np.linalg.inv(px_from_mm), np.column_stack([x.ravel(), y.ravel()]))
        inside = is_inside(mm, rect_mm)
        mask = inside.reshape(x.shape)
        source = np.full((*x.shape, 2), -1, np.float32)
        source[mask] = project(mm[inside]) - 0.5
        part = cv2.remap(srgb, source[..., 0], source[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        picture[region][mask] = part[mask]
    return picture


def fit_cylinder(flat, mm, px, size, focal_px, focal_spread=UNKNOWN_FOCAL, floor_px=CORNER_NOISE_PX) -> Shape | None:
    """Fit paper on a cylinder: the best of the fits from several starts; None if it is flat or bent by over 90°."""
    from scipy.optimize import least_squares  # a fifth of a second, which flat paper need not wait for

    center, half_mm = mm.mean(0), np.ptp(mm, axis=0).max() / 2
    middle = np.array(size) / 2
    focal = focal_px or _TYPICAL_FOCAL * np.hypot(*size)

    def project(p, points):
        # p or each of its rows: rotation vector, page center in the camera (mm), log focal / guess, bend, its direction
        rotation = np.swapaxes(Rotation.from_rotvec(p[..., :3]).as_matrix(), -1, -2)
        camera = in_space(p, points)[0] @ rotation + p[..., None, 3:6]
        return focal * np.exp(p[..., 6, None, None]) * camera[..., :2] / np.maximum(camera[..., 2:], 1e-3) + middle

    def in_space(p, points):
        c, s = np.cos(p[..., 8:]), np.sin(p[..., 8:])
        right, down = (points - center).T
        x, y = c * right + s * down, c * down - s * right  # along the bend, along the rulings
        turn = p[..., 7:8] * x / half_mm
        across = x * np.sinc(turn / np.pi)
        depth = x * np.sinc(turn / 2 / np.pi) * np.sin(turn / 2)  # x (1 - cos t) / t, defined at t = 0, too
        return np.stack([c * across - s * y, s * across + c * y, depth], -1), turn

    def tangent(p, point, turn_rad):
        (place,), (turn,) = in_space(p, np.asarray(point, float)[None])
        c, s = np.cos(p[8]), np.sin(p[8])
        slope, rulings = turn + turn_rad, np.array([-s, c, 0.0])
        along = np.array([c * np.cos(slope), s * np.cos(slope), np.sin(slope)])
        x, y = c * along - s * rulings, s * along + c * rulings
        rotation, pose = Rotation.from_rotvec(p[:3]).as_matrix(), np.eye(4)
        pose[:3, :3] = rotation @ np.column_stack([x, y, np.cross(x, y)])
        pose[:3, 3] = rotation @ place + p[3:6]
        return pose

    matrix = np.array([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1.0]])
    pose = plane_pose(flat @ np.array([[1, 0, center[0]], [0, 1, center[1]], [0, 0, 1.0]]), matrix)
    flat_start = [*Rotation.from_matrix(pose[:3, :3]).as_rotvec(), *pose[:3, 3], 0.0]
    prior = CORNER_NOISE_PX / (UNKNOWN_FOCAL if focal_px is None else focal_spread)

    def residuals(p):
        return np.concatenate([(project(p, mm) - px).reshape(*p.shape[:-1], -1), prior * p[..., 6:7]], -1)

    def jacobian(p):
        steps = _STEP * np.where(p == 0, 1, np.abs(p))
        rows = residuals(np.vstack([p, p + np.diag(steps)]))  # in one call: for few points it costs no more than one
        return ((rows[1:] - rows[0]) / steps[:, None]).T

    fits = []
    for starts in (_starts(flat, mm, px, matrix @ pose[:3], center, half_mm), _FALLBACK_STARTS):
        for bend, direction in starts:
            start = np.array([*flat_start, bend, direction])
            # approximate errors of the start's parameters
            scales = np.array([0.1, 0.1, 0.1, *[0.05 * max(abs(start[5]), 1.0)] * 3, 0.2, 0.2, 0.5])
            fit = least_squares(residuals, start, jacobian, x_scale=scales, max_nfev=40, method="lm")  # pyright: ignore[reportArgumentType]
            fits.append(fit)
        best = min(fits, key=lambda fit: fit.cost)
        if rms(best.fun) < _FAILED_PX:
            break
    bend = best.x[7]
    if abs(bend) < 1e-6 or abs(bend) > np.pi / 2:
        return None
    turns = in_space(best.x, mm)[1].reshape(-1, 4)
    hidden = np.maximum(turns.min(1), -turns.max(1)).min()  # to the nearest marker; negative if one covers the middle
    shape = _shape(project, best, mm, px, half_mm / bend, floor_px)
    return replace(shape, tangent=tangent, hidden_turn_rad=max(0.0, float(hidden)))


def _starts(flat, mm, px, camera, center, half_mm) -> list[tuple[float, float]]:
    """Starts of the fit: bends, in radians over half the sheet, and their directions.

    Slightly bent paper deviates from its plane by a quadratic form of the position, which shifts pixels in proportion:
    one linear fit gives form and homography. A cylinder's form has one eigenvalue that is not 0. Noise may exceed it,
    so both give starts; the larger one also with its sign reversed, which a distant camera hardly tells apart.
    """
    from_center = mm - center
    base = np.column_stack([from_center, np.zeros(len(mm))])
    depths = 0.01 * half_mm, -0.01 * half_mm
    images = ((base + np.array([0, 0, depth])) @ camera[:, :3].T + camera[:, 3] for depth in depths)
    farther, nearer = (image[:, :2] / image[:, 2:] for image in images)
    by_depth = (farther - nearer) / (0.02 * half_mm)
    x, y = from_center.T / half_mm
    form = [by_depth * (term * half_mm)[:, None] for term in (x * x, x * y, y * y)]
    flat_px = apply_homography(flat, mm)
    plane = homography_jacobian(np.eye(3), (flat_px - flat_px.mean(0)) / np.ptp(flat_px, axis=0).max())
    columns = np.column_stack([plane, *(each.ravel() for each in form)])
    xx, xy, yy = np.linalg.lstsq(columns, (px - flat_px).ravel(), rcond=1e-6)[0][8:]
    values, vectors = np.linalg.eigh([[xx, xy / 2], [xy / 2, yy]])
    order = np.argsort(-np.abs(values))
    starts = []
    for i, sign in ((order[0], 1), (order[0], -1), (order[1], 1)):
        bend = sign * np.copysign(np.clip(abs(2 * values[i]), *_START_BENDS), values[i])
        starts.append((float(bend), float(np.arctan2(vectors[1, i], vectors[0, i]))))
    return starts


def fit_radial_lens(flat, mm, px, size) -> Shape:
    """Fit a plane seen through a lens with one radial term about the picture's middle."""
    from scipy.optimize import least_squares

    middle, half = np.array(size) / 2, np.hypot(*size) / 2

    def project(p, points):
        straight = apply_homography(np.append(p[:8] * unit, 1).reshape(3, 3), points) - middle
        return straight * (1 + p[8] * (straight**2).sum(1, keepdims=True) / half**2) + middle

    unit = np.maximum(np.abs(flat.ravel()[:8]), 1e-9)
    start = np.append(flat.ravel()[:8] / unit, 0.0)
    fit = least_squares(lambda p: (project(p, mm) - px).ravel(), start, max_nfev=40, method="lm")
    return replace(_shape(project, fit, mm, px, None, CORNER_NOISE_PX), unit=unit)


def _shape(project: Project, fit, mm, px, radius_mm, floor_px) -> Shape:
    residual = project(fit.x, mm) - px
    noise, bend = noise_and_bend(residual, residual.reshape(-1, 4, 2), residual.size - len(fit.x), floor_px)
    return Shape(project, fit.x, covariance_of(fit.jac, noise, 1e-9), rms(residual), radius_mm, bend)


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))
