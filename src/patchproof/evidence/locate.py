"""Locate the sheet in a photograph (flat, rolled or behind a lens), with uncertainty, and the camera's pose.

In: a `PinholePhoto` and the markers detected in it. Out: `LocatedSheet`, its `Geometry` and `CameraPose`. The design's
own pixels are checked, too: markers in a piece's corners fit a plane even if the paper bulges between them. Figures of
rolled paper are those of the tangent plane at the design's middle. A camera file gives intrinsics and lens terms; the
picture is then resampled without lens distortion. Without one the matrix follows from EXIF's focal length with the
principal point in the middle, or is unknown. A camera file also fits upright photographs, as those of a camera that was
turned by 90° clockwise, as most phones are.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from patchproof.base.geometry import fit_homography, intrinsics, plane_pose, rect_corners
from patchproof.channel.object_box import project_box
from patchproof.evidence.classify import BoxEdges
from patchproof.evidence.results import CameraPose, FocalSource, Geometry
from patchproof.evidence.surface import PromisedColors, Surface
from patchproof.photo import pose as sheet_pose
from patchproof.photo.detect import MarkersInView, row_strips
from patchproof.photo.exif import EXIF_SPREAD
from patchproof.photo.known_page import is_in_picture, shows_small_code
from patchproof.photo.quality import FrameLight
from patchproof.photo.read import Photo
from patchproof.photo.rectify import PageFit, fit_page
from patchproof.photo.registration import Registration, register
from patchproof.photo.rejection import PhotoRejected
from patchproof.photo.unroll import LocatedSheet, flat_sheet, unroll

if TYPE_CHECKING:
    from patchproof.channel.lens import Camera

MOST_SHIFT = 0.005  # of the design's shorter side: offset of its own pixels from where the markers put them
_LEAST_CELLS = 3
_TANGENT_MM = 5.0  # of paper round the middle that stands for a plane
_SHIFT_PERCENTILE = 80  # of the cells; gloss, a shadow's edge or a thumb may lie over the others
_SURE_SIGMAS = 2.0
# of a cell: up to 1.2 where another printer's colors displace a smooth design's corners, 0.3 for designs with detail
_OFFSET_SIGMAS, _LEAST_OFFSET_CELLS = 1.25, 9
_OUTLIER_FACTOR = 2.0  # the design's corner beside an outlier marker may lie off by more than the marker
# 95 % errors beyond which a figure is "not measured": the azimuth's (beyond some 10° a view from the left cannot be
# told from one from the right) beside what an unconfirmed focal length adds, and the distance's
MOST_AZIMUTH_ERROR_DEG, MOST_DISTANCE_ERROR = 10.0, 0.2
FOCAL_ERROR = 0.005  # relative, 95 %, of a camera file


@dataclass(frozen=True)
class PinholePhoto:
    """A photograph uint8 H×W×3 without lens distortion, its camera matrix (None: unknown), whether a camera file gave
    it, the standard deviation of the focal length's logarithm, whether EXIF's focal length is of an uncropped file, and
    how many pixels of the file one is in both directions.
    """

    srgb: np.ndarray
    matrix_px: np.ndarray | None
    calibrated: bool
    focal_spread: float = EXIF_SPREAD
    cropped: bool = False
    step: int = 1


def pinhole_photo(photo: Photo, camera: "Camera | None") -> PinholePhoto:
    """Remove the distortion by the camera file; use EXIF if there is no file, or if it is of another picture size."""
    height, width = photo.srgb.shape[:2]
    if camera is not None and width != height:
        for candidate in (camera, _turn_clockwise(camera)):
            if candidate.fits((width, height)):
                matrix = candidate.matrix_px((width, height))
                srgb = _undistort(photo.srgb, candidate, matrix)
                return PinholePhoto(srgb, matrix, True, FOCAL_ERROR / 1.96, step=photo.step)
    focal = photo.focal_px
    matrix = None if focal is None else np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return PinholePhoto(photo.srgb, matrix, False, photo.focal_spread, photo.focal_rejected, photo.step)


def _turn_clockwise(camera: "Camera") -> "Camera":
    """Turn a camera's pictures by 90° clockwise: (x, y) becomes (height - y, x)."""
    (width, height), cx, cy = camera.image_px, camera.cx, camera.cy
    turned = camera.changed(image_px=(height, width), fx=camera.fy, fy=camera.fx, cx=height - cy, cy=cx)
    return turned.changed(p1=camera.p2, p2=-camera.p1)


def _undistort(srgb: np.ndarray, camera: "Camera", matrix: np.ndarray) -> np.ndarray:
    if not camera.has_distortion:
        return srgb
    index = matrix.copy()
    index[:2, 2] -= 0.5  # OpenCV counts from pixel centers
    terms = np.array([camera.k1, camera.k2, camera.p1, camera.p2, camera.k3])
    picture = np.empty_like(srgb)
    for rows in row_strips(srgb):  # maps take 8 bytes a pixel: in strips they stay small
        strip, strip_matrix = picture[rows], index - np.array([[0, 0, 0], [0, 0, rows.start], [0, 0, 0]])
        size_px = strip.shape[1], strip.shape[0]
        maps = cv2.initUndistortRectifyMap(index, terms, None, strip_matrix, size_px, cv2.CV_32FC1)
        cv2.remap(srgb, *maps, cv2.INTER_CUBIC, strip, cv2.BORDER_REPLICATE)
    return picture


def locate_sheet(view: PinholePhoto, detected: MarkersInView, surface: Surface) -> LocatedSheet | None:
    """Locate the sheet by its markers; None if they fit no plane, cylinder or lens."""
    fit = _fit(detected, surface)
    return fit and (_unroll_piece(view, detected, surface) or flat_sheet(view.srgb, fit, surface.rect_mm))


def _fit(detected: MarkersInView, surface: Surface) -> PageFit | None:
    """Fit the piece's homography, with the page's markers if in its plane; only the piece's count as outliers."""
    corners = {i: b.corners_px for i, b in detected.markers.items() if b.fitted} or detected.corners_px
    on_piece = {i: c for i, c in corners.items() if i in surface.piece_ids}
    try:
        fit = fit_page(on_piece or corners, surface.corners_mm)
        if on_piece and len(on_piece) < len(corners):
            together = fit_page(corners, surface.corners_mm)
            # a page that does not lie in the plane of its piece would distort the fit
            if set(on_piece) <= set(together.inlier_ids):
                fit = replace(together, outlier_mm=0.0)
        if not on_piece:
            fit = replace(fit, outlier_mm=0.0)
    except (np.linalg.LinAlgError, PhotoRejected):
        return None
    return fit if np.isfinite(fit.px_from_mm).all() and np.isfinite(fit.covariance).all() else None


def _unroll_piece(view: PinholePhoto, detected: MarkersInView, surface: Surface) -> LocatedSheet | None:
    """Flatten the piece, if its markers lie in no plane but fit a cylinder or a lens; else None."""
    corners = {i: b.corners_px for i, b in detected.markers.items() if b.fitted and i in surface.piece_ids}
    focal = () if view.matrix_px is None else (float(view.matrix_px[0, 0]), view.focal_spread)
    try:
        return unroll(view.srgb, corners, surface.corners_mm, surface.rect_mm, *focal)
    except (np.linalg.LinAlgError, ValueError):
        return None  # the shape cannot be seen by any camera; the plane's residual decides


def object_box(view: PinholePhoto, location: LocatedSheet, surface: Surface) -> BoxEdges | None:
    """Project the object's extent by the tangent plane in the design's middle; shares of the centered square. None if
    the sheet has no extent, or no camera sees the plane so. An unknown focal length is taken from the promised views.
    """
    if surface.outermost_mm is None:
        return None
    size_px = view.srgb.shape[1], view.srgb.shape[0]
    matrix = intrinsics(surface.fov_deg, size_px) if view.matrix_px is None else view.matrix_px
    around = np.array(surface.center_mm) + _TANGENT_MM * (rect_corners((-1, -1, 2, 2)))
    try:
        pose = plane_pose(fit_homography(around, location.shape.px(around)), matrix)
    except (np.linalg.LinAlgError, ValueError):
        return None
    side, left, top = min(size_px), *((size - min(size_px)) / 2 for size in size_px)
    to_square = np.array([[1, 0, -left], [0, 1, -top], [0, 0, 1.0]])
    box = project_box(surface.outermost_mm, pose, to_square @ matrix, (side, side)) / side
    return None if not np.isfinite(box).all() or not box.any() else (*box.tolist(),)


def geometry_of(
    view: PinholePhoto,
    location: LocatedSheet,
    detected: MarkersInView,
    light: FrameLight,
    blur: float,
    surface: Surface,
    colors: PromisedColors | None,
) -> tuple[Geometry, int, tuple[float, int]]:
    """Measure the sheet's geometry; count the corners of the design in which its pixels were found, four if that is
    unknown; and give the share found of the cells with detail between the markers, with their number.
    """
    fit, shape, unrolled = location.fit, location.shape, location.unrolled
    px_per_mm, tilt_deg = sheet_pose.scale_and_tilt(shape, surface.center_mm)
    shift, corners, found = None, 4, (1.0, 0)
    uncertainty = float(np.hypot(location.uncertainty_mm, _OUTLIER_FACTOR * fit.outlier_mm))
    # one page of a piece in tiles has none of the piece's markers, or some of them
    if colors is not None and surface.is_piece:
        cells = register(location.srgb, fit.px_from_mm, surface.rect_mm, colors.design, px_per_mm, blur)
        shift, corners, corner_shift = _shifts(cells, _absent_markers(view, location, detected, surface), surface)
        free = ~surface.on_marker(cells.middle_mm, cells.size_mm / 2)
        found = float(np.isfinite(cells.sigma_mm[free]).mean()) if free.any() else 1.0, int(free.sum())
        offset = _offset_mm(cells, free, surface)
        uncertainty = float(np.linalg.norm([uncertainty, _SURE_SIGMAS * corner_shift, offset]))
        shift = None if shift is None else max(shift, offset)
    middle, turn = surface.center_mm, _turn_rad(location, surface)
    distortion = None if unrolled else sheet_pose.distortion_of(fit, view.matrix_px, view.focal_spread)
    geometry = Geometry(
        residual_mm=fit.residual_mm,
        px_per_mm=px_per_mm,
        tilt_deg=tilt_deg,
        tilt_uncertainty_deg=sheet_pose.tilt_uncertainty_deg(shape, middle, turn, distortion),
        contrast=light.contrast,
        blur_px=blur,
        corner_uncertainty_mm=uncertainty,
        curl_radius_mm=shape.radius_mm,
        bend_mm=fit.bend_mm,
        design_shift_mm=shift,
        # no homography maps a page that was unrolled to the photograph
        homography_px_from_mm=None if unrolled else fit.px_from_mm.tolist(),
    )
    return geometry, corners, found


def _turn_rad(location: LocatedSheet, surface: Surface) -> float:
    return sheet_pose.turn_rad(location.fit.bend_mm / min(surface.rect_mm[2:]), location.shape)


def _offset_mm(cells: Registration, free: np.ndarray, surface: Surface) -> float:
    """The shift of the farthest of the design's corners by an affine map of the cells `free`; 0 if it is not
    significant, `MOST_SHIFT` at most where cells are so smooth that a print's colors shift them, too.
    """
    most = MOST_SHIFT * min(surface.rect_mm[2:])
    free = free & (cells.sigma_mm < most)  # False where NaN
    if free.sum() < _LEAST_OFFSET_CELLS:
        return 0.0
    sigma, rows = cells.sigma_mm[free], np.column_stack([cells.middle_mm[free], np.ones(free.sum())])
    affine = np.linalg.lstsq(rows / sigma[:, None], cells.shift_mm[free] / sigma[:, None], rcond=None)[0]
    corners = np.column_stack([rect_corners(surface.rect_mm), np.ones(4)])
    offset, sigma = float(np.linalg.norm(corners @ affine, axis=1).max()), float(np.median(sigma))
    return 0.0 if offset < _OFFSET_SIGMAS * sigma else offset if sigma < most / 4 else min(offset, most)


def _absent_markers(
    view: PinholePhoto, location: LocatedSheet, detected: MarkersInView, surface: Surface
) -> dict[int, bool]:
    """The piece's markers that were not found, and whether each lies partly beyond the picture's edge. Left out are
    those whose cells show in their places, only too few pixels wide for their borders to be fitted.
    """
    absent: dict[int, bool] = {}
    for i in surface.piece_ids - detected.markers.keys():
        quad = location.shape.px(surface.corners_mm[i])
        if not shows_small_code(view.srgb, quad, i, surface.dictionary):
            absent[i] = not is_in_picture(quad, view.srgb)
    return absent


def _shifts(
    cells: Registration, absent_markers: Mapping[int, bool], surface: Surface
) -> tuple[float | None, int, float]:
    """The 80 % point of the cells' significant shifts in mm; the number of corners in which the design and a marker, if
    one belongs there, were found; the largest significant shift in a corner. Significant: over two standard deviations.
    The design alone is enough where the picture's edge cuts the marker; a marker is where the design has no detail.
    """
    shift = np.linalg.norm(cells.shift_mm, axis=1)
    significant = np.maximum(shift - _SURE_SIGMAS * cells.sigma_mm, 0)
    side = min(surface.rect_mm[2:])
    sure = cells.sigma_mm < MOST_SHIFT * side / 2  # False where NaN
    most_cells = float(np.percentile(significant[sure], _SHIFT_PERCENTILE)) if sure.sum() >= _LEAST_CELLS else None
    corners, largest = 0, 0.0
    for corner in rect_corners(surface.rect_mm):
        nearby = np.abs(cells.middle_mm - corner).max(1) < side / 8
        markers = [i for i in surface.piece_ids if np.abs(surface.corners_mm[i] - corner).max() < side / 4]
        is_found, absent = bool(np.isfinite(shift[nearby]).any()), [i for i in markers if i in absent_markers]
        if markers and len(absent) == len(markers):
            corners += is_found and all(absent_markers[i] for i in absent)
        else:
            corners += is_found or not nearby.any()
        largest = max(largest, float(significant[nearby & sure].max(initial=0)))
    return most_cells, corners, largest


def camera_pose(view: PinholePhoto, location: LocatedSheet, surface: Surface) -> tuple[CameraPose | None, FocalSource]:
    """Compute the camera's pose, None if its focal length is unknown or contradicted, and say where that is from."""
    if view.matrix_px is None:
        return None, "cropped" if view.cropped else "unknown"
    camera = view.matrix_px, view.focal_spread, surface.center_mm, _turn_rad(location, surface), view.calibrated
    stance = sheet_pose.bent_sheet_position(location.shape, *camera)
    # perspective cannot tell a stretched print from a wrong focal length: a camera file is trusted, EXIF is not
    if stance.focal_agrees is False and not view.calibrated:
        return None, "contradicted"
    angle, length = stance.azimuth_uncertainty_deg, stance.distance_uncertainty_mm
    far = length > MOST_DISTANCE_ERROR * stance.distance_mm
    unconfirmed = 0.0 if stance.focal_agrees or view.calibrated else sheet_pose.UNCONFIRMED_DEG
    pose = CameraPose(
        azimuth_uncertainty_deg=angle,
        azimuth_deg=stance.azimuth_deg if angle <= np.hypot(MOST_AZIMUTH_ERROR_DEG, unconfirmed) else None,
        distance_mm=None if far else stance.distance_mm,
        distance_uncertainty_mm=None if far else length,
    )
    return pose, "calibrated" if view.calibrated else "confirmed" if stance.focal_agrees else "unchecked"
