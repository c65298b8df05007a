"""Fit the homography of a flat sheet to marker corners, with its uncertainty, and rectify parts of the page.

In: corners in pixels and in page millimeters, by marker id. Out: `PageFit`. Least median of squares finds the corners
that agree (it breaks down if half of them are wrong); Gauss-Newton on the reprojection error gives the homography and
its covariance. Blur and sharpening make all markers of a photograph a little larger or smaller: with three markers or
more, their corners' mean outward shift is subtracted first. The uncertainty is the 95 % point of the *largest* of the
design's corner errors, drawn from that covariance. It is wider with few corners (Student's t); the noise of a single
marker, which fits exactly, is assumed to be large. Curved paper, motion and lenses rotate, stretch and shear whole
markers; noise twists them as well. Deformation beyond the noise that the twist shows is called bend, and the design's
corners miss by several times as much.

Source: Hartley and Zisserman, Multiple View Geometry, 2nd ed., 4.2 (reprojection error), 5.2 (covariance).
"""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.special import fdtri, stdtrit

from patchproof.base.geometry import apply_homography, fit_homography, normalize_homography, rect_corners
from patchproof.base.resample import index_homography
from patchproof.photo.rejection import PhotoRejected

Quads = Mapping[int, np.ndarray]  # corners 4×2 by marker id
CORNER_NOISE_PX = 0.045  # per coordinate, of fitted corners in noisy JPEGs of flat pages (measured 0.03 to 0.05)
UNSEEN_NOISE_PX = 0.2  # assumed for one marker, whose residual is always 0: more than sharp photographs have
_BEND_FACTOR = 3.0  # error of the design's corners per bend of markers: 2 to 4.5 on wavy, wobbly and folded paper
_LEAST_CORNERS = 3  # inlier corners of an inlier marker
_CHANCE_PX = 0.5  # a corner's error up to which it may be chance
_ROUNDS = 6  # of weights
_MAX_SIDE_PX = 3000  # of an oversampled patch before it is averaged down


@dataclass(frozen=True)
class PageFit:
    """The homography `px_from_mm` 3×3 of a page, fitted to markers."""

    px_from_mm: np.ndarray
    covariance: np.ndarray  # 8×8, of the homography's first entries
    residual_mm: float  # rms over the inlier corners
    inlier_ids: tuple[int, ...]
    bend_mm: float = 0.0  # the part of the residual that is no noise of the corners
    outlier_mm: float = 0.0  # rms of the worst outlier marker


def fit_page(corners_px: Quads, corners_mm: Quads) -> PageFit:
    """Fit the homography page mm → photo px to all markers in both mappings; raises `PhotoRejected` without any."""
    ids, px, mm = common_corners(corners_px, corners_mm)
    if not ids:
        raise PhotoRejected("too_few_markers", 0, 1, "no marker of this sheet is in view: show the whole patch")
    inlier = _find_inliers(mm, px) if len(ids) > 2 else np.ones(len(px), bool)
    homography = fit_homography(mm[inlier], px[inlier])
    for _ in range(3):
        homography = _gauss_newton(homography, mm[inlier], px[inlier])
        if len(ids) > 2:
            px = px - _outward_shift(homography, mm, px, inlier)
            homography = _gauss_newton(homography, mm[inlier], px[inlier])
        error = np.linalg.norm(apply_homography(homography, mm) - px, axis=1)
        new_inlier = error < max(4 * np.sqrt(np.mean(error[inlier] ** 2)), _CHANCE_PX)
        if len(ids) < 3 or (new_inlier == inlier).all():
            break
        inlier = new_inlier
    counts = inlier.reshape(-1, 4).sum(1)
    inlier_ids = tuple(i for i, count in zip(ids, counts, strict=True) if count >= _LEAST_CORNERS)
    return _page_fit(homography, mm, px, inlier, inlier_ids)


def fit_points(mm: np.ndarray, px: np.ndarray, sigma_px: np.ndarray, start: np.ndarray | None = None) -> PageFit:
    """Fit the homography mm → px to N ≥ 4 points N×2, beginning at `start` if given; `sigma_px` N are standard
    deviations of a coordinate. Of more than four points, those off by more than three deviations lose weight.
    """
    homography, weight = fit_homography(mm, px) if start is None else start, np.ones(len(mm))
    root = np.repeat(1 / sigma_px, 2)
    for _ in range(_ROUNDS if len(mm) > 4 else 1):
        off = np.linalg.norm(px - apply_homography(homography, mm), axis=1) / sigma_px
        weight = np.minimum(1, (3 * max(1.0, float(np.median(off))) / np.maximum(off, 1e-9)) ** 2)
        root = np.repeat(np.sqrt(weight) / sigma_px, 2)
        homography = _gauss_newton(homography, mm, px, root, 3)
    residual = px - apply_homography(homography, mm)
    spread = float(np.sqrt(np.sum((residual.ravel() * root) ** 2) / max(2 * len(mm) - 8, 1)))
    covariance = covariance_of(homography_jacobian(homography, mm) * root[:, None], max(1.0, spread))
    # a corner that was named wrongly says nothing of the paper, a vague point little
    share = np.where(weight == weight.max(), 1 / sigma_px, 0.0)
    residual = residual * (share / np.sqrt(np.mean(share**2)))[:, None]
    return PageFit(homography, covariance, rms_length_mm(_mm_by_px(homography, mm), residual), ())


def common_corners(corners_px: Quads, corners_mm: Quads) -> tuple[tuple[int, ...], np.ndarray, np.ndarray]:
    """(ids, px 4N×2, mm 4N×2) of the markers in both mappings."""
    ids = tuple(sorted(corners_px.keys() & corners_mm.keys()))
    px, mm = (np.array([corners[i] for i in ids], float).reshape(-1, 2) for corners in (corners_px, corners_mm))
    return ids, px, mm


def corner_uncertainty_mm(fit: PageFit, rect_mm) -> float:
    """The 95 % point of the largest error among the rectangle's corners, in page mm, by the fit's covariance."""
    corners = rect_corners(rect_mm)
    jacobian = homography_jacobian(fit.px_from_mm, corners)
    return largest_shift_mm(root_of(fit.covariance), jacobian.T, _mm_by_px(fit.px_from_mm, corners))


def largest_shift_mm(root: np.ndarray, px_by_parameter: np.ndarray, mm_by_px: np.ndarray) -> float:
    """The 95 % point of the largest error of C points, in 1000 draws of P parameters with covariance root · rootᵀ.
    `px_by_parameter` P×2C and `mm_by_px` C×2×2 are derivatives.
    """
    # a fixed generator: the same photo must give the same bytes
    draws = np.random.default_rng(0).standard_normal((1000, len(root))) @ root.T
    shift_mm = np.einsum("cij,ncj->nci", mm_by_px, (draws @ px_by_parameter).reshape(len(draws), -1, 2))
    return float(np.percentile(np.linalg.norm(shift_mm, axis=2).max(1), 95))


def covariance_of(jacobian: np.ndarray, noise_px: float, rcond: float = 1e-15) -> np.ndarray:
    """Covariance P×P of least-squares parameters, by the pixels' Jacobian N×P, whose columns are scaled first."""
    scale = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-12)
    inverse = np.linalg.pinv(jacobian / scale, rcond=rcond)
    return noise_px**2 * (inverse @ inverse.T) / np.outer(scale, scale)


def rectify(pixels: np.ndarray, px_from_mm: np.ndarray, rect_mm, px_per_mm: float) -> np.ndarray:
    """Rectify a rectangle of the page at `px_per_mm`, averaged over area to avoid moiré. `pixels` is H×W×C, uint8 or
    float32 (pass linear light to measure); beyond the photo its border pixels are repeated.
    """
    size = rectified_px(rect_mm, px_per_mm)
    return resize_by_area(oversample_flat(pixels, px_from_mm, rect_mm, size), size)


def rectified_px(rect_mm, px_per_mm: float) -> tuple[int, int]:
    """The width and height in pixels of a rectangle at `px_per_mm`."""
    return max(1, round(rect_mm[2] * px_per_mm)), max(1, round(rect_mm[3] * px_per_mm))


def oversample_flat(pixels: np.ndarray, px_from_mm: np.ndarray, rect_mm, size: tuple[int, int]) -> np.ndarray:
    """Rectify a rectangle of the page at a multiple of `size` that has samples as dense as the photograph's pixels."""
    x, y, width_mm, height_mm = rect_mm
    px_per_mm = max(np.linalg.norm(np.linalg.inv(j), 2) for j in _mm_by_px(px_from_mm, rect_corners(rect_mm)))
    factor = max(1, int(np.ceil(px_per_mm * width_mm / size[0])))
    factor = max(1, min(factor, _MAX_SIDE_PX // max(size)))
    grid = size[0] * factor, size[1] * factor
    part, px_from_mm = crop_around(pixels, px_from_mm, rect_corners(rect_mm), 2)
    step_x, step_y = width_mm / grid[0], height_mm / grid[1]
    index_from_grid = index_homography(px_from_mm @ np.array([[step_x, 0, x], [0, step_y, y], [0, 0, 1]]))
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpPerspective(part, index_from_grid, grid, None, flags, cv2.BORDER_REPLICATE)


def resize_by_area(pixels: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Resize to (width, height) by averaging over area; a larger size is interpolated."""
    if pixels.shape[1::-1] == size:
        return pixels
    interpolation = cv2.INTER_AREA if size[0] <= pixels.shape[1] else cv2.INTER_LINEAR
    return cv2.resize(pixels, size, interpolation=interpolation)


def coarsen(light: np.ndarray, shape: tuple[int, ...], blur_px: float = 0.0) -> np.ndarray:
    """Blur a picture's light by so many of its pixels and average it to cells of `shape`."""
    if blur_px > 0.3:
        light = cv2.GaussianBlur(light, (0, 0), float(blur_px), borderType=cv2.BORDER_REPLICATE)
    return resize_by_area(light, (shape[1], shape[0]))


def least_px_per_mm(px_from_mm: np.ndarray, rect_mm) -> float:
    """The smallest number of pixels per millimeter, over the rectangle's corners and all directions."""
    return float(1 / max(np.linalg.norm(j, 2) for j in _mm_by_px(px_from_mm, rect_corners(rect_mm))))


def crop_around(pixels: np.ndarray, px_from_mm: np.ndarray, points_mm, margin_px: int) -> tuple[np.ndarray, np.ndarray]:
    """Crop a photo to the page's points N×2 with a margin; returns the part and the homography to it."""
    rows, columns = region_around(apply_homography(px_from_mm, points_mm), margin_px, pixels.shape[:2])
    shift = np.array([[1, 0, -columns.start], [0, 1, -rows.start], [0, 0, 1.0]])
    return np.ascontiguousarray(pixels[rows, columns]), shift @ px_from_mm


def region_around(points_px: np.ndarray, margin_px: float, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Rows and columns of a picture H×W that contain points N×2 (x, y) with a margin; at least one pixel."""
    limit = np.array([shape[1], shape[0]])
    low = np.clip(np.floor(points_px.min(0) - margin_px).astype(int), 0, limit - 1)
    high = np.clip(np.ceil(points_px.max(0) + margin_px).astype(int), low + 1, limit)
    return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))


def _find_inliers(mm, px) -> np.ndarray:
    """True for corners that fit the homography of the majority (least median of squares)."""
    if len(px) == 12:  # a majority of three markers is hardly more than one, which extrapolates to the others
        error = np.linalg.norm(apply_homography(fit_homography(mm, px), mm) - px, axis=1)
        if error.max() < _CHANCE_PX:
            return np.ones(12, bool)
    homography, _ = cv2.findHomography(mm, px, cv2.LMEDS)
    if homography is None:
        return np.ones(len(px), bool)
    error = np.linalg.norm(apply_homography(homography, mm) - px, axis=1)
    sigma = 1.4826 * np.median(error)
    inlier = error < max(4 * sigma, _CHANCE_PX)
    return inlier if inlier.sum() >= 8 else np.ones(len(px), bool)


def _outward_shift(homography, mm, px, inlier) -> np.ndarray:
    """The shift N×2 of all corners if the borders of all markers are shifted outwards by their common error."""
    quads = apply_homography(homography, mm).reshape(-1, 4, 2)
    along = np.roll(quads, -1, 1) - quads
    along /= np.maximum(np.linalg.norm(along, axis=2, keepdims=True), 1e-9)
    normal = np.stack([along[..., 1], -along[..., 0]], 2)  # a clockwise quad's normals outwards, y down
    previous_normal = np.roll(normal, 1, 1)
    outward = (normal + previous_normal) / np.maximum(1 + (normal * previous_normal).sum(2, keepdims=True), 0.1)
    outward = outward.reshape(-1, 2)
    residual = ((px - quads.reshape(-1, 2)) * outward).sum(1)
    return outward * (residual[inlier].sum() / (outward[inlier] ** 2).sum())


def _gauss_newton(homography, mm, px, root: np.ndarray | float = 1.0, steps: int = 10) -> np.ndarray:
    """Refine a homography to the least squared reprojection error, 2N coordinates weighted by the square of `root`."""
    root = np.broadcast_to(root, 2 * len(mm))
    for _ in range(steps):
        residual = (px - apply_homography(homography, mm)).ravel()
        jacobian = homography_jacobian(homography, mm)
        scale = np.linalg.norm(jacobian, axis=0)
        step = np.linalg.lstsq(jacobian / scale * root[:, None], residual * root, rcond=None)[0] / scale
        homography = homography + np.append(step, 0).reshape(3, 3)
        if np.abs(jacobian @ step).max() < 1e-7:
            break
    return normalize_homography(homography)


def homography_jacobian(homography, mm) -> np.ndarray:
    """Derivatives 2N×8 of pixels (x, y of each point) by the first eight entries of a homography whose last is 1."""
    ones = np.column_stack([mm, np.ones(len(mm))])
    u, v, w = (ones @ homography.T).T
    zeros = np.zeros_like(ones)
    by_x = np.hstack([ones, zeros, -(u / w)[:, None] * mm]) / w[:, None]
    by_y = np.hstack([zeros, ones, -(v / w)[:, None] * mm]) / w[:, None]
    return np.stack([by_x, by_y], 1).reshape(-1, 8)


def _mm_by_px(homography, mm) -> np.ndarray:
    """Derivatives N×2×2 of page millimeters by photo pixels at page points."""
    u, v, w = (np.column_stack([mm, np.ones(len(mm))]) @ homography.T).T
    px = np.stack([u / w, v / w], 1)
    return np.linalg.inv((homography[:2, :2] - px[:, :, None] * homography[2, :2]) / w[:, None, None])


def _page_fit(homography, mm, px, inlier, ids) -> PageFit:
    """The `PageFit` of a homography, with the figures computed from its residuals."""
    residuals = px - apply_homography(homography, mm)
    residual, noise, bend = residuals[inlier], UNSEEN_NOISE_PX, 0.0
    freedom = residual.size - (9 if len(ids) > 2 else 8)
    by_marker = inlier.reshape(-1, 4)
    if freedom > 0:
        noise, bend = noise_and_bend(residual, residuals.reshape(-1, 4, 2)[by_marker.all(1)], freedom)
    covariance = covariance_of(homography_jacobian(homography, mm[inlier]), noise)
    length = rms_length_mm(_mm_by_px(homography, mm[inlier]), residual)
    outlier = by_marker.sum(1) < _LEAST_CORNERS
    outlier_mm = [
        rms_length_mm(_mm_by_px(homography, corners), errors)
        for corners, errors in zip(mm.reshape(-1, 4, 2)[outlier], residuals.reshape(-1, 4, 2)[outlier], strict=True)
    ]
    return PageFit(homography, covariance, length, ids, bend_mm(bend, residual, length), max(outlier_mm, default=0.0))


def noise_and_bend(
    residual: np.ndarray, markers: np.ndarray, freedom: int, floor_px: float = CORNER_NOISE_PX
) -> tuple[float, float]:
    """Return (noise for uncertainties, bend), px per coordinate, from residuals N×2 and complete markers' residuals
    M×4×2.

    Noise is estimated from markers' twists (the alternating sums of their corners), which smooth deformations do not
    change; the rest is bend. Below three complete markers, all beyond the noise of sharp corners counts as bend.
    """
    variance = float((residual**2).sum()) / freedom
    noise = max(floor_px, np.sqrt(variance) * stdtrit(freedom, 0.975) / stdtrit(np.inf, 0.975))
    if len(residual) < 12:  # the residual of two markers is mostly noise
        return float(noise), 0.0
    noise_variance = floor_px**2
    if len(markers) > 2:
        twist = np.einsum("mki,k->mi", markers, [0.5, -0.5, 0.5, -0.5])
        noise_variance = fdtri(freedom, twist.size, 0.9) * max(noise_variance, float(np.mean(twist**2)))
    bend_variance = max(0.0, variance - noise_variance)
    return float(np.sqrt(noise**2 + _BEND_FACTOR**2 * bend_variance)), float(np.sqrt(bend_variance))


def bend_mm(bend_px: float, residual_px: np.ndarray, residual_mm: float) -> float:
    """Convert a bend from px per coordinate to a length, in the ratio of the residual N×2 to its `residual_mm`."""
    return residual_mm * bend_px / max(float(np.sqrt(np.mean(residual_px**2))), 1e-9)


def rms_length_mm(mm_by_px: np.ndarray, residual_px: np.ndarray) -> float:
    """The rms length in millimeters of residuals N×2 px, by the derivatives N×2×2."""
    lengths = np.linalg.norm(np.einsum("nij,nj->ni", mm_by_px, residual_px), axis=1)
    return float(np.sqrt(np.mean(lengths**2)))


def root_of(covariance: np.ndarray) -> np.ndarray:
    """A matrix R with R Rᵀ = covariance, which may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.maximum(values, 0))


def root_of_scaled(covariance: np.ndarray) -> np.ndarray:
    """`root_of` for parameters of different units, which are scaled first."""
    spread = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    return spread[:, None] * root_of(covariance / np.outer(spread, spread))
