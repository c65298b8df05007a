"""Read the printed chart in one photograph: the light of each swatch relative to bare paper at the same place.

In: a photograph, the sheet's manifest. Out: `ChartPhoto`. The page is found by its markers;
swatches are read in their unblurred cores, in linear light. Illumination differs from place to place, so `paper_light`
fits a smooth surface to white paper around the chart and its white swatches, which gives the light of bare paper under
each swatch: dividing by it cancels gradients, vignetting, exposure and white balance at once. Text and lines on the
paper are outliers of that surface, and the robust fit ignores them.
Left out on purpose: lens distortion (a swatch's core is far from its border), and gloss: photograph it without shine.
"""

from dataclasses import dataclass

import numpy as np

from patchproof.base.color import LINEAR_FROM_CODE
from patchproof.base.geometry import apply_homography, rect_corners
from patchproof.photo.detect import MarkersInView, is_mirrored
from patchproof.photo.known_page import find_sheet
from patchproof.photo.paper_light import paper_light, quadratic_terms
from patchproof.photo.quality import CLIPPED_CODE, blur_px
from patchproof.photo.read import Photo
from patchproof.photo.rectify import fit_page
from patchproof.photo.rejection import PhotoRejected
from patchproof.sheets.manifest import Manifest
from patchproof.sheets.piece import marker_rect
from patchproof.sheets.rects import RectMm, rect_contains

MIN_CORE_PX = 4.0  # a swatch's side between blurred borders
MAX_CLIPPED_SHARE = 0.05  # share of white paper at full white; beyond it, its light is unknown
_CORE_MARGIN = 0.2  # of a swatch's side: the least margin on each side
_SAMPLES = 15  # along each side of a core
_SEARCH_MM = 60.0  # bare paper is searched for within this distance of the chart


@dataclass(frozen=True)
class ChartPhoto:
    """`light` N×3 relative to paper, one row per swatch of the manifest's chart, NaN where it could not be read, and
    the light of bare `paper` under the chart (1 = the camera's full white).
    """

    light: np.ndarray
    paper: tuple[float, float, float]


def read_chart(photo: Photo, manifest: Manifest) -> ChartPhoto:
    """Read the chart's swatches; raises `PhotoRejected` where there is none, or none that can be trusted."""
    srgb = photo.srgb
    page = px_from_mm, _ = _find_page(srgb, manifest)
    found = {row: _core(swatch.rect_mm, *page, srgb.shape) for row, swatch in enumerate(manifest.chart)}
    cores = {row: core for row, core in found.items() if core is not None}
    if not cores:
        advice = "come closer to the chart, hold still and show all of it"
        raise PhotoRejected("too_small", 0, 1, advice)
    light = np.full((len(manifest.chart), 3), np.nan)
    middles_mm = np.array([[x + w / 2, y + h / 2] for x, y, w, h in cores.values()])
    by_swatch = _paper_at(middles_mm, srgb, manifest, *page)
    for (row, core), paper in zip(cores.items(), by_swatch, strict=True):
        codes = _codes(srgb, px_from_mm, core)
        if (codes >= CLIPPED_CODE).any(-1).mean() <= MAX_CLIPPED_SHARE:
            light[row] = LINEAR_FROM_CODE[codes].mean(0) / paper
    red, green, blue = np.median(by_swatch, 0).tolist()
    return ChartPhoto(light, (red, green, blue))


def _find_page(srgb: np.ndarray, manifest: Manifest) -> tuple[np.ndarray, float]:
    """Find the chart's page by the markers beside the piece; the piece's own help where it is not cut out. Returns the
    homography from millimeters to pixels, and the blur in pixels.
    """
    dictionary = manifest.markers[0].dictionary
    on_page = {marker.id: marker for marker in manifest.markers if marker.page == manifest.chart[0].page}
    corners_mm = {i: np.array(marker.corners_mm) for i, marker in on_page.items()}
    detected = find_sheet(srgb, corners_mm.keys(), corners_mm, dictionary)
    corners_px = detected.corners_px
    if not corners_px:
        raise _no_sheet(srgb, detected, dictionary)
    beside = {i: px for i, px in corners_px.items() if not rect_contains(manifest.cut_mm, marker_rect(on_page[i]))}
    fit = fit_page(corners_px, corners_mm)
    if len(beside) > 1 and not set(beside) <= set(fit.inlier_ids):
        fit = fit_page(beside, corners_mm)
    return fit.px_from_mm, blur_px(detected.markers.values())


def _no_sheet(srgb: np.ndarray, detected: MarkersInView, dictionary: str) -> PhotoRejected:
    if is_mirrored(srgb, detected, dictionary):
        return PhotoRejected("mirrored", None, None, "the photo is mirrored: switch off the camera's mirror setting")
    if detected.foreign:
        advice = "these are the markers of another sheet or page: name that sheet's JSON, or leave the photo out"
        return PhotoRejected("wrong_sheet", len(detected.foreign), 0, advice)
    return PhotoRejected("too_few_markers", 0, 1, "no marker is readable: show the page sharp and well lit")


def _core(rect: RectMm, px_from_mm: np.ndarray, blur_px: float, shape) -> RectMm | None:
    """The part of a swatch that blur does not reach; None where there is none or it lies outside the picture."""
    x, y, w, h = rect
    quad = apply_homography(px_from_mm, rect_corners(rect))
    sides = np.linalg.norm(np.roll(quad, -1, axis=0) - quad, axis=1)
    sides = np.array([min(sides[0], sides[2]), min(sides[1], sides[3])])
    edge = np.maximum(_CORE_MARGIN, (0.75 + 1.5 * blur_px) / sides)
    in_picture = ((quad >= 0) & (quad <= [shape[1], shape[0]])).all()
    if (sides * (1 - 2 * edge) < MIN_CORE_PX).any() or not in_picture:
        return None
    return x + w * edge[0], y + h * edge[1], w * (1 - 2 * edge[0]), h * (1 - 2 * edge[1])


def _paper_at(points_mm, srgb: np.ndarray, manifest: Manifest, px_from_mm: np.ndarray, blur_px: float) -> np.ndarray:
    """The light N×3 of bare paper at points N×2, by the white paper around the chart and its white swatches."""
    rects = np.array([swatch.rect_mm for swatch in manifest.chart])
    low = np.maximum(rects[:, :2].min(0) - _SEARCH_MM, 0)
    high = np.minimum((rects[:, :2] + rects[:, 2:]).max(0) + _SEARCH_MM, manifest.page_mm)
    printed = [swatch.rect_mm for swatch in manifest.chart if min(swatch.srgb) < 1]
    printed += [marker_rect(m) for m in manifest.markers if m.page == manifest.chart[0].page]
    if any(not rect_contains(manifest.cut_mm, swatch.rect_mm) for swatch in manifest.chart):
        printed.append(manifest.cut_mm)
    area = (*low.tolist(), *(high - low).tolist())
    paper = paper_light(srgb, px_from_mm, area, printed, blur_px)
    light = quadratic_terms(points_mm - low, area[2:]) @ paper.coefficients.T
    if light.max() > (full := LINEAR_FROM_CODE[CLIPPED_CODE]) or light.min() <= 0:
        advice = "the paper is overexposed, or its light too uneven: lower the exposure by one step, in even light"
        raise PhotoRejected("clipped", float(light.max()), float(full), advice)
    return light


def _codes(srgb: np.ndarray, px_from_mm: np.ndarray, rect: RectMm) -> np.ndarray:
    """uint8 N×3 of the pixels nearest to a grid in a rectangle of mm. Nearest pixels, not mixtures: the mean of their
    light is the light's mean, whatever the tone curve.
    """
    step = (np.indices((_SAMPLES, _SAMPLES)).reshape(2, -1).T + 0.5) / _SAMPLES
    px = np.floor(apply_homography(px_from_mm, rect[:2] + np.multiply(rect[2:], step))).astype(int)
    column, line = np.clip(px, 0, [srgb.shape[1] - 1, srgb.shape[0] - 1]).T
    return srgb[line, column]
