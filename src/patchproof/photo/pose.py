"""Where the camera stood, as a point of the sheet has it, and how sure that is: of flat paper and of rolled.

In: a homography or a `Shape` with its covariance, a pinhole matrix whose focal length is known to `focal_spread` of its
logarithm (one standard deviation). Out: `CameraPosition`, and whether a flat sheet's own perspective agrees with the matrix.
A small or far sheet looks almost the same from either side of its normal: the azimuth's sign goes first. Spreads are
those of the figures one standard deviation off along each axis of the parameters' covariance; tilt, which is never
negative, is drawn.

A page seen with a right matrix has px_from_mm ~ K [r1, r2, t]: r1 · r2 = 0 and |r1| = |r2|. Another focal length breaks
both as sin² of the tilt, another principal point (a picture cropped aside) likewise, so frontal views tell nothing. A
crop need leave no trace in a file. So a focal length that EXIF states is believed no further than perspective confirms
it; where that cannot tell, there is no distance, and the azimuth is as uncertain as crops make it. Rolled paper may
turn anywhere between its markers, at a fold too, so that the tangent of a middle far from them is uncertain by as much,
and so is that of paper that misses its markers by more than noise.

Source: Hartley and Zisserman, Multiple View Geometry, 2nd ed., 8.1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from patchproof.base.geometry import plane_pose, scaling_about, view_angles
from patchproof.photo.print_ratio import cosine, gradient, log_ratio
from patchproof.photo.rectify import PageFit, root_of
from patchproof.photo.shapes import Project, Shape

_PRINT_STRETCH = 0.015  # of |r1| = |r2|: what printers do to proportions
_PAPER = 0.003  # of both, of angles in radians and of lengths: paper that is not quite flat or round, lenses
_TOO_FAR = 9.2  # χ² of two degrees of freedom, 99 %
_TOO_FAR_SIGMAS = 2.6
_WEAK = 0.1  # of the focal length's logarithm: perspective that knows it no better cannot confirm it
# 95 % of what crops to 0.35 to 0.95 of a picture, anywhere in it, turned the azimuth by where perspective cannot tell
# (2,000 drawn, with a focal length of 36 mm on film); the most was 16.4
_CROPPED_DEG = 7.0
# one σ, as a share of the turn between the middle and the nearest marker: 95 % are 0.43 of it. A fold right beside the
# middle turns that by all that the sheet turns to one side, 1.28 of it where markers of a tenth lie in the corners
_HIDDEN_TURN = 0.22
# one σ in radians of what misses by a share of its side beyond noise: waves half a side long, seen under 20° or less
_BEND_TURNS = 50.0


@dataclass(frozen=True)
class CameraPosition:
    """Azimuth and distance, each with its 95 % uncertainty (infinite: not known), and whether perspective agrees with
    the focal length: None where it tells too little.
    """

    azimuth_deg: float
    azimuth_uncertainty_deg: float
    distance_mm: float
    distance_uncertainty_mm: float
    agrees: bool | None


def turn_rad(bend: float, shape: Shape | None) -> float:
    """One standard deviation of how the paper's middle may be turned against its model: by what markers miss beyond
    noise, as a share of its side, and by where between markers a `shape` turns.
    """
    return float(np.hypot(_BEND_TURNS * bend, 0.0 if shape is None else _HIDDEN_TURN * shape.hidden_turn_rad))


def flat_sheet_position(
    fit: PageFit, matrix_px: np.ndarray, focal_spread: float, point_mm, turn: float = 0.0, whole: bool = False
) -> CameraPosition:
    """Of flat paper seen by that camera, with its `turn_rad`; `whole`: the matrix is known to be this picture's."""
    agrees, told = _agreement(fit, matrix_px, focal_spread)
    entries = np.append(fit.px_from_mm.ravel()[:8], 0.0)
    root = np.zeros((9, 9))
    root[:8, :8], root[8, 8] = root_of(fit.covariance), _believed(focal_spread, told, agrees, whole)

    def figures(values: np.ndarray) -> np.ndarray:
        homography = np.append(values[:8], 1.0).reshape(3, 3)
        return np.array(view_angles(plane_pose(homography, _longer(matrix_px, values[8])), point_mm))[[0, 2]]

    stance = _stance(figures, entries, root, agrees, whole)
    return replace(
        stance, azimuth_uncertainty_deg=float(np.hypot(stance.azimuth_uncertainty_deg, 1.96 * np.degrees(turn)))
    )


def bent_sheet_position(
    shape: Shape, matrix_px: np.ndarray, focal_spread: float, point_mm, turn: float = 0.0, whole: bool = False
) -> CameraPosition:
    """Of paper that a cylinder or a lens explains, by the tangent plane at the point."""
    if shape.unit is not None:
        scale = np.append(shape.unit, 1.0)
        homography = np.append(shape.parameters[:8], 1.0) * scale
        covariance = shape.covariance[:8, :8] * np.outer(shape.unit, shape.unit)
        fit = PageFit(homography.reshape(3, 3), covariance, 0.0, ())
        return flat_sheet_position(fit, matrix_px, focal_spread, point_mm, turn, whole)
    tangent = shape.tangent
    assert tangent is not None  # a shape is one or the other

    def figures(values: np.ndarray) -> np.ndarray:
        return np.array(view_angles(tangent(values[:-1], point_mm, values[-1]), (0, 0)))[[0, 2]]

    off, spread = float(shape.parameters[6]), float(np.sqrt(shape.covariance[6, 6]))
    told = spread < 0.7 * focal_spread
    agrees = abs(off) <= _TOO_FAR_SIGMAS * focal_spread if told or abs(off) > focal_spread else None
    # what the bend says of the focal length, it says of a true cylinder
    believed = _believed(focal_spread, spread, agrees, whole)
    by_focal = shape.covariance[6] / spread**2
    more = max(0.0, believed**2 - spread**2)
    root = np.zeros((10, 10))
    root[:9, :9] = root_of_scaled(shape.covariance + more * np.outer(by_focal, by_focal))
    root[9, 9] = turn
    return _stance(figures, np.append(shape.parameters, 0.0), root, agrees, whole)


def _believed(focal_spread: float, told: float, agrees: bool | None, whole: bool) -> float:
    """What the focal length's logarithm is known to, where perspective alone knows it to `told`."""
    return focal_spread if whole or not agrees else max(focal_spread, told)


def scale_and_tilt(px: Project, parameters: np.ndarray, point_mm) -> tuple[float, float]:
    """(px_per_mm, tilt_deg) of a page point, as `geometry.local_scale` has them, for `px(parameters, mm)`."""
    stretch = _stretch(px, parameters, point_mm)
    return float(np.sqrt(abs(np.linalg.det(stretch)))), float(_tilt_deg(stretch[None])[0])


def tilt_uncertainty_deg(
    px: Project, parameters: np.ndarray, covariance: np.ndarray, point_mm, turn: float = 0.0
) -> float:
    """95 % of that tilt, of paper with that `turn_rad`."""
    root, here = root_of_scaled(covariance), _stretch(px, parameters, point_mm)
    sides = [[_stretch(px, parameters + sign * axis, point_mm) for axis in root.T] for sign in (1, -1)]
    by_axis = (np.array(sides[0]) - np.array(sides[1])) / 2
    rng = np.random.default_rng(0)  # fixed: same photo, same bytes
    moved = here + np.einsum("nk,kij->nij", rng.standard_normal((1000, len(by_axis))), by_axis)
    paper = np.eye(2) + _PAPER * rng.standard_normal((1000, 2, 2))
    off = _tilt_deg(moved @ paper) - _tilt_deg(here[None])
    return float(np.hypot(np.percentile(np.abs(off), 95), 1.96 * np.degrees(turn)))


def _stretch(px: Project, parameters: np.ndarray, point_mm) -> np.ndarray:
    """2×2 derivative of pixels by page millimeters, over a tenth of one."""
    step = 0.05 * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    right, left, below, above = px(parameters, np.asarray(point_mm, float) + step)
    return np.stack([right - left, below - above], 1) / 0.1


def root_of_scaled(covariance: np.ndarray) -> np.ndarray:
    """`root_of`, for parameters of different units."""
    spread = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    return spread[:, None] * root_of(covariance / np.outer(spread, spread))


def _stance(figures, parameters, root, agrees, whole) -> CameraPosition:
    apart = np.array([figures(parameters + axis) - figures(parameters - axis) for axis in root.T]) / 2
    apart[:, 0] = (apart[:, 0] + 90) % 180 - 90  # half of an angle's difference
    azimuth, distance = figures(parameters)
    spread = 1.96 * np.hypot(np.linalg.norm(apart, axis=0), [np.degrees(_PAPER), _PAPER * distance])
    if agrees is None and not whole:
        spread = np.hypot(spread, [_CROPPED_DEG, np.inf])
    return CameraPosition(float(azimuth), float(spread[0]), float(distance), float(spread[1]), agrees)


def _longer(matrix_px: np.ndarray, log_focal: float) -> np.ndarray:
    return matrix_px @ scaling_about([0.0, 0.0], float(np.exp(log_focal)))


def _agreement(fit: PageFit, matrix_px: np.ndarray, focal_spread: float) -> tuple[bool | None, float]:
    """Whether r1 and r2 are as long and at right angles as their uncertainty allows, None where they tell nothing; what
    they alone know the focal length's logarithm to, one standard deviation.
    """
    entries = fit.px_from_mm.ravel()[:8]

    def both(log_focal: float) -> np.ndarray:
        back = np.linalg.inv(_longer(matrix_px, log_focal))
        return np.array([cosine(entries, back), log_ratio(entries, back)])

    back = np.linalg.inv(matrix_px)
    by_entries = np.stack([gradient(f, entries, back) for f in (cosine, log_ratio)])
    own = by_entries @ fit.covariance @ by_entries.T + np.diag([_PAPER**2, _PRINT_STRETCH**2 + _PAPER**2])
    by_focal = (both(0.01) - both(-0.01)) / 0.02
    off = both(0.0)
    # a principal point aside turns r1 and r2, too, and by chance back: what confirms must outweigh more than paper
    firm = own + _PRINT_STRETCH**2 * np.eye(2)
    told = 1 / np.sqrt(max(float(by_focal @ np.linalg.solve(firm, by_focal)), 1e-12))
    if off @ np.linalg.solve(own + focal_spread**2 * np.outer(by_focal, by_focal), off) > _TOO_FAR:
        return False, told
    return (True if told < _WEAK else None), told


def _tilt_deg(stretch: np.ndarray) -> np.ndarray:
    """Of derivatives N×2×2."""
    small = np.linalg.svd(stretch, compute_uv=False)
    return np.degrees(np.arccos(np.clip(small[:, 1] / small[:, 0], 0, 1)))
