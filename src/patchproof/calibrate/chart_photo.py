"""Read the printed chart in one photograph: the light of each swatch relative to bare paper at the same place.

In: a photograph, the sheet's manifest. Out: `ChartPhoto`. The page is found by its markers;
swatches are read in their unblurred cores, in linear light. Illumination differs from place to place, so white paper
around the chart and the chart's own white swatches are read, too, and a smooth surface through them gives the light of
bare paper under each swatch: dividing by it cancels gradients, vignetting, exposure and white balance at once. Text and
lines on the paper are outliers of that surface, and the robust fit ignores them.
Left out on purpose: lens distortion (a swatch's core is far from its border), and gloss: photograph it without shine.
"""

from dataclasses import dataclass

import numpy as np

from patchproof.base.color import LINEAR_FROM_CODE
from patchproof.base.geometry import apply_homography, local_scale, rect_corners
from patchproof.photo.detect import Ids, MarkersInView, is_mirrored
from patchproof.photo.known_page import find_sheet
from patchproof.photo.quality import CLIPPED_CODE, blur_px
from patchproof.photo.read import Photo
from patchproof.photo.rectify import fit_page
from patchproof.photo.rejection import PhotoRejected
from patchproof.sheets.manifest import Manifest
from patchproof.sheets.rects import RectMm, rect_contains

MIN_CORE_PX = 4.0  # a swatch's side between blurred borders
MAX_CLIPPED_SHARE = 0.05  # share of white paper at full white; beyond it, its light is unknown
_CORE_MARGIN = 0.2  # of a swatch's side: the least margin on each side
_SAMPLES = 15  # along each side of a core
_SEARCH_MM = 60.0  # bare paper is searched for within this distance of the chart
_PITCH_MM, _PATCH_MM = 2.5, 2.0  # distance between patches of bare paper, and the side of each
_CLEARANCE_MM = 1.0  # between a patch and anything printed; twice the blur is added
_POWERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))  # of x and y in the logarithm of the paper's light
_PATCHES_PER_TERM = 5


@dataclass(frozen=True)
class ChartPhoto:
    """`light` N×3 relative to paper, one row per swatch of the manifest's chart, NaN where it could not be read, and
    the light of bare `paper` under the chart (1 = the camera's full white).
    """

    light: np.ndarray
    paper: tuple[float, float, float]


@dataclass(frozen=True)
class _Page:
    """The chart's page in a photograph: the homography to pixels, blur, and pixels per mm at the chart."""

    px_from_mm: np.ndarray
    blur_px: float
    px_per_mm: float


def read_chart(photo: Photo, manifest: Manifest) -> ChartPhoto:
    """Read the chart's swatches; raises `PhotoRejected` where there is none, or none that can be trusted."""
    page = _find_page(photo.srgb, manifest)
    found = {row: _core(swatch.rect_mm, page, photo.srgb.shape) for row, swatch in enumerate(manifest.chart)}
    cores = {row: core for row, core in found.items() if core is not None}
    if not cores:
        advice = "come closer to the chart, hold still and show all of it"
        raise PhotoRejected("too_small", page.px_per_mm, None, advice)
    patches = _bare_patches(manifest, page, photo.srgb.shape)
    whites = [core for row, core in cores.items() if min(manifest.chart[row].srgb) == 1]
    patches = np.concatenate([patches, np.reshape(whites, (-1, 4))])
    paper_light_at = _paper(photo.srgb, page, patches)
    light = np.full((len(manifest.chart), 3), np.nan)
    paper_light = paper_light_at(np.array([[x + w / 2, y + h / 2] for x, y, w, h in cores.values()]))
    for (row, core), paper in zip(cores.items(), paper_light, strict=True):
        codes = _codes(photo.srgb, page, core)
        if (codes >= CLIPPED_CODE).any(-1).mean() <= MAX_CLIPPED_SHARE:
            light[row] = LINEAR_FROM_CODE[codes].mean(0) / paper
    red, green, blue = np.median(paper_light, 0).tolist()
    return ChartPhoto(light, (red, green, blue))


def _find_page(srgb: np.ndarray, manifest: Manifest) -> _Page:
    """Find the chart's page by the markers beside the piece; the piece's own help where it is not cut out."""
    dictionary, rects = manifest.markers[0].dictionary, np.array([swatch.rect_mm for swatch in manifest.chart])
    on_page = [marker for marker in manifest.markers if marker.page == manifest.chart[0].page]
    corners_mm = {marker.id: np.array(marker.corners_mm) for marker in on_page}
    detected = find_sheet(srgb, corners_mm.keys(), corners_mm, dictionary)
    corners_px = detected.corners_px
    if not corners_px:
        raise _no_sheet(srgb, detected, corners_mm.keys(), dictionary)
    is_beside = {i: not rect_contains(manifest.cut_mm, _bounding_rect(corners_mm[i])) for i in corners_px}
    beside = {i: px for i, px in corners_px.items() if is_beside[i]}
    fit = fit_page(corners_px, corners_mm)
    if len(beside) > 1 and not set(beside) <= set(fit.inlier_ids):
        fit = fit_page(beside, corners_mm)
    scale, _ = local_scale(fit.px_from_mm, tuple((rects[:, :2] + rects[:, 2:] / 2).mean(0)))
    return _Page(fit.px_from_mm, blur_px(detected.markers.values()), float(scale))


def _no_sheet(srgb: np.ndarray, detected: MarkersInView, ids: Ids, dictionary: str) -> PhotoRejected:
    if is_mirrored(srgb, ids, dictionary):
        return PhotoRejected("mirrored", None, None, "the photo is mirrored: switch off the camera's mirror setting")
    if detected.foreign:
        advice = "these are the markers of another sheet or page: name that sheet's JSON, or leave the photo out"
        return PhotoRejected("wrong_sheet", len(detected.foreign), 0, advice)
    return PhotoRejected("too_few_markers", 0, 1, "no marker is readable: show the page sharp and well lit")


def _core(rect: RectMm, page: _Page, shape) -> RectMm | None:
    """The part of a swatch that blur does not reach; None where there is none or it lies outside the picture."""
    x, y, w, h = rect
    quad = apply_homography(page.px_from_mm, rect_corners(rect))
    sides = np.linalg.norm(np.roll(quad, -1, axis=0) - quad, axis=1)
    sides = np.array([min(sides[0], sides[2]), min(sides[1], sides[3])])
    edge = np.maximum(_CORE_MARGIN, (0.75 + 1.5 * page.blur_px) / sides)
    if (sides * (1 - 2 * edge) < MIN_CORE_PX).any() or not _in_picture(quad, shape):
        return None
    return x + w * edge[0], y + h * edge[1], w * (1 - 2 * edge[0]), h * (1 - 2 * edge[1])


def _bare_patches(manifest: Manifest, page: _Page, shape) -> np.ndarray:
    """Small squares K×4 mm around the chart on which nothing is printed, as far as the manifest knows."""
    rows = np.array([swatch.rect_mm for swatch in manifest.chart])
    clear = _CLEARANCE_MM + 2 * page.blur_px / page.px_per_mm
    low = np.maximum(rows[:, :2].min(0) - _SEARCH_MM, clear)
    high = np.minimum((rows[:, :2] + rows[:, 2:]).max(0) + _SEARCH_MM, np.array(manifest.page_mm) - clear) - _PATCH_MM
    steps = [np.arange(a, b + 1e-9, _PITCH_MM) if b > a else np.array([a]) for a, b in zip(low, high, strict=True)]
    corner = np.stack(np.meshgrid(*steps), -1).reshape(-1, 2)
    on_page = (marker for marker in manifest.markers if marker.page == manifest.chart[0].page)
    printed = [*rows, *(_bounding_rect(marker.corners_mm) for marker in on_page)]
    if any(not rect_contains(manifest.cut_mm, rect) for rect in rows):
        printed.append(manifest.cut_mm)
    bare = np.ones(len(corner), bool)
    for x, y, w, h in printed:
        is_clear = (corner >= np.array([x + w, y + h]) + clear) | (corner + _PATCH_MM <= np.array([x, y]) - clear)
        bare &= is_clear.any(1)
    squares = np.column_stack([corner, np.full((len(corner), 2), _PATCH_MM)])[bare]
    inside = [_in_picture(apply_homography(page.px_from_mm, rect_corners(square)), shape) for square in squares]
    return squares[np.array(inside, bool)]


def _paper(srgb: np.ndarray, page: _Page, patches: np.ndarray):
    """The function points N×2 mm → light of bare paper: exp of a polynomial per channel, fitted robustly."""
    if not len(patches):
        raise PhotoRejected("too_small", 0, 1, "no bare paper is in view: show the white paper around the chart")
    codes = _codes(srgb, page, patches.T, 5)
    clipped = float(np.median((codes >= CLIPPED_CODE).any(-1).mean(1)))
    if clipped > MAX_CLIPPED_SHARE:
        advice = "the paper is overexposed: lower the exposure by one step"
        raise PhotoRejected("clipped", clipped, MAX_CLIPPED_SHARE, advice)
    light = np.log(np.maximum(LINEAR_FROM_CODE[codes].mean(1), 1e-4))
    centers = patches[:, :2] + patches[:, 2:] / 2
    middle, reach = centers.mean(0), max(float(np.ptp(centers, 0).max()), 1.0) / 2
    count = next(n for n in (6, 3, 1) if len(patches) >= _PATCHES_PER_TERM * n or n == 1)

    def powers(points_mm: np.ndarray) -> np.ndarray:
        x, y = ((points_mm - middle) / reach).T
        return np.stack([x**i * y**j for i, j in _POWERS[:count]], 1)

    patch_powers = powers(centers)
    weight, surface = np.ones(len(patches)), np.zeros((count, 3))
    for _ in range(30):
        root = np.sqrt(weight)[:, None]
        surface = np.linalg.lstsq(patch_powers * root, light * root, rcond=None)[0]
        error = np.abs(light - patch_powers @ surface).max(1)
        spread = max(1.4826 * float(np.median(error)), 2e-3)
        weight = np.maximum(1 - (error / (4.7 * spread)) ** 2, 0) ** 2  # Tukey's biweight: none for printed patches
    return lambda points_mm: np.exp(powers(points_mm) @ surface)


def _codes(srgb: np.ndarray, page: _Page, rect, samples: int = _SAMPLES) -> np.ndarray:
    """uint8 `K × samples² × 3` (or `samples² × 3` of one rectangle) of pixels nearest to a grid in rectangles of mm.

    Nearest pixels, not mixtures: the mean of their light is the light's mean, whatever the tone curve.
    """
    x, y, w, h = (np.asarray(value, float)[..., None, None] for value in rect)
    step = (np.arange(samples) + 0.5) / samples
    points_mm = np.stack(np.broadcast_arrays(x + w * step, y + h * step[:, None]), -1)
    px = np.floor(apply_homography(page.px_from_mm, points_mm.reshape(-1, 2))).astype(int)
    column, line = np.clip(px, 0, [srgb.shape[1] - 1, srgb.shape[0] - 1]).T
    return srgb[line, column].reshape(*points_mm.shape[:-3], samples**2, 3)


def _bounding_rect(corners) -> RectMm:
    (x0, y0), (x1, y1) = np.min(corners, 0), np.max(corners, 0)
    return x0, y0, x1 - x0, y1 - y0


def _in_picture(points: np.ndarray, shape: tuple[int, ...]) -> bool:
    return bool(((points >= 0) & (points <= [shape[1], shape[0]])).all())
