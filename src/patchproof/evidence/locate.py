"""Where the sheet lies in a photograph: flat, rolled or behind a lens, how sure that is, and where the camera stood.

In: a `PinholePhoto` and the markers detected in it. Out: `LocatedSheet`, its `Geometry` and `CameraPose`, and what the design's own pixels
say of it: markers in a piece's corners fit a plane whatever the paper does between them. All that is stated of rolled
paper is of the tangent plane at the design's middle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from patchproof.base.geometry import apply_homography, fit_homography, intrinsics, plane_pose, rect_corners
from patchproof.channel.object_box import project_box
from patchproof.evidence.camera import FOCAL_ERROR, PinholePhoto
from patchproof.evidence.classify import BoxEdges
from patchproof.evidence.results import CameraPose, FocalSource, Geometry
from patchproof.evidence.surface import PromisedColors, Surface
from patchproof.photo.detect import MarkersInView
from patchproof.photo.pose import (
    bent_sheet_position,
    flat_sheet_position,
    scale_and_tilt,
    tilt_uncertainty_deg,
    turn_rad,
)
from patchproof.photo.print_ratio import x_over_y
from patchproof.photo.quality import FrameLight, blur_px
from patchproof.photo.rectify import PageFit, corner_uncertainty_mm, fit_page
from patchproof.photo.registration import Registration, register
from patchproof.photo.rejection import PhotoRejected
from patchproof.photo.unroll import UnrolledSheet, unroll

MOST_SHIFT = 0.005  # of the design's shorter side, by which its own pixels may lie elsewhere than the markers say
_LEAST_CELLS = 3
_TANGENT_MM = 5.0  # of paper round the middle that stands for a plane
_SHARE = 80  # per cent of the cells; gloss, a shadow's edge or a thumb may lie over the others
_SURE_SIGMAS = 2.0
_ODD_GROWS = 2.0  # the design's corner beside a marker that does not agree may lie off by as much as that, or more
MOST_RATIO_ERROR = 0.005  # a less certain x:y ratio is "not measured"
# Neither are these, 95 %. Beyond some 10° a sheet that is seen from the left may as well be seen from the right.
MOST_AZIMUTH_ERROR_DEG, MOST_DISTANCE_ERROR = 10.0, 0.2


@dataclass(frozen=True)
class LocatedSheet:
    """A picture in which the sheet is flat, its homography there, and how it was made of another photograph."""

    srgb: np.ndarray
    fit: PageFit
    unrolled: UnrolledSheet | None

    def px(self, parameters: np.ndarray, mm: np.ndarray) -> np.ndarray:
        """Photograph's pixels N×2 of page points by the model's parameters."""
        if self.unrolled is not None:
            return self.unrolled.shape.project(parameters, mm)
        return apply_homography(np.append(parameters, 1.0).reshape(3, 3), mm)

    @property
    def parameters(self) -> np.ndarray:
        """The model's, eight of a homography for flat paper."""
        return self.unrolled.shape.parameters if self.unrolled else self.fit.px_from_mm.ravel()[:8]

    @property
    def covariance(self) -> np.ndarray:
        """Of the parameters."""
        return self.unrolled.shape.covariance if self.unrolled else self.fit.covariance


def place(view: PinholePhoto, detected: MarkersInView, surface: Surface) -> LocatedSheet | None:
    """The sheet's place by its markers; None where they fit nothing."""
    fit = _fit(detected, surface)
    if fit is None:
        return None
    unrolled = _unrolled(view, detected, surface)
    return (
        LocatedSheet(view.srgb, fit, None) if unrolled is None else LocatedSheet(unrolled.srgb, unrolled.fit, unrolled)
    )


def _fit(detected: MarkersInView, surface: Surface) -> PageFit | None:
    """The homography of the piece, with the page's own markers where they lie in the same plane; only the piece's count
    as odd.
    """
    sure = {i: b.corners_px for i, b in detected.markers.items() if b.fitted}
    corners = sure or detected.corners_px
    on_piece = {i: c for i, c in corners.items() if i in surface.piece_ids}
    try:
        fit = fit_page(on_piece or corners, surface.corners_mm)
        if on_piece and len(on_piece) < len(corners):
            together = fit_page(corners, surface.corners_mm)
            # a page that hangs elsewhere than its piece would drag the fit away
            if set(on_piece) <= set(together.inlier_ids):
                fit = replace(together, outlier_mm=0.0)
        if not on_piece:
            fit = replace(fit, outlier_mm=0.0)
    except (np.linalg.LinAlgError, PhotoRejected):
        return None
    return fit if np.isfinite(fit.px_from_mm).all() and np.isfinite(fit.covariance).all() else None


def _unrolled(view: PinholePhoto, detected: MarkersInView, surface: Surface) -> UnrolledSheet | None:
    """The piece made flat where its markers do not lie in one plane and a cylinder or a lens says why."""
    corners = {i: b.corners_px for i, b in detected.markers.items() if b.fitted and i in surface.piece_ids}
    focal = () if view.matrix_px is None else (float(view.matrix_px[0, 0]), view.focal_spread)
    try:
        return unroll(view.srgb, corners, surface.corners_mm, surface.rect_mm, *focal)
    except (np.linalg.LinAlgError, ValueError):
        return None  # a shape that no camera sees is no explanation; the plane's residual decides


def object_box(view: PinholePhoto, placed: LocatedSheet, surface: Surface) -> BoxEdges | None:
    """Where the object lies that the sheet hangs on, by the plane that touches the paper in the design's middle; None
    where the sheet does not say, or no camera sees it so. Without a focal length the promised field of view stands in.
    """
    if surface.outermost_mm is None:
        return None
    size_px = view.srgb.shape[1], view.srgb.shape[0]
    matrix = intrinsics(surface.fov_deg, size_px) if view.matrix_px is None else view.matrix_px
    around = np.array(surface.center_mm) + _TANGENT_MM * (rect_corners((-1, -1, 2, 2)))
    try:
        pose = plane_pose(fit_homography(around, placed.px(placed.parameters, around)), matrix)
    except (np.linalg.LinAlgError, ValueError):
        return None
    side, left, top = min(size_px), *((size - min(size_px)) / 2 for size in size_px)
    to_square = np.array([[1, 0, -left], [0, 1, -top], [0, 0, 1.0]])
    box = project_box(surface.outermost_mm, pose, to_square @ matrix, (side, side)) / side
    return None if not np.isfinite(box).all() or not box.any() else (*box.tolist(),)


def geometry_of(
    placed: LocatedSheet, detected: MarkersInView, light: FrameLight, surface: Surface, promised: PromisedColors | None
) -> tuple[Geometry, int]:
    """The figures, and in how many of the design's corners the photograph shows what was printed there: four where
    that is not known.
    """
    fit, unrolled = placed.fit, placed.unrolled
    px_per_mm, tilt_deg = scale_and_tilt(placed.px, placed.parameters, surface.center_mm)
    blur, shift, corners = blur_px(detected.markers.values()), None, 4
    uncertainty = unrolled.uncertainty_mm if unrolled else corner_uncertainty_mm(fit, surface.rect_mm)
    uncertainty = float(np.hypot(uncertainty, _ODD_GROWS * fit.outlier_mm))
    # a page in tiles shows none of the piece's markers, or a part of them
    if promised is not None and surface.piece_ids:
        cells = register(placed.srgb, fit.px_from_mm, surface.rect_mm, promised.design, px_per_mm, blur)
        shift, corners, at_corners = _shifts(cells, surface)
        uncertainty = float(np.hypot(uncertainty, _SURE_SIGMAS * at_corners))
    tilt_by = placed.px, placed.parameters, placed.covariance, surface.center_mm, _turn_rad(placed, surface)
    geometry = Geometry(
        residual_mm=fit.residual_mm,
        px_per_mm=px_per_mm,
        tilt_deg=tilt_deg,
        tilt_uncertainty_deg=tilt_uncertainty_deg(*tilt_by),
        contrast=light.contrast,
        blur_px=blur,
        corner_uncertainty_mm=uncertainty,
        curl_radius_mm=unrolled and unrolled.radius_mm,
        bend_mm=fit.bend_mm,
        design_shift_mm=shift,
        # none maps a page that was unrolled to the photograph
        homography_px_from_mm=None if unrolled else fit.px_from_mm.tolist(),
    )
    return geometry, corners


def _turn_rad(placed: LocatedSheet, surface: Surface) -> float:
    return turn_rad(placed.fit.bend_mm / min(surface.rect_mm[2:]), placed.unrolled and placed.unrolled.shape)


def _shifts(cells: Registration, surface: Surface) -> tuple[float | None, int, float]:
    """What nearly all cells have moved by, what is not sure of it taken off; corners that show the design; the most
    that any of these has moved by.
    """
    moved = np.linalg.norm(cells.shift_mm, axis=1)
    beyond = np.maximum(moved - _SURE_SIGMAS * cells.sigma_mm, 0)
    side = min(surface.rect_mm[2:])
    sure = cells.sigma_mm < MOST_SHIFT * side / 2  # False where NaN
    shift = float(np.percentile(beyond[sure], _SHARE)) if sure.sum() >= _LEAST_CELLS else None
    shown, most = 0, 0.0
    for corner in rect_corners(surface.rect_mm):
        near = np.abs(cells.middle_mm - corner).max(1) < side / 8
        shown += not near.any() or bool(np.isfinite(moved[near]).any())
        most = max(most, float(beyond[near & sure].max(initial=0)))
    return shift, shown, most


def camera_pose(view: PinholePhoto, placed: LocatedSheet, surface: Surface) -> tuple[CameraPose | None, FocalSource]:
    """Where the camera stood, None where its focal length is not known or not to be believed, and which it is."""
    if view.matrix_px is None:
        return None, "cropped" if view.cropped else "unknown"
    camera = view.matrix_px, view.focal_spread, surface.center_mm, _turn_rad(placed, surface), view.calibrated
    if placed.unrolled is None:
        stance = flat_sheet_position(placed.fit, *camera)
    else:
        stance = bent_sheet_position(placed.unrolled.shape, *camera)
    # a camera file is what stretched prints are measured by, which perspective cannot tell from a wrong focal length
    if stance.focal_agrees is False and not view.calibrated:
        return None, "contradicted"
    ratio, angle, length = None, stance.azimuth_uncertainty_deg, stance.distance_uncertainty_mm
    if view.calibrated and placed.unrolled is None:
        ratio, uncertainty = x_over_y(placed.fit, view.matrix_px, FOCAL_ERROR)
        ratio = ratio if uncertainty <= MOST_RATIO_ERROR else None
    far = length > MOST_DISTANCE_ERROR * stance.distance_mm
    pose = CameraPose(
        azimuth_uncertainty_deg=angle,
        azimuth_deg=stance.azimuth_deg if angle <= MOST_AZIMUTH_ERROR_DEG else None,
        distance_mm=None if far else stance.distance_mm,
        distance_uncertainty_mm=None if far else length,
        scale_x_over_y=ratio,
    )
    return pose, "calibrated" if view.calibrated else "confirmed" if stance.focal_agrees else "unchecked"
