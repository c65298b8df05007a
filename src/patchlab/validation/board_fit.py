"""Fit light, printed black and blur to a photographed board, and render it again with our channel.

In: a uint8 photograph and a `BoardPose`. Out: a `BoardFit`, whose `rendered` is the photograph that print, light and
camera of our channel give: light × print, blurred as `channel.camera` does it, encoded as sRGB. Per channel

    light(x) = q(x) · [b + (1 - b) · share(x)],   share = paper's share of the pixel, blurred by sigma

with q a quadratic in the picture's coordinates and b the printed black; both are fitted robustly (Tukey). sigma
minimizes the residual, in turns with a cubic shift of the pattern, which follows the lens, paper that is not quite
flat, and errors of the homography. Noise and JPEG are not rendered. A tone curve other than sRGB's, stray light and
sharpening are not modeled: they show in the printed black and in the residual.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
import torch

from patchlab.validation.marker_boards import BoardPose, PrintedSquare, paper_share, shift_squares
from patchproof.base.color import LINEAR_FROM_CODE, LUMINANCE, codes_from_srgb
from patchproof.channel.camera import READ_SHARE, SMALLEST_BLUR_PX, encode_light, gaussian_blur
from patchproof.photo.detect import LINEAR_FLOAT32_FROM_CODE
from patchproof.photo.paper_light import quadratic_terms
from patchproof.photo.quality import CLIPPED_CODE
from patchproof.photo.rejection import PhotoRejected

# in px, up to 4.4; the channel skips blurs below 0.4
_BLURS_PX = (0.0, *(SMALLEST_BLUR_PX * 1.05 ** np.arange(50)).tolist())
_COARSE_STEP = 5  # blurs between two that are tried first
_ROUNDS = 4  # of shift, then light and blur; a fifth moves nothing by 0.01 px
_MAX_PIXELS, _MIN_PIXELS = 10_000, 500
_MAX_CLIPPED_SHARE = 0.5  # share of the board at full white
_MAX_MISS = 0.3  # of paper's light; limits the pull of what a shift cannot explain, such as a hand
_FLAT_SHARE, _FLAT_PX = 0.995, 7  # paper's share throughout a square of pixels that counts as flat white
_EDGE_BIN_PX, _EDGE_REACH_PX = 0.1, 2.5


@dataclass(frozen=True)
class BoardFit:
    """`light` H×W×3 of white paper and `share` H×W of paper before blur; `black` (3,) over paper in linear light;
    `bend_px` the root mean square of the cubic shift; `clipped` the share of the board at full white.
    """

    prints: tuple[PrintedSquare, ...]
    mask: np.ndarray
    share: np.ndarray
    light: np.ndarray
    black: np.ndarray
    blur_px: float
    bend_px: float
    clipped: float

    def rendered(self) -> np.ndarray:
        """Render uint8 H×W×3 sRGB with our channel's print, light, blur and tone; around the board is paper."""
        lit = self.light * (self.black + (1 - self.black) * self.share[..., None])
        seen = encode_light(gaussian_blur(_tensor(lit), torch.tensor([self.blur_px])))
        return codes_from_srgb(seen)[0].permute(1, 2, 0).numpy()

    def paper_seen(self, srgb: np.ndarray) -> np.ndarray:
        """H×W: the share of each pixel of a uint8 picture that looks like paper in this light and with this black."""
        relative = LINEAR_FLOAT32_FROM_CODE[srgb] / np.maximum(self.light, 1e-4)
        return ((relative - self.black) / (1 - self.black)) @ np.array(LUMINANCE)


def fit_board(srgb: np.ndarray, pose: BoardPose) -> BoardFit:
    """Fit light, black and blur to the board; `PhotoRejected` if it is too small or overexposed."""
    mask = pose.mask(srgb.shape)
    clipped = np.asarray((srgb >= CLIPPED_CODE).any(-1))
    known = np.flatnonzero(mask & ~clipped)
    if mask.sum() < _MIN_PIXELS:
        raise PhotoRejected("too_small", int(mask.sum()), _MIN_PIXELS, "the board has too few pixels")
    clipped_share = float(clipped[mask].mean())
    if clipped_share > _MAX_CLIPPED_SHARE:
        advice = f"{clipped_share:.0%} of the board is overexposed"
        raise PhotoRejected("clipped", clipped_share, _MAX_CLIPPED_SHARE, advice)
    known = np.random.default_rng(0).permutation(known)[:_MAX_PIXELS]  # a fixed seed, so that figures are repeatable
    places = _pixel_centers(srgb.shape)
    terms = _quadratic(places, srgb.shape)[known]
    light = LINEAR_FLOAT32_FROM_CODE[srgb].reshape(-1, 3)[known].astype(float)
    bend, prints, share = np.zeros((10, 2)), pose.prints, paper_share(pose.prints, srgb.shape)
    shade, blur = _best_blur(share, known, terms, light, _Shade(np.zeros((3, 6)), np.full(3, 0.03)), None)
    for _ in range(_ROUNDS):
        soft = _blur_share(share, _BLURS_PX[blur])
        bend = bend + _fit_shift(soft, known, places[known], srgb.shape, shade, terms, light)
        prints = shift_squares(pose.prints, lambda at, bend=bend: _cubic(at, srgb.shape) @ bend)
        share = paper_share(prints, srgb.shape)
        shade, blur = _best_blur(share, known, terms, light, shade, blur)
    paper = (_quadratic(places, srgb.shape) @ shade.quadratic.T).reshape(srgb.shape)
    shifts = _cubic(places[known], srgb.shape) @ bend
    bend_px = float(np.sqrt((shifts**2).sum(1).mean()))
    return BoardFit(prints, mask, share, paper, shade.black, _BLURS_PX[blur], bend_px, clipped_share)


@dataclass(frozen=True)
class _Shade:
    """Coefficients 3×6 of the quadratic of paper's light, and printed black (3,)."""

    quadratic: np.ndarray
    black: np.ndarray

    def misses(self, terms: np.ndarray, share: np.ndarray, light: np.ndarray) -> np.ndarray:
        """Residuals N×3 of pixels, relative to paper's light."""
        return light / np.maximum(terms @ self.quadratic.T, 1e-4) - self.black - (1 - self.black) * share[:, None]


def _best_blur(share, known, terms, light, shade: _Shade, near: int | None) -> tuple[_Shade, int]:
    """Light, black and the index in `_BLURS_PX` with the smallest residual; searched around `near` if given."""

    def residual(index: int) -> tuple[float, int]:
        soft = _blur_share(share, _BLURS_PX[index]).ravel()[known]
        tried = _fit_shade(terms, soft, light, shade.black, 2)
        return float((np.clip(tried.misses(terms, soft, light), -_MAX_MISS, _MAX_MISS) ** 2).mean()), index

    if near is None:
        near = min(residual(i) for i in range(0, len(_BLURS_PX), _COARSE_STEP))[1]
    best = min(residual(i) for i in range(max(near - _COARSE_STEP + 1, 0), min(near + _COARSE_STEP, len(_BLURS_PX))))[1]
    return _fit_shade(terms, _blur_share(share, _BLURS_PX[best]).ravel()[known], light, shade.black, 10), best


def _fit_shade(terms: np.ndarray, share: np.ndarray, light: np.ndarray, black: np.ndarray, rounds: int) -> _Shade:
    """Fit light and black in turns by least squares with Tukey's weights, shared by all channels."""
    weight, quadratic, ink = np.ones(len(terms)), np.zeros((3, 6)), 1 - share
    for _ in range(rounds):
        seen = black + (1 - black) * share[:, None]
        root = np.sqrt(weight)
        rows = [terms * (seen[:, c] * root)[:, None] for c in range(3)]
        # normal equations are fast (this runs some hundred times) and stable: the six columns are about orthogonal
        quadratic = np.stack([np.linalg.solve(a.T @ a, a.T @ (light[:, c] * root)) for c, a in enumerate(rows)])
        paper = terms @ quadratic.T
        inked = paper * ink[:, None]
        above = weight[:, None] * (light - paper * share[:, None]) * inked
        black = above.sum(0) / np.maximum((weight[:, None] * inked**2).sum(0), 1e-9)
        error = np.linalg.norm(light - paper * (black + (1 - black) * share[:, None]), axis=1)
        spread = max(1.4826 * float(np.median(error)), 1e-3)
        weight = np.maximum(1 - (error / (4.685 * spread)) ** 2, 0) ** 2
    return _Shade(quadratic, np.clip(black, 0, 0.9))


def _fit_shift(soft, known, at, shape, shade: _Shade, terms, light) -> np.ndarray:
    """Coefficients 10×2 of the cubic shift of the pattern, by one Gauss-Newton step."""
    down, across = (slope.ravel()[known] for slope in np.gradient(soft))
    miss, cubic = shade.misses(terms, soft.ravel()[known], light).mean(1), _cubic(at, shape)
    root = np.sqrt(np.minimum(1, _MAX_MISS / np.maximum(np.abs(miss), 1e-9)))  # Huber's weights
    rows = -float(1 - shade.black.mean()) * np.concatenate([cubic * across[:, None], cubic * down[:, None]], 1)
    rows, miss = rows * root[:, None], miss * root
    ridge = 1e-6 * len(rows) * np.eye(20)  # no shift where there is no edge
    return np.linalg.solve(rows.T @ rows + ridge, rows.T @ miss).reshape(2, 10).T


def _pixel_centers(shape: tuple[int, ...]) -> np.ndarray:
    """Centers N×2 of all pixels, row by row."""
    rows, columns = np.mgrid[0 : shape[0], 0 : shape[1]] + 0.5
    return np.column_stack([columns.ravel(), rows.ravel()])


def _quadratic(at: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    return quadratic_terms(at, (shape[1], shape[0]))


def _cubic(at: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """N×10 terms up to third order."""
    lower = _quadratic(at, shape)
    u, v = lower[:, 1], lower[:, 2]
    return np.column_stack([lower, u**3, u * u * v, u * v * v, v**3])


def _blur_share(share: np.ndarray, blur_px: float) -> np.ndarray:
    return gaussian_blur(_tensor(share[..., None]), torch.tensor([blur_px]))[0, 0].numpy()


def _tensor(picture: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(picture.transpose(2, 0, 1), np.float32))[None]


def edge_profile(
    paper_seen: np.ndarray, prints: Sequence[PrintedSquare], module_px: float
) -> tuple[float | None, float | None]:
    """(10 to 90 % width in pixels, overshoot over paper as a share of the contrast) of the outer borders of markers
    whose area is known: a slanted-edge profile (ISO 12233) of native pixels, with borders aligned first.
    """
    reach = min(_EDGE_REACH_PX, 0.9 * module_px)
    distances, values = [], []
    for printed in prints:
        if printed.is_marker and len(printed.area_px):
            for start, end in pairwise([*printed.corners_px, printed.corners_px[0]]):
                t, value = _across(paper_seen, start, end, reach)
                if len(t) > 20:
                    # of a step from 0 to 1 at d, the mean from -reach to reach is (reach - d) / (2 reach)
                    distances.append(t - reach * (1 - 2 * float(np.clip(value, 0, 1).mean())))
                    values.append(value)
    if not distances:
        return None, None
    t, value = np.concatenate(distances), np.concatenate(values)
    bins = np.round(t / _EDGE_BIN_PX).astype(int)
    most = int(reach / _EDGE_BIN_PX)
    places = [i for i in range(-most, most + 1) if (bins == i).sum() >= 5]
    profile = np.array([np.median(value[bins == i]) for i in places])
    if profile.min() > 0.1 or profile.max() < 0.9:
        return None, float(profile.max() - 1)
    low, high = (_crossing(np.array(places) * _EDGE_BIN_PX, profile, level) for level in (0.1, 0.9))
    return high - low, float(profile.max() - 1)


def _across(picture: np.ndarray, start: np.ndarray, end: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Distances of pixels outward of a border (a marker's corners run clockwise), and their values."""
    low = np.maximum(np.floor(np.minimum(start, end) - reach).astype(int), 0)
    high = np.ceil(np.maximum(start, end) + reach).astype(int)
    part = picture[low[1] : high[1], low[0] : high[0]]
    points = _pixel_centers(part.shape) + low
    along = (end - start) / np.linalg.norm(end - start)
    s = (points - start) @ along / np.linalg.norm(end - start)
    t = (points - start) @ np.array([along[1], -along[0]])
    near = (np.abs(s - 0.5) < 0.4) & (np.abs(t) <= reach)
    return t[near], part.ravel()[near]


def _crossing(places: np.ndarray, profile: np.ndarray, level: float) -> float:
    after = int(np.argmax(profile >= level))
    if after == 0:
        return float(places[0])
    before = profile[after - 1]
    return float(places[after - 1] + (level - before) / (profile[after] - before) * (places[after] - places[after - 1]))


def flat_white(fit: BoardFit, srgb: np.ndarray) -> np.ndarray:
    """H×W bool: pixels with nothing but unclipped white paper around them."""
    clear = (_blur_share(fit.share, fit.blur_px) > _FLAT_SHARE) & fit.mask & (srgb < CLIPPED_CODE).all(-1)
    return cv2.erode(clear.astype(np.uint8), np.ones((_FLAT_PX, _FLAT_PX), np.uint8)) > 0


def white_noise(fit: BoardFit, srgb: np.ndarray) -> tuple[float | None, float | None]:
    """(noise, unevenness) of flat white paper; None if there is too little. Noise is that of `camera.noise`: the
    standard deviation at white in linear light, by Immerkaer's filter (see `evidence.appearance.noise_of`), without the
    part of rounding to codes. Unevenness is the root mean square residual of the quadratic, as a share of the light.
    """
    flat = flat_white(fit, srgb)
    if flat.sum() < 100:
        return None, None
    light, mask = LINEAR_FLOAT32_FROM_CODE[srgb], np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    detail = np.abs(cv2.filter2D(light, -1, mask))[flat].mean(0) * np.sqrt(np.pi / 2) / 6
    paper = fit.light[flat].mean(0)
    step = np.interp(paper, LINEAR_FROM_CODE[:-1], np.diff(LINEAR_FROM_CODE))
    variance = np.maximum(detail**2 - step**2 / 12, 0) / (paper + READ_SHARE**2)
    residual = light[flat] / fit.light[flat] - 1
    return float(np.sqrt(variance.mean())), float(np.sqrt((residual**2).mean()))
