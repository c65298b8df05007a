"""Find the printed markers in a photograph, coarse to fine.

In: uint8 sRGB pixels and the ids that the sheet carries. Out: `MarkersInView`: corners in photo pixels (centers at .5,
clockwise from the code's top-left) with what their borders show of blur and light, the ids of the same dictionary
that are not the sheet's, and ids seen at two places. The detector looks at linear light: in code values blurred paper
grows over ink, and at a blur of 0.3 modules it read 5 of 48 markers where linear light read 45. The pyramid starts
below 1000 px and stops at the level where every expected id has been found; only if some are missing are code values
tried, local contrast (CLAHE) where the photo is dark, and twice the size where there are less than 4 megapixels to
look at. Corners of all levels are then fitted in the full photograph (`edges`). Where the page's millimeters are known
`complete.find_sheet` needs fewer levels. Only OpenCV's class API is used, so 4.10 to 5.x will do.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence, Set
from dataclasses import dataclass

import cv2
import numpy as np

from patchproof.color import LIGHT_OF_CODE, LUMINANCE
from patchproof.photo.edges import Borders, fit_borders

DICTIONARY = "DICT_5X5_1000"
COARSEST_PX = 1000  # a level's longer side; halves are taken until it is no longer than this
UPSCALE_BELOW_PX = 4_000_000
LARGEST_LEVEL_PX = 25_000_000  # of what one level looks at: a second of work and 0.3 GB; sharper pictures are halved
MIRROR_PX = 3000  # longer side of the picture in which a mirrored sheet is looked for
DARK = 70  # median code value below which local contrast helps; in light photos it hurts sharp markers
SMALLEST_MARKER_PX = 9.0  # side at its level: 7 modules of 1.3 px are the least that has been read

Box = tuple[int, int, int, int]
"""Left, top, right, bottom of a part of the photograph, in whole pixels."""


@dataclass(frozen=True)
class MarkersInView:
    """`markers` by id; `foreign` ids of the same dictionary; `doubled` ids of ours that lie at two places."""

    markers: dict[int, Borders]
    foreign: tuple[int, ...]
    doubled: tuple[int, ...]

    @property
    def corners_px(self) -> dict[int, np.ndarray]:
        """Corners 4×2 by id."""
        return {marker_id: borders.corners_px for marker_id, borders in self.markers.items()}


@dataclass(frozen=True)
class Level:
    """One look at a photograph: its pixels' `scale` and what of them the detector gets (uint8 gray from sRGB)."""

    scale: float
    picture: Callable[[np.ndarray], np.ndarray]


def find_markers(
    srgb: np.ndarray,
    expected: Set[int],
    also: Set[int] = frozenset(),
    dictionary: str = DICTIONARY,
    or_all_of: Sequence[Set[int]] = (),
) -> MarkersInView:
    """All markers of `expected` and `also` in the picture; the search ends when every one of `expected` is found, or
    every one of a set in `or_all_of`.
    """
    printed = printed_markers(dictionary)
    detections: dict[int, list[np.ndarray]] = {}
    for level in levels(srgb, whole(srgb)):
        look(srgb, whole(srgb), level, printed, detections)
        if any(wanted <= detections.keys() for wanted in (expected, *or_all_of)):
            break
    return fitted(srgb, detections, set(expected) | set(also), printed)


def fitted(srgb: np.ndarray, detections: dict[int, list[np.ndarray]], ours: Set[int], printed) -> MarkersInView:
    """`detections` with borders fitted in the full photograph."""
    known = sorted(detections.keys() & ours)
    rough = np.array([detections[marker_id][0] for marker_id in known]).reshape(-1, 4, 2)
    borders = refine(srgb, rough, cells_of(printed, known)) if known else []
    markers = {i: b for i, b in zip(known, borders, strict=True) if possible(b.corners_px)}
    foreign = tuple(sorted(detections.keys() - set(known)))
    return MarkersInView(markers, foreign, tuple(i for i in known if len(detections[i]) > 1))


def printed_markers(dictionary: str):
    """OpenCV's dictionary of that name."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))


def is_mirrored(srgb: np.ndarray, expected: Set[int], dictionary: str = DICTIONARY) -> bool:
    """Whether the sheet shows up when the picture is flipped: selfie cameras and scans through the back do that."""
    shrink = MIRROR_PX / max(srgb.shape)
    if shrink < 1:
        srgb = cv2.resize(srgb, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    return bool(find_markers(np.ascontiguousarray(srgb[:, ::-1]), expected, frozenset(), dictionary).markers)


def possible(corners: np.ndarray) -> bool:
    """Whether a flat square can look like this: convex, clockwise, no side more than 12 times another."""
    sides = np.roll(corners, -1, axis=0) - corners
    following = np.roll(sides, -1, axis=0)
    turns = sides[:, 0] * following[:, 1] - sides[:, 1] * following[:, 0]
    lengths = np.linalg.norm(sides, axis=1)
    return bool(np.isfinite(corners).all() and (turns > 0).all() and lengths.max() < 12 * lengths.min())


def cells_of(printed, ids) -> np.ndarray:
    """The printed modules M×n×n of marker ids, rim included: 1 = paper, 0 = ink."""
    side = printed.markerSize + 2
    return np.stack([cv2.aruco.generateImageMarker(printed, int(i), side) for i in ids]).astype(float) / 255


def whole(srgb: np.ndarray) -> Box:
    """The box of all of the photograph."""
    return 0, 0, srgb.shape[1], srgb.shape[0]


def levels(srgb: np.ndarray, box: Box, coarsest_px: int = COARSEST_PX) -> Iterator[Level]:
    """Half sizes in linear light up to the full one, then the fallbacks for a part of the photograph."""
    halvings = max(0, int(np.ceil(np.log2(max(srgb.shape[:2]) / coarsest_px))))
    for n in range(halvings, -1, -1):
        yield Level(0.5**n, light_picture)
    yield Level(1.0, code_picture)
    codes = [code_picture]
    x0, y0, x1, y1 = box
    sparse = max(1, max(srgb.shape) // 512)
    if float(np.median(code_picture(np.ascontiguousarray(srgb[y0:y1:sparse, x0:x1:sparse])))) < DARK:
        codes = [contrast_picture]
        yield Level(1.0, contrast_picture)
    if (y1 - y0) * (x1 - x0) < UPSCALE_BELOW_PX:
        for picture in (light_picture, *codes):
            yield Level(2.0, picture)


def look(srgb: np.ndarray, box: Box, level: Level, printed, detections: dict[int, list[np.ndarray]]) -> None:
    """Add to `detections` the corners, in the full photograph's pixels, of what one level shows of a part of it."""
    x0, y0, x1, y1 = box
    if (x1 - x0) * (y1 - y0) * level.scale**2 > LARGEST_LEVEL_PX:
        return
    part = srgb[y0:y1, x0:x1]
    size = max(1, round((x1 - x0) * level.scale)), max(1, round((y1 - y0) * level.scale))
    if level.scale < 1:
        part = cv2.resize(part, size, interpolation=cv2.INTER_AREA)
    picture = level.picture(np.ascontiguousarray(part))
    if level.scale > 1:
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_CUBIC)
    to_full = np.array([(x1 - x0) / size[0], (y1 - y0) / size[1]])
    for marker_id, quad in _detect(picture, printed, level.scale * max(srgb.shape)):
        _add(detections, marker_id, quad * to_full + [x0, y0])


def light_picture(srgb: np.ndarray) -> np.ndarray:
    """Linear light scaled so that all but the brightest thousandth (lamps, glare) fits."""
    step = max(1, max(srgb.shape) // 512)
    bright = max(float(np.percentile(luminance(np.ascontiguousarray(srgb[::step, ::step])), 99.9)), 1e-3)
    picture = np.empty(srgb.shape[:2], np.uint8)
    for rows in _strips(srgb):
        cv2.convertScaleAbs(luminance(srgb[rows]), picture[rows], alpha=255 / bright)
    return picture


def code_picture(srgb: np.ndarray) -> np.ndarray:
    """Gray code values."""
    return cv2.cvtColor(srgb, cv2.COLOR_RGB2GRAY)


def contrast_picture(srgb: np.ndarray) -> np.ndarray:
    """Gray code values with their contrast evened out by region."""
    return cv2.createCLAHE(3.0, (8, 8)).apply(code_picture(srgb))


def detector_settings() -> cv2.aruco.DetectorParameters:
    """Chosen on warped pages of known geometry: of 48 markers blurred by 0.3 modules the defaults find 37, these 46."""
    settings = cv2.aruco.DetectorParameters()
    settings.perspectiveRemovePixelPerCell = 8
    settings.perspectiveRemoveIgnoredMarginPerCell = 0.3
    settings.adaptiveThreshConstant = 3
    return settings


def _detect(picture: np.ndarray, printed, whole_px: float) -> Iterator[tuple[int, np.ndarray]]:
    """Ids and corners of one gray picture, part of one whose longer side has `whole_px` pixels."""
    settings = detector_settings()
    settings.minDistanceToBorder = 0
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    settings.relativeCornerRefinmentWinSize = 0.3
    settings.minMarkerPerimeterRate = min(0.03 * whole_px, 4 * SMALLEST_MARKER_PX) / max(picture.shape)
    corners, ids, _ = cv2.aruco.ArucoDetector(printed, settings).detectMarkers(picture)
    if ids is None:
        return
    for marker_id, quad in zip(np.asarray(ids).reshape(-1), corners, strict=True):
        # the detector counts from pixel centers: its 0 is our .5
        quad = np.asarray(quad, float).reshape(4, 2) + 0.5
        if possible(quad):
            yield int(marker_id), quad


def _add(detections: dict[int, list[np.ndarray]], marker_id: int, corners: np.ndarray) -> None:
    """Remember one detection; the same marker seen again at another level is not a second one."""
    others = detections.setdefault(marker_id, [])
    size = np.linalg.norm(corners[2] - corners[0])
    if all(np.linalg.norm(corners.mean(0) - other.mean(0)) > 0.5 * size for other in others):
        others.append(corners)


def refine(srgb: np.ndarray, rough: np.ndarray, cells: np.ndarray) -> list[Borders]:
    """Fit borders in the part of the photograph that holds the markers; only that part is turned into light."""
    height, width = srgb.shape[:2]
    low = np.maximum(np.floor(rough.min((0, 1))).astype(int) - 16, 0)
    high = np.minimum(np.ceil(rough.max((0, 1))).astype(int) + 16, [width, height])
    part = np.ascontiguousarray(srgb[low[1] : high[1], low[0] : high[0]])
    borders = fit_borders(luminance(part), rough - low, cells)
    return [Borders(b.corners_px + low, b.blur_px, b.black, b.white, b.module_px, b.fitted) for b in borders]


def luminance(srgb: np.ndarray) -> np.ndarray:
    """Linear luminance H×W float32 of uint8 sRGB."""
    table = np.repeat(LIGHT_OF_CODE.astype(np.float32)[None, :, None], 3, 2)
    weights = np.array([LUMINANCE], np.float32)
    out = np.empty(srgb.shape[:2], np.float32)
    for rows in _strips(srgb):  # the table makes 12 bytes of each pixel
        cv2.transform(cv2.LUT(srgb[rows], table), weights, out[rows])
    return out


def _strips(srgb: np.ndarray) -> Iterator[slice]:
    """Slices of rows of a million pixels or so."""
    rows = max(1, 1_000_000 // srgb.shape[1])
    return (slice(y, y + rows) for y in range(0, len(srgb), rows))
