"""Find a second print of a sheet in view, too far away for its markers to be read.

In: a photograph, the markers of the print that was found. Out: ids of those that a print beside it shows, too. Dark
squares are compared with the known codes, and count where two or three lie as on the sheet. A marker is seen so from
8 px across on in sharp pictures, from 10 px on at a blur of 0.9 px, where it is read from 14 px on.
"""

from collections.abc import Iterator
from itertools import combinations

import cv2
import numpy as np

from patchproof.base.geometry import apply_homography
from patchproof.photo.detect import light_picture, marker_codes
from patchproof.photo.edges import sample
from patchproof.photo.rectify import Quads
from patchproof.sheets.markers import aruco_dictionary, marker_cells

# The picture is scaled until the first print's markers are as large; those of one four times as far away are 17 px then
_FIRST_PX, _MOST_SCALE, _MOST_PIXELS = 70.0, 2.0, 4_500_000
_LEAST_PX, _LARGEST_SHARE, _MOST_SQUARES = 9.0, 1.2, 300  # sides of squares there; of the first print's markers
_OFFSETS = np.array([(x, y) for x in (-0.5, 0.0, 0.5) for y in (-0.5, 0.0, 0.5)])  # in modules
_LEAST_CORRELATION = {3: 0.5, 2: 0.7}  # of the cells' light with the codes, by the number of markers that show a print
_LEAST_OF_ONE = 0.85
_SQUARES_PER_MARKER = 3  # those most like it
_SAME_PX = 4.0  # between the middles of a marker that was read and of its square
_MOST_MISFIT = 0.15  # rms of corners as an affine map of the sheet has them, in sides of a marker

Match = tuple[int, float, np.ndarray]
"""A marker's id, how well a square's light correlates with its code, and the square from the code's top-left corner."""


def find_second_print(
    srgb: np.ndarray, corners_px: Quads, corners_mm: Quads, dictionary: str, agree: bool
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Ids of markers beside `corners_px` (outside of all of them if these `agree` that they are of one print) and no
    larger: the two or three that show a second print of the sheet, and those that are read and not in `corners_mm`.
    """
    if len(corners_px) < 2:
        return (), ()
    first = np.concatenate([corners_px[i] for i in sorted(corners_px)])
    side = max(float(np.sqrt(cv2.contourArea(q.astype(np.float32)))) for q in corners_px.values())
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
    return tuple(sorted(doubled)), tuple(sorted(_read(light, quads, dictionary) - corners_mm.keys()))


def _read(light: np.ndarray, quads: list[np.ndarray], dictionary: str) -> set[int]:
    """Ids of the dictionary whose code squares show without an error; OpenCV's `identify` takes 4 ms for each."""
    aruco, found = aruco_dictionary(dictionary), set()
    n, codes = aruco.markerSize, marker_codes(aruco.bytesList.tobytes(), aruco.markerSize)
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
    """Rough corners 4×2 by id of markers too small to be read that lie with those in `read` as on the sheet."""
    light, scale = _scaled_light(srgb, _MOST_SCALE)
    matches = _matches(light, _dark_squares(light, _FIRST_PX), sorted(corners_mm), dictionary)
    found = {i: quad * scale for i, quad in read.items()}
    for group in _groups(matches, corners_mm):
        if any(np.linalg.norm((group[i] - found[i]).mean(0)) < _SAME_PX for i in group.keys() & found.keys()):
            found = group | found
    return {i: found[i] / scale for i in found.keys() - read.keys()}


def _groups(matches: list[Match], corners_mm: Quads) -> Iterator[dict[int, np.ndarray]]:
    """Corners by id of markers that lie as on the sheet: three, then two that resemble their codes more."""
    for count, least in _LEAST_CORRELATION.items():
        for group in combinations([match for match in matches if match[1] > least], count):
            quads = {marker_id: quad for marker_id, _, quad in group}
            if len(quads) == count and _misfit(quads, corners_mm) < _MOST_MISFIT:
                yield quads


def _scaled_light(srgb: np.ndarray, scale: float) -> tuple[np.ndarray, float]:
    """The picture's light at about this scale, and the scale."""
    scale = min(scale, _MOST_SCALE, float(np.sqrt(_MOST_PIXELS / srgb[..., 0].size)))
    scale = scale if scale >= 1 else 1 / float(np.ceil(1 / scale))  # whole pixels are averaged 20 times as fast
    size = max(1, round(srgb.shape[1] * scale)), max(1, round(srgb.shape[0] * scale))
    if scale < 1:
        return light_picture(cv2.resize(srgb, size, interpolation=cv2.INTER_AREA)), scale
    return cv2.resize(light_picture(srgb), size, interpolation=cv2.INTER_CUBIC), scale


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
    inner = np.stack(np.meshgrid(np.arange(1, n - 1), np.arange(1, n - 1)), -1).reshape(-1, 2) + 0.5
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
    """Rows of `count` values whose products are correlations."""
    rows = values.reshape(-1, count)
    rows = rows - rows.mean(1, keepdims=True)
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-6)


def _misfit(quads: Quads, corners_mm: Quads) -> float:
    mm, px = (np.concatenate([corners[i] for i in quads]) for corners in (corners_mm, quads))
    rows = np.column_stack([mm, np.ones(len(mm))])
    affine = np.linalg.lstsq(rows, px, rcond=None)[0]
    side_px = np.linalg.norm(mm[1] - mm[0]) * np.sqrt(abs(np.linalg.det(affine[:2])))
    return float(np.sqrt(np.mean((rows @ affine - px) ** 2)) / max(side_px, 1e-9))
