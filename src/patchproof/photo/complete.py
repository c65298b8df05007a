"""Markers that the detector missed, looked for where the others say they must be.

In: the photograph, what was found, and where every marker lies on the page. Out: the same with more markers. A
homography from the markers found predicts the corners of the rest; borders are fitted from there, and a marker counts
when its borders fit near the prediction and its cells are the printed ones. That needs no contours, so it still works
for small, blurred or partly covered markers; it never identifies a sheet by itself.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from patchproof.geometry import apply_homography
from patchproof.photo.detect import DICTIONARY, Found, cells_of, luminance, possible, refine
from patchproof.photo.edges import Borders, sample
from patchproof.photo.rectify import fit_page

LEAST_CORRELATION = (
    0.7  # of light with printed cells; wrong codes of the dictionary stay below 0.6, blur lowers it to 0.8
)


def complete(
    srgb: np.ndarray, found: Found, corners_mm: Mapping[int, np.ndarray], dictionary: str = DICTIONARY
) -> Found:
    """`found` with all markers of `corners_mm` that verify at their predicted places; bad fits are replaced."""
    printed = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    light = luminance(srgb)
    for _ in range(3):  # each round's markers predict farther ones better
        more = _round(srgb, light, found, corners_mm, printed)
        if not more:
            break
        kept = {i: b for i, b in found.markers.items() if i not in more}
        found = Found(dict(sorted((kept | more).items())), found.foreign, found.doubled)
    return found


def _round(srgb, light, found: Found, corners_mm, printed) -> dict[int, Borders]:
    """Markers that are not fitted yet and verify at the places that the fitted ones predict."""
    sure = {i: b.corners_px for i, b in found.markers.items() if b.fitted}
    if not sure:
        return {}
    px_from_mm = fit_page(sure, corners_mm).px_from_mm
    predicted = {i: apply_homography(px_from_mm, np.asarray(mm)) for i, mm in corners_mm.items() if i not in sure}
    ids = sorted(i for i, quad in predicted.items() if possible(quad) and _inside(quad, srgb))
    if not ids:
        return {}
    cells = cells_of(printed, ids)
    borders = refine(srgb, np.array([predicted[i] for i in ids]), cells)
    return {
        i: b
        for i, b, code in zip(ids, borders, cells, strict=True)
        if b.fitted and _near(b, predicted[i]) and _reads(light, b, code)
    }


def _inside(quad: np.ndarray, srgb: np.ndarray) -> bool:
    limit = [srgb.shape[1] - 2, srgb.shape[0] - 2]
    side = np.sqrt(abs(cv2.contourArea(quad.astype(np.float32))))
    return bool((quad > 2).all() and (quad < limit).all() and side >= 10)


def _near(borders: Borders, quad: np.ndarray) -> bool:
    return bool(np.linalg.norm(borders.corners_px - quad, axis=1).max() < max(0.5 * borders.module_px, 1.0))


def _reads(light: np.ndarray, borders: Borders, code: np.ndarray) -> bool:
    """Whether the cells show the printed pattern: correlation of their light with it."""
    n = len(code)
    square = np.array([[0, 0], [n, 0], [n, n], [0, n]], np.float32)
    to_px = cv2.getPerspectiveTransform(square, borders.corners_px.astype(np.float32))
    rows, columns = np.mgrid[0:n, 0:n] + 0.5
    centers = apply_homography(to_px, np.column_stack([columns.ravel(), rows.ravel()]))
    inner = np.zeros((n, n), bool)
    inner[1:-1, 1:-1] = True
    seen = sample(light, centers)[inner.ravel()]
    return float(seen.std()) > 1e-6 and float(np.corrcoef(seen, code[inner])[0, 1]) > LEAST_CORRELATION
