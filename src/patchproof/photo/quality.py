"""Measure a photograph's quality: empty or not, the blur of markers' borders, the light of paper and ink, clipping.

In: a photograph and its fitted markers. Out: `FrameLight`. Paper and ink are sampled half a module outside and inside
of every border and corrected for their mixture by the blur, per channel in linear light.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.special import ndtr

from patchproof.base.color import LUMINANCE, linear_from_srgb
from patchproof.photo.edges import Borders, border_frame, sample

CLIPPED_CODE = 253  # JPEG and sharpening move full white by a code or two
_ALONG = 16
_CELLS = 8  # along each side; their mean colors are compared
_MIN_DEVIATION_CODES = 1.0  # standard deviation of the means: covered lenses, black and burnt-out frames have less
_MIN_DEVIATION_NOISES = 2.0  # in units of the deviation that pixel noise alone gives the means


@dataclass(frozen=True)
class FrameLight:
    """Linear light (3,) of paper and ink, 1 = the photo's full white; contrast is their difference in luminance."""

    paper: np.ndarray
    ink: np.ndarray
    contrast: float
    clipped: float  # share of paper samples with a channel at full white


def is_featureless(srgb: np.ndarray) -> bool:
    """True if a uint8 picture H×W×3 is one tone or noise, by the mean colors of its 8 × 8 cells. Noise is estimated
    from neighboring pixels, which are similar in pictures of real things.
    """
    means = cv2.resize(srgb, (_CELLS, _CELLS), interpolation=cv2.INTER_AREA).reshape(-1, 3)
    steps = np.diff(srgb[:: max(1, len(srgb) // 200)].astype(np.int16), axis=1).astype(float)
    noise = np.sqrt((steps**2).mean() / 2) if steps.size else 0.0
    pixels = srgb.shape[0] * srgb.shape[1] / _CELLS**2
    return float(means.std(0).max()) < max(_MIN_DEVIATION_CODES, _MIN_DEVIATION_NOISES * noise / np.sqrt(pixels))


def blur_px(markers: Iterable[Borders]) -> float:
    """The Gaussian sigma of the borders in photo pixels: the median over the fitted markers, or over all if none is."""
    return float(np.median([b.blur_px for b in _fitted_or_all(markers)]))


def frame_light(srgb: np.ndarray, markers: Iterable[Borders]) -> FrameLight:
    """Measure paper and ink at the borders of at least one marker in a uint8 sRGB photograph."""
    markers = _fitted_or_all(markers)
    corners = np.stack([b.corners_px for b in markers])
    module = np.array([b.module_px for b in markers])[:, None, None, None]
    middle, half, normal = border_frame(corners)
    s = np.linspace(-0.8, 0.8, _ALONG)[:, None]
    border = middle[:, :, None] + s * half[:, :, None]
    outside, inside = (sample(srgb, border + sign * 0.5 * module * normal[:, :, None]) for sign in (1, -1))
    clipped = float((outside >= CLIPPED_CODE).any(-1).mean())
    light_out, light_in = (np.median(linear_from_srgb(v / 255.0), axis=(0, 1, 2)) for v in (outside, inside))
    # half a module m to either side of a step blurred by sigma the share of paper is Φ(±m/2σ)
    blur = np.median([b.blur_px / max(b.module_px, 1e-6) for b in markers])
    share = float(ndtr(0.5 / max(blur, 1e-3)))
    span = (light_out - light_in) / max(2 * share - 1, 0.3)
    ink = np.maximum(light_in - (1 - share) * span, 0)
    paper = np.minimum(ink + span, 1.2)
    return FrameLight(paper, ink, float(np.dot(LUMINANCE, paper - ink)), clipped)


def _fitted_or_all(markers: Iterable[Borders]) -> list[Borders]:
    """The fitted markers, or all if none is fitted."""
    markers = list(markers)
    return [b for b in markers if b.fitted] or markers
