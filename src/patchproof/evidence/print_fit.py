"""Fit how the colors of this print differ from those that the promise's printer would have made.

In: the design's coarse colors in several photographs, media-relative, and the design as promised. Out: a map from
promised to printed light, or None if the design's colors are too few or too alike to fit one. All photographs show one
print, so its cells are pooled over them: light and noise differ from photo to photo, ink does not.

A cell shows the mean of many colors, and print is not linear. Hence the map is linear in its coefficients: it adds to a
color a quadratic in its light, and to a cell that quadratic's mean over the cell. Over twelve changes of print
(inkjets, dot gain, faded dyes) that left ΔE00 3.3 in the mean; a quadratic in code values left 3.6.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence

import cv2
import numpy as np

LEAST_CELLS = 30  # three for each coefficient of a channel
_RIDGE = 1e-4  # of the mean square of a term: what the cells do not determine stays as promised
_LEAST_SPREAD = 0.02  # smallest over largest singular value of the cells' colors


def fit_print(
    relative: Sequence[np.ndarray], promised: np.ndarray, ink_in_photos: np.ndarray, ink: np.ndarray
) -> Callable[[np.ndarray], np.ndarray] | None:
    """Fit a function from promised to printed linear light (`... × 3` both). `relative` are each photo's cells h×w×3,
    NaN where unread; `promised` is the design's light H×W×3; the markers' promised `ink` became `ink_in_photos`.

    The map leaves paper unchanged: a change of paper's light counts as light, not as print.
    """
    if not relative:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a cell that is NaN in all photographs is left out
        pooled = np.nanmedian(np.stack(relative), axis=0)
    cells_px = pooled.shape[1::-1]
    inner = np.zeros(pooled.shape[:2], bool)  # blur mixes what lies around the piece into the rim
    inner[1:-1, 1:-1] = np.isfinite(pooled[1:-1, 1:-1]).all(-1)
    expected = cv2.resize(promised, cells_px, interpolation=cv2.INTER_AREA).astype(float)[inner]
    if len(expected) < LEAST_CELLS:
        return None
    singular = np.linalg.svd(np.column_stack([expected, np.ones(len(expected))]), compute_uv=False)
    if singular[-1] < _LEAST_SPREAD * singular[0]:
        return None
    # one at a time: OpenCV averages four channels at most
    terms = [cv2.resize(term, cells_px, interpolation=cv2.INTER_AREA)[inner] for term in _terms(promised)]
    ends = np.stack([np.ones(3), ink])
    rows = np.concatenate([np.stack(terms, -1), _terms(ends).T])
    added = np.concatenate([pooled[inner] - expected, [np.zeros(3), ink_in_photos - ink]])
    # errors are weighted as the eye sees them; paper and ink, which all photographs show, as much as all cells
    weight = np.concatenate([1 / (expected.mean(1) + 0.05) ** 0.6, np.full(2, np.sqrt(len(expected)))])[:, None]
    square = (rows * weight).T @ (rows * weight)
    ridge = _RIDGE * np.trace(square) / len(square) * np.eye(len(square))
    coefficients = np.linalg.solve(square + ridge, (rows * weight).T @ (added * weight))

    def as_printed(linear: np.ndarray) -> np.ndarray:
        terms = _terms(linear.astype(np.float32))
        added = coefficients.T.astype(np.float32) @ terms.reshape(len(terms), -1)
        return np.clip(linear + added.T.reshape(linear.shape), 0, 1).astype(np.float32)

    return as_printed


def _terms(linear: np.ndarray) -> np.ndarray:
    """Terms of a quadratic in linear light, `10 × ...`, each contiguous in memory."""
    r, g, b = np.moveaxis(np.clip(linear, 0, 1), -1, 0)
    terms = np.empty((10, *r.shape), linear.dtype)
    for into, term in zip(terms, (1.0, r, g, b, r * r, g * g, b * b, r * g, g * b, b * r), strict=True):
        into[...] = term
    return terms
