"""Sheets that are no plane in the photograph: curled paper is unrolled, a lens's bending taken out, where that pays.

In: marker corners in pixels and page millimeters, and the flat fit's word that they do not agree. Out: `UnrolledSheet`: a
picture in which the sheet is flat, with its homography, so that whatever measures flat sheets measures this one. Two
explanations are tried against the plane: paper rolled round a cylinder of any radius and direction, seen by a pinhole
camera (nine parameters, the focal length held as near the file's own as that is known), and a plane seen through a lens
with one radial term. One is believed where it leaves less than half of the plane's residual; what it leaves that is no
noise is still refused as `curled` where it matters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from patchproof.base.geometry import apply_homography, fit_homography, rect_corners
from patchproof.photo.detect import row_strips
from patchproof.photo.edges import GRID, REACH, border_frame, intersect_borders
from patchproof.photo.rectify import (
    CORNER_NOISE_PX,
    PageFit,
    bend_mm,
    common_corners,
    largest_shift_mm,
    region_around,
    rms_length_mm,
    root_of,
)
from patchproof.photo.shapes import UNKNOWN_FOCAL, Shape, fit_cylinder, fit_radial_lens, rms

FLAT_PX = 0.15  # rms per coordinate up to which a plane needs no better explanation: three times the corners' own noise
PAYS = 0.5  # of the plane's residual
LEAST_MARKERS = 4
_MENDED = 0.3  # of what is mended where straight lines were fitted to bent borders may still be wrong


@dataclass(frozen=True)
class UnrolledSheet:
    """`srgb` shows the sheet flat, `fit` is its homography there, `shape` what any page point is there."""

    srgb: np.ndarray
    fit: PageFit
    uncertainty_mm: float
    shape: Shape

    @property
    def radius_mm(self) -> float | None:
        """The shape's."""
        return self.shape.radius_mm


@dataclass(frozen=True)
class Explained:
    """What a better explanation than a plane was found from, corners mended, and the explanation."""

    flat: np.ndarray  # 3×3 homography of the corners as they were
    mm: np.ndarray
    px: np.ndarray
    shape: Shape


def fit_shape(
    corners_px: Mapping[int, np.ndarray],
    corners_mm: Mapping[int, np.ndarray],
    size_px: tuple[int, int],
    focal_px: float | None = None,
    focal_spread: float = UNKNOWN_FOCAL,
) -> Explained | None:
    """A cylinder or a lens that explains the corners in a picture of this size; None where a plane does as well."""
    ids, px, mm = common_corners(corners_px, corners_mm)
    if len(ids) < LEAST_MARKERS:
        return None
    flat = fit_homography(mm, px)
    plain = rms(apply_homography(flat, mm) - px)
    if not plain > FLAT_PX:
        return None
    best = _best(flat, mm, px, size_px, focal_px, focal_spread)
    if best.rms_px > PAYS * plain:
        return None
    # the borders were fitted as straight lines, which on strongly bent paper misses the corners where they meet
    shift = _chord_shift(best, mm)
    px, floor = px - shift, float(np.hypot(CORNER_NOISE_PX, _MENDED * rms(shift)))
    return Explained(flat, mm, px, _best(flat, mm, px, size_px, focal_px, focal_spread, floor))


def unroll(
    srgb: np.ndarray,
    corners_px: Mapping[int, np.ndarray],
    corners_mm: Mapping[int, np.ndarray],
    rect_mm,
    focal_px: float | None = None,
    focal_spread: float = UNKNOWN_FOCAL,
) -> UnrolledSheet | None:
    """The piece (a rectangle x, y, width, height on the page) made flat; None where a plane explains it as well.

    The uncertainty is that of its corners; the focal length is known to `focal_spread` of its logarithm.
    """
    explained = fit_shape(corners_px, corners_mm, (srgb.shape[1], srgb.shape[0]), focal_px, focal_spread)
    if explained is None:
        return None
    flat, mm, px, best = explained.flat, explained.mm, explained.px, explained.shape
    grid = rect_mm[:2] + np.multiply(rect_mm[2:], GRID)
    straight = fit_homography(grid, best.px(grid))
    error = np.linalg.norm(apply_homography(flat, mm) - px, axis=1).max()  # what is moved lies this near, about
    picture = _straightened(srgb, best.px, straight, rect_mm, margin_px=error)
    # the covariance of the homography alone says nothing about the bend: `uncertainty_mm` has it all
    ids = common_corners(corners_px, corners_mm)[0]
    left = best.px(mm) - px
    length = rms_length_mm(_mm_from_px(best.px, mm), left)
    fit = PageFit(straight, np.zeros((8, 8)), length, ids, bend_mm(best.bend_px, left, length))
    return UnrolledSheet(picture, fit, _uncertainty_mm(best, rect_corners(rect_mm)), best)


def _best(flat, mm, px, size, focal_px, focal_spread, floor_px=CORNER_NOISE_PX) -> Shape:
    """The explanation that leaves least."""
    paper = fit_cylinder(flat, mm, px, size, focal_px, focal_spread, floor_px)
    lens = fit_radial_lens(flat, mm, px, size)
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
    return (intersect_borders(*ends) - corners).reshape(-1, 2)


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
    rows, columns = region_around(apply_homography(px_from_mm, rect_corners(sheet_mm)), margin_px, srgb.shape)
    left, top, width, height = sheet_mm
    picture = srgb.copy()
    for strip in row_strips(srgb[rows]):  # of all of a large picture the coordinates would take gigabytes
        box = slice(rows.start + strip.start, min(rows.start + strip.stop, rows.stop)), columns
        y, x = np.mgrid[box] + 0.5
        mm = apply_homography(np.linalg.inv(px_from_mm), np.column_stack([x.ravel(), y.ravel()]))
        on_sheet = ((mm >= [left, top]) & (mm <= [left + width, top + height])).all(1)
        where = on_sheet.reshape(x.shape)
        source = np.full((*x.shape, 2), -1, np.float32)
        source[where] = project(mm[on_sheet]) - 0.5
        part = cv2.remap(srgb, source[..., 0], source[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        picture[box][where] = part[where]
    return picture
