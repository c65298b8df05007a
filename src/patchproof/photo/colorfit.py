"""From what the camera saw to what was promised: an affine map in linear light, fitted to colors or to paper and ink.

In: linear light as photographed and as promised, media-relative (paper = 1). Out: `ColorFit`. The ladder: with at
least eight usable colors a full affine map (12 numbers: gains, channel mixing and a veil), fitted robustly; else
per channel from paper and ink. Either takes out light and camera; what no affine map explains stays, and that is what
a color difference should measure.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

LEAST_COLORS = 8  # 12 numbers from 24 values; fewer have let a single bad color turn the map
_SETTLED = 1e-3  # weights that change by less move no digit that is shown


@dataclass(frozen=True)
class ColorFit:
    """`promised = matrix[:, :3] @ seen + matrix[:, 3]`; the name says what it was fitted to."""

    name: str
    matrix: np.ndarray

    def apply(self, linear: np.ndarray) -> np.ndarray:
        """Linear light `... × 3` as the promise would have it."""
        return linear @ self.matrix[:, :3].T + self.matrix[:, 3]


def affine12(photographed: np.ndarray, promised: np.ndarray) -> ColorFit | None:
    """Robust affine map of N×3 colors; None where they are too few or too much alike to hold it.

    Fitted from promised to photographed and turned round: the promise is exact, and a glare on a color is then an
    outlier of the answer and not of the question, where it would pull the map towards itself.
    """
    if len(photographed) < LEAST_COLORS:
        return None
    rows = np.column_stack([promised, np.ones(len(promised))])
    singular = np.linalg.svd(rows / np.maximum(np.linalg.norm(rows, axis=0), 1e-12), compute_uv=False)
    if singular[-1] < 0.02 * singular[0]:
        return None
    # errors count as the eye sees them: steps of code values are finer in the dark
    eye = 1 / (np.maximum(photographed.mean(1), 0) + 0.05) ** 0.6
    weight, seen_from_promised = np.ones(len(photographed)), np.zeros((3, 4))
    for weigh, most in ((_huber, 10), (_tukey, 20)):
        for _ in range(most):
            w = (eye * np.sqrt(weight))[:, None]
            weighted = rows * w  # the normal equations take a fifth of the time, and such colors hold them well
            normal, moment = weighted.T @ weighted, weighted.T @ (photographed * w)
            seen_from_promised = np.linalg.lstsq(normal, moment, rcond=None)[0].T
            miss = rows @ seen_from_promised.T - photographed
            error = eye * np.sqrt(np.einsum("nc,nc->n", miss, miss))  # a fifth of the time of the library's norm
            spread = max(1.4826 * float(np.median(error)), 1e-6)
            weight, before = weigh(error / spread), weight
            if (weight > 0).sum() < LEAST_COLORS - 2:
                return None
            if np.abs(weight - before).max() < _SETTLED:
                break
    if np.linalg.cond(seen_from_promised[:, :3]) > 50:  # no camera mixes its channels so far
        return None
    return ColorFit("affine12", invert_affine(seen_from_promised))


def invert_affine(matrix: np.ndarray) -> np.ndarray:
    """The 3×4 affine map that undoes another."""
    back = np.linalg.inv(matrix[:, :3])
    return np.column_stack([back, -back @ matrix[:, 3]])


def white_black(paper: np.ndarray, ink: np.ndarray, promised_ink: np.ndarray) -> ColorFit:
    """Per-channel map that takes photographed paper to 1 and photographed ink to the promised one."""
    gain = (1 - promised_ink) / np.maximum(paper - ink, 1e-3)
    return ColorFit("white_black", np.column_stack([np.diag(gain), promised_ink - gain * ink]))


def _huber(error: np.ndarray) -> np.ndarray:
    """Weights that find the basin; errors in units of their spread."""
    return np.minimum(1, 1.345 / np.maximum(error, 1e-12))


def _tukey(error: np.ndarray) -> np.ndarray:
    """Weights that let outliers go."""
    return np.maximum(1 - (error / 4.685) ** 2, 0) ** 2
