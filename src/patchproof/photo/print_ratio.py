"""Measure a print's x:y ratio in one photograph, from a flat page's homography and the camera's matrix.

In: a `PageFit` and a pinhole matrix. Out: the ratio of the print's scale along x to its scale along y, with its 95 %
uncertainty. A page printed s_x, s_y times its size has px_from_mm ~ K [s_x r1, s_y r2, t]: the ratio is that of two
column lengths. First r1 · r2 = 0 corrects the homography within its own covariance. An error of the focal length enters
with sin² of the tilt, so this needs a calibrated camera.

Source: Hartley and Zisserman, Multiple View Geometry, 2nd ed., 8.1.
"""

import numpy as np

from patchproof.photo.rectify import PageFit


def x_over_y(fit: PageFit, matrix_px: np.ndarray, focal_error: float) -> tuple[float, float]:
    """(ratio, its 95 % uncertainty); `focal_error` is the focal length's relative 95 % uncertainty."""
    inverse = np.linalg.inv(matrix_px)
    entries = fit.px_from_mm.ravel()[:8]
    skew, by_skew = cosine(entries, inverse), gradient(cosine, entries, inverse)
    spread = fit.covariance @ by_skew
    variance = float(by_skew @ spread)
    if variance > 0:
        entries = entries - spread * (skew / variance)
    by_ratio = gradient(log_ratio, entries, inverse)
    covariance = fit.covariance - np.outer(spread, spread) / max(variance, 1e-300)
    noise = np.sqrt(max(float(by_ratio @ covariance @ by_ratio), 0.0))
    longer = matrix_px.copy()
    longer[[0, 1], [0, 1]] *= 1 + focal_error
    ratio = log_ratio(entries, inverse)
    return float(np.exp(ratio)), float(np.hypot(2 * noise, log_ratio(entries, np.linalg.inv(longer)) - ratio))


def _page_axes(entries, inverse) -> np.ndarray:
    """The page's x and y axes in the camera, as columns, from a homography's first eight entries and K⁻¹."""
    return (inverse @ np.append(entries, 1.0).reshape(3, 3))[:, :2]


def log_ratio(entries, inverse) -> float:
    """The logarithm of the ratio of the page axes' lengths; `inverse` is the camera matrix's inverse."""
    x, y = np.linalg.norm(_page_axes(entries, inverse), axis=0)
    return float(np.log(x / y))


def cosine(entries, inverse) -> float:
    """The cosine of the angle between the page axes; `inverse` is the camera matrix's inverse."""
    x, y = _page_axes(entries, inverse).T
    return float(x @ y / np.linalg.norm(x) / np.linalg.norm(y))


def gradient(function, entries, inverse) -> np.ndarray:
    """The gradient by central differences, with steps in proportion to entries of different orders of magnitude."""
    steps = 1e-6 * np.maximum(np.abs(entries), np.abs(entries).max() * 1e-6)
    rows = entries + np.diag(steps), entries - np.diag(steps)
    up, down = ([function(row, inverse) for row in side] for side in rows)
    return (np.array(up) - np.array(down)) / (2 * steps)
