"""How the print looks in a photograph against how it was promised to look: ΔE00, after a stated color fit.

In: a photograph, its homography, the promised linear light. Out: figures for the entry, the clipped share, and
pictures. Both sides are averaged over the same coarse cells, and the promise is blurred as the photo is, so that
resolution is not mistaken for color: a cell is at least two photo pixels, twice the blur and four times the corner
uncertainty wide. The outermost ring of cells is left out: blur mixes what lies around the piece into it. The
design's own cells, with paper and ink, say what print, light and camera did to colors; each is compared after a map
that was fitted to others. Clipped cells and cells with gloss, light that is added to all three channels in one place,
are left out and counted.
"""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np

from patchproof.base.color import ciede2000, lab_from_linear, photo_codes_from_srgb, srgb_from_linear
from patchproof.base.geometry import rect_corners
from patchproof.evidence.results import Color, Geometry
from patchproof.evidence.surface import PromisedColors, Surface
from patchproof.photo.colorfit import ColorFit, affine12, white_black
from patchproof.photo.detect import LINEAR_FLOAT32_FROM_CODE
from patchproof.photo.quality import CLIPPED_CODE, FrameLight
from patchproof.photo.rectify import crop_around, least_px_per_mm, oversample_flat, rectified_px, resize_by_area

_CELLS = (6, 48)  # least and most along the design's shorter side
MOST_CLIPPED = 0.5  # share of the design at full white, where color is unknown
_MOST_CLIPPED_PAPER = 0.2
_PICTURE_PX = 192
_SAMPLES = 8  # along a cell that are looked at, each the mean of the photograph's pixels there
_STRIP_PX = 100_000  # 1.6 MB as light: caches hold it
_LIGHT = np.repeat(LINEAR_FLOAT32_FROM_CODE[None, :, None], 3, 2)
_ANCHORS = 8  # cells for each time that paper and ink count
_GLOSS = 0.15  # linear light, paper = 1


def appearance(
    srgb: np.ndarray,
    px_from_mm: np.ndarray,
    surface: Surface,
    promised: PromisedColors,
    light: FrameLight,
    geometry: Geometry,
    with_pictures: bool = True,
) -> tuple[Color, dict[str, np.ndarray]]:
    """Color difference of the whole design, None where more than half of it is clipped, and pictures (uint8 sRGB;
    `delta_e00` float cells) where they are wanted.
    """
    cells_per_mm, picture_per_mm = _cells_per_mm(surface, geometry), _PICTURE_PX / max(surface.rect_mm[2:])
    spare = least_px_per_mm(px_from_mm, surface.rect_mm) / max(_SAMPLES * cells_per_mm, picture_per_mm)
    step = max(1, int(spare))
    part, px_from_mm = crop_around(srgb, px_from_mm, rect_corners(surface.rect_mm), 4 * step)
    linear = _reduced_light(part, step)
    px_from_mm = np.diag([1 / step, 1 / step, 1.0]) @ px_from_mm
    size = rectified_px(surface.rect_mm, cells_per_mm)
    flat = oversample_flat(linear, px_from_mm, surface.rect_mm, size)
    *lit, clipped = cv2.split(resize_by_area(flat, size))
    lit, clipped = np.dstack(lit).astype(float), clipped > 0.05
    blur_mm = geometry.blur_px / geometry.px_per_mm
    expected = coarse(promised.design, lit.shape[:2], blur_mm * promised.design.shape[1] / surface.rect_mm[2])
    usable = ~clipped
    usable[[0, -1]] = usable[:, [0, -1]] = False
    fit = cells_fit(lit[usable], expected[usable], light, promised.ink)
    cells = _fitted_by_others(lit, expected, usable, fit, light, promised.ink)
    delta = ciede2000(lab_from_linear(expected), lab_from_linear(cells))
    glossy = _glossy(cells, expected) & ~clipped
    usable &= ~glossy
    inner = np.s_[1:-1, 1:-1]
    share = float(clipped[inner].mean())
    if fit.name == "white_black" and light.clipped > _MOST_CLIPPED_PAPER:
        share = 1.0  # paper at full white is no reference
    known = delta[usable] if share <= MOST_CLIPPED else delta[:0]
    color = Color(
        color_fit=fit.name,
        clipped_share=share,
        glossy_share=float(glossy[inner].mean()),
        delta_e00_mean=float(known.mean()) if known.size else None,
        delta_e00_p95=float(np.percentile(known, 95)) if known.size else None,
    )
    if not with_pictures:
        return color, {}
    seen = resize_by_area(flat, rectified_px(surface.rect_mm, picture_per_mm))[..., :3]
    fitted = fit.apply(seen)
    pictures = {
        "seen": photo_codes_from_srgb(srgb_from_linear(seen)),
        "fitted": photo_codes_from_srgb(srgb_from_linear(fitted)),
        "promised": photo_codes_from_srgb(srgb_from_linear(coarse(promised.design, fitted.shape[:2], 0.0))),
        "delta_e00": np.where(usable, delta, np.nan).astype(np.float32),
    }
    return color, pictures


def _reduced_light(srgb: np.ndarray, step: int) -> np.ndarray:
    """Linear light of uint8 pixels and the share of clipped ones, H×W×4 float32, each the mean of `step` times `step`:
    of 12 megapixels each cell has hundreds, of which making them light and resampling them took most of the time.
    """
    height, width = (side // step for side in srgb.shape[:2])
    srgb, means = srgb[: height * step, : width * step], np.zeros((height, width, 4), np.float32)
    rows = max(1, _STRIP_PX // srgb.shape[1] // step)
    for top in range(0, height, rows):
        strip, into = srgb[top * step : (top + rows) * step], means[top : top + rows]
        shrunk = partial(cv2.resize, dsize=into.shape[1::-1], interpolation=cv2.INTER_AREA)
        into[..., :3] = shrunk(cv2.LUT(strip, _LIGHT))
        unclipped = cv2.inRange(strip, (0, 0, 0), 3 * (CLIPPED_CODE - 1,))
        if cv2.countNonZero(unclipped) < unclipped.size:
            into[..., 3] = shrunk((unclipped == 0).astype(np.float32))
    return means


def cells_fit(seen: np.ndarray, promised: np.ndarray, light: FrameLight, ink: np.ndarray) -> ColorFit:
    """The best color map that N×3 cells of the design support, beside paper and ink: these alone where the cells are
    too few or too much alike.
    """
    anchors = max(len(seen) // _ANCHORS, 1)  # each: the design's own colors do not say what white and black became
    known = [[light.paper] * anchors, [light.ink] * anchors], [[np.ones(3)] * anchors, [ink] * anchors]
    fit = affine12(*(np.concatenate([cells, *ends]) for cells, ends in zip((seen, promised), known, strict=True)))
    return fit or white_black(light.paper, light.ink, ink)


def _fitted_by_others(
    lit: np.ndarray, expected: np.ndarray, usable: np.ndarray, fit: ColorFit, light: FrameLight, ink: np.ndarray
) -> np.ndarray:
    """Cells H×W×3 after a fit to the other half of a checkerboard, so that none flatters itself."""
    cells = fit.apply(lit)
    if fit.name == "white_black":
        return cells
    black = np.indices(usable.shape).sum(0) % 2 == 0
    for own in (black, ~black):
        others = usable & ~own
        cells[own] = cells_fit(lit[others], expected[others], light, ink).apply(lit[own])
    return cells


def _glossy(cells: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Cells H×W to which light was added in all channels: no ink that is missing or wrong lifts all three.

    More than the design as a whole, which a print on other paper may lift; a lone cell is an edge that lies off.
    """
    added = (cells - expected).min(-1)
    mask = added - np.median(added) > _GLOSS
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8)) > 0


def _cells_per_mm(surface: Surface, geometry: Geometry) -> float:
    foreshortened = np.sqrt(max(np.cos(np.radians(geometry.tilt_deg)), 0.05))
    cell_mm = max(2.0, 2 * geometry.blur_px) / geometry.px_per_mm / foreshortened
    cell_mm = max(cell_mm, 4 * geometry.corner_uncertainty_mm)
    side_mm = min(surface.rect_mm[2:])
    return float(np.clip(side_mm / cell_mm, *_CELLS)) / side_mm


def coarse(design: np.ndarray, shape: tuple[int, ...], blur_design_px: float) -> np.ndarray:
    """The promised light blurred and averaged to `shape` cells."""
    if blur_design_px > 0.3:
        design = cv2.GaussianBlur(design, (0, 0), float(blur_design_px), borderType=cv2.BORDER_REPLICATE)
    return resize_by_area(design, (shape[1], shape[0])).astype(float)
