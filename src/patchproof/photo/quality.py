"""What a photograph lets one see: the blur of markers' borders, the light of paper and ink beside them, clipping.

In: a photograph and its fitted markers. Out: `FrameLight`. Paper and ink are read half a module outside and inside of
every border and corrected for what the blur mixed between them, per channel in linear light.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from patchproof.color import LUMINANCE, linear_from_srgb
from patchproof.photo.edges import Borders, border_frame, sample

CLIPPED_CODE = 253  # JPEG and sharpening move full white by a code or two
_ALONG = 16


@dataclass(frozen=True)
class FrameLight:
    """Linear light (3,) of paper and ink, 1 = the photo's full white; contrast is their difference in luminance."""

    paper: np.ndarray
    ink: np.ndarray
    contrast: float
    clipped: float  # share of paper samples with a channel at full white


def blur_px(markers: Iterable[Borders]) -> float:
    """Gaussian sigma of the borders in photo pixels: the median over fitted markers, else over all."""
    return float(np.median([b.blur_px for b in _surest(markers)]))


def frame_light(srgb: np.ndarray, markers: Iterable[Borders]) -> FrameLight:
    """Paper and ink around at least one marker of an uint8 sRGB photograph."""
    sure = _surest(markers)
    corners = np.stack([b.corners_px for b in sure])
    module = np.array([b.module_px for b in sure])[:, None, None, None]
    middle, half, normal = border_frame(corners)
    s = np.linspace(-0.8, 0.8, _ALONG)[:, None]
    border = middle[:, :, None] + s * half[:, :, None]
    outside, inside = (sample(srgb, border + sign * 0.5 * module * normal[:, :, None]) for sign in (1, -1))
    clipped = float((outside >= CLIPPED_CODE).any(-1).mean())
    light_out, light_in = (np.median(linear_from_srgb(v / 255.0), axis=(0, 1, 2)) for v in (outside, inside))
    # a step blurred by sigma leaves Φ(±m/2σ) of paper at half a module m to either side
    blur = np.median([b.blur_px / max(b.module_px, 1e-6) for b in sure])
    share = float(ndtr(0.5 / max(blur, 1e-3)))
    span = (light_out - light_in) / max(2 * share - 1, 0.3)
    ink = np.maximum(light_in - (1 - share) * span, 0)
    paper = np.minimum(ink + span, 1.2)
    return FrameLight(paper, ink, float(np.dot(LUMINANCE, paper - ink)), clipped)


def _surest(markers: Iterable[Borders]) -> list[Borders]:
    """The fitted ones, or all where none is."""
    markers = list(markers)
    return [b for b in markers if b.fitted] or markers
