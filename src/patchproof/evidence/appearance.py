"""Compare the photographed design with the promised one: its color difference (ΔE00), its structure, its inks.

In: a photograph, its homography, the promised linear light. Out: figures for the entry, the clipped share, and
pictures; a `DesignMatch`. Both sides are averaged over the same coarse cells, and the promise is blurred as the photo
is, so that resolution is not mistaken for color: a cell is at least two photo pixels, twice the blur and four times the
corner uncertainty wide. Left out: the outermost ring of cells, into which blur mixes the surroundings of the piece;
clipped cells, and cells with gloss (light added to all three channels in one place), which are counted. Each cell is
compared after a color map fitted to other cells, paper and ink. What noise and codes make of a right print is measured.

Whether it shows the sheet's design, cells tell as the square root of light over paper, less the mean of their
surroundings: shadows, veils and a print's usual errors of color leave that structure, and another design lacks it. How
a channel follows the promised one, where the others do not, is its ink's contrast: on 29 photographs of real prints the
weakest had 0.32 of the strongest's, on prints without it 0.14. Left out on purpose: bands of clogged nozzles, and inks
that only a composite black would show.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from patchproof.base.color import ciede2000, lab_from_linear, photo_codes_from_srgb, srgb_from_linear
from patchproof.base.geometry import apply_homography, rect_corners
from patchproof.channel.print_colors import CELLS_PER_ANCHOR, ShownColors, affine12, white_black
from patchproof.evidence.results import Color, Geometry, Remark
from patchproof.evidence.surface import PromisedColors, Surface
from patchproof.photo.detect import LINEAR_FLOAT32_FROM_CODE
from patchproof.photo.quality import CLIPPED_CODE, FrameLight
from patchproof.photo.rectify import coarsen, crop_around, least_px_per_mm, oversample_flat, rectified_px
from patchproof.photo.rejection import PhotoRejected

_CELLS = (6, 48)  # least and most along the design's shorter side
MOST_CLIPPED = 0.5  # share of the design at full white, where color is unknown
_MOST_CLIPPED_PAPER = 0.2
_PICTURE_PX = 192
_SAMPLES_PER_CELL = 8  # along a side, each the mean of the photograph's pixels there
_STRIP_PX = 100_000  # 1.6 MB as light: caches hold it
_LIGHT_TABLE = np.repeat(LINEAR_FLOAT32_FROM_CODE[None, :, None], 3, 2)
_GLOSS_LIGHT = 0.15  # linear light, paper = 1
MOST_NOISE = 3.0  # ΔE00 that the photograph alone makes
_CODE_ERROR = 0.8  # of a cell, by rounding and JPEG: from 2 to 5 stops too dark it explains what a right print measures
_LAPLACIANS = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)  # multiplies white noise by 6
LEAST_FOUND = 0.35  # of the cells with detail, in their places: other designs show 0.33 at most, its own prints 0.8
_LEAST_UNCOVERED, _LEAST_SHOWN = 0.4, 0.75  # share of these cells where a fifth to a third of the design is covered
LEAST_LIKENESS = 0.6  # correlation of structure
_SWAPPED_BY = 0.3  # of hues' correlation: red and blue swapped beside as they are
LEAST_INK, WEAK_INK = 0.2, 0.3  # contrast: of the strongest ink's; of chroma real prints keep 0.4, gray ones 0.04
_LEAST_PLAIN_INK = 0.55  # the same of grays without structure, by the light absorbed: real prints have 0.65 and more
_MOST_COLOR = 36.0  # ΔE00 of one color: 177 of real prints are off by 27 at most from `office`, by 35 from `coated`
_LEAST_CELLS, _LEAST_DETAILED = 40, 6
# of the square root of light: promised, and shown where none is: glare makes 0.04, other designs 0.09 and more
_LEAST_STRUCTURE, _MOST_STRUCTURE = 0.01, 0.065
_SURROUNDINGS = 1 / 8  # of the shorter side: standard deviation of the mean that is subtracted
_LEAST_CHROMA, _LEAST_COLORFUL = 0.05, 0.15  # of the colors' largest singular value: the second's and the third's
_INKS = ("cyan", "magenta", "yellow")
_OTHER_ADVICE = "this is another design than the sheet's: name that design's JSON, or print this sheet"
_INK_ADVICE = "{} ink is missing or wrong, or the print is gray: check the printer's inks and nozzles and print again"
_GRAY_ADVICE = "print or photograph are gray: switch black and white off, in the printer's settings and the camera's"
_SWAPPED_ADVICE = "red and blue are swapped: give RGB, such as array[..., ::-1] of what OpenCV reads"
_WEAK_ADVICE = "{} ink is weak in this print: it counts, but check the printer's nozzles before you print more"
_COVERED_ADVICE = "part of the design is covered: show all of it"
_UNTOLD_ADVICE = "too little of the design is resolved to tell it from another: come closer"


@dataclass(frozen=True)
class DesignMatch:
    """Correlation with the promised structure (None: it has none), trouble with ink or design, a weak ink."""

    likeness: float | None = None
    trouble: PhotoRejected | None = None
    weak_ink: Remark | None = None

    def trouble_beside(
        self, trouble: PhotoRejected | None, found: float, detailed: int, noisy: bool
    ) -> PhotoRejected | None:
        """Return the photograph's other `trouble`, beside which only structure counts, or that the design cannot be
        told. Raises `PhotoRejected` for another design or a missing ink. `found`: share of the `detailed` cells found,
        which noise hides, too.
        """
        # what covers markers may cover the design, and full white shows none
        if trouble is not None and trouble.code in ("too_few_markers", "clipped"):
            return trouble
        own, least = self.trouble, LEAST_FOUND if detailed >= _LEAST_DETAILED else 0.0
        if own is not None and own.code != "too_small" and (trouble is None or self.likeness is not None):
            raise own
        if trouble is None and least and not noisy and _LEAST_UNCOVERED <= found < _LEAST_SHOWN:
            return PhotoRejected("too_few_markers", found, _LEAST_SHOWN, _COVERED_ADVICE)
        likeness = 1.0 if self.likeness is None or trouble is not None else self.likeness
        for figure, limit in ((found, least), (likeness, LEAST_LIKENESS)):
            if not figure >= limit:
                raise PhotoRejected("other_design", figure, limit, _OTHER_ADVICE)
        return trouble or (None if least or own is None else own)


def appearance(
    srgb: np.ndarray,
    px_from_mm: np.ndarray,
    surface: Surface,
    promised: PromisedColors,
    light: FrameLight,
    geometry: Geometry,
    with_pictures: bool = True,
) -> tuple[Color, dict[str, np.ndarray], DesignMatch]:
    """Measure the color difference of the whole design (None if more than half of it is clipped); if `with_pictures`,
    make pictures: uint8 sRGB, and float cells as `delta_e00`; and compare the design with the promised one.
    """
    cells_per_mm, picture_per_mm = _cells_per_mm(surface, geometry), _PICTURE_PX / max(surface.rect_mm[2:])
    px_per_sample = least_px_per_mm(px_from_mm, surface.rect_mm) / max(_SAMPLES_PER_CELL * cells_per_mm, picture_per_mm)
    step = max(1, int(px_per_sample))
    part, px_from_mm = crop_around(srgb, px_from_mm, rect_corners(surface.rect_mm), 4 * step)
    linear = _reduced_light(part, step)
    px_from_mm = np.diag([1 / step, 1 / step, 1.0]) @ px_from_mm
    size = rectified_px(surface.rect_mm, cells_per_mm)
    flat = oversample_flat(linear, px_from_mm, surface.rect_mm, size)
    *photographed, clipped = cv2.split(coarsen(flat, size[::-1]))
    photographed, clipped = np.dstack(photographed).astype(float), clipped > 0.05
    blur_mm = geometry.blur_px / geometry.px_per_mm
    design = promised.design
    expected = coarsen(design, photographed.shape, blur_mm * design.shape[1] / surface.rect_mm[2]).astype(float)
    usable = ~clipped
    usable[[0, -1]] = usable[:, [0, -1]] = False
    middles_mm = (np.indices(usable.shape)[::-1].reshape(2, -1).T + 0.5) / cells_per_mm + surface.rect_mm[:2]
    free = ~surface.on_marker(middles_mm, 0.5 / cells_per_mm).reshape(usable.shape)
    match = match_design(photographed, expected, usable & free, light)
    fit = fit_cells(photographed[usable], expected[usable], light, promised.ink)
    cells = _cross_fitted_cells(photographed, expected, usable, fit, light, promised.ink)
    delta = ciede2000(lab_from_linear(expected), lab_from_linear(cells))
    glossy = _glossy(cells, expected) & ~clipped
    usable &= ~glossy
    inner = np.s_[1:-1, 1:-1]
    share = float(clipped[inner].mean())
    if fit.kind == "white_black" and light.clipped > _MOST_CLIPPED_PAPER:
        share = 1.0  # overexposed paper is no reference
    valid_delta = delta[usable] if share <= MOST_CLIPPED else delta[:0]
    pixels = cv2.contourArea(apply_homography(px_from_mm, rect_corners(surface.rect_mm)).astype(np.float32))
    noise = _noise_delta(linear[..., :3], photographed, fit, max(pixels / usable.size, 1.0))
    color = Color(
        color_fit=fit.kind,
        clipped_share=share,
        glossy_share=float(glossy[inner].mean()),
        noise_delta_e00=float(noise[usable].mean()) if usable.any() else None,
    )
    if valid_delta.size and (color.noise_delta_e00 or 0) <= MOST_NOISE:
        p95 = float(np.percentile(valid_delta, 95))
        color = color.changed(delta_e00_mean=float(valid_delta.mean()), delta_e00_p95=p95)
    if not with_pictures:
        return color, {}, match
    seen = coarsen(flat, rectified_px(surface.rect_mm, picture_per_mm)[::-1])[..., :3]
    lights = {"seen": seen, "fitted": fit.undo(seen), "promised": coarsen(design, seen.shape)}
    pictures = {kind: photo_codes_from_srgb(srgb_from_linear(linear)) for kind, linear in lights.items()}
    return color, pictures | {"delta_e00": np.where(usable, delta, np.nan).astype(np.float32)}, match


def _reduced_light(srgb: np.ndarray, step: int) -> np.ndarray:
    """Average uint8 pixels over `step` × `step` to H×W×4 float32: linear light and the share of clipped pixels.

    In 12 megapixels a cell has hundreds of pixels; linearizing and resampling all of them took most of the time.
    """
    height, width = (side // step for side in srgb.shape[:2])
    srgb, means = srgb[: height * step, : width * step], np.zeros((height, width, 4), np.float32)
    rows = max(1, _STRIP_PX // srgb.shape[1] // step)
    for top in range(0, height, rows):
        strip, into = srgb[top * step : (top + rows) * step], means[top : top + rows]
        shrunk = partial(cv2.resize, dsize=into.shape[1::-1], interpolation=cv2.INTER_AREA)
        into[..., :3] = shrunk(cv2.LUT(strip, _LIGHT_TABLE))
        unclipped = cv2.inRange(strip, (0, 0, 0), 3 * (CLIPPED_CODE - 1,))
        if cv2.countNonZero(unclipped) < unclipped.size:
            into[..., 3] = shrunk((unclipped == 0).astype(np.float32))
    return means


def noise_of(linear: np.ndarray) -> np.ndarray:
    """Estimate the standard deviation of noise in linear light H×W or H×W×N where it is smooth: a number, or N of them.

    Immerkaer, Fast Noise Variance Estimation, CVIU 64 (1996) 300-302, with a low quantile in place of the mean: a
    fifth of most photographs is smooth, and in a mean texture would count as noise.
    """
    detail = np.abs(cv2.filter2D(linear, -1, _LAPLACIANS)[1:-1, 1:-1]).reshape(-1, *linear.shape[2:])
    return np.quantile(detail, 0.2, axis=0) / 0.2533 / 6  # a fifth of a normal variable is nearer to 0 than 0.2533 σ


def _noise_delta(linear: np.ndarray, cells: np.ndarray, fit: ShownColors, pixels: float) -> np.ndarray:
    """ΔE00 (H×W) that noise of the photograph's light and errors of its codes make in cells of so many pixels."""
    of_code = np.maximum(2.4 / 1.055 * np.clip(cells, 0, 1) ** (1 - 1 / 2.4), 1 / 12.92) / 255  # light
    error = np.hypot(noise_of(linear) / np.sqrt(pixels), _CODE_ERROR * of_code)
    noisy = cells + error * np.random.default_rng(0).normal(size=cells.shape)
    return ciede2000(lab_from_linear(fit.undo(cells)), lab_from_linear(fit.undo(noisy)))


def fit_cells(photographed: np.ndarray, promised: np.ndarray, light: FrameLight, ink: np.ndarray) -> ShownColors:
    """Fit a color map to N×3 cells, paper and ink; to paper and ink alone if the cells are too few or too alike."""
    anchors = max(len(photographed) // CELLS_PER_ANCHOR, 1)  # the design's colors alone do not fix white and black
    count = anchors if light.clipped > _MOST_CLIPPED_PAPER else 2 * anchors  # overexposed paper is no reference
    seen_ends, ends = (np.repeat(pair, anchors, 0)[:count] for pair in ([light.ink, light.paper], [ink, np.ones(3)]))
    fit = affine12(np.concatenate([photographed, seen_ends]), np.concatenate([promised, ends]))
    return fit or white_black(light.paper, light.ink, ink)


def _cross_fitted_cells(
    cells: np.ndarray, expected: np.ndarray, usable: np.ndarray, fit: ShownColors, light: FrameLight, ink: np.ndarray
) -> np.ndarray:
    """Map cells H×W×3, each by a fit to the other color of a checkerboard, so that no cell is judged by its own fit."""
    fitted = fit.undo(cells)
    if fit.kind == "white_black":
        return fitted
    black = np.indices(usable.shape).sum(0) % 2 == 0
    for half in (black, ~black):
        other_half = usable & ~half
        fitted[half] = fit_cells(cells[other_half], expected[other_half], light, ink).undo(cells[half])
    return fitted


def _glossy(cells: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Find the cells (H×W) to which light was added in all three channels, which no wrong or missing ink does.

    The light that was added to the design as a whole is subtracted, since other paper may lift all of it; single
    cells do not count, since a misplaced edge makes them.
    """
    added = (cells - expected).min(-1)
    mask = added - np.median(added) > _GLOSS_LIGHT
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8)) > 0


def _cells_per_mm(surface: Surface, geometry: Geometry) -> float:
    foreshortened = np.sqrt(max(np.cos(np.radians(geometry.tilt_deg or 0.0)), 0.05))
    cell_mm = max(2.0, 2 * geometry.blur_px) / geometry.px_per_mm / foreshortened
    cell_mm = max(cell_mm, 4 * geometry.corner_uncertainty_mm)
    side_mm = min(surface.rect_mm[2:])
    return float(np.clip(side_mm / cell_mm, *_CELLS)) / side_mm


def match_design(seen: np.ndarray, promised: np.ndarray, usable: np.ndarray, light: FrameLight) -> DesignMatch:
    """Compare linear light H×W×3 of cells as seen and as promised, where `usable`."""
    if (count := int(usable.sum())) < _LEAST_CELLS:
        return DesignMatch(trouble=PhotoRejected("too_small", count, _LEAST_CELLS, _UNTOLD_ADVICE))
    paper = np.maximum(light.paper, 1e-3)
    veil = float(np.clip((light.ink / paper).min(), 0, 0.5))
    shown, promised = np.clip(seen / paper, 0, 1.2), np.sqrt(np.clip(promised, 0, 1))
    seen = np.sqrt(np.clip((shown - veil) / (1 - veil), 0, 1.2))
    y, x = (_less_surroundings(v, usable)[usable] for v in (seen, promised))
    looks, promised = (seen[usable], np.sqrt(shown[usable])), promised[usable]
    structure_x, structure_y = (float(np.median(np.abs(v))) for v in (x, y))  # medians: blur spreads markers' light
    if structure_x < _LEAST_STRUCTURE:
        return DesignMatch(trouble=_plain_trouble(looks, promised, structure_y))
    gains = _robust_gains(x, y)
    likeness, diagonal = float(np.corrcoef((x @ gains).ravel(), y.ravel())[0, 1]), np.diag(gains)
    contrast, ink = float(diagonal.min() / max(diagonal.max(), 1e-6)), _INKS[int(diagonal.argmin())]
    if not likeness >= LEAST_LIKENESS or diagonal.max() <= 0:  # a negative is another design
        return DesignMatch(likeness)
    own, found = (np.linalg.svd(colors, compute_uv=False) for colors in (x, x @ gains))
    chroma = float(found[1] * own[0] / max(found[0] * own[1], 1e-9))
    hues, *seen_hues = (v - v.mean(1, keepdims=True) for v in (x, y, y[:, ::-1]))
    alike, swapped = (float(np.corrcoef(hues.ravel(), each.ravel())[0, 1]) for each in seen_hues)
    is_colorful = own[1] > _LEAST_CHROMA * own[0]
    if is_colorful and swapped > LEAST_LIKENESS > alike + _SWAPPED_BY:
        return DesignMatch(likeness, PhotoRejected("wrong_ink", alike, LEAST_LIKENESS, _SWAPPED_ADVICE))
    if is_colorful and chroma < LEAST_INK:
        return DesignMatch(likeness, PhotoRejected("wrong_ink", chroma, LEAST_INK, _GRAY_ADVICE))
    if own[2] < _LEAST_COLORFUL * own[0]:  # a design in gray or two inks tells no contrasts: compare its two colors
        centered = promised - promised.mean(0)
        along = centered @ np.linalg.svd(centered, full_matrices=False)[2][0]
        low, high = np.quantile(along, (0.02, 0.98)) @ [[0.75, 0.25], [0.25, 0.75]]
        troubles = (_plain_trouble([c[end] for c in looks], promised[end], 0.0) for end in (along < low, along > high))
        return DesignMatch(likeness, next(filter(None, troubles), None))
    if contrast < LEAST_INK:
        return DesignMatch(likeness, PhotoRejected("wrong_ink", contrast, LEAST_INK, _INK_ADVICE.format(ink)))
    weak = Remark(code="weak_ink", figure=contrast, threshold=WEAK_INK, advice=_WEAK_ADVICE.format(ink))
    return DesignMatch(likeness, weak_ink=weak if contrast < WEAK_INK else None)


def _plain_trouble(seen: Sequence[np.ndarray], promised: np.ndarray, structure: float) -> PhotoRejected | None:
    """Compare square roots of light N×3 of cells of one color, less the veil and with it, and what structure was seen.
    The nearer one counts, since blur lightens the ink of small markers as a veil does.
    """
    seen, promised = [np.median(each, 0) for each in seen], promised.mean(0)
    if structure > _MOST_STRUCTURE:
        return PhotoRejected("other_design", structure, _MOST_STRUCTURE, _OTHER_ADVICE)
    absorbed, is_gray = (1 - seen[0]) / np.maximum(1 - promised, 0.1), (1 - promised).min() > 0.6 * (1 - promised).max()
    contrast, ink = float(absorbed.min() / max(absorbed.max(), 1e-6)), _INKS[int(absorbed.argmin())]
    if contrast < _LEAST_PLAIN_INK and is_gray and promised.max() < 0.85:
        return PhotoRejected("wrong_ink", contrast, _LEAST_PLAIN_INK, _INK_ADVICE.format(ink))
    delta = min(float(ciede2000(*map(lab_from_linear, (promised**2, look**2)))) for look in seen)
    return PhotoRejected("other_design", delta, _MOST_COLOR, _OTHER_ADVICE) if delta > _MOST_COLOR else None


def _less_surroundings(values: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Subtract from H×W×3 the Gaussian mean of the usable cells around each."""
    sigma, weight = _SURROUNDINGS * min(usable.shape), usable.astype(float)
    total = cv2.GaussianBlur(values * weight[..., None], (0, 0), sigma)
    return values - total / np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma), 1e-6)[..., None]


def _robust_gains(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Fit y ≈ x @ gains to N×3 by least squares, with less weight on what lies over the design."""
    weight, gains = np.ones((len(x), 1)), np.eye(3)
    for _ in range(5):
        gains = np.linalg.lstsq(x * weight, y * weight, rcond=None)[0]
        error = np.linalg.norm(y - x @ gains, axis=1, keepdims=True)
        weight = 1 / np.sqrt(np.maximum(error / max(1.5 * float(np.median(error)), 1e-6), 1))
    return gains
