"""The print's x:y ratio from one photograph: a flat page's homography and the camera's matrix leave only it open.

In: a `PageFit` and a pinhole matrix. Out: the ratio of the print's size along x to its size along y, as shares of what
was intended, with its 95 % uncertainty. A page printed s_x, s_y times its size has px_from_mm ~ K [s_x r1, s_y r2, t]:
the ratio is that of two column lengths, and r1 · r2 = 0, which is used up first to correct the homography within its
own covariance. An error of the focal length goes in with sin² of the tilt, so it takes a calibrated camera.

Source: Hartley and Zisserman, Multiple View Geometry, 2nd ed., 8.1.
"""

from __future__ import annotations

import numpy as np

from patchproof.photo.rectify import PageFit


def x_over_y(fit: PageFit, matrix_px: np.ndarray, focal_error: float) -> tuple[float, float]:
    """(ratio, its 95 % uncertainty); `focal_error` is the focal length's relative 95 % uncertainty."""
    back = np.linalg.inv(matrix_px)
    entries = fit.px_from_mm.ravel()[:8]
    skew, by_skew = cosine(entries, back), gradient(cosine, entries, back)
    spread = fit.covariance @ by_skew
    variance = float(by_skew @ spread)
    if variance > 0:
        entries = entries - spread * (skew / variance)
    by_ratio = gradient(log_ratio, entries, back)
    covariance = fit.covariance - np.outer(spread, spread) / max(variance, 1e-300)
    noise = np.sqrt(max(float(by_ratio @ covariance @ by_ratio), 0.0))
    longer = matrix_px.copy()
    longer[[0, 1], [0, 1]] *= 1 + focal_error
    ratio = log_ratio(entries, back)
    return float(np.exp(ratio)), float(np.hypot(2 * noise, log_ratio(entries, np.linalg.inv(longer)) - ratio))


def _columns(entries, back) -> np.ndarray:
    return (back @ np.append(entries, 1.0).reshape(3, 3))[:, :2]


def log_ratio(entries, back) -> float:
    """Of the lengths of a homography's first two columns, the inverse matrix `back` of the camera taken off."""
    x, y = np.linalg.norm(_columns(entries, back), axis=0)
    return float(np.log(x / y))


def cosine(entries, back) -> float:
    """Of the angle between them."""
    x, y = _columns(entries, back).T
    return float(x @ y / np.linalg.norm(x) / np.linalg.norm(y))


def gradient(function, entries, back) -> np.ndarray:
    """Central differences; the entries differ by orders of magnitude, and with them their steps."""
    steps = 1e-6 * np.maximum(np.abs(entries), np.abs(entries).max() * 1e-6)
    rows = entries + np.diag(steps), entries - np.diag(steps)
    up, down = ([function(row, back) for row in side] for side in rows)
    return (np.array(up) - np.array(down)) / (2 * steps)
