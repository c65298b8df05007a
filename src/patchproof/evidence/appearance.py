"""How the print looks in a photograph against how it was promised to look: ΔE00, after a stated color fit.

In: a photograph, its homography, the promised linear light. Out: figures for the entry, the clipped share, and
pictures. Both sides are averaged over the same coarse cells, and the promise is blurred as the photo is, so that
resolution is not mistaken for color: a cell is at least two photo pixels, twice the blur and four times the corner
uncertainty wide. The outermost ring of cells is left out: blur mixes the white frame into it. Clipped cells and cells
with gloss, light that is added to all three channels in one place, are left out and counted.
"""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np
from scipy.special import ndtr

from patchproof.color import ciede2000, lab_from_linear, photo_codes_of, srgb_from_linear
from patchproof.evidence.results import Color, Geometry, SwatchSeen
from patchproof.evidence.surface import Promised, Surface
from patchproof.geometry import apply_homography, rect_corners
from patchproof.photo.colorfit import ColorFit, affine12, white_black
from patchproof.photo.detect import LIGHT
from patchproof.photo.edges import GRID, sample
from patchproof.photo.quality import CLIPPED_CODE, FrameLight
from patchproof.photo.rectify import crop, rectify

_CELLS = (6, 48)  # least and most along the design's shorter side
MOST_CLIPPED = 0.5  # share of the design at full white, where color is unknown
_MOST_CLIPPED_PAPER = 0.2
_PICTURE_PX = 192
# JPEG halves the resolution of color: read up to their borders, swatches came out up to 17 code values off; with this
# much more of a margin up to 5 and mostly under 1
_CHROMA_PX = 1.0
_GLOSS = 0.15  # linear light, paper = 1
_UNREAD = np.full(3, np.nan)


def appearance(
    srgb: np.ndarray,
    px_from_mm: np.ndarray,
    surface: Surface,
    promised: Promised,
    light: FrameLight,
    geometry: Geometry,
) -> tuple[Color, dict[str, np.ndarray]]:
    """Color difference of the whole design, None where more than half of it is clipped, and pictures (uint8 sRGB;
    `delta_e00` float cells).
    """
    part, px_from_mm = piece_only(srgb, px_from_mm, surface)
    linear = LIGHT[part]
    swatches = seen_swatches(part, linear, px_from_mm, surface, geometry.blur_px, light.paper)
    fit = color_fit(swatches, promised, light)
    flat = partial(rectify, px_from_mm=px_from_mm, rect_mm=surface.rect_mm, px_per_mm=_cells_per_mm(surface, geometry))
    cells = fit.apply(flat(linear).astype(float))
    clipped = flat((part.max(-1, keepdims=True) >= CLIPPED_CODE).astype(np.float32)).reshape(cells.shape[:2]) > 0.05
    blur_mm = geometry.blur_px / geometry.px_per_mm
    expected = _coarse(promised.design, cells.shape[:2], blur_mm * promised.design.shape[1] / surface.rect_mm[2])
    delta = ciede2000(lab_from_linear(expected), lab_from_linear(cells))
    glossy = _glossy(cells, expected) & ~clipped
    usable = ~(clipped | glossy)
    usable[[0, -1]] = usable[:, [0, -1]] = False
    inner = np.s_[1:-1, 1:-1]
    share = float(clipped[inner].mean())
    if fit.name == "white_black" and light.clipped > _MOST_CLIPPED_PAPER:
        share = 1.0  # paper at full white is no reference
    known = delta[usable] if share <= MOST_CLIPPED else delta[:0]
    color = Color(
        color_fit=fit.name,
        clipped_share=share,
        glossy_share=float(glossy[inner].mean()),
        swatches=_compared(fit, swatches, promised.swatches, surface.swatches_srgb),
        delta_e00_mean=float(known.mean()) if known.size else None,
        delta_e00_p95=float(np.percentile(known, 95)) if known.size else None,
    )
    flat = partial(flat, px_per_mm=_PICTURE_PX / max(surface.rect_mm[2:]))
    fitted = fit.apply(flat(linear))
    pictures = {
        "seen": flat(part),
        "fitted": photo_codes_of(srgb_from_linear(fitted)),
        "promised": photo_codes_of(srgb_from_linear(_coarse(promised.design, fitted.shape[:2], 0.0))),
        "delta_e00": np.where(usable, delta, np.nan).astype(np.float32),
    }
    return color, pictures


def color_fit(swatches: np.ndarray, promised: Promised, light: FrameLight) -> ColorFit:
    """The best color map that the N×3 swatches in view support (NaN: unread)."""
    usable = np.isfinite(swatches).all(1)
    fit = affine12(swatches[usable], promised.swatches[usable].reshape(-1, 3))
    return fit or white_black(light.paper, light.ink, promised.ink)


def _compared(fit: ColorFit, swatches: np.ndarray, promised: np.ndarray, sent: np.ndarray) -> tuple[SwatchSeen, ...]:
    """Each readable swatch after the color fit beside its promise."""
    compared = []
    for color, light, wanted in zip(sent, swatches, promised, strict=True):
        if np.isfinite(light).all():
            fitted = np.clip(fit.apply(light), 0, 1)
            delta = ciede2000(lab_from_linear(wanted), lab_from_linear(fitted))
            colors = [tuple(c.tolist()) for c in (color, srgb_from_linear(wanted), srgb_from_linear(fitted))]
            compared.append(SwatchSeen(srgb=colors[0], promised=colors[1], seen=colors[2], delta_e00=float(delta)))
    return tuple(compared)


def _glossy(cells: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Cells H×W to which light was added in all channels: no ink that is missing or wrong lifts all three.

    More than the design as a whole, which a print on other paper may lift; a lone cell is an edge that lies off.
    """
    added = (cells - expected).min(-1)
    mask = added - np.median(added) > _GLOSS
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8)) > 0


def seen_swatches(
    part: np.ndarray, linear: np.ndarray, px_from_mm: np.ndarray, surface: Surface, blur_px: float, paper: np.ndarray
) -> np.ndarray:
    """Linear light N×3 of the piece's swatches; NaN where one is clipped, unresolved or out of the picture.

    Each is read clear of its border by blur and by JPEG's halved resolution of color, and what the blur still brings
    over from the `paper` around is taken out.
    """
    values = [_swatch(part, linear, px_from_mm, rect, blur_px, paper) for rect in surface.swatch_rects_mm]
    return np.array(values).reshape(-1, 3)


def _swatch(part, linear, px_from_mm, rect, blur_px: float, paper) -> np.ndarray:
    """Linear light of a swatch's core; NaN where it has none, is clipped, or lies out of the picture."""
    x, y, w, h = rect
    quad = apply_homography(px_from_mm, rect_corners(rect))
    sides = np.linalg.norm(np.roll(quad, -1, axis=0) - quad, axis=1).reshape(2, 2).min(0)  # width, height
    if ((0.75 + _CHROMA_PX + 1.5 * blur_px) / sides > 0.4).any():
        return _UNREAD
    edge = np.minimum((0.75 + _CHROMA_PX + 2.5 * blur_px) / sides, 0.4)  # shares of width, height
    shares = edge + GRID * (1 - 2 * edge)
    points = apply_homography(px_from_mm, [x, y] + [w, h] * shares)
    if (points < 0).any() or (points > [part.shape[1], part.shape[0]]).any():
        return _UNREAD
    if float((sample(part, points) >= CLIPPED_CODE).mean()) > 0.05:
        return _UNREAD
    sigma = max(blur_px, 0.1) / sides
    own = (ndtr(shares / sigma) - ndtr((shares - 1) / sigma)).prod(1)[:, None]  # of the light, under a Gaussian
    return np.median((sample(linear, points) - (1 - own) * paper) / own, axis=0)


def _cells_per_mm(surface: Surface, geometry: Geometry) -> float:
    foreshortened = np.sqrt(max(np.cos(np.radians(geometry.tilt_deg)), 0.05))
    cell_mm = max(2.0, 2 * geometry.blur_px) / geometry.px_per_mm / foreshortened
    cell_mm = max(cell_mm, 4 * geometry.corner_uncertainty_mm)
    side_mm = min(surface.rect_mm[2:])
    return float(np.clip(side_mm / cell_mm, *_CELLS)) / side_mm


def _coarse(design: np.ndarray, shape: tuple[int, ...], blur_design_px: float) -> np.ndarray:
    """The promised light blurred and averaged to `shape` cells."""
    if blur_design_px > 0.3:
        design = cv2.GaussianBlur(design, (0, 0), float(blur_design_px), borderType=cv2.BORDER_REPLICATE)
    way = cv2.INTER_AREA if shape[1] <= design.shape[1] else cv2.INTER_LINEAR
    return cv2.resize(design, (shape[1], shape[0]), interpolation=way).astype(float)


def piece_only(srgb: np.ndarray, px_from_mm: np.ndarray, surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """The part of the photo that holds the design and all swatches, and the homography to it."""
    corners = np.concatenate([rect_corners(r) for r in (surface.rect_mm, *surface.swatch_rects_mm)])
    return crop(srgb, px_from_mm, corners, 4)
