"""From marker corners to millimeters: the homography of a flat sheet, how sure it is, and the patch cut out flat.

In: corners in pixels and in page millimeters, by marker id. Out: `PageFit`. Least median of squares finds the corners
that agree (it breaks down when half of them lie), Gauss-Newton on the reprojection error of those gives the
homography and its covariance. Blur and sharpening make all markers of a photograph a little larger or smaller; that is
no noise, so where there are three or more, what their corners lie too far out on average is taken off first. The
uncertainty is the 95 % point of the *largest* of the design's corner errors, drawn from that covariance. Few corners
say little of their own noise, so what is made of it is wider (Student's t); a single marker fits any noise exactly, and
gets a wide guess. Paper that is no plane, motion and lenses turn, stretch and shear whole markers, which noise does no
more than it twists them: what exceeds the twist is no noise, and the design's corners miss several times as much.

Source: Hartley and Zisserman, Multiple View Geometry, 2nd ed., 4.2 (reprojection error), 5.2 (covariance).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.special import fdtri, stdtrit

from patchproof.base.geometry import apply_homography, fit_homography, normalize_homography, rect_corners
from patchproof.base.resample import index_homography
from patchproof.photo.rejection import PhotoRejected

# px per coordinate: what fitted corners of noisy JPEGs of flat pages still miss (measured 0.03 to 0.05)
CORNER_NOISE_PX = 0.045
UNSEEN_NOISE_PX = 0.2  # of one marker, whose residual is 0 whatever its noise: more than sharp photographs have
# What corners of the design miss where markers, beyond noise, miss 1: 2 to 4.5 on wavy, wobbly and folded paper
_BEND_GROWS = 3.0
_LEAST_CORNERS = 3  # of a marker's four that agree where it does
_LARGEST_PIXELS = 3000  # of one side of a finely sampled patch before it is averaged down


@dataclass(frozen=True)
class PageFit:
    """`px_from_mm` 3×3, the 8×8 covariance of its first entries, what the corners that agree miss, and their ids.

    `bend_mm` is the part of the residual that is no noise of the corners, `outlier_mm` what the worst of the markers misses
    that do not agree.
    """

    px_from_mm: np.ndarray
    covariance: np.ndarray
    residual_mm: float
    inlier_ids: tuple[int, ...]
    bend_mm: float = 0.0
    outlier_mm: float = 0.0


def fit_page(corners_px: Mapping[int, np.ndarray], corners_mm: Mapping[int, np.ndarray]) -> PageFit:
    """The homography page mm → photo px from all markers that both mappings know; raises `PhotoRejected` for none."""
    ids, px, mm = common_corners(corners_px, corners_mm)
    if not ids:
        raise PhotoRejected("too_few_markers", 0, 1, "no marker of this sheet is in view: show the whole patch")
    keep = _agreeing(mm, px) if len(ids) > 2 else np.ones(len(px), bool)
    homography = fit_homography(mm[keep], px[keep])
    for _ in range(3):
        homography = _gauss_newton(homography, mm[keep], px[keep])
        if len(ids) > 2:
            px = px - _swelling(homography, mm, px, keep)
            homography = _gauss_newton(homography, mm[keep], px[keep])
        error = np.linalg.norm(apply_homography(homography, mm) - px, axis=1)
        again = error < np.maximum(4 * np.sqrt(np.mean(error[keep] ** 2)), 0.5)
        if len(ids) < 3 or (again == keep).all():
            break
        keep = again
    inlier_ids = tuple(
        i for i, agreeing in zip(ids, keep.reshape(-1, 4).sum(1), strict=True) if agreeing >= _LEAST_CORNERS
    )
    return _with_figures(homography, mm, px, keep, inlier_ids)


def common_corners(
    corners_px: Mapping[int, np.ndarray], corners_mm: Mapping[int, np.ndarray]
) -> tuple[tuple[int, ...], np.ndarray, np.ndarray]:
    """(ids, px 4N×2, mm 4N×2) of the markers that both mappings know."""
    ids = tuple(sorted(corners_px.keys() & corners_mm.keys()))
    px, mm = (np.array([corners[i] for i in ids], float).reshape(-1, 2) for corners in (corners_px, corners_mm))
    return ids, px, mm


def corner_uncertainty_mm(fit: PageFit, rect_mm) -> float:
    """95 % point of the largest error among the rectangle's corners in page mm, from 1000 draws of the covariance."""
    corners = rect_corners(rect_mm)
    jacobian = _jacobian(fit.px_from_mm, corners)
    return largest_shift_mm(root_of(fit.covariance), jacobian.T, _mm_from_px(fit.px_from_mm, corners))


def largest_shift_mm(root: np.ndarray, px_by_parameter: np.ndarray, mm_from_px: np.ndarray) -> float:
    """95 % point of the largest error of C points, from 1000 draws of P parameters whose covariance is root · rootᵀ, by
    the derivatives P×2C and C×2×2.
    """
    # a fixed generator: the same photo must give the same bytes
    draws = np.random.default_rng(0).standard_normal((1000, len(root))) @ root.T
    shift_mm = np.einsum("cij,ncj->nci", mm_from_px, (draws @ px_by_parameter).reshape(len(draws), -1, 2))
    return float(np.percentile(np.linalg.norm(shift_mm, axis=2).max(1), 95))


def covariance_of(jacobian: np.ndarray, noise_px: float, rcond: float = 1e-15) -> np.ndarray:
    """P×P of least-squares parameters by their Jacobian N×P of pixels; columns are scaled before inverting."""
    scale = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-12)
    inverse = np.linalg.pinv(jacobian / scale, rcond=rcond)
    return noise_px**2 * (inverse @ inverse.T) / np.outer(scale, scale)


def rectify(pixels: np.ndarray, px_from_mm: np.ndarray, rect_mm, px_per_mm: float) -> np.ndarray:
    """The rectangle as seen from straight above at `px_per_mm`, averaged over area, so that nothing turns into moiré.

    `pixels` is H×W×C, uint8 or float32 (pass linear light to measure); outside of the photo its rim is repeated.
    """
    size = rectified_px(rect_mm, px_per_mm)
    return resize_by_area(oversample_flat(pixels, px_from_mm, rect_mm, size), size)


def rectified_px(rect_mm, px_per_mm: float) -> tuple[int, int]:
    """Width and height of a rectangle at `px_per_mm`."""
    return max(1, round(rect_mm[2] * px_per_mm)), max(1, round(rect_mm[3] * px_per_mm))


def oversample_flat(pixels: np.ndarray, px_from_mm: np.ndarray, rect_mm, size: tuple[int, int]) -> np.ndarray:
    """The rectangle as seen from straight above, so many times as wide and high as `size` that samples are as dense as
    the photograph's own pixels.
    """
    x, y, width_mm, height_mm = rect_mm
    finest = max(np.linalg.norm(np.linalg.inv(j), 2) for j in _mm_from_px(px_from_mm, rect_corners(rect_mm)))
    fine = max(1, int(np.ceil(finest * width_mm / size[0])))
    fine = max(1, min(fine, _LARGEST_PIXELS // max(size)))
    grid = size[0] * fine, size[1] * fine
    part, px_from_mm = crop_around(pixels, px_from_mm, rect_corners(rect_mm), 2)
    step_x, step_y = width_mm / grid[0], height_mm / grid[1]
    index_from_grid = index_homography(px_from_mm @ np.array([[step_x, 0, x], [0, step_y, y], [0, 0, 1]]))
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpPerspective(part, index_from_grid, grid, None, flags, cv2.BORDER_REPLICATE)


def resize_by_area(pixels: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Means over area at a width and height; between pixels where these are larger."""
    if pixels.shape[1::-1] == size:
        return pixels
    way = cv2.INTER_AREA if size[0] <= pixels.shape[1] else cv2.INTER_LINEAR
    return cv2.resize(pixels, size, interpolation=way)


def least_px_per_mm(px_from_mm: np.ndarray, rect_mm) -> float:
    """How many pixels a millimeter has at the rectangle's corner, and in the direction, where it has fewest."""
    return float(1 / max(np.linalg.norm(j, 2) for j in _mm_from_px(px_from_mm, rect_corners(rect_mm))))


def crop_around(pixels: np.ndarray, px_from_mm: np.ndarray, points_mm, margin_px: int) -> tuple[np.ndarray, np.ndarray]:
    """The part of a photo that shows the page's points N×2 and a margin about them, and the homography to it."""
    rows, columns = region_around(apply_homography(px_from_mm, points_mm), margin_px, pixels.shape[:2])
    shift = np.array([[1, 0, -columns.start], [0, 1, -rows.start], [0, 0, 1.0]])
    return np.ascontiguousarray(pixels[rows, columns]), shift @ px_from_mm


def region_around(points_px: np.ndarray, margin_px: float, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Rows and columns of a picture H×W that hold points N×2 (x, y) and a margin about them; at least a pixel."""
    limit = np.array([shape[1], shape[0]])
    low = np.clip(np.floor(points_px.min(0) - margin_px).astype(int), 0, limit - 1)
    high = np.clip(np.ceil(points_px.max(0) + margin_px).astype(int), low + 1, limit)
    return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))


def _agreeing(mm, px) -> np.ndarray:
    """Corners that follow the homography which most of them share."""
    homography, _ = cv2.findHomography(mm, px, cv2.LMEDS)
    if homography is None:
        return np.ones(len(px), bool)
    error = np.linalg.norm(apply_homography(homography, mm) - px, axis=1)
    sigma = 1.4826 * np.median(error)
    keep = error < max(4 * sigma, 0.5)  # half a pixel: never throw out corners for being merely unlucky
    return keep if keep.sum() >= 8 else np.ones(len(px), bool)


def _swelling(homography, mm, px, keep) -> np.ndarray:
    """N×2: how far all markers' corners, four by four, lie outwards of the homography, their borders moved alike."""
    quads = apply_homography(homography, mm).reshape(-1, 4, 2)
    along = np.roll(quads, -1, 1) - quads
    along /= np.maximum(np.linalg.norm(along, axis=2, keepdims=True), 1e-9)
    after = np.stack([along[..., 1], -along[..., 0]], 2)  # a clockwise quad's normals outwards, y down
    before = np.roll(after, 1, 1)
    outward = (after + before) / np.maximum(1 + (after * before).sum(2, keepdims=True), 0.1)
    outward = outward.reshape(-1, 2)
    residual = ((px - quads.reshape(-1, 2)) * outward).sum(1)
    return outward * (residual[keep].sum() / (outward[keep] ** 2).sum())


def _gauss_newton(homography, mm, px) -> np.ndarray:
    """Homography of least squared reprojection error; four corners are met exactly."""
    for _ in range(10):
        residual = (px - apply_homography(homography, mm)).ravel()
        jacobian = _jacobian(homography, mm)
        scale = np.linalg.norm(jacobian, axis=0)
        step = np.linalg.lstsq(jacobian / scale, residual, rcond=None)[0] / scale
        homography = homography + np.append(step, 0).reshape(3, 3)
        if np.abs(jacobian @ step).max() < 1e-7:
            break
    return normalize_homography(homography)


def _jacobian(homography, mm) -> np.ndarray:
    """2N×8: pixels by the first eight entries of a homography whose last is 1."""
    ones = np.column_stack([mm, np.ones(len(mm))])
    u, v, w = (ones @ homography.T).T
    zeros = np.zeros_like(ones)
    by_x = np.hstack([ones, zeros, -(u / w)[:, None] * mm]) / w[:, None]
    by_y = np.hstack([zeros, ones, -(v / w)[:, None] * mm]) / w[:, None]
    return np.stack([by_x, by_y], 1).reshape(-1, 8)


def _mm_from_px(homography, mm) -> np.ndarray:
    """N×2×2 derivatives of page millimeters by photo pixels at page points."""
    u, v, w = (np.column_stack([mm, np.ones(len(mm))]) @ homography.T).T
    px = np.stack([u / w, v / w], 1)
    return np.linalg.inv((homography[:2, :2] - px[:, :, None] * homography[2, :2]) / w[:, None, None])


def _with_figures(homography, mm, px, keep, ids) -> PageFit:
    every = px - apply_homography(homography, mm)
    residual, noise, bend = every[keep], UNSEEN_NOISE_PX, 0.0
    freedom = residual.size - (9 if len(ids) > 2 else 8)
    if freedom > 0:
        whole = every.reshape(-1, 4, 2)[keep.reshape(-1, 4).all(1)]
        noise, bend = noise_and_bend(residual, whole, freedom)
    covariance = covariance_of(_jacobian(homography, mm[keep]), noise)
    length = rms_length_mm(_mm_from_px(homography, mm[keep]), residual)
    odd = keep.reshape(-1, 4).sum(1) < _LEAST_CORNERS
    misses = [
        rms_length_mm(_mm_from_px(homography, at), off)
        for at, off in zip(mm.reshape(-1, 4, 2)[odd], every.reshape(-1, 4, 2)[odd], strict=True)
    ]
    return PageFit(homography, covariance, length, ids, bend_mm(bend, residual, length), max(misses, default=0.0))


def noise_and_bend(
    residual: np.ndarray, markers: np.ndarray, freedom: int, floor_px: float = CORNER_NOISE_PX
) -> tuple[float, float]:
    """(px per coordinate to state uncertainties from, the part of px that is no noise) of residuals N×2 and M×4×2.

    The alternating sum of a marker's corners, its twist, is what smooth shifts leave alone and noise does not; without
    three whole markers to read it from, all that exceeds sharp corners' noise counts as no noise.
    """
    square = float((residual**2).sum()) / freedom
    noise = max(floor_px, np.sqrt(square) * stdtrit(freedom, 0.975) / stdtrit(np.inf, 0.975))
    if len(residual) < 12:  # of two markers a homography leaves little but noise
        return float(noise), 0.0
    chance = floor_px**2
    if len(markers) > 2:
        twist = np.einsum("mki,k->mi", markers, [0.5, -0.5, 0.5, -0.5])
        chance = fdtri(freedom, twist.size, 0.9) * max(chance, float(np.mean(twist**2)))
    bend = max(0.0, square - chance)
    return float(np.sqrt(noise**2 + _BEND_GROWS**2 * bend)), float(np.sqrt(bend))


def bend_mm(bend_px: float, residual_px: np.ndarray, residual_mm: float) -> float:
    """The part in px per coordinate of a residual N×2 as a length, as the residual's own is `residual_mm`."""
    return residual_mm * bend_px / max(float(np.sqrt(np.mean(residual_px**2))), 1e-9)


def rms_length_mm(mm_from_px: np.ndarray, residual_px: np.ndarray) -> float:
    """Of residuals N×2 px in millimeters, by the derivatives N×2×2."""
    lengths = np.linalg.norm(np.einsum("nij,nj->ni", mm_from_px, residual_px), axis=1)
    return float(np.sqrt(np.mean(lengths**2)))


def root_of(covariance: np.ndarray) -> np.ndarray:
    """A matrix R with R Rᵀ = covariance, also where that is singular."""
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.maximum(values, 0))
