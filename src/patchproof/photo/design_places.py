"""Propose places of a design in a photograph that has no markers.

In: a photograph's pixels, a design's, its size on the page. Out: corners 4×2 px, rough and often wrong. Two sources:
SIFT features of the design at several sizes, whose matches vote for a place, size and angle (single matches of blocks
are often wrong); and the correlation of a small design with the photograph over sizes, angles and slants, which finds
smooth designs, too. Left out on purpose: prints smaller than `SMALLEST_PRINT_PX` in a copy of `SEARCHED_PX`, and smooth
prints turned by more than 50 degrees, whose templates would double the time.

Source: Lowe, Distinctive Image Features from Scale-Invariant Keypoints, IJCV 2004 (features, votes); Barath et al.,
MAGSAC++, CVPR 2020.
"""

from collections.abc import Iterable, Iterator
from functools import cached_property, lru_cache

import cv2
import numpy as np
from scipy import fft

from patchproof.base.geometry import apply_homography, rect_corners
from patchproof.base.resample import downscaled_size, halving_pyramid
from patchproof.photo.detect import is_plausible_quad
from patchproof.sheets.manifest import Rect

SEARCHED_PX = 1600  # longer side of the copy of a large photograph in which prints have their least size
SMALLEST_PRINT_PX = 60.0  # of the design's shorter side there
# Longer side of the copy that features are taken from, and their number: of 90 prints 66 to 160 px wide in 1600 px 85
# are found, by 1280 and 6000 in 1.3 times the seconds 84, by 900 and 3000 83.
_FEATURES_PX, _MOST_FEATURES = 1024, 4000
_FEATURE_SIZES_PX = (64, 128, 256, 512)  # of the drawn design's longer side
_NEIGHBORS = 3  # photograph's features that may be a feature of the design
_MOST_MATCHES = 1000
_VOTE_SHARE, _VOTE_LOG_SIZE, _VOTE_RAD = 0.25, 0.4, 0.5  # matches that agree: of the print's side, size, angle
_LEAST_VOTES = 4
_MOST_PLACES = 8  # of each source
# Of 240 prints of five kinds, templates of 12 and 16 pixels alone found 149 and 147, in 0.3 and 0.5 s; of 24 pixels, by
# OpenCV's matching, 151 in 1.6 s.
_TEMPLATE_PX, _TEMPLATE_STEP = 12, 1.2
_TURNS_DEG, _SLANTS = (0, -15, 15, -30, 30, -45, 45), (1.0, 0.75, 0.55)


class SearchedPhoto:
    """Copies of a photograph, itself the first, and its features: read once for all designs that are looked for."""

    def __init__(self, srgb: np.ndarray):
        self.levels = halving_pyramid(srgb)
        self.zoom = max(1.0, max(srgb.shape[:2]) / SEARCHED_PX)  # of its pixels in one of the copy of `SEARCHED_PX`

    def copy_of(self, longest_px: float) -> np.ndarray:
        """The photograph at a longer side of `longest_px` at most, by area from the next larger level."""
        size = downscaled_size(self.levels[0].shape[1::-1], longest_px)
        larger = [level for level in self.levels if min(np.array(level.shape[1::-1]) - size) >= 0]
        return cv2.resize(larger[-1], size, interpolation=cv2.INTER_AREA)

    @cached_property
    def features(self) -> tuple[np.ndarray, np.ndarray]:
        """Features of the photograph, in its pixels, and their descriptors."""
        copy = self.copy_of(_FEATURES_PX)
        found, descriptors = _features(cv2.cvtColor(copy, cv2.COLOR_RGB2GRAY))
        zoom = max(self.levels[0].shape[:2]) / max(copy.shape[:2])
        return found * (zoom, zoom, zoom, 1), descriptors


def draw_design(design: np.ndarray, size_mm: tuple[float, float], longer_px: float) -> np.ndarray:
    """The design in its printed shape with a longer side of `longer_px`; pixels are squares, as printers print them."""
    width, height = (max(4, round(longer_px * side / max(size_mm))) for side in size_mm)
    zoom = max(1, -(-2 * max(width, height) // min(design.shape[:2])))
    large = design if min(design.shape[:2]) >= 2 * max(width, height) else design.repeat(zoom, 0).repeat(zoom, 1)
    return cv2.resize(large, (width, height), interpolation=cv2.INTER_AREA)


def _features(gray: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """SIFT features N×4 (x, y with centers at .5, diameter, angle in radians) and descriptors N×128 (root of L1)."""
    points, descriptors = cv2.SIFT.create(nfeatures=_MOST_FEATURES, contrastThreshold=0.02).detectAndCompute(gray, None)
    if descriptors is None:
        return np.zeros((0, 4)), np.zeros((0, 128), np.float32)
    table = [(p.pt[0] + 0.5, p.pt[1] + 0.5, p.size, np.radians(p.angle)) for p in points]
    return np.array(table), np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-6))


@lru_cache(maxsize=2)  # a design and its mirror image are looked for in one photograph after the other
def _design_features(pixels: bytes, shape: tuple[int, ...], size_mm: tuple[float, float]) -> list:
    """Features of a design at each size that has any, positions and diameters as shares of its longer side."""
    design, found, margin = np.frombuffer(pixels, np.uint8).reshape(shape), [], 8
    for longer_px in _FEATURE_SIZES_PX:
        drawn = cv2.cvtColor(draw_design(design, size_mm, longer_px), cv2.COLOR_RGB2GRAY)
        own, descriptors = _features(np.pad(drawn, margin, mode="edge"))
        found.append(((own - (margin, margin, 0, 0)) / (longer_px, longer_px, longer_px, 1), descriptors))
    return [each for each in found if len(each[0])]


def places_by_features(photo: SearchedPhoto, design: np.ndarray, size_mm: tuple[float, float]) -> Iterator[np.ndarray]:
    """Yield corners 4×2 px, those of most agreeing matches first."""
    seen, seen_descriptors = photo.features
    features = _design_features(design.tobytes(), design.shape, size_mm)
    if len(seen) < 8 or not features:
        return
    parts = []
    for own, own_descriptors in features:
        index, distance = _nearest(own_descriptors, seen_descriptors)
        quality = distance / np.minimum(distance[:, -1:] + 1e-6, distance[:, 0].mean())
        a, b = own.repeat(_NEIGHBORS, 0), seen[index.ravel()]
        parts.append((a[:, :2], b[:, :2], b[:, 3] - a[:, 3], np.log(b[:, 2] / a[:, 2]), quality.ravel()))
    source, target, angle, size, quality = map(np.concatenate, zip(*parts, strict=True))
    best = np.argsort(quality, kind="stable")[:_MOST_MATCHES]
    source, target, angle, size = (each[best] for each in (source, target, angle, size))
    shape = np.array(size_mm) / max(size_mm)
    arm = (shape / 2 - source) * np.exp(size)[:, None]
    cosine, sine = np.cos(angle), np.sin(angle)
    middle = target + np.column_stack([cosine * arm[:, 0] - sine * arm[:, 1], sine * arm[:, 0] + cosine * arm[:, 1]])
    x, y, log, c, s = np.column_stack([middle, size, cosine, sine]).astype(np.float32).T
    near = (_VOTE_SHARE * np.exp(log)) ** 2
    agree = (x[:, None] - x) ** 2 + (y[:, None] - y) ** 2 < np.minimum(near[:, None], near)
    agree &= np.abs(log[:, None] - log) < _VOTE_LOG_SIZE
    agree &= c[:, None] * c + s[:, None] * s > np.cos(_VOTE_RAD)
    for _ in range(_MOST_PLACES):
        votes = cv2.reduce(agree.view(np.uint8), 1, cv2.REDUCE_SUM, dtype=cv2.CV_32S).ravel()
        leader = int(votes.argmax())
        if votes[leader] < _LEAST_VOTES:
            return
        members = np.flatnonzero(agree[leader])
        agree[:, members] = False
        agree[members] = False
        middle_size = np.exp(np.median(size[members]))
        pairs, most_px = (source[members], target[members]), float(max(2.0 * photo.zoom, 0.02 * middle_size))
        homography, _ = cv2.findHomography(*pairs, cv2.USAC_MAGSAC, most_px, maxIters=2000)
        corners = rect_corners((0, 0, *shape))
        quad = None if homography is None else apply_homography(homography, corners)
        if quad is not None and is_plausible_quad(quad):
            yield quad
        turn = np.median(cosine[members]), np.median(sine[members])
        matrix = middle_size * np.array([[turn[0], turn[1]], [-turn[1], turn[0]]])
        yield (corners - shape / 2) @ matrix + np.median(middle[members], 0)


def _nearest(own: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices and distances N×3 of the descriptors M×128 nearest to each of N×128, all of length 1. One product of
    matrices takes an eighth of the time of OpenCV's matcher.
    """
    cosine, rows, nearest = own @ seen.T, np.arange(len(own)), []
    for _ in range(_NEIGHBORS):
        index = cosine.argmax(1)
        nearest.append((index, cosine[rows, index]))
        cosine[rows, index] = -1
    index, cosine = (np.stack(each, 1) for each in zip(*nearest, strict=True))
    return index, np.sqrt((2 - 2 * cosine).clip(0))


def places_by_templates(photo: SearchedPhoto, design: np.ndarray, size_mm: tuple[float, float]) -> list[np.ndarray]:
    """Corners 4×2 px where a small design correlates best with the picture, over sizes, angles and slants."""
    found: list[tuple[float, np.ndarray]] = []
    most_px = max(photo.levels[0].shape[:2])
    longer_px = photo.zoom * SMALLEST_PRINT_PX * 0.8 * max(size_mm) / min(size_mm)
    drawn = draw_design(design, size_mm, 4 * _TEMPLATE_PX)
    while longer_px < 0.95 * most_px:
        scale = _TEMPLATE_PX / longer_px
        small = photo.copy_of(most_px * scale)
        middle = np.array(small.shape[1::-1]) / 2
        templates = list(_templates(drawn, small.shape[:2]))
        for turn in _TURNS_DEG:
            matrix = cv2.getRotationMatrix2D(tuple(middle - 0.5), turn, 1.0)
            turned = cv2.warpAffine(small, matrix, small.shape[1::-1], borderMode=cv2.BORDER_REPLICATE)
            angle = np.radians(turn)
            back = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
            for peak, rect in _correlation_peaks(turned, templates):
                found.append((peak, ((rect_corners(rect) - middle) @ back + middle) / scale))
        longer_px *= _TEMPLATE_STEP
    kept: list[np.ndarray] = []
    for _, quad in sorted(found, key=lambda pair: -pair[0]):
        side = np.ptp(quad, axis=0).max()
        if len(kept) < _MOST_PLACES and all(np.abs(quad - other).max() > 0.25 * side for other in kept):
            kept.append(quad)
    return kept


def _templates(drawn: np.ndarray, shape: tuple[int, ...]) -> Iterator[tuple[tuple[int, int], np.ndarray]]:
    """Yield the sizes (width, height) of a design's slants that fit into a picture H×W, and their spectra."""
    transform_size = [cv2.getOptimalDFTSize(side) for side in shape]
    for slant in _SLANTS:
        size = width, height = max(6, round(drawn.shape[1] / 4 * slant)), max(6, round(drawn.shape[0] / 4))
        if width < shape[1] and height < shape[0]:
            planes = np.array(cv2.split(cv2.resize(drawn, size, interpolation=cv2.INTER_AREA)), np.float32)
            planes -= planes.mean((1, 2), keepdims=True)
            planes /= max(float(np.linalg.norm(planes)), 1e-6)
            yield size, np.conj(np.asarray(fft.rfft2(planes, transform_size)))


def _correlation_peaks(
    srgb: np.ndarray, templates: Iterable[tuple[tuple[int, int], np.ndarray]]
) -> Iterator[tuple[float, Rect]]:
    """Yield each template's greatest correlation with the picture, whose deviation counts as a code value at least, and
    its rectangle there. One transform of the picture serves all templates, which OpenCV's matching would repeat.
    """
    planes, size = np.array(cv2.split(srgb), np.float32) - 127.5, [cv2.getOptimalDFTSize(s) for s in srgb.shape[:2]]
    seen, power = np.asarray(fft.rfft2(planes, size)), (planes**2).sum(0)
    for (width, height), spectra in templates:
        rows, columns = srgb.shape[0] - height + 1, srgb.shape[1] - width + 1
        box, pixels = {"ksize": (width, height), "anchor": (0, 0), "normalize": False}, width * height
        # sums over the rectangle whose top left pixel each one is
        *sums, squares = (cv2.boxFilter(plane, -1, **box) for plane in (*planes, power))
        variance = squares - sum(each**2 for each in sums) / pixels
        product = np.asarray(fft.irfft2((seen * spectra).sum(0), size))
        likeness = product[:rows, :columns] / np.sqrt(variance[:rows, :columns].clip(0) + 3 * pixels)
        _, peak, _, (x, y) = cv2.minMaxLoc(likeness)
        yield peak, (x, y, width, height)
