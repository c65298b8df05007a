"""Estimate the camera's position as seen from a point of a flat or rolled sheet, with its uncertainty.

In: a homography or a `Shape` with its covariance, and a pinhole matrix, the logarithm of whose focal length has the
standard deviation `focal_spread`. Out: `CameraPosition`, with the answer whether the sheet's own perspective agrees
with the matrix. A small or distant sheet looks almost the same from either side of its normal: the azimuth's sign is
lost first. Spreads follow from shifts by one standard deviation along each axis of the parameters' covariance; that of
tilt, which is never negative, from random draws.

A page seen with the right matrix has px_from_mm ~ K [r1, r2, t]: r1 · r2 = 0 and |r1| = |r2|. A wrong focal length or
principal point (an off-center crop) breaks both with sin² of the tilt, so frontal views tell nothing. Crops and
software that straightens may leave no trace in a file, so a focal length from EXIF is trusted only as far as
perspective confirms it; otherwise the distance is unknown, and angles are as uncertain as these can make them. Angles
are also less certain for rolled paper that may turn between its markers, and for paper that misses its markers.

Source: Hartley and Zisserman, Multiple View Geometry, 2nd ed., 8.1.
"""

from dataclasses import dataclass, replace

import numpy as np

from patchproof.base.geometry import plane_pose, scaling_about, view_angles
from patchproof.photo.rectify import PageFit, root_of, root_of_scaled
from patchproof.photo.unroll import Shape

# One σ of errors beyond corner noise: printers' errors of proportion, in |r1| = |r2|; errors of lenses and of paper
# that is not quite flat or round, in both equations, in angles (rad) and in lengths.
_PRINT_STRETCH, _PAPER = 0.015, 0.003
# One σ of stretch in a tilt's uncertainty if perspective cannot tell: with prints stretched by up to 5 % or pictures
# squeezed by up to 12 %, errors stay within three times the stated value, which is half as wide as with 0.015.
_TILT_STRETCH = 0.008
_MAX_CHI2 = 9.2  # 99 % of two degrees of freedom
_MAX_SIGMAS = 2.6
_MAX_CONFIRMING_SPREAD = 0.1  # of the focal length's logarithm: perspective with a larger one cannot confirm it
# 95 % uncertainty of azimuth and tilt if perspective does not confirm the focal length. Software that straightens views
# from up to 50° leaves azimuths up to 44° off and tilts up to 46°, three times this, and no trace in 281 of 1,500 drawn
# pictures, all of which look nearly frontal. Crops, anywhere in a picture, turn the azimuth by up to 16.4°.
UNCONFIRMED_DEG = 15.5
# One σ as a share of the turn between the middle and the nearest marker (95 %: 0.43 of it). At worst, with a fold right
# beside the middle and markers a tenth as wide as the sheet in its corners, the middle is turned by 1.28 of it.
_HIDDEN_TURN = 0.22
# One σ in radians per bend (share of the side beyond noise), for waves half a side long seen at a tilt of 20° or less.
_TURN_PER_BEND = 50.0


@dataclass(frozen=True)
class CameraPosition:
    """The camera's azimuth and distance, each with its 95 % uncertainty (infinite: unknown). `focal_agrees` says if
    perspective confirms the focal length; None if it cannot tell.
    """

    azimuth_deg: float
    azimuth_uncertainty_deg: float
    distance_mm: float
    distance_uncertainty_mm: float
    focal_agrees: bool | None


def turn_rad(bend: float, shape: Shape | None) -> float:
    """One standard deviation of the turn of the paper's middle against its model, from `bend` (the markers' error
    beyond noise, as a share of the paper's side) and from the turn of a `shape` between its markers.
    """
    return float(np.hypot(_TURN_PER_BEND * bend, 0.0 if shape is None else _HIDDEN_TURN * shape.hidden_turn_rad))


def distortion_of(fit: PageFit, matrix_px: np.ndarray | None, focal_spread: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a print's or picture's shear and log stretch (x over y), mean (2,) and covariance 2×2, as a flat sheet's
    perspective shows them; without a matrix those of usual prints.
    """
    expected, paper = _TILT_STRETCH**2 * np.eye(2), _PAPER**2 * np.eye(2)
    if matrix_px is None:
        return np.zeros(2), expected + paper
    error, covariance, by_focal = _disagreement(fit, matrix_px)
    gain = np.linalg.solve(expected + covariance + focal_spread**2 * np.outer(by_focal, by_focal), expected).T
    return gain @ error, expected - gain @ expected + paper


def flat_sheet_position(
    fit: PageFit, matrix_px: np.ndarray, focal_spread: float, point_mm, turn: float = 0.0, matrix_is_known: bool = False
) -> CameraPosition:
    """The camera's position before flat paper; `turn` is that of `turn_rad`. With `matrix_is_known` the matrix is that
    of this picture and needs no confirmation by perspective.
    """
    agrees, own_spread = _agreement(fit, matrix_px, focal_spread)
    entries = np.append(fit.px_from_mm.ravel()[:8], 0.0)
    root = np.pad(root_of(fit.covariance), (0, 1))
    root[8, 8] = _trusted_spread(focal_spread, own_spread, agrees, matrix_is_known)

    def figures(values: np.ndarray) -> np.ndarray:
        homography = np.append(values[:8], 1.0).reshape(3, 3)
        return np.array(view_angles(plane_pose(homography, _scale_focal(matrix_px, values[8])), point_mm))[[0, 2]]

    position = _position(figures, entries, root, agrees, matrix_is_known)
    azimuth_uncertainty_deg = float(np.hypot(position.azimuth_uncertainty_deg, 1.96 * np.degrees(turn)))
    return replace(position, azimuth_uncertainty_deg=azimuth_uncertainty_deg)


def bent_sheet_position(
    shape: Shape, matrix_px: np.ndarray, focal_spread: float, point_mm, turn: float = 0.0, matrix_is_known: bool = False
) -> CameraPosition:
    """`flat_sheet_position` for any shape: for paper on a cylinder by the tangent plane at the point."""
    if shape.unit is not None:
        homography = np.append(shape.parameters[:8] * shape.unit, 1.0)
        fit = PageFit(homography.reshape(3, 3), shape.covariance[:8, :8] * np.outer(shape.unit, shape.unit), 0.0, ())
        return flat_sheet_position(fit, matrix_px, focal_spread, point_mm, turn, matrix_is_known)
    tangent = shape.tangent
    assert tangent is not None  # a shape has either `unit` or `tangent`

    def figures(values: np.ndarray) -> np.ndarray:
        return np.array(view_angles(tangent(values[:-1], point_mm, values[-1]), (0, 0)))[[0, 2]]

    error, spread = float(shape.parameters[6]), float(np.sqrt(shape.covariance[6, 6]))
    can_tell = spread < 0.7 * focal_spread or abs(error) > focal_spread
    agrees = abs(error) <= _MAX_SIGMAS * focal_spread if can_tell else None
    # the fitted bend determines the focal length only if the paper is a true cylinder
    added_variance = max(0.0, _trusted_spread(focal_spread, spread, agrees, matrix_is_known) ** 2 - spread**2)
    by_focal = shape.covariance[6] / spread**2
    root = np.pad(root_of_scaled(shape.covariance + added_variance * np.outer(by_focal, by_focal)), (0, 1))
    root[9, 9] = turn
    return _position(figures, np.append(shape.parameters, 0.0), root, agrees, matrix_is_known)


def _trusted_spread(focal_spread: float, own_spread: float, agrees: bool | None, matrix_is_known: bool) -> float:
    """The spread to assume for the focal length's logarithm, if perspective alone gives it `own_spread`."""
    return focal_spread if matrix_is_known or not agrees else max(focal_spread, own_spread)


def scale_and_tilt(shape: Shape, point_mm) -> tuple[float, float]:
    """(px_per_mm, tilt_deg) of a page point; see `geometry.local_scale`."""
    stretch = _stretch(shape, shape.parameters, point_mm)
    return float(np.sqrt(abs(np.linalg.det(stretch)))), float(_tilt_deg(stretch[None])[0])


def tilt_uncertainty_deg(shape: Shape, point_mm, turn: float = 0.0, distortion=None) -> float:
    """The 95 % uncertainty of the tilt of `scale_and_tilt`, by covariance, a `turn_rad` and a `distortion_of`."""
    root, stretch = root_of_scaled(shape.covariance), _stretch(shape, shape.parameters, point_mm)
    sides = [[_stretch(shape, shape.parameters + sign * axis, point_mm) for axis in root.T] for sign in (1, -1)]
    by_axis = (np.array(sides[0]) - np.array(sides[1])) / 2
    rng = np.random.default_rng(0)  # fixed, so that the same photo gives the same bytes
    draws = stretch + np.einsum("nk,kij->nij", rng.standard_normal((1000, len(by_axis))), by_axis)
    mean, spread = (np.zeros(2), 2 * _PAPER**2 * np.eye(2)) if distortion is None else distortion
    shear, stretch_x = (mean + rng.standard_normal((1000, 2)) @ root_of(spread).T).T / 2
    paper = np.eye(2) - np.moveaxis(np.array([[stretch_x, shear], [shear, -stretch_x]]), -1, 0)
    errors = _tilt_deg(draws @ paper) - _tilt_deg(stretch[None])
    return float(np.hypot(np.percentile(np.abs(errors), 95), 1.96 * np.degrees(turn)))


def _stretch(shape: Shape, parameters: np.ndarray, point_mm) -> np.ndarray:
    """The derivative 2×2 of pixels by page millimeters, over a tenth of a millimeter."""
    step = 0.05 * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    right, left, below, above = shape.project(parameters, np.asarray(point_mm, float) + step)
    return np.stack([right - left, below - above], 1) / 0.1


def _position(figures, parameters, root, agrees, matrix_is_known) -> CameraPosition:
    """The position from `figures(parameters)` (azimuth, distance), with the spread over the columns of `root`."""
    shifts = np.array([figures(parameters + axis) - figures(parameters - axis) for axis in root.T]) / 2
    shifts[:, 0] = (shifts[:, 0] + 90) % 180 - 90  # half of a difference of angles
    azimuth, distance = figures(parameters)
    spread = 1.96 * np.hypot(np.linalg.norm(shifts, axis=0), [np.degrees(_PAPER), _PAPER * distance])
    if agrees is None and not matrix_is_known:
        spread = np.hypot(spread, [UNCONFIRMED_DEG, np.inf])
    return CameraPosition(float(azimuth), float(spread[0]), float(distance), float(spread[1]), agrees)


def _scale_focal(matrix_px: np.ndarray, log_scale: float) -> np.ndarray:
    return matrix_px @ scaling_about([0.0, 0.0], float(np.exp(log_scale)))


def _agreement(fit: PageFit, matrix_px: np.ndarray, focal_spread: float) -> tuple[bool | None, float]:
    """Return True or False if r1 and r2 confirm or contradict the focal length, None if they cannot tell, and the
    standard deviation of its logarithm from perspective alone.
    """
    error, covariance, by_focal = _disagreement(fit, matrix_px)
    covariance += np.diag([_PAPER**2, _PRINT_STRETCH**2 + _PAPER**2])
    # an off-center principal point changes r1 and r2, too, and may cancel a wrong focal length: confirming takes more
    confirming = covariance + _PRINT_STRETCH**2 * np.eye(2)
    own_spread = 1 / np.sqrt(max(float(by_focal @ np.linalg.solve(confirming, by_focal)), 1e-12))
    if error @ np.linalg.solve(covariance + focal_spread**2 * np.outer(by_focal, by_focal), error) > _MAX_CHI2:
        return False, own_spread
    return (True if own_spread < _MAX_CONFIRMING_SPREAD else None), own_spread


def _disagreement(fit: PageFit, matrix_px: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors (2,) of r1 · r2 = 0 and |r1| = |r2|, their covariance and derivatives by the focal length's logarithm."""
    entries = fit.px_from_mm.ravel()[:8]

    def errors(entries: np.ndarray, log_scale: float = 0.0) -> np.ndarray:
        axes = (np.linalg.inv(_scale_focal(matrix_px, log_scale)) @ np.append(entries, 1.0).reshape(3, 3))[:, :2]
        (x, y), lengths = axes.T, np.linalg.norm(axes, axis=0)
        return np.array([x @ y / np.linalg.norm(x) / np.linalg.norm(y), np.log(lengths[0] / lengths[1])])

    # central differences, with steps in proportion to entries of different orders of magnitude
    steps = 1e-6 * np.maximum(np.abs(entries), np.abs(entries).max() * 1e-6)
    rows = [errors(entries + step) - errors(entries - step) for step in np.diag(steps)]
    by_entries = np.array(rows).T / (2 * steps)
    covariance = by_entries @ fit.covariance @ by_entries.T
    return errors(entries), covariance, (errors(entries, 0.01) - errors(entries, -0.01)) / 0.02


def _tilt_deg(stretch: np.ndarray) -> np.ndarray:
    singular = np.linalg.svd(stretch, compute_uv=False)
    return np.degrees(np.arccos(np.clip(singular[:, 1] / singular[:, 0], 0, 1)))
