"""Maps from photographed to promised colors, in linear light.

In: photographed and promised colors, or the light of paper and ink. Out: a `ColorFit`. With at least eight usable
colors it is a full affine map, media-relative (12 numbers: gains, channel mixing and a veil), fitted robustly;
otherwise one per channel from paper and ink. Both remove the effects of light and camera; the difference that no affine
map explains remains, and that is what a color difference should measure.
"""

from dataclasses import dataclass

import numpy as np

LEAST_COLORS = 8  # 12 numbers from 24 values; with fewer a single bad color spoiled the map
_CONVERGED = 1e-3  # smaller changes of weights change no printed digit


@dataclass(frozen=True)
class ColorFit:
    """The map `promised = matrix[:, :3] @ photographed + matrix[:, 3]`; `name` is "affine12" or "white_black"."""

    name: str
    matrix: np.ndarray

    def apply(self, linear: np.ndarray) -> np.ndarray:
        """Map photographed linear light `... × 3` to that of the promise."""
        return linear @ self.matrix[:, :3].T + self.matrix[:, 3]


def affine12(photographed: np.ndarray, promised: np.ndarray) -> ColorFit | None:
    """Fit a robust affine map to N×3 colors; None if they are too few or too similar to determine it.

    It is fitted from promised to photographed colors and inverted: the promise is exact, and a glare on a color is then
    an outlier of the dependent variable; as an outlier of the independent one it would pull the map towards itself.
    """
    if len(photographed) < LEAST_COLORS:
        return None
    rows = np.column_stack([promised, np.ones(len(promised))])
    singular = np.linalg.svd(rows / np.maximum(np.linalg.norm(rows, axis=0), 1e-12), compute_uv=False)
    if singular[-1] < 0.02 * singular[0]:
        return None
    # errors are weighted by the eye's sensitivity: steps of code values are finer in the dark
    eye = 1 / (np.maximum(photographed.mean(1), 0) + 0.05) ** 0.6
    weight, photographed_from_promised = np.ones(len(photographed)), np.zeros((3, 4))
    for weigh, max_rounds in ((_huber, 10), (_tukey, 20)):
        for _ in range(max_rounds):
            w = (eye * np.sqrt(weight))[:, None]
            weighted = rows * w  # the normal equations take a fifth of the time, and are well conditioned here
            normal, moment = weighted.T @ weighted, weighted.T @ (photographed * w)
            photographed_from_promised = np.linalg.lstsq(normal, moment, rcond=None)[0].T
            miss = rows @ photographed_from_promised.T - photographed
            error = eye * np.sqrt(np.einsum("nc,nc->n", miss, miss))  # a fifth of the time of np.linalg.norm
            spread = max(1.4826 * float(np.median(error)), 1e-6)
            weight, previous = weigh(error / spread), weight
            if (weight > 0).sum() < LEAST_COLORS - 2:
                return None
            if np.abs(weight - previous).max() < _CONVERGED:
                break
    if np.linalg.cond(photographed_from_promised[:, :3]) > 50:  # no camera mixes its channels that much
        return None
    return ColorFit("affine12", invert_affine(photographed_from_promised))


def invert_affine(matrix: np.ndarray) -> np.ndarray:
    """The inverse of a 3×4 affine map."""
    inverse = np.linalg.inv(matrix[:, :3])
    return np.column_stack([inverse, -inverse @ matrix[:, 3]])


def white_black(paper: np.ndarray, ink: np.ndarray, promised_ink: np.ndarray) -> ColorFit:
    """The map per channel that takes photographed paper to 1 and photographed ink to `promised_ink`."""
    gain = (1 - promised_ink) / np.maximum(paper - ink, 1e-3)
    return ColorFit("white_black", np.column_stack([np.diag(gain), promised_ink - gain * ink]))


def _huber(error: np.ndarray) -> np.ndarray:
    """Huber's weights, for convergence from afar; errors are in units of their spread."""
    return np.minimum(1, 1.345 / np.maximum(error, 1e-12))


def _tukey(error: np.ndarray) -> np.ndarray:
    """Tukey's weights, 0 for outliers."""
    return np.maximum(1 - (error / 4.685) ** 2, 0) ** 2
