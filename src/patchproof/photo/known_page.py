"""Find all markers of a known page: those that the detector finds, and others at the places that these predict.

In: the photograph and the place of every marker on the page. Out: `MarkersInView`. After each level of the detector a
homography from the markers found so far predicts the corners of the missing ones. Where the cells resemble the printed
ones, borders are fitted from there; a marker counts if they lie near the prediction and its cells match. This needs no
contours, so it works for small, blurred or partly covered markers, and it saves finer levels, which cost most.

A print, or a second one, may be too far away for its markers to be read: dark squares are compared with the known
codes, and count where two or three lie as on the sheet. That works from 8 px across on; at a blur of 0.9 px it works
from 10 px on, and reading from 14.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import cv2
import numpy as np

from patchproof.base.geometry import apply_homography
from patchproof.photo import detect
from patchproof.photo.detect import Detections, Ids, ImageRegion, MarkersInView
from patchproof.photo.edges import Borders, sample
from patchproof.photo.rectify import PageFit, Quads, fit_page, region_around
from patchproof.photo.rejection import PhotoRejected
from patchproof.sheets.markers import DICTIONARY, aruco_dictionary, marker_cells

# Of the light with the printed cells: blur lowers it to 0.8, and other codes of the dictionary stay below 0.6.
LEAST_CORRELATION = 0.7
# Borders, which cost most, are fitted only from here on, from the best of the offsets (in modules) about the predicted
# place: two markers 12 px across, the others' diagonal, are off by up to 1.6 modules at the other corners.
_MIN_TRIAL_CORRELATION = 0.5
_TRIAL_OFFSETS = np.stack(np.meshgrid(*2 * [np.linspace(-1.6, 1.6, 9)]), -1).reshape(-1, 2)
# A marker's side in px, 4 a module: the detector reads 99 % of such markers, so one that is missing must be covered.
READABLE_PX, _UNREAD_PX = 28.0, 18.0  # the latter: where none is read, larger squares are other codes
_LEAST_MARKERS = 3  # with less, flat paper cannot be told from bent
# The picture is scaled until the first print's markers have this side; those of one four times as far have 17 px then.
_FIRST_PX, _MOST_SCALE, _MOST_PIXELS = 70.0, 2.0, 4_500_000
_LEAST_PX, _LARGEST_SHARE, _MOST_SQUARES = 9.0, 1.2, 300  # sides of squares there; of the first print's markers
_OFFSETS = np.array([(x, y) for x in (-0.5, 0.0, 0.5) for y in (-0.5, 0.0, 0.5)])  # in modules
_LEAST_LIKENESS = {3: 0.5, 2: 0.7}  # of the cells' light with the codes, by the number of markers that show a print
_LEAST_OF_ONE = 0.85
_SQUARES_PER_MARKER = 3  # those most like it
_SAME_PX = 4.0  # between the middles of a marker that was read and of its square
_MOST_MISFIT = 0.15  # rms of corners as an affine map of the sheet has them, in sides of a marker

Match = tuple[int, float, np.ndarray]
"""A marker's id, how well a square's light correlates with its code, and the square from the code's top-left corner."""


def find_sheet(srgb: np.ndarray, expected: Ids, corners_mm: Quads, dictionary: str = DICTIONARY) -> MarkersInView:
    """Find the markers of `corners_mm` (page mm by id) in a uint8 photograph, then those of prints beside the first
    one. The search ends when each of `expected` is found, out of the picture or covered, unless a finer level could
    decide about a single foreign marker.
    """
    aruco, detections = aruco_dictionary(dictionary), Detections()
    borders, mirrored = dict[int, Borders](), set[int]()
    region, view = detect.full_region(srgb), MarkersInView({}, (), ())
    for level in detect.pyramid_levels(srgb, region):
        count, foreign = sum(map(len, detections.values())), view.foreign
        mirrored |= detect.search_level(srgb, region, level, aruco, detections)
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
    few = fitted < min(max(_LEAST_MARKERS, len(expected) / 2), len(expected)) and not view.another_sheet
    # a larger picture is reduced, and shows nothing there that cannot be read
    if few and (view.markers or srgb[..., 0].size <= _MOST_PIXELS):
        small = find_small_markers(srgb, view.corners_px, {i: corners_mm[i] for i in expected}, dictionary)
        detections = {i: [quad] for i, quad in small.items()} | detections
        detected = detect.fit_detections(srgb, detections, set(corners_mm), dictionary)
        view = complete_markers(srgb, detected, corners_mm, dictionary)
    view = replace(view, mirrored=frozenset(mirrored & corners_mm.keys()))
    if view.doubled or view.another_sheet:
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
        missing = {i for i, quad in quads.items() if detect.side_px(quad) * scale < READABLE_PX}
    if quads is None or not missing:
        return missing, detect.full_region(srgb)
    margin = 2 * max(detect.side_px(quads[i]) for i in missing)
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
    trials = {i: _likeness(srgb, predicted[i], codes[i], _TRIAL_OFFSETS) for i in ids}
    rough = {i: corners for i, (likeness, corners) in trials.items() if likeness > _MIN_TRIAL_CORRELATION}
    if not rough:
        return {}
    borders = detect.fit_marker_borders(srgb, np.array([*rough.values()]), np.array([codes[i] for i in rough]))
    return {
        i: b
        for i, b in zip(rough, borders, strict=True)
        if b.fitted
        and np.linalg.norm(b.corners_px - rough[i], axis=1).max() < max(0.5 * b.module_px, 1.0)
        and _likeness(srgb, b.corners_px, codes[i])[0] > LEAST_CORRELATION
    }


def _predict_corners(srgb, view: MarkersInView, missing: Ids, corners_mm) -> dict[int, np.ndarray] | None:
    """Corners of missing markers in the picture, by id, from the fitted ones; None if these determine no homography."""
    fit = _fit({i: b.corners_px for i, b in view.markers.items() if b.fitted}, corners_mm)
    if fit is None:
        return None
    quads = {i: apply_homography(fit.px_from_mm, corners_mm[i]) for i in missing}
    seen = {i: quad for i, quad in quads.items() if detect.is_plausible_quad(quad) and is_in_picture(quad, srgb)}
    return {i: quad for i, quad in seen.items() if detect.side_px(quad) >= 10}


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
    is_small = is_in_picture(quad, srgb) and detect.side_px(quad) < READABLE_PX / 2
    return is_small and _likeness(srgb, quad, marker_cells(dictionary, [marker_id])[0], _OFFSETS)[0] > LEAST_CORRELATION


def _likeness(srgb, corners_px: np.ndarray, code: np.ndarray, offsets=_OFFSETS[4:5]) -> tuple[float, np.ndarray]:
    """Correlation of cells' light with a code at the best of some offsets (none) in modules, and the corners there."""
    n = len(code)
    square = np.array([[0, 0], [n, 0], [n, n], [0, n]], np.float32)
    to_px = cv2.getPerspectiveTransform(square, corners_px.astype(np.float32))
    inner = np.indices((n - 2, n - 2))[::-1].reshape(2, -1).T + 1.5  # without the black border
    centers = apply_homography(to_px, (offsets[:, None] + inner).reshape(-1, 2))
    region = region_around(centers, 1, srgb.shape)
    light = detect.luminance(np.ascontiguousarray(srgb[region]))
    cells = sample(light, centers - [region[1].start, region[0].start])
    correlation = _normalized(cells, len(inner)) @ _normalized(code[1:-1, 1:-1], len(inner))[0]
    best = int(correlation.argmax())
    return float(correlation[best]), apply_homography(to_px, square + offsets[best])


def find_second_print(
    srgb: np.ndarray, corners_px: Quads, corners_mm: Quads, dictionary: str, agree: bool
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Ids of markers beside `corners_px` and no larger: those that show a second print, and those of other sheets. If
    `agree`, the markers found are of one print, and only what lies outside of them all counts.
    """
    if len(corners_px) < 2:
        return (), ()
    first = np.concatenate([corners_px[i] for i in sorted(corners_px)])
    side = max(map(detect.side_px, corners_px.values()))
    light, scale = _scaled_light(srgb, _FIRST_PX / max(side, 1.0))
    hull = cv2.convexHull((first * scale).astype(np.float32))
    middles = scale * first.reshape(-1, 4, 2).mean(1)
    quads = [
        q
        for q in _dark_squares(light, _LARGEST_SHARE * side * scale)
        if np.linalg.norm(middles - q.mean(0), axis=1).min() > side * scale / 2
        and not (agree and cv2.pointPolygonTest(hull, q.mean(0).tolist(), False) >= 0)
    ]
    matches = _matches(light, quads, sorted(corners_px), dictionary)
    # where markers of two prints were found as one, a single one may be left
    single = {i for i, correlation, _ in matches if not agree and correlation > _LEAST_OF_ONE}
    doubled = single or next(_groups(matches, corners_mm), {})
    return tuple(sorted(doubled)), tuple(sorted(_read_codes(light, quads, dictionary) - corners_mm.keys()))


def _read_codes(light: np.ndarray, quads: list[np.ndarray], dictionary: str) -> set[int]:
    """Ids of the dictionary whose code squares show without an error; OpenCV's `identify` takes 4 ms for each."""
    aruco, found = aruco_dictionary(dictionary), set()
    n, codes = aruco.markerSize, detect.marker_codes(aruco.bytesList.tobytes(), aruco.markerSize)
    square = 4 * np.array([[-1, -1], [n + 1, -1], [n + 1, n + 1], [-1, n + 1]], np.float32) - 0.5
    for quad in quads[:_MOST_SQUARES]:
        to_cells = cv2.getPerspectiveTransform(quad.astype(np.float32) - 0.5, square)
        cells = cv2.resize(cv2.warpPerspective(light, to_cells, (4 * n, 4 * n)), (n, n), interpolation=cv2.INTER_AREA)
        low, high = int(cells.min()), int(cells.max())
        if high > 1.5 * low:
            alike = np.where(cells.ravel() > (low + high) / 2, 1.0, -1.0) @ codes
            found |= set((np.flatnonzero(alike == n * n) % len(aruco.bytesList)).tolist())
    return found


def find_small_markers(srgb: np.ndarray, read: Quads, corners_mm: Quads, dictionary: str) -> dict[int, np.ndarray]:
    """Rough corners 4×2 by id of markers too small to be read that lie as on the sheet, with those in `read` if any."""
    found = dict(read)
    for to_gray in (detect.light_picture, detect.code_picture):  # codes where paper's light hides thin borders
        light, scale = _scaled_light(srgb, _MOST_SCALE, to_gray)
        squares = _dark_squares(light, _FIRST_PX if read else _UNREAD_PX * scale)
        for scaled in _groups(_matches(light, squares, [*corners_mm], dictionary), corners_mm):
            group = {i: quad / scale for i, quad in scaled.items()}
            apart = (scale * np.linalg.norm((group[i] - found[i]).mean(0)) for i in group.keys() & found.keys())
            joins = min(apart, default=np.inf) < _SAME_PX or _misfit(group | found, corners_mm) < _MOST_MISFIT
            found = group | found if joins else found
    return {i: found[i] for i in found.keys() - read.keys()}


def _groups(matches: list[Match], corners_mm: Quads) -> Iterator[dict[int, np.ndarray]]:
    """Yield groups (corners by id) that lie as on the sheet: of three markers, then of two with better correlations."""
    for count, least in _LEAST_LIKENESS.items():
        for group in combinations([match for match in matches if match[1] > least], count):
            quads = {marker_id: quad for marker_id, _, quad in group}
            if len(quads) == count and _misfit(quads, corners_mm) < _MOST_MISFIT:
                yield quads


def _scaled_light(srgb: np.ndarray, scale: float, to_gray=detect.light_picture) -> tuple[np.ndarray, float]:
    """The picture's light at about this scale, and the scale."""
    scale = min(scale, _MOST_SCALE, float(np.sqrt(_MOST_PIXELS / srgb[..., 0].size)))
    scale = scale if scale >= 1 else 1 / float(np.ceil(1 / scale))  # whole pixels are averaged 20 times as fast
    size = max(1, round(srgb.shape[1] * scale)), max(1, round(srgb.shape[0] * scale))
    if scale < 1:
        return to_gray(cv2.resize(srgb, size, interpolation=cv2.INTER_AREA)), scale
    return cv2.resize(to_gray(srgb), size, interpolation=cv2.INTER_CUBIC), scale


def _dark_squares(light: np.ndarray, most_px: float) -> list[np.ndarray]:
    """Clockwise corners 4×2 of dark quadrilaterals, largest first."""
    dark = cv2.adaptiveThreshold(light, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, 17, 3)
    outlines, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    # an outline runs through the middles of dark pixels, so that it is a pixel too short on each side
    outlines = [o for o in outlines if 4 * (_LEAST_PX - 1) <= len(o) <= 4 * most_px]
    polygons = [cv2.approxPolyDP(o, 0.05 * len(o), True) for o in sorted(outlines, key=len, reverse=True)]
    quads = [p.reshape(4, 2) + 0.5 for p in polygons if len(p) == 4 and cv2.isContourConvex(p)]
    quads = [q if cv2.contourArea(q.astype(np.float32), True) > 0 else q[::-1] for q in quads]
    return [q + (q - q.mean(0)) / max(float(np.linalg.norm(q[1] - q[0])), 1.0) for q in quads]


def _matches(light: np.ndarray, quads: list[np.ndarray], ids: list[int], dictionary: str) -> list[Match]:
    """The squares most like each marker, turned by any quarter turns and shifted by half a module at most."""
    quads = quads[:_MOST_SQUARES]
    if len(quads) < 2:
        return []
    cells = marker_cells(dictionary, ids)
    n = cells.shape[1]
    inner = np.indices((n - 2, n - 2))[::-1].reshape(2, -1).T + 1.5
    points = (_OFFSETS[:, None] + inner).reshape(-1, 2)
    square = np.array([[0, 0], [n, 0], [n, n], [0, n]], np.float32)
    to_px = [cv2.getPerspectiveTransform(square, q.astype(np.float32)) for q in quads]
    seen = _normalized(sample(light, np.array([apply_homography(h, points) for h in to_px])), len(inner))
    turned = np.stack([np.rot90(cells, turns, (1, 2)) for turns in range(4)], 1)[..., 1:-1, 1:-1]
    codes = _normalized(turned, len(inner)).reshape(len(ids), 4, -1)
    correlation = np.einsum("qoc,mtc->mtqo", seen.reshape(len(quads), len(_OFFSETS), -1), codes)
    matches = []
    for marker_id, table in zip(ids, correlation, strict=True):
        for best in np.argsort(-table.max(2), axis=None)[:_SQUARES_PER_MARKER].tolist():
            turns, k = divmod(best, len(quads))
            x, y = _OFFSETS[table[turns, k].argmax()]
            corners = apply_homography(to_px[k], square + np.array([x, y]))
            matches.append((marker_id, float(table[turns, k].max()), np.roll(corners, turns, axis=0)))
    return matches


def _normalized(values: np.ndarray, count: int) -> np.ndarray:
    """Return rows of `count` values with mean 0 and length 1, whose inner products are correlations."""
    rows = values.reshape(-1, count)
    rows = rows - rows.mean(1, keepdims=True)
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-6)


def _misfit(quads: Quads, corners_mm: Quads) -> float:
    mm, px = (np.concatenate([corners[i] for i in quads]) for corners in (corners_mm, quads))
    rows = np.column_stack([mm, np.ones(len(mm))])
    affine = np.linalg.lstsq(rows, px, rcond=None)[0]
    side_px = np.linalg.norm(mm[1] - mm[0]) * np.sqrt(abs(np.linalg.det(affine[:2])))
    return float(np.sqrt(np.mean((rows @ affine - px) ** 2)) / max(side_px, 1e-9))
