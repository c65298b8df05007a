"""Find the printed markers in a photograph, coarse to fine.

In: uint8 sRGB pixels and the ids that the sheet carries. Out: `Found`: corners in photo pixels (centres at .5,
clockwise from the code's top-left) with what their borders show of blur and light, the ids of the same dictionary
that are not the sheet's, and ids seen at two places. The detector looks at linear light: in code values blurred paper
grows over ink, and at a blur of 0.3 modules it read 5 of 48 markers where linear light read 45. The pyramid starts
below 1000 px and stops at the level where every expected id has been found; only if some are missing are code values
tried, local contrast (CLAHE) where the photo is dark, and twice the size where it has less than 4 megapixels. Corners
of all levels are then fitted in the full photograph (`edges`). Only OpenCV's class API is used, so 4.10 to 5.x will
do.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass

import cv2
import numpy as np

from patchproof.color import LUMINANCE, linear_from_srgb
from patchproof.photo.edges import Borders, fit_borders

DICTIONARY = "DICT_5X5_1000"
COARSEST_PX = 1000  # a level's longer side; halves are taken until it is no longer than this
UPSCALE_BELOW_PX = 4_000_000
DARK = 70  # median code value below which local contrast helps; in light photos it hurts sharp markers
SMALLEST_MARKER_PX = 9.0  # side at its level: 7 modules of 1.3 px are the least that has been read


@dataclass(frozen=True)
class Found:
    """`markers` by id; `foreign` ids of the same dictionary; `doubled` ids of ours that lie at two places."""

    markers: dict[int, Borders]
    foreign: tuple[int, ...]
    doubled: tuple[int, ...]

    @property
    def corners_px(self) -> dict[int, np.ndarray]:
        """Corners 4×2 by id."""
        return {marker_id: borders.corners_px for marker_id, borders in self.markers.items()}


def find_markers(
    srgb: np.ndarray,
    expected: Set[int],
    also: Set[int] = frozenset(),
    dictionary: str = DICTIONARY,
    or_all_of: Sequence[Set[int]] = (),
) -> Found:
    """All markers of `expected` and `also` in the picture; the search ends when every one of `expected` is found, or
    every one of a set in `or_all_of`.
    """
    printed = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    seen: dict[int, list[np.ndarray]] = {}
    for level in _levels(srgb):
        for marker_id, corners in _detect(level, printed, srgb.shape):
            _add(seen, marker_id, corners)
        if any(wanted <= seen.keys() for wanted in (expected, *or_all_of)):
            break
    ours = sorted(seen.keys() & (set(expected) | set(also)))
    rough = np.array([seen[marker_id][0] for marker_id in ours]).reshape(-1, 4, 2)
    borders = refine(srgb, rough, cells_of(printed, ours)) if ours else []
    markers = {i: b for i, b in zip(ours, borders, strict=True) if possible(b.corners_px)}
    foreign = tuple(sorted(seen.keys() - set(ours)))
    return Found(markers, foreign, tuple(i for i in ours if len(seen[i]) > 1))


def is_mirrored(srgb: np.ndarray, expected: Set[int], dictionary: str = DICTIONARY) -> bool:
    """Whether the sheet shows up when the picture is flipped: selfie cameras and scans through the back do that."""
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


def _levels(srgb: np.ndarray) -> Iterator[np.ndarray]:
    """Half-size pictures in linear light up to the full one, then the fallbacks; all uint8."""
    height, width = srgb.shape[:2]
    halvings = max(0, int(np.ceil(np.log2(max(height, width) / COARSEST_PX))))
    light = _eight_bit(luminance(srgb))
    for n in range(halvings, -1, -1):
        yield light if n == 0 else cv2.resize(light, _half(light, n), interpolation=cv2.INTER_AREA)
    gray = cv2.cvtColor(srgb, cv2.COLOR_RGB2GRAY)
    yield gray
    if float(np.median(gray[:: max(1, height // 256), :: max(1, width // 256)])) < DARK:
        gray = cv2.createCLAHE(3.0, (8, 8)).apply(gray)
        yield gray
    if height * width < UPSCALE_BELOW_PX:
        for picture in (light, gray):
            yield cv2.resize(picture, (2 * width, 2 * height), interpolation=cv2.INTER_CUBIC)


def _eight_bit(light: np.ndarray) -> np.ndarray:
    """Light scaled so that all but the brightest thousandth (lamps, glare) fits."""
    step = max(1, max(light.shape) // 512)
    bright = max(float(np.percentile(light[::step, ::step], 99.9)), 1e-3)
    return np.minimum(light * np.float32(255 / bright), 255).astype(np.uint8)


def _half(gray, times: int) -> tuple[int, int]:
    return max(1, round(gray.shape[1] / 2**times)), max(1, round(gray.shape[0] / 2**times))


def _detect(level: np.ndarray, printed, full_shape) -> Iterator[tuple[int, np.ndarray]]:
    """Ids and corners in the full photograph's pixels of what one level shows."""
    settings = cv2.aruco.DetectorParameters()
    # chosen on warped pages of known geometry: of 48 markers blurred by 0.3 modules the defaults find 37, these 46
    settings.perspectiveRemovePixelPerCell = 8
    settings.perspectiveRemoveIgnoredMarginPerCell = 0.3
    settings.adaptiveThreshConstant = 3
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    settings.relativeCornerRefinmentWinSize = 0.3
    settings.minMarkerPerimeterRate = min(0.03, 4 * SMALLEST_MARKER_PX / max(level.shape))
    corners, ids, _ = cv2.aruco.ArucoDetector(printed, settings).detectMarkers(level)
    if ids is None:
        return
    to_full = np.array([full_shape[1] / level.shape[1], full_shape[0] / level.shape[0]])
    for marker_id, quad in zip(np.asarray(ids).reshape(-1), corners, strict=True):
        # the detector counts from pixel centres: its 0 is our .5
        quad = (np.asarray(quad, float).reshape(4, 2) + 0.5) * to_full
        if possible(quad):
            yield int(marker_id), quad


def _add(seen: dict[int, list[np.ndarray]], marker_id: int, corners: np.ndarray) -> None:
    """Remember one detection; the same marker seen again at another level is not a second one."""
    others = seen.setdefault(marker_id, [])
    size = np.linalg.norm(corners[2] - corners[0])
    if all(np.linalg.norm(corners.mean(0) - other.mean(0)) > 0.5 * size for other in others):
        others.append(corners)


def refine(srgb: np.ndarray, rough: np.ndarray, cells: np.ndarray) -> list[Borders]:
    """Fit borders in the part of the photograph that holds the markers; only that part is turned into light."""
    height, width = srgb.shape[:2]
    low = np.maximum(np.floor(rough.min((0, 1))).astype(int) - 16, 0)
    high = np.minimum(np.ceil(rough.max((0, 1))).astype(int) + 16, [width, height])
    part = srgb[low[1] : high[1], low[0] : high[0]]
    borders = fit_borders(luminance(part), rough - low, cells)
    return [Borders(b.corners_px + low, b.blur_px, b.black, b.white, b.module_px, b.fitted) for b in borders]


def luminance(srgb: np.ndarray) -> np.ndarray:
    """Linear luminance H×W float32 of uint8 sRGB."""
    light = linear_from_srgb(np.arange(256) / 255).astype(np.float32)
    return sum(np.float32(share) * light[srgb[..., c]] for c, share in enumerate(LUMINANCE))
