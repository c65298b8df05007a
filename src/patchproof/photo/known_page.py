"""Find all markers of a known page: those that the detector finds, and others at the places that these predict.

In: the photograph and the place of every marker on the page. Out: `MarkersInView`. After each level of the detector a
homography from the markers found so far predicts the corners of the missing ones; where the cells resemble the printed
ones, borders are fitted from there, and a marker counts if these lie near the prediction and its cells match. This
needs no contours, so it works for small, blurred or partly covered markers, and it avoids the finer levels, which cost
most; they search only where markers are still missing. Prediction never identifies a sheet by itself.
"""

from dataclasses import replace

import cv2
import numpy as np

from patchproof.base.geometry import apply_homography
from patchproof.photo import detect
from patchproof.photo.detect import Detections, Ids, ImageRegion, MarkersInView
from patchproof.photo.edges import Borders, sample
from patchproof.photo.rectify import PageFit, Quads, fit_page, region_around
from patchproof.photo.rejection import PhotoRejected
from patchproof.photo.second_print import find_second_print, find_small_markers
from patchproof.sheets.markers import DICTIONARY, aruco_dictionary, marker_cells

# of the light with the printed cells; wrong codes of the dictionary stay below 0.6, blur lowers it to 0.8
LEAST_CORRELATION = 0.7
# at one of the offsets (in modules) about the predicted place, which is at most half a module off: with less, borders
# are not fitted, because that costs most
_MIN_TRIAL_CORRELATION = 0.5
_TRIAL_OFFSETS = tuple((x, y) for x in (-0.4, 0.0, 0.4) for y in (-0.4, 0.0, 0.4))
# px of a marker's side, 4 per module: the detector reads 0.99 of these, so one that is missing must be covered
READABLE_PX = 28.0
_LEAST_MARKERS = 3  # with less, flat paper cannot be told from bent


def find_sheet(srgb: np.ndarray, expected: Ids, corners_mm: Quads, dictionary: str = DICTIONARY) -> MarkersInView:
    """Find the markers of `corners_mm` (page mm by id) in a uint8 photograph.

    The search ends when each of `expected` is found, out of the picture or covered, unless a finer level could decide
    about a single foreign marker. Prints beside the first one are sought last.
    """
    aruco = aruco_dictionary(dictionary)
    detections: Detections = {}
    borders: dict[int, Borders] = {}
    region, view = detect.full_region(srgb), MarkersInView({}, (), ())
    for level in detect.pyramid_levels(srgb, region):
        count, foreign = sum(map(len, detections.values())), view.foreign
        detect.search_level(srgb, region, level, aruco, detections)
        if sum(map(len, detections.values())) != count:
            detected = detect.fit_detections(srgb, detections, set(corners_mm), dictionary, borders)
            view = complete_markers(srgb, detected, corners_mm, dictionary)
        missing = expected - view.markers.keys()
        if missing and view.markers:
            missing, region = _findable(srgb, missing, view, corners_mm, level.scale)
        # one marker of another sheet is either clutter or the first one read of it, which a finer level can tell
        unclear = len(view.foreign) == 1 and view.foreign != foreign
        if not missing and not unclear:
            break
    fitted = sum(b.fitted for b in view.markers.values())
    if view.markers and fitted < min(max(_LEAST_MARKERS, len(expected) / 2), len(expected)):
        # those of a print far away that are read identify it
        small = find_small_markers(srgb, view.corners_px, {i: corners_mm[i] for i in expected}, dictionary)
        detections = {i: [quad] for i, quad in small.items()} | detections
        detected = detect.fit_detections(srgb, detections, set(corners_mm), dictionary)
        view = complete_markers(srgb, detected, corners_mm, dictionary)
    if view.doubled or len(view.foreign) > 1:
        return view
    fit = _fit(view.corners_px, corners_mm)
    agree = fit is not None and len(fit.inlier_ids) == len(view.markers)
    doubled, foreign = find_second_print(srgb, view.corners_px, corners_mm, dictionary, agree)
    return replace(view, doubled=doubled, foreign=tuple(sorted({*view.foreign, *foreign})))


def _findable(srgb, missing: Ids, view: MarkersInView, corners_mm, scale: float) -> tuple[Ids, ImageRegion]:
    """The missing markers that a finer level could still find, and the region to search."""
    quads = None
    if sum(b.fitted for b in view.markers.values()) >= 2:  # one marker predicts the others' places badly
        quads = _predict_corners(srgb, view, missing, corners_mm)
    if quads is not None:
        missing = {i for i, quad in quads.items() if _side_px(quad) * scale < READABLE_PX}
    if quads is None or not missing:
        return missing, detect.full_region(srgb)
    margin = 2 * max(_side_px(quads[i]) for i in missing)
    return missing, region_around(np.concatenate([quads[i] for i in missing]), margin, srgb.shape)


def complete_markers(
    srgb: np.ndarray, view: MarkersInView, corners_mm: Quads, dictionary: str = DICTIONARY
) -> MarkersInView:
    """Add to `view` all markers of `corners_mm` that are confirmed at their predicted places, and replace bad fits."""
    for _ in range(3):  # each round's markers predict farther ones better
        confirmed = _confirm_markers(srgb, view, corners_mm, dictionary)
        if not confirmed:
            break
        view = MarkersInView(dict(sorted((view.markers | confirmed).items())), view.foreign, view.doubled)
    return view


def _confirm_markers(srgb, view: MarkersInView, corners_mm, dictionary: str) -> dict[int, Borders]:
    """Markers that are not fitted yet and are confirmed at the places that the fitted ones predict."""
    missing = {i for i in corners_mm if i not in view.markers or not view.markers[i].fitted}
    predicted = _predict_corners(srgb, view, missing, corners_mm)
    if not predicted:
        return {}
    ids = sorted(predicted)
    codes = dict(zip(ids, marker_cells(dictionary, ids), strict=True))
    ids = [i for i in ids if _correlation(srgb, predicted[i], codes[i], _TRIAL_OFFSETS) > _MIN_TRIAL_CORRELATION]
    if not ids:
        return {}
    cells = np.array([codes[i] for i in ids])
    borders = detect.fit_marker_borders(srgb, np.array([predicted[i] for i in ids]), cells)
    return {
        i: b
        for i, b, code in zip(ids, borders, cells, strict=True)
        if b.fitted and _is_near(b, predicted[i]) and _correlation(srgb, b.corners_px, code) > LEAST_CORRELATION
    }


def _predict_corners(srgb, view: MarkersInView, missing: Ids, corners_mm) -> dict[int, np.ndarray] | None:
    """Corners of missing markers in the picture, by id, from the fitted ones; None if these determine no homography."""
    fit = _fit({i: b.corners_px for i, b in view.markers.items() if b.fitted}, corners_mm)
    if fit is None:
        return None
    quads = {i: apply_homography(fit.px_from_mm, corners_mm[i]) for i in missing}
    seen = {i: quad for i, quad in quads.items() if detect.is_plausible_quad(quad) and is_in_picture(quad, srgb)}
    return {i: quad for i, quad in seen.items() if _side_px(quad) >= 10}


def _fit(corners_px: Quads, corners_mm: Quads) -> PageFit | None:
    try:
        return fit_page(corners_px, corners_mm)
    except (PhotoRejected, np.linalg.LinAlgError):
        return None


def is_in_picture(quad: np.ndarray, srgb: np.ndarray) -> bool:
    """True if corners 4×2 px lie in a picture, with two pixels to its edge."""
    return bool((quad > 2).all() and (quad < [srgb.shape[1] - 2, srgb.shape[0] - 2]).all())


def shows_small_code(srgb: np.ndarray, quad: np.ndarray, marker_id: int, dictionary: str) -> bool:
    """True if corners 4×2 px lie in the picture, are too small for borders to be fitted, and resemble a marker."""
    code = marker_cells(dictionary, [marker_id])[0]
    is_small = is_in_picture(quad, srgb) and _side_px(quad) < READABLE_PX / 2
    return is_small and _correlation(srgb, quad, code, _TRIAL_OFFSETS) > LEAST_CORRELATION


def _side_px(quad: np.ndarray) -> float:
    return float(np.sqrt(abs(cv2.contourArea(quad.astype(np.float32)))))


def _is_near(borders: Borders, quad: np.ndarray) -> bool:
    return bool(np.linalg.norm(borders.corners_px - quad, axis=1).max() < max(0.5 * borders.module_px, 1.0))


def _correlation(srgb: np.ndarray, corners_px: np.ndarray, code: np.ndarray, offsets=((0.0, 0.0),)) -> float:
    """Correlation of the cells' light with the printed pattern, at the best of several offsets in modules."""
    n = len(code)
    square = np.array([[0, 0], [n, 0], [n, n], [0, n]], np.float32)
    to_px = cv2.getPerspectiveTransform(square, corners_px.astype(np.float32))
    rows, columns = np.mgrid[1 : n - 1, 1 : n - 1] + 0.5  # without the black border
    inner = np.column_stack([columns.ravel(), rows.ravel()])
    centers = apply_homography(to_px, (np.array(offsets)[:, None] + inner).reshape(-1, 2))
    region = region_around(centers, 1, srgb.shape)
    light = detect.luminance(np.ascontiguousarray(srgb[region]))
    cells = sample(light, centers - [region[1].start, region[0].start]).reshape(len(offsets), -1)
    values, printed = cells[cells.std(1) > 1e-6], code[1:-1, 1:-1].ravel()
    values, printed = values - values.mean(1, keepdims=True), printed - printed.mean()
    correlation = values @ printed / (np.linalg.norm(values, axis=1) * np.linalg.norm(printed))
    return float(correlation.max(initial=-1.0))
