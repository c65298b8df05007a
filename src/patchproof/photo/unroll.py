"""Flatten curled paper or a lens's distortion in a photograph, if that explains the markers better than a plane.

In: marker corners in pixels and page millimeters that fit no plane. Out: `UnrolledSheet`: a picture in which the sheet
is flat, with its homography, so that it can be measured like flat sheets. Two models are compared with the plane: paper
on a cylinder of any radius and direction, seen by a pinhole camera (nine parameters, the focal length held near the
file's within its uncertainty), and a plane seen through a lens with one radial term. A model is accepted if its
residual is less than half of the plane's; a photograph with too much residual beyond noise is still rejected as
`curled`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from patchproof.base.geometry import apply_homography, fit_homography, rect_corners
from patchproof.photo import rectify
from patchproof.photo.detect import row_strips
from patchproof.photo.edges import BORDER_SHARE, RECT_GRID, border_frame, intersect_borders
from patchproof.photo.rectify import CORNER_NOISE_PX, PageFit, Quads
from patchproof.photo.shapes import UNKNOWN_FOCAL, Shape, fit_cylinder, fit_radial_lens, rms

MAX_FLAT_RMS_PX = 0.15  # per coordinate, up to which a sheet counts as flat: three times the corners' noise
MAX_RESIDUAL_SHARE = 0.5  # of the plane's residual, for a model to be accepted
LEAST_MARKERS = 4
_CORRECTION_ERROR = 0.3  # of the correction for bent borders that were fitted as straight lines


@dataclass(frozen=True)
class UnrolledSheet:
    """A photograph `srgb` with the sheet flattened, the sheet's homography `fit` in it, and the original `shape`."""

    srgb: np.ndarray
    fit: PageFit
    uncertainty_mm: float
    shape: Shape


@dataclass(frozen=True)
class ShapeFit:
    """A shape and the corners that it was fitted to."""

    flat: np.ndarray  # 3×3 homography of the uncorrected corners
    mm: np.ndarray
    px: np.ndarray  # corrected for bent borders
    shape: Shape


def fit_shape(
    corners_px: Quads,
    corners_mm: Quads,
    size_px: tuple[int, int],
    focal_px: float | None = None,
    focal_spread: float = UNKNOWN_FOCAL,
) -> ShapeFit | None:
    """Fit a cylinder or a lens to the corners in a picture of this size; None if a plane fits as well."""
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
    return ShapeFit(flat, mm, px, _best_shape(flat, mm, px, size_px, focal_px, focal_spread, floor))


def unroll(
    srgb: np.ndarray,
    corners_px: Quads,
    corners_mm: Quads,
    rect_mm,
    focal_px: float | None = None,
    focal_spread: float = UNKNOWN_FOCAL,
) -> UnrolledSheet | None:
    """Flatten the piece (a rectangle x, y, width, height on the page) in the photograph; None if a plane fits as well.

    The uncertainty is that of the piece's corners; `focal_spread` is the spread of the focal length's logarithm.
    """
    shape_fit = fit_shape(corners_px, corners_mm, (srgb.shape[1], srgb.shape[0]), focal_px, focal_spread)
    if shape_fit is None:
        return None
    flat, mm, px, shape = shape_fit.flat, shape_fit.mm, shape_fit.px, shape_fit.shape
    grid = rect_mm[:2] + np.multiply(rect_mm[2:], RECT_GRID)
    px_from_mm = fit_homography(grid, shape.px(grid))
    margin = np.linalg.norm(apply_homography(flat, mm) - px, axis=1).max()  # pixels move about that far
    picture = _flatten(srgb, shape.px, px_from_mm, rect_mm, margin_px=margin)
    # the homography's covariance would not cover the bend, so it is 0 and `uncertainty_mm` covers everything
    ids = rectify.common_corners(corners_px, corners_mm)[0]
    residual = shape.px(mm) - px
    length = rectify.rms_length_mm(_mm_by_px(shape.px, mm), residual)
    fit = PageFit(px_from_mm, np.zeros((8, 8)), length, ids, rectify.bend_mm(shape.bend_px, residual, length))
    return UnrolledSheet(picture, fit, _uncertainty_mm(shape, rect_corners(rect_mm)), shape)


def _best_shape(flat, mm, px, size, focal_px, focal_spread, floor_px=CORNER_NOISE_PX) -> Shape:
    """The shape with the smaller residual."""
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
    steps = 0.05 * np.eye(2)
    columns = [(project(mm + step) - project(mm - step)) / 0.1 for step in steps]
    return np.linalg.inv(np.stack(columns, -1))


def _flatten(srgb, project, px_from_mm, rect_mm, margin_px: float) -> np.ndarray:
    """The photograph with the rectangle of the page resampled as if the sheet were flat."""
    rows, columns = rectify.region_around(apply_homography(px_from_mm, rect_corners(rect_mm)), margin_px, srgb.shape)
    left, top, width, height = rect_mm
    picture = srgb.copy()
    for strip in row_strips(srgb[rows]):  # in strips, because coordinates of a whole large picture take gigabytes
        region = slice(rows.start + strip.start, min(rows.start + strip.stop, rows.stop)), columns
        y, x = np.mgrid[region] + 0.5
        mm = apply_homography(np.linalg.inv(px_from_mm), np.column_stack([x.ravel(), y.ravel()]))
        inside = ((mm >= [left, top]) & (mm <= [left + width, top + height])).all(1)
        mask = inside.reshape(x.shape)
        source = np.full((*x.shape, 2), -1, np.float32)
        source[mask] = project(mm[inside]) - 0.5
        part = cv2.remap(srgb, source[..., 0], source[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        picture[region][mask] = part[mask]
    return picture
