"""What this print makes of colors beside what the promise's printer would have made of them, from swatches in view.

In: swatches and marker ink of several photographs, media-relative. Out: a map from promised to printed
light, or None where fewer than eight swatches are readable anywhere. One print hangs in all photographs, so its
swatches are pooled over them: light and noise differ from photo to photo, ink does not. The map is the promise's
printer plus an affine map plus a thin-plate spline through what is left, in encoded values, which needs the fewest
swatches for a given error.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence

import numpy as np

from patchproof.color import linear_from_srgb, srgb_from_linear
from patchproof.photo.colorfit import LEAST_SWATCHES

_SMOOTHING = 1e-3  # keeps reading errors of half a code value from bending the spline


def fit_print(
    relative: Sequence[np.ndarray], promised: np.ndarray, ink_in_photos: np.ndarray, ink: np.ndarray
) -> Callable[[np.ndarray], np.ndarray] | None:
    """Linear light `... × 3` as printed from linear light as promised; `relative` N×3 per photo, NaN where unread.

    Paper keeps its light: that it does is how light is told from print. The markers' `ink` became
    `ink_in_photos`.
    """
    from scipy.interpolate import RBFInterpolator

    if not len(promised) or not relative:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a swatch that no photograph shows is NaN, and left out
        pooled = np.nanmedian(np.stack(relative), axis=0)
    readable = np.isfinite(pooled).all(1)
    if readable.sum() < LEAST_SWATCHES:
        return None
    sent = srgb_from_linear(np.stack([*promised[readable], np.ones(3), ink]))
    printed = srgb_from_linear(np.clip(np.stack([*pooled[readable], np.ones(3), ink_in_photos]), 0, 1))
    try:
        difference = RBFInterpolator(sent, printed - sent, kernel="thin_plate_spline", degree=1, smoothing=_SMOOTHING)
    except np.linalg.LinAlgError:  # swatches in one plane of the color cube
        return None

    def as_printed(linear: np.ndarray) -> np.ndarray:
        colors = srgb_from_linear(np.clip(linear, 0, 1)).reshape(-1, 3)
        return linear_from_srgb(np.clip(colors + difference(colors), 0, 1)).reshape(linear.shape).astype(np.float32)

    return as_printed
