"""Find the printed markers in a photograph, from coarse to fine.

In: uint8 sRGB pixels and the ids of the sheet. Out: `MarkersInView`: corners in photo pixels (centers at .5, clockwise
from the code's top-left) with the blur of their borders, ids of the same dictionary that are not the sheet's, and ids
found at two places. The detector gets linear light, because blurred paper spreads over ink in code values: at a blur of
0.3 modules it read 45 of 48 markers in linear light, and 5 in code values. The pyramid starts below 1000 px and stops
at the level where every expected id has been found. Only if some are missing, it tries code values and, in dark photos,
local contrast (CLAHE), both at half the size above 4 megapixels; smaller pictures are also tried at twice their size.
Corners are then fitted in the full photograph (`edges`). `known_page.find_sheet` knows the page's millimeters and needs
fewer levels. Only OpenCV's class API (4.11 to 5.x) is used.
"""

from collections.abc import Callable, Iterator, Sequence, Set
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import cv2
import numpy as np

from patchproof.base.color import LINEAR_FROM_CODE, LUMINANCE
from patchproof.base.geometry import corner_turns
from patchproof.base.input import remaining_seconds
from patchproof.photo.edges import Borders, fit_borders
from patchproof.photo.limits import find_squares
from patchproof.photo.rectify import region_around
from patchproof.photo.rejection import PhotoRejected
from patchproof.sheets.markers import DICTIONARY, aruco_dictionary, marker_cells

LINEAR_FLOAT32_FROM_CODE = LINEAR_FROM_CODE.astype(np.float32)
COARSEST_PX = 1000  # longer side of the coarsest level at most
UPSCALE_BELOW_PX = 4_000_000
LARGEST_LEVEL_PX = 25_000_000  # searched in one level: a second of work and 0.3 GB; larger pictures are halved
MOST_SQUARES = 1500  # photographs have some hundreds at most
_SQUARE_S = 0.004  # to examine one, which cannot be interrupted
DARK_CODE = 70  # median code value below which local contrast helps; in bright photos it hurts sharp markers
# Margin of light about a marker's rough corners: `edges` may move borders by 1 px and 0.6 modules (of 7 in a marker),
# and samples 10 px farther.
_MARGIN_PX, _MARGIN_SHARE = 16.0, 0.2
SMALLEST_MARKER_PX = 9.0  # side at its level: 7 modules of 1.3 px are the smallest that has been read
# Shares of a side: the detector also tries squares inside a square, which may be a quiet zone or shadow (one: 0.55).
_INSETS = (1.0, 0.93, 0.86, 0.79, 0.72, 0.66, 0.6, 0.54)
_LEAST_CONTRAST_CODES, _MOST_BORDER_ERRORS = 6, 0.4  # of a square that can be a marker
# A reduced picture is searched with one window of the detector's threshold, a full one with all three, which takes
# twice the time: markers missed with one are found at their predicted places, or at a finer level.
_REDUCED_WINDOW_PX, _WINDOW_STEP_PX = 5, 10

ImageRegion = tuple[slice, slice]
"""Rows and columns of a part of the photograph."""
Ids = Set[int]
Detections = dict[int, list[np.ndarray]]
"""Rough corners 4×2 px by marker id, for each place where it was detected."""


@dataclass(frozen=True)
class MarkersInView:
    """A sheet's markers by id; `foreign` ids of the same dictionary; `doubled` ids of the sheet found in two places;
    `mirrored` ids of the sheet whose codes some squares resemble in a mirror.
    """

    markers: dict[int, Borders]
    foreign: tuple[int, ...]
    doubled: tuple[int, ...]
    mirrored: frozenset[int] = frozenset()

    @property
    def corners_px(self) -> dict[int, np.ndarray]:
        """Corners 4×2 px by id."""
        return {marker_id: borders.corners_px for marker_id, borders in self.markers.items()}

    @property
    def another_sheet(self) -> bool:
        """True if markers of another sheet are in view; one alone may be clutter (9 of 500 photographs without any)."""
        return len(self.foreign) > 1


@dataclass(frozen=True)
class Level:
    """A level of the search: its scale, the conversion of uint8 sRGB to gray, below scale 1 the reduced photograph."""

    scale: float
    to_gray: Callable[[np.ndarray], np.ndarray]
    reduced: np.ndarray | None = None


def find_markers(
    srgb: np.ndarray,
    expected: Ids,
    also: Ids = frozenset(),
    dictionary: str = DICTIONARY,
    or_all_of: Sequence[Ids] = (),
) -> MarkersInView:
    """Find markers of `expected` and `also` in a uint8 photo, until `expected` or a set in `or_all_of` is complete."""
    aruco = aruco_dictionary(dictionary)
    detections: Detections = {}
    mirrored: set[int] = set()
    for level in pyramid_levels(srgb, full_region(srgb)):
        mirrored |= search_level(srgb, full_region(srgb), level, aruco, detections)
        if any(ids <= detections.keys() for ids in (expected, *or_all_of)):
            break
    sheet_ids = set(expected) | set(also)
    return replace(fit_detections(srgb, detections, sheet_ids, dictionary), mirrored=frozenset(mirrored & sheet_ids))


def fit_detections(
    srgb: np.ndarray, detections: Detections, sheet_ids: Ids, dictionary: str, borders: dict[int, Borders] | None = None
) -> MarkersInView:
    """Fit the borders of `detections` in the full photograph; `borders` is a cache by id, which is extended."""
    borders, ids = {} if borders is None else borders, sorted(detections.keys() & sheet_ids)
    if new := [marker_id for marker_id in ids if marker_id not in borders]:
        rough = np.array([detections[marker_id][0] for marker_id in new])
        borders |= zip(new, fit_marker_borders(srgb, rough, marker_cells(dictionary, new)), strict=True)
    markers = {i: borders[i] for i in ids if is_plausible_quad(borders[i].corners_px)}
    foreign = tuple(sorted(detections.keys() - set(ids)))
    return MarkersInView(markers, foreign, tuple(i for i in ids if len(detections[i]) > 1))


def is_mirrored(srgb: np.ndarray, view: MarkersInView, dictionary: str = DICTIONARY) -> bool:
    """True if no marker is in `view`, but the flipped picture shows one: selfie cameras and scans through the back."""
    expected = view.mirrored
    if view.markers or not expected:
        return False
    mirrored = np.ascontiguousarray(srgb[:, ::-1])
    if not _is_large(srgb):
        return bool(find_markers(mirrored, expected, frozenset(), dictionary).markers)
    detections: Detections = {}
    for level in pyramid_levels(mirrored, full_region(mirrored)):
        if level.scale < 1:
            search_level(mirrored, full_region(mirrored), level, aruco_dictionary(dictionary), detections)
    return bool(fit_detections(mirrored, detections, expected, dictionary).markers)


def _is_large(picture: np.ndarray) -> bool:
    """True for pictures whose full size is searched in linear light with one window only, which takes a third."""
    return picture.shape[0] * picture.shape[1] > UPSCALE_BELOW_PX


def is_plausible_quad(corners: np.ndarray) -> bool:
    """True if a flat square can look like this: convex, clockwise, no side more than 12 times another."""
    lengths = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    convex = np.isfinite(corners).all() and (corner_turns(corners) > 0).all()
    return bool(convex and lengths.max() < 12 * lengths.min())


def side_px(quad: np.ndarray) -> float:
    """The side in px of the square that has the area of corners 4×2 px."""
    return float(np.sqrt(cv2.contourArea(quad.astype(np.float32))))


def full_region(srgb: np.ndarray) -> ImageRegion:
    """The region of the whole photograph."""
    return slice(0, srgb.shape[0]), slice(0, srgb.shape[1])


def pyramid_levels(srgb: np.ndarray, region: ImageRegion) -> Iterator[Level]:
    """Yield half sizes in linear light up to the full size, then the fallbacks for a region of the photograph."""
    halvings = max(0, int(np.ceil(np.log2(max(srgb.shape[:2]) / COARSEST_PX))))
    reduced = [srgb]  # repeated halving differs from direct reduction by a code value, and takes less time in total
    for n in range(1, halvings + 1):
        even = not any(side % 2 for side in reduced[-1].shape[:2])
        size = _scaled_size(srgb, 0.5**n)
        reduced.append(cv2.resize(reduced[-1] if even else srgb, size, interpolation=cv2.INTER_AREA))
    for n in range(halvings, 0, -1):
        yield Level(0.5**n, light_picture, reduced[n])
    yield Level(1.0, light_picture)
    large = _is_large(srgb[region])
    fallback = partial(Level, 0.5, reduced=reduced[1]) if large and halvings else partial(Level, 1.0)
    yield fallback(code_picture)
    codes = code_picture
    part, step = srgb[region], max(1, max(srgb.shape) // 512)
    if float(np.median(code_picture(np.ascontiguousarray(part[::step, ::step])))) < DARK_CODE:
        codes = contrast_picture
        yield fallback(contrast_picture)
    if not large:
        yield from (Level(2.0, to_gray) for to_gray in (light_picture, codes))


def search_level(srgb: np.ndarray, region: ImageRegion, level: Level, aruco, detections: Detections) -> Ids:
    """Search a region at one level, add corners (full pixels) to `detections`, and return ids that look mirrored."""
    part = srgb[region]
    height, width = part.shape[:2]
    if width * height * level.scale**2 > LARGEST_LEVEL_PX:
        return set()
    size = _scaled_size(part, level.scale)
    if level.scale < 1:
        is_full = level.reduced is not None and part.shape == srgb.shape
        part = level.reduced if is_full else cv2.resize(part, size, interpolation=cv2.INTER_AREA)
    picture = level.to_gray(np.ascontiguousarray(part))
    if level.scale > 1:
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_CUBIC)
    to_full, start = np.array([width / size[0], height / size[1]]), [region[1].start, region[0].start]
    found, mirrored = _detect(picture, aruco, level.scale * max(srgb.shape), level.scale < 1)
    for marker_id, quad in found:
        corners, others = quad * to_full + start, detections.setdefault(marker_id, [])
        min_distance = 0.5 * np.linalg.norm(corners[2] - corners[0])  # nearer, it is the marker of another level
        if all(np.linalg.norm(corners.mean(0) - other.mean(0)) > min_distance for other in others):
            others.append(corners)
    return mirrored


def _scaled_size(srgb: np.ndarray, scale: float) -> tuple[int, int]:
    return max(1, round(srgb.shape[1] * scale)), max(1, round(srgb.shape[0] * scale))


def light_picture(srgb: np.ndarray) -> np.ndarray:
    """Linear light as uint8, scaled so that all but the brightest thousandth (lamps, glare) fits."""
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
    """Gray code values with locally equalized contrast (CLAHE)."""
    return cv2.createCLAHE(3.0, (8, 8)).apply(code_picture(srgb))


def detector_settings() -> cv2.aruco.DetectorParameters:
    """Detector parameters: of 48 markers blurred by 0.3 modules on warped pages these find 46, the defaults 37."""
    settings = cv2.aruco.DetectorParameters()
    settings.perspectiveRemovePixelPerCell = 8
    settings.perspectiveRemoveIgnoredMarginPerCell = 0.3
    settings.adaptiveThreshConstant = 3  # `find_squares` has the same
    settings.adaptiveThreshWinSizeStep = _WINDOW_STEP_PX
    return settings


def _detect(
    picture: np.ndarray, aruco, full_px: float, is_reduced: bool = False
) -> tuple[list[tuple[int, np.ndarray]], Ids]:
    """Ids and corners in a gray picture, part of one `full_px` long; ids whose codes some squares resemble mirrored."""
    settings = detector_settings()
    if is_reduced or _is_large(picture):
        settings.adaptiveThreshWinSizeMin = settings.adaptiveThreshWinSizeMax = _REDUCED_WINDOW_PX
    settings.minDistanceToBorder = 0
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    settings.relativeCornerRefinmentWinSize = 0.3
    settings.minMarkerPerimeterRate = min(0.03 * full_px, 4 * SMALLEST_MARKER_PX) / max(picture.shape)
    corners, ids, mirrored = detect_markers(picture, aruco, settings)
    # in the detector's coordinates pixel centers lie at whole numbers: its 0 is our .5
    quads = np.array(corners, float).reshape(-1, 4, 2) + 0.5
    found = zip([] if ids is None else np.asarray(ids).ravel().tolist(), quads, strict=True)
    return [(marker_id, quad) for marker_id, quad in found if is_plausible_quad(quad)], mirrored


def detect_markers(picture: np.ndarray, aruco, settings: cv2.aruco.DetectorParameters):
    """OpenCV's (corners, ids or None) of one uint8 gray picture, and the set of ids whose codes some squares resemble
    in a mirror. Raises `PhotoRejected("too_costly")` if it shows more possible markers than there is time for. OpenCV
    gets only the codes that some square resembles, because comparing a square with a whole dictionary takes a
    millisecond, or 20 s for a block design.
    """
    max_squares = int(min(MOST_SQUARES, remaining_seconds() / _SQUARE_S))
    windows = range(settings.adaptiveThreshWinSizeMin, settings.adaptiveThreshWinSizeMax + 1, _WINDOW_STEP_PX)
    perimeter_px = settings.minMarkerPerimeterRate * max(picture.shape)
    quads_of = [find_squares(picture, perimeter_px, window) for window in windows]
    if (squares := max(map(len, quads_of))) > max_squares:
        advice = f"it shows {squares} squares that could be markers: photograph less of that pattern"
        raise PhotoRejected("too_costly", squares, max_squares, advice)
    quads = np.concatenate(quads_of)
    similar, mirrored = _similar_ids(picture, quads, aruco) if len(quads) else ([], [])
    if not similar:
        return (), None, set(mirrored)
    some = cv2.aruco.Dictionary(aruco.bytesList[similar].copy(), aruco.markerSize, aruco.maxCorrectionBits)
    corners, ids, _ = cv2.aruco.ArucoDetector(some, settings).detectMarkers(picture)
    ids = None if ids is None else np.array(similar, np.int32)[np.asarray(ids, int).ravel()][:, None]
    return corners, ids, set(mirrored)


def _similar_ids(picture: np.ndarray, quads: np.ndarray, aruco) -> tuple[list[int], list[int]]:
    """Return ids whose codes a gray picture resembles within corners Q×4×2, or within the smaller squares in them that
    the detector tries, too; and ids that are resembled in a mirror.
    """
    size = aruco.markerSize
    side, codes = size + 2, marker_codes(aruco.bytesList.tobytes(), size)
    cells = (np.indices((side, side))[::-1].reshape(2, -1).T + 0.5) / side - 0.5
    corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]], np.float32)
    is_border = np.abs(cells).max(1) > 0.5 - 1 / side
    px = []
    for quad in quads.astype(np.float32):
        to_px = cv2.getPerspectiveTransform(corners, quad)
        px.append(cv2.perspectiveTransform(np.concatenate([inset * cells for inset in _INSETS])[None], to_px)[0])
    x, y = np.array(px, np.float32).transpose(2, 0, 1)
    light = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).reshape(-1, side * side)
    low, high = np.percentile(light, (5, 95), axis=1)
    bits = light > (low + high)[:, None] / 2
    bits = bits[(high - low > _LEAST_CONTRAST_CODES) & (bits[:, is_border].mean(1) < _MOST_BORDER_ERRORS)]
    cells = (2 * bits[:, ~is_border] - np.float32(1)).reshape(-1, size, size)

    def resembled(cells: np.ndarray) -> list[int]:
        agreement = (cells.reshape(-1, size * size) @ codes).max(0, initial=-size * size)
        likely = size * size - agreement <= 2 * (aruco.maxCorrectionBits + 1)
        return np.unique(np.flatnonzero(likely) % len(aruco.bytesList)).tolist()

    return resembled(cells), resembled(cells[:, :, ::-1])


@lru_cache(maxsize=4)
def marker_codes(data: bytes, size: int) -> np.ndarray:
    """The inner cells of a dictionary's codes, 1 for paper and -1 for ink: size² × 4N."""
    every = np.frombuffer(data, np.uint8).reshape(-1, -(-size * size // 8), 4)
    bits = [cv2.aruco.Dictionary.getBitsFromByteList(code[None], size) for code in every]
    turned = np.concatenate([np.rot90(bits, turn, (1, 2)) for turn in range(4)])
    return 2 * turned.reshape(-1, size * size).T - np.float32(1)


def fit_marker_borders(srgb: np.ndarray, rough: np.ndarray, cells: np.ndarray) -> list[Borders]:
    """Fit the borders of markers with rough corners M×4×2; only the regions about them are converted to light."""
    region = region_around(rough.reshape(-1, 2), _MARGIN_PX, srgb.shape)
    low = np.array([region[1].start, region[0].start])
    part, quads = srgb[region], rough - low
    light = np.zeros(part.shape[:2], np.float32)  # memory pages that are never touched take no memory
    for quad in quads:
        around = region_around(quad, _MARGIN_PX + _MARGIN_SHARE * np.ptp(quad, axis=0).max(), part.shape)
        light[around] = luminance(np.ascontiguousarray(part[around]))
    return [replace(b, corners_px=b.corners_px + low) for b in fit_borders(light, quads, cells)]


def luminance(srgb: np.ndarray) -> np.ndarray:
    """Linear luminance H×W float32 of uint8 sRGB H×W×3."""
    table = np.repeat(LINEAR_FLOAT32_FROM_CODE[None, :, None], 3, 2)
    weights = np.array([LUMINANCE], np.float32)
    out = np.empty(srgb.shape[:2], np.float32)
    for rows in row_strips(srgb):  # in strips, because the table makes 12 bytes of each pixel
        cv2.transform(cv2.LUT(srgb[rows], table), weights, out[rows])
    return out


def row_strips(srgb: np.ndarray) -> Iterator[slice]:
    """Slices of rows with about a million pixels each; the last may exceed the picture."""
    rows = max(1, 1_000_000 // srgb.shape[1])
    return (slice(y, y + rows) for y in range(0, len(srgb), rows))
