"""Measure the light on a piece of paper where the paper is white.

In: a photograph, the homography and blur of a page, a rectangle of it, and what is printed there. Out: `PaperLight`:
per channel a quadratic in the rectangle of the linear light that white paper shows, the unexplained remainder, and the
paper's grain. Pixels count if they are not clipped and lie on white paper, far enough from ink and the rectangle's edge
that blur brings nothing over. The fit is robust: least median of squares finds the light that most of the paper agrees
on, and Tukey's weights ignore a highlight or a shadow's edge. A lamp's fall-off over a flat piece is smooth: for a bare
lamp twice the piece's size above its middle the quadratic's error is within 1 %, above its edge within 4 %.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from patchproof.base.color import LINEAR_FROM_CODE
from patchproof.base.geometry import apply_homography, is_inside, rect_corners
from patchproof.photo.quality import CLIPPED_CODE
from patchproof.photo.rectify import least_px_per_mm, region_around
from patchproof.photo.rejection import PhotoRejected
from patchproof.sheets.rects import RectMm, grow_rect

_CUT_SLACK_MM = 1.0  # scissors do not follow the line
_MAX_CLIPPED = 0.5  # of the white paper
_MIN_PIXELS = 200
_MAX_PIXELS = 20_000  # more would cost time and change no digit


@dataclass(frozen=True)
class PaperLight:
    """The light on paper: `coefficients` 3×6 of [1, u, v, u², uv, v²]; `unevenness` is the root mean square of the
    remainder without noise, as a share of the light; `noise` the standard deviation at white in linear light.
    """

    coefficients: np.ndarray
    unevenness: float
    noise: float


def paper_light(
    srgb: np.ndarray, px_from_mm: np.ndarray, area_mm: RectMm, printed: Iterable[RectMm], blur_px: float
) -> PaperLight:
    """Measure the light on paper, white but for what is `printed`; `PhotoRejected` if too little of it is white."""
    codes, mm = _white_pixels(srgb, px_from_mm, area_mm, printed, blur_px)
    if len(codes) < _MIN_PIXELS:
        raise PhotoRejected("too_small", len(codes), _MIN_PIXELS, "come closer: too little white paper is in view")
    clipped = (codes >= CLIPPED_CODE).any(1)
    if clipped.mean() > _MAX_CLIPPED:
        raise PhotoRejected("clipped", float(clipped.mean()), _MAX_CLIPPED, "the paper is overexposed: expose less")
    codes, mm = codes[~clipped], mm[~clipped]
    light, terms = LINEAR_FROM_CODE[codes], quadratic_terms(mm - area_mm[:2], area_mm[2:])
    coefficients, weight = _robust_fit(terms, light)
    residual = light - terms @ coefficients.T
    white = light.mean(0)
    noise = _noise(residual[weight > 0], white)
    unevenness = ((residual**2).mean(0).sum() - noise**2 * white.sum()) / (white**2).sum()
    return PaperLight(coefficients, float(np.sqrt(max(unevenness, 0))), noise)


def quadratic_terms(mm: np.ndarray, size_mm: tuple[float, float]) -> np.ndarray:
    """Return N×6 rows [1, u, v, u², uv, v²] of points in a rectangle of this size."""
    u, v = (2 * mm / np.array(size_mm) - 1).T
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], 1)


def _white_pixels(srgb, px_from_mm, area_mm, printed, blur_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Return codes N×3 and millimeters N×2 of pixels that see nothing but white paper."""
    y, x = region_around(apply_homography(px_from_mm, rect_corners(area_mm)), 0, srgb.shape)
    pixels = (y.stop - y.start) * (x.stop - x.start)
    stride = max(1, int(np.sqrt(pixels / (4 * _MAX_PIXELS))))  # about a quarter of the box is clear paper
    columns, rows = np.meshgrid(*(np.arange(each.start, each.stop, stride) for each in (x, y)))
    mm = apply_homography(np.linalg.inv(px_from_mm), np.column_stack([columns.ravel(), rows.ravel()]) + 0.5)
    margin_mm = (1 + 3 * blur_px) / max(least_px_per_mm(px_from_mm, area_mm), 1e-6)
    white = is_inside(mm, grow_rect(area_mm, -margin_mm - _CUT_SLACK_MM))
    for rect in printed:
        white &= ~is_inside(mm, grow_rect(rect, margin_mm))
    return srgb[rows.ravel()[white], columns.ravel()[white]], mm[white]


def _robust_fit(terms: np.ndarray, light: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return coefficients 3×6 and the pixels' weights, which all channels share."""
    error = np.abs(light.mean(1) - terms @ _start(terms, light.mean(1)))
    coefficients, weight = np.zeros((3, 6)), np.ones(len(terms))
    for _ in range(20):
        spread = max(1.4826 * float(np.median(error)), 1e-3)
        weight = np.maximum(1 - (error / (4.685 * spread)) ** 2, 0) ** 2
        weighted = terms * weight[:, None]  # the normal equations: few terms within [-1, 1], ten times as fast
        coefficients = np.linalg.lstsq(weighted.T @ terms, weighted.T @ light, rcond=None)[0].T
        error = np.linalg.norm(light - terms @ coefficients.T, axis=1)
    return coefficients, weight


def _start(terms: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Return six coefficients of least median error among 500 fits to 12 random pixels each; if a third of the pixels
    are bad, four of these fits are expected to have none.
    """
    rng = np.random.default_rng(0)  # fixed: the same photograph must give the same bytes
    dozens = rng.integers(0, len(light), (500, 12))
    candidates = np.einsum("kpn,kn->kp", np.linalg.pinv(terms[dozens]), light[dozens])
    sample = rng.integers(0, len(light), 1000)
    return candidates[np.median(np.abs(candidates @ terms[sample].T - light[sample]), axis=1).argmin()]


def _noise(residual: np.ndarray, white: np.ndarray) -> float:
    """Return the standard deviation at white of residuals N×3 (without outliers) around `white`, less that of rounding.
    The variance of shot noise is proportional to the light (EMVA 1288), hence the division.
    """
    step = np.interp(white, LINEAR_FROM_CODE[:-1], np.diff(LINEAR_FROM_CODE))
    variance = (residual**2).mean(0) - step**2 / 12
    return float(np.sqrt(np.maximum(variance / np.maximum(white, 1e-3), 0).mean()))
