"""All markers of a known page: those that the detector sees, and those it missed, where the others say they must be.

In: the photograph and where every marker lies on the page. Out: `MarkersInView`. After each level of the detector a
homography from the markers found predicts the corners of the rest; where cells are about the printed ones, borders are
fitted from there, and a marker counts when these fit near the prediction and its cells are the printed ones. That needs
no contours, so it still works for small, blurred or partly covered markers, and it spares the finer levels, which cost
most; they then look only where markers are still missing. Prediction never identifies a sheet by itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Set

import cv2
import numpy as np

from patchproof.base.geometry import apply_homography
from patchproof.photo.detect import (
    COARSEST_PX,
    ImageRegion,
    MarkersInView,
    fitted,
    full_region,
    is_plausible_quad,
    luminance,
    pyramid_levels,
    refine,
    search_level,
)
from patchproof.photo.edges import Borders, sample
from patchproof.photo.rectify import fit_page, region_around
from patchproof.photo.rejection import PhotoRejected
from patchproof.sheets.markers import DICTIONARY, aruco_dictionary, marker_cells

# of light with printed cells; wrong codes of the dictionary stay below 0.6, blur lowers it to 0.8
LEAST_CORRELATION = 0.7
# what a marker has at least at one of the places round its predicted one, which is half a module off at most: borders,
# which cost most, are not fitted to less
_HOPELESS = 0.5
_AROUND = tuple((x, y) for x in (-0.4, 0.0, 0.4) for y in (-0.4, 0.0, 0.4))
# px of a marker's side, 4 per module: the detector reads nearly all of those (0.99), so one that is missing is covered
READABLE_PX = 28.0


def find_sheet(
    srgb: np.ndarray,
    expected: Set[int],
    corners_mm: Mapping[int, np.ndarray],
    dictionary: str = DICTIONARY,
    coarsest_px: int = COARSEST_PX,
) -> MarkersInView:
    """The markers of `corners_mm` (page mm by id) that are in the picture.

    The search ends when every one of `expected` is found, or shown to be out of the picture or covered, and none or
    several are at two places.
    """
    printed = aruco_dictionary(dictionary)
    detections: dict[int, list[np.ndarray]] = {}
    borders: dict[int, Borders] = {}
    box, view = full_region(srgb), MarkersInView({}, (), ())
    for level in pyramid_levels(srgb, box, coarsest_px):
        before, foreign = sum(map(len, detections.values())), view.foreign
        search_level(srgb, box, level, printed, detections)
        if sum(map(len, detections.values())) != before:
            detected = fitted(srgb, detections, set(corners_mm), dictionary, borders)
            view = complete_markers(srgb, detected, corners_mm, dictionary)
        wanted = expected - view.markers.keys()
        if wanted and view.markers:
            wanted, box = _still_wanted(srgb, wanted, view, corners_mm, level.scale)
        # one marker at two places, or of another sheet, is clutter, or the first that is read of a second print: a
        # finer level tells
        unclear = len(view.doubled) == 1 or (len(view.foreign) == 1 and view.foreign != foreign)
        if not wanted and not unclear:
            break
    return view


def _still_wanted(
    srgb, wanted: Set[int], view: MarkersInView, corners_mm, scale: float
) -> tuple[Set[int], ImageRegion]:
    """Which of the missing markers a finer level could still show, and the part of the picture to look at for them."""
    quads = None
    if sum(b.fitted for b in view.markers.values()) >= 2:  # one marker says too little about where the others are
        quads = _predicted(srgb, view, wanted, corners_mm)
    if quads is not None:
        wanted = {i for i, quad in quads.items() if _side_px(quad) * scale < READABLE_PX}
    if quads is None or not wanted:
        return wanted, full_region(srgb)
    margin = 2 * max(_side_px(quads[i]) for i in wanted)
    return wanted, region_around(np.concatenate([quads[i] for i in wanted]), margin, srgb.shape)


def complete_markers(
    srgb: np.ndarray, view: MarkersInView, corners_mm: Mapping[int, np.ndarray], dictionary: str = DICTIONARY
) -> MarkersInView:
    """`view` with all markers of `corners_mm` that verify at their predicted places; bad fits are replaced."""
    for _ in range(3):  # each round's markers predict farther ones better
        more = _round(srgb, view, corners_mm, dictionary)
        if not more:
            break
        view = MarkersInView(dict(sorted((view.markers | more).items())), view.foreign, view.doubled)
    return view


def _round(srgb, view: MarkersInView, corners_mm, dictionary: str) -> dict[int, Borders]:
    """Markers that are not fitted yet and verify at the places that the fitted ones predict."""
    unsure = {i for i in corners_mm if i not in view.markers or not view.markers[i].fitted}
    predicted = _predicted(srgb, view, unsure, corners_mm)
    if not predicted:
        return {}
    ids = sorted(predicted)
    codes = dict(zip(ids, marker_cells(dictionary, ids), strict=True))
    ids = [i for i in ids if _agreement(srgb, predicted[i], codes[i], _AROUND) > _HOPELESS]
    if not ids:
        return {}
    cells = np.array([codes[i] for i in ids])
    borders = refine(srgb, np.array([predicted[i] for i in ids]), cells)
    return {
        i: b
        for i, b, code in zip(ids, borders, cells, strict=True)
        if b.fitted and _near(b, predicted[i]) and _agreement(srgb, b.corners_px, code) > LEAST_CORRELATION
    }


def _predicted(srgb, view: MarkersInView, missing: Set[int], corners_mm) -> dict[int, np.ndarray] | None:
    """Where the fitted markers say that missing ones lie in the picture, by id; None where they cannot tell."""
    try:
        px_from_mm = fit_page({i: b.corners_px for i, b in view.markers.items() if b.fitted}, corners_mm).px_from_mm
    except (PhotoRejected, np.linalg.LinAlgError):
        return None
    quads = {i: apply_homography(px_from_mm, corners_mm[i]) for i in missing}
    return {i: quad for i, quad in quads.items() if is_plausible_quad(quad) and _inside(quad, srgb)}


def _inside(quad: np.ndarray, srgb: np.ndarray) -> bool:
    limit = [srgb.shape[1] - 2, srgb.shape[0] - 2]
    return bool((quad > 2).all() and (quad < limit).all() and _side_px(quad) >= 10)


def _side_px(quad: np.ndarray) -> float:
    return float(np.sqrt(abs(cv2.contourArea(quad.astype(np.float32)))))


def _near(borders: Borders, quad: np.ndarray) -> bool:
    return bool(np.linalg.norm(borders.corners_px - quad, axis=1).max() < max(0.5 * borders.module_px, 1.0))


def _agreement(srgb: np.ndarray, corners_px: np.ndarray, code: np.ndarray, moved=((0.0, 0.0),)) -> float:
    """Correlation of the cells' light with the printed pattern, at the best of places `moved` by so many modules."""
    n = len(code)
    square = np.array([[0, 0], [n, 0], [n, n], [0, n]], np.float32)
    to_px = cv2.getPerspectiveTransform(square, corners_px.astype(np.float32))
    rows, columns = np.mgrid[1 : n - 1, 1 : n - 1] + 0.5  # without the rim
    inner = np.column_stack([columns.ravel(), rows.ravel()])
    centers = apply_homography(to_px, (np.array(moved)[:, None] + inner).reshape(-1, 2))
    box = region_around(centers, 1, srgb.shape)
    light = luminance(np.ascontiguousarray(srgb[box]))
    cells = sample(light, centers - [box[1].start, box[0].start]).reshape(len(moved), -1)
    shown, printed = cells[cells.std(1) > 1e-6], code[1:-1, 1:-1].ravel()
    shown, printed = shown - shown.mean(1, keepdims=True), printed - printed.mean()
    correlation = shown @ printed / (np.linalg.norm(shown, axis=1) * np.linalg.norm(printed))
    return float(correlation.max(initial=-1.0))
