"""How the print looks in a photograph against how it was promised to look: ΔE00, after a stated colour fit.

In: a photograph, its homography, the promised linear light. Out: figures for the entry, the clipped share, and
pictures. Both sides are averaged over the same coarse cells, and the promise is blurred as the photo is, so that
resolution is not mistaken for colour: a cell is at least two photo pixels, twice the blur and four times the corner
uncertainty wide. The outermost ring of cells is left out: blur mixes the white frame into it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from patchproof.color import ciede2000, lab_from_linear, linear_from_srgb, srgb_from_linear
from patchproof.geometry import apply_homography, rect_corners
from patchproof.photo.colorfit import ColorFit, affine12, white_black
from patchproof.photo.edges import sample
from patchproof.photo.quality import CLIPPED_CODE, FrameLight
from patchproof.photo.rectify import rectify
from patchproof.verify.results import PhotoEntry
from patchproof.verify.surface import Promised, Surface

_CELLS = (6, 48)  # least and most along the design's shorter side
MOST_CLIPPED = 0.5  # share of the design at full white, where colour is unknown
_MOST_CLIPPED_PAPER = 0.2
_PICTURE_PX = 192
_POINTS = np.stack(np.meshgrid(np.linspace(0, 1, 7), np.linspace(0, 1, 7)), -1).reshape(-1, 2)


@dataclass(frozen=True)
class Appearance:
    """Fields of `PhotoEntry`, the clipped share of the design, pictures (uint8 sRGB; `delta_e00` float cells)."""

    figures: dict[str, float | str | None]
    clipped: float
    pictures: dict[str, np.ndarray]


def appearance(
    srgb: np.ndarray, px_from_mm: np.ndarray, surface: Surface, promised: Promised, light: FrameLight, entry: PhotoEntry
) -> Appearance:
    """Colour difference of the whole design; figures stay null where more than half of it is clipped."""
    part, px_from_mm = piece_only(srgb, px_from_mm, surface)
    linear = linear_from_srgb(np.arange(256) / 255).astype(np.float32)[part]
    fit = color_fit(part, linear, px_from_mm, surface, promised, light, entry.blur_px)
    cells_per_mm = _cells_per_mm(surface, entry)
    seen = fit.apply(rectify(linear, px_from_mm, surface.rect_mm, cells_per_mm).astype(float))
    at_limit = rectify(
        (part >= CLIPPED_CODE).any(-1)[..., None].astype(np.float32), px_from_mm, surface.rect_mm, cells_per_mm
    )
    clipped = at_limit.reshape(seen.shape[:2]) > 0.05
    expected = _coarse(
        promised.design, seen.shape[:2], entry.blur_px / entry.px_per_mm * promised.design.shape[1] / surface.rect_mm[2]
    )
    delta = ciede2000(lab_from_linear(expected), lab_from_linear(seen))
    usable = ~clipped
    usable[[0, -1]] = usable[:, [0, -1]] = False
    share = 1 - float(usable[1:-1, 1:-1].mean())
    if fit.name == "white_black" and light.clipped > _MOST_CLIPPED_PAPER:
        share = 1.0  # paper at full white is no reference
    figures: dict = {"color_fit": fit.name}
    if share <= MOST_CLIPPED:
        values = delta[usable]
        figures |= {"delta_e00_mean": float(values.mean()), "delta_e00_p95": float(np.percentile(values, 95))}
    picture_px_per_mm = _PICTURE_PX / max(surface.rect_mm[2:])
    fitted = fit.apply(rectify(linear, px_from_mm, surface.rect_mm, picture_px_per_mm))
    pictures = {
        "seen": rectify(part, px_from_mm, surface.rect_mm, picture_px_per_mm),
        "fitted": _eight_bit(fitted),
        "promised": _eight_bit(_coarse(promised.design, fitted.shape[:2], 0.0)),
        "delta_e00": np.where(usable, delta, np.nan).astype(np.float32),
    }
    return Appearance(figures, share, pictures)


def color_fit(
    part, linear, px_from_mm, surface: Surface, promised: Promised, light: FrameLight, blur_px: float
) -> ColorFit:
    """The best colour map that the piece in view supports; clipped or unresolved swatches are left out."""
    seen = seen_swatches(part, linear, px_from_mm, surface, blur_px)
    usable = np.isfinite(seen).all(1)
    fit = affine12(seen[usable], promised.swatches[usable].reshape(-1, 3))
    return fit or white_black(light.paper, light.ink, promised.ink)


def seen_swatches(part, linear, px_from_mm, surface: Surface, blur_px: float) -> np.ndarray:
    """Linear light N×3 of the piece's swatches; NaN where one is clipped, unresolved or out of the picture."""
    values = [_swatch(part, linear, px_from_mm, rect, blur_px) for rect in surface.swatch_rects_mm]
    return np.array([np.full(3, np.nan) if value is None else value for value in values]).reshape(-1, 3)


def _swatch(part, linear, px_from_mm, rect, blur_px) -> np.ndarray | None:
    """Linear light of a swatch's unblurred core; None where it has none, is clipped, or lies out of the picture."""
    x, y, w, h = rect
    quad = apply_homography(px_from_mm, rect_corners(rect))
    sides = np.linalg.norm(np.roll(quad, -1, axis=0) - quad, axis=1)
    edge = (0.75 + 1.5 * blur_px) / np.array(
        [min(sides[0], sides[2]), min(sides[1], sides[3])]
    )  # shares of width, height
    if (edge > 0.4).any():
        return None
    points = apply_homography(px_from_mm, [x, y] + [w, h] * (edge + _POINTS * (1 - 2 * edge)))
    if (points < 0).any() or (points > [part.shape[1], part.shape[0]]).any():
        return None
    if float((sample(part, points) >= CLIPPED_CODE).mean()) > 0.05:
        return None
    return np.median(sample(linear, points), axis=0)


def _cells_per_mm(surface: Surface, entry: PhotoEntry) -> float:
    cell_mm = max(2.0, 2 * entry.blur_px) / entry.px_per_mm
    cell_mm = max(cell_mm / np.sqrt(max(np.cos(np.radians(entry.tilt_deg)), 0.05)), 4 * entry.corner_uncertainty_mm)
    side_mm = min(surface.rect_mm[2:])
    return float(np.clip(side_mm / cell_mm, *_CELLS)) / side_mm


def _coarse(design: np.ndarray, shape: tuple[int, int], blur_design_px: float) -> np.ndarray:
    """The promised light blurred and averaged to `shape` cells."""
    if blur_design_px > 0.3:
        design = cv2.GaussianBlur(design, (0, 0), float(blur_design_px), borderType=cv2.BORDER_REPLICATE)
    way = cv2.INTER_AREA if shape[1] <= design.shape[1] else cv2.INTER_LINEAR
    return cv2.resize(design, (shape[1], shape[0]), interpolation=way).astype(float)


def piece_only(srgb, px_from_mm, surface: Surface):
    """The part of the photo that holds the design and all swatches, and the homography to it."""
    corners = np.concatenate([rect_corners(r) for r in (surface.rect_mm, *surface.swatch_rects_mm)])
    quad = apply_homography(px_from_mm, corners)
    limit = np.array([srgb.shape[1], srgb.shape[0]])
    low = np.clip(np.floor(quad.min(0)).astype(int) - 4, 0, limit - 1)
    high = np.clip(np.ceil(quad.max(0)).astype(int) + 4, low + 1, limit)
    shift = np.array([[1, 0, -low[0]], [0, 1, -low[1]], [0, 0, 1.0]])
    return np.ascontiguousarray(srgb[low[1] : high[1], low[0] : high[0]]), shift @ px_from_mm


def _eight_bit(linear: np.ndarray) -> np.ndarray:
    return np.clip(srgb_from_linear(np.clip(linear, 0, 1)) * 255 + 0.5, 0, 255).astype(np.uint8)
