"""Find the printed markers in a photograph, coarse to fine.

In: uint8 sRGB pixels and the ids that the sheet carries. Out: `MarkersInView`: corners in photo pixels (centers at .5,
clockwise from the code's top-left) with what their borders show of blur, the ids of the same dictionary
that are not the sheet's, and ids seen at two places. The detector looks at linear light: in code values blurred paper
grows over ink, and at a blur of 0.3 modules it read 5 of 48 markers where linear light read 45. The pyramid starts
below 1000 px and stops at the level where every expected id has been found; only if some are missing are code values
tried, local contrast (CLAHE) where the photo is dark, and twice the size where there are less than 4 megapixels to
look at. Corners of all levels are then fitted in the full photograph (`edges`). Where the page's millimeters are known
`complete.find_sheet` needs fewer levels. Only OpenCV's class API is used, so 4.11 to 5.x will do.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence, Set
from dataclasses import dataclass, replace

import cv2
import numpy as np

from patchproof.base.color import LINEAR_FROM_CODE, LUMINANCE
from patchproof.base.input import seconds_left
from patchproof.base.resample import downscale
from patchproof.photo.edges import Borders, fit_borders
from patchproof.photo.limits import squares_in
from patchproof.photo.rectify import region_around
from patchproof.photo.rejection import PhotoRejected
from patchproof.sheets.markers import DICTIONARY, aruco_dictionary, marker_cells

LINEAR_FLOAT32_FROM_CODE = LINEAR_FROM_CODE.astype(np.float32)
COARSEST_PX = 1000  # a level's longer side; halves are taken until it is no longer than this
UPSCALE_BELOW_PX = 4_000_000
LARGEST_LEVEL_PX = 25_000_000  # of what one level looks at: a second of work and 0.3 GB; sharper pictures are halved
MOST_SQUARES = 2000  # photographs have some hundreds at most
_SQUARE_S = 0.004  # that it takes to look into one, which nothing interrupts
MIRROR_PX = 3000  # longer side of the picture in which a mirrored sheet is looked for
DARK = 70  # median code value below which local contrast helps; in light photos it hurts sharp markers
# how far beyond a marker's rough corners its borders are looked for, at most: `edges` may move them by 1 px and 0.6
# modules, a seventh of the marker each, and looks 10 px farther
_FAR_PX, _FAR = 16.0, 0.2
SMALLEST_MARKER_PX = 9.0  # side at its level: 7 modules of 1.3 px are the least that has been read
# A reduced picture is looked at through one window of the detector's threshold, a full one through its three, which
# take twice the time: markers that one misses are found where the others say that they lie, or at a finer level.
_REDUCED_WINDOW_PX = 5

ImageRegion = tuple[slice, slice]
"""Rows and columns of a part of the photograph."""


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
    """One look at a photograph: its pixels' `scale`, what of them the detector gets (uint8 gray from sRGB), and all of
    it averaged down, where that scale has half a picture's pixels or fewer along each side.
    """

    scale: float
    picture: Callable[[np.ndarray], np.ndarray]
    small: np.ndarray | None = None


def find_markers(
    srgb: np.ndarray,
    expected: Set[int],
    also: Set[int] = frozenset(),
    dictionary: str = DICTIONARY,
    or_all_of: Sequence[Set[int]] = (),
) -> MarkersInView:
    """All markers of `expected` and `also` in the picture; the search ends when all of `expected` are found, or all of
    a set in `or_all_of`.
    """
    printed = aruco_dictionary(dictionary)
    detections: dict[int, list[np.ndarray]] = {}
    for level in pyramid_levels(srgb, full_region(srgb)):
        search_level(srgb, full_region(srgb), level, printed, detections)
        if any(wanted <= detections.keys() for wanted in (expected, *or_all_of)):
            break
    return fitted(srgb, detections, set(expected) | set(also), dictionary)


def fitted(
    srgb: np.ndarray,
    detections: dict[int, list[np.ndarray]],
    ours: Set[int],
    dictionary: str,
    borders: dict[int, Borders] | None = None,
) -> MarkersInView:
    """`detections` with borders fitted in the full photograph; those in `borders` are, and the others are added."""
    borders, known = {} if borders is None else borders, sorted(detections.keys() & ours)
    if new := [marker_id for marker_id in known if marker_id not in borders]:
        rough = np.array([detections[marker_id][0] for marker_id in new])
        borders |= zip(new, refine(srgb, rough, marker_cells(dictionary, new)), strict=True)
    markers = {i: borders[i] for i in known if is_plausible_quad(borders[i].corners_px)}
    foreign = tuple(sorted(detections.keys() - set(known)))
    return MarkersInView(markers, foreign, tuple(i for i in known if len(detections[i]) > 1))


def is_mirrored(srgb: np.ndarray, expected: Set[int], dictionary: str = DICTIONARY) -> bool:
    """Whether the sheet shows up when the picture is flipped: selfie cameras and scans through the back do that."""
    mirrored = np.ascontiguousarray(downscale(srgb, MIRROR_PX)[:, ::-1])
    return bool(find_markers(mirrored, expected, frozenset(), dictionary).markers)


def is_plausible_quad(corners: np.ndarray) -> bool:
    """Whether a flat square can look like this: convex, clockwise, no side more than 12 times another."""
    sides = np.roll(corners, -1, axis=0) - corners
    following = np.roll(sides, -1, axis=0)
    turns = sides[:, 0] * following[:, 1] - sides[:, 1] * following[:, 0]
    lengths = np.linalg.norm(sides, axis=1)
    return bool(np.isfinite(corners).all() and (turns > 0).all() and lengths.max() < 12 * lengths.min())


def full_region(srgb: np.ndarray) -> ImageRegion:
    """The box of all of the photograph."""
    return slice(0, srgb.shape[0]), slice(0, srgb.shape[1])


def pyramid_levels(srgb: np.ndarray, box: ImageRegion, coarsest_px: int = COARSEST_PX) -> Iterator[Level]:
    """Half sizes in linear light up to the full one, then the fallbacks for a part of the photograph."""
    halvings = max(0, int(np.ceil(np.log2(max(srgb.shape[:2]) / coarsest_px))))
    smaller = [srgb]  # halves of halves differ from what they stand for by a code value, and all take less than one
    for n in range(1, halvings + 1):
        even = not any(side % 2 for side in smaller[-1].shape[:2])
        smaller.append(cv2.resize(smaller[-1] if even else srgb, _scaled(srgb, 0.5**n), interpolation=cv2.INTER_AREA))
    for n in range(halvings, 0, -1):
        yield Level(0.5**n, light_picture, smaller[n])
    yield Level(1.0, light_picture)
    yield Level(1.0, code_picture)
    codes = [code_picture]
    part, sparse = srgb[box], max(1, max(srgb.shape) // 512)
    if float(np.median(code_picture(np.ascontiguousarray(part[::sparse, ::sparse])))) < DARK:
        codes = [contrast_picture]
        yield Level(1.0, contrast_picture)
    if part.shape[0] * part.shape[1] < UPSCALE_BELOW_PX:
        yield from (Level(2.0, picture) for picture in (light_picture, *codes))


def search_level(
    srgb: np.ndarray, box: ImageRegion, level: Level, printed, detections: dict[int, list[np.ndarray]]
) -> None:
    """Add to `detections` the corners, in the full photograph's pixels, of what one level shows of a part of it."""
    part = srgb[box]
    height, width = part.shape[:2]
    if width * height * level.scale**2 > LARGEST_LEVEL_PX:
        return
    size = _scaled(part, level.scale)
    if level.scale < 1:
        known = level.small is not None and part.shape == srgb.shape
        part = level.small if known else cv2.resize(part, size, interpolation=cv2.INTER_AREA)
    picture = level.picture(np.ascontiguousarray(part))
    if level.scale > 1:
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_CUBIC)
    to_full, start = np.array([width / size[0], height / size[1]]), [box[1].start, box[0].start]
    for marker_id, quad in _detect(picture, printed, level.scale * max(srgb.shape), level.scale < 1):
        corners, others = quad * to_full + start, detections.setdefault(marker_id, [])
        apart = 0.5 * np.linalg.norm(corners[2] - corners[0])  # nearer, it is the same marker as at another level
        if all(np.linalg.norm(corners.mean(0) - other.mean(0)) > apart for other in others):
            others.append(corners)


def _scaled(srgb: np.ndarray, scale: float) -> tuple[int, int]:
    """Width and height at another scale."""
    return max(1, round(srgb.shape[1] * scale)), max(1, round(srgb.shape[0] * scale))


def light_picture(srgb: np.ndarray) -> np.ndarray:
    """Linear light scaled so that all but the brightest thousandth (lamps, glare) fits."""
    step = max(1, max(srgb.shape) // 500)
    bright = max(float(np.percentile(luminance(np.ascontiguousarray(srgb[::step, ::step])), 99.9)), 1e-3)
    picture = np.empty(srgb.shape[:2], np.uint8)
    for rows in row_strips(srgb):
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


def _detect(
    picture: np.ndarray, printed, whole_px: float, is_reduced: bool = False
) -> Iterator[tuple[int, np.ndarray]]:
    """Ids and corners of one gray picture, part of one whose longer side has `whole_px` pixels."""
    settings = detector_settings()
    if is_reduced:
        settings.adaptiveThreshWinSizeMin = settings.adaptiveThreshWinSizeMax = _REDUCED_WINDOW_PX
    settings.minDistanceToBorder = 0
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    settings.relativeCornerRefinmentWinSize = 0.3
    settings.minMarkerPerimeterRate = min(0.03 * whole_px, 4 * SMALLEST_MARKER_PX) / max(picture.shape)
    corners, ids = detect_markers(picture, printed, settings)
    if ids is None:
        return
    for marker_id, quad in zip(np.asarray(ids).reshape(-1), corners, strict=True):
        # the detector counts from pixel centers: its 0 is our .5
        quad = np.asarray(quad, float).reshape(4, 2) + 0.5
        if is_plausible_quad(quad):
            yield int(marker_id), quad


def detect_markers(picture: np.ndarray, printed, settings: cv2.aruco.DetectorParameters):
    """OpenCV's (corners, ids or None) of one uint8 gray picture; `PhotoRejected("too_costly")` where it shows so much
    that looks like markers that the detector would not end in time.
    """
    most = int(min(MOST_SQUARES, seconds_left() / _SQUARE_S))
    squares = squares_in(picture, settings.minMarkerPerimeterRate * max(picture.shape), most)
    if squares > most:
        advice = f"it shows {squares} squares that could be markers: photograph less of that pattern"
        raise PhotoRejected("too_costly", squares, most, advice)
    return cv2.aruco.ArucoDetector(printed, settings).detectMarkers(picture)[:2]


def refine(srgb: np.ndarray, rough: np.ndarray, cells: np.ndarray) -> list[Borders]:
    """Fit borders in the photograph, of which only what lies round the markers is turned into light."""
    box = region_around(rough.reshape(-1, 2), _FAR_PX, srgb.shape)
    low = np.array([box[1].start, box[0].start])
    part, quads = srgb[box], rough - low
    light = np.zeros(part.shape[:2], np.float32)  # pages of it that nobody looks at take no memory
    for quad in quads:
        around = region_around(quad, _FAR_PX + _FAR * np.ptp(quad, axis=0).max(), part.shape)
        light[around] = luminance(np.ascontiguousarray(part[around]))
    return [replace(b, corners_px=b.corners_px + low) for b in fit_borders(light, quads, cells)]


def luminance(srgb: np.ndarray) -> np.ndarray:
    """Linear luminance H×W float32 of uint8 sRGB."""
    table = np.repeat(LINEAR_FLOAT32_FROM_CODE[None, :, None], 3, 2)
    weights = np.array([LUMINANCE], np.float32)
    out = np.empty(srgb.shape[:2], np.float32)
    for rows in row_strips(srgb):  # the table makes 12 bytes of each pixel
        cv2.transform(cv2.LUT(srgb[rows], table), weights, out[rows])
    return out


def row_strips(srgb: np.ndarray) -> Iterator[slice]:
    """Slices of rows of a million pixels or so; the last may pass the end."""
    rows = max(1, 1_000_000 // srgb.shape[1])
    return (slice(y, y + rows) for y in range(0, len(srgb), rows))
