"""Separate a printer's inks from the light and camera of the photographs that show its known colors.

In: cells of photographs, wherever they lie, each with the light that a known printer would have made of it, and its
light as seen. Out: the print's ink, a quadratic in code values that is added to the known printer's light, and for each
photograph what its place and camera did to that light: veil, gains, tone, chroma, by the channel's own formulas. The
ink is linear in its coefficients, so a cell of many colors has the mean of its colors' terms. What cells do not
determine stays as the known printer has it.

Ink and photographs are told apart only as far as photographs differ: what all of them share (one phone's tone curve, a
veil in every place) may be either. Left out on purpose: light that changes within a photograph.

Where print and light need not be told apart, one map in light undoes both, so that a color difference measures what no
such map explains: with eight usable colors a robust affine map, else one per channel from paper and ink.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from patchproof.base.color import LUMINANCE, MAX_TONE, lab_from_linear, lift_tone, linear_from_srgb, srgb_from_linear

INK_TERMS = 9
LEAST_COLORS = 8  # 12 numbers from 24 values; with fewer a single bad color spoiled the map
_CONVERGED = 1e-3  # smaller changes of weights change no printed digit
_MOST_CELLS = 600  # of a photograph enter the fit
_EVEN_SHARE = 0.7  # of the cells
CELLS_PER_ANCHOR = 8  # paper and ink each enter once for so many: a design's colors do not fix white and black
_INK_RIDGE = 0.03  # weight of a term's prior, in cells: few noisy ones make no other print, and many say what it is
_TERMS_RIDGE = 0.05  # of a photograph's terms, per squared unit: keeps what cells cannot tell near its start
_STEPS = 4  # of a photograph's fit in each round
_LAB_NOISE = 1.0  # CIELAB distances below count by their square
_LIGHT_NOISE = 0.02  # likewise for light, in the eye's steps
_PROBE = 1e-4  # of finite differences
_FARTHEST = np.array([0.5] * 3 + [2.0] * 3 + [MAX_TONE] * 3 + [0.8])  # what terms may move from their start


@dataclass(frozen=True)
class CellColors:
    """Cells of one photograph: `promised` light N×3 of the known printer, its mean `terms` N×9, light as `seen` N×3,
    and `start` (10,), the photograph's terms as far as known: veil, log gains and tone by channel, chroma.
    """

    promised: np.ndarray
    terms: np.ndarray
    seen: np.ndarray
    start: np.ndarray

    def ink_light(self, ink: np.ndarray) -> np.ndarray:
        """Return the cells' light N×3 in this ink."""
        return np.clip(self.promised + self.terms @ ink, 0, 1)

    def shown_in(self, ink: np.ndarray) -> "ShownColors":
        """Fit the photograph's colors to its cells in a known ink."""
        return ShownColors.of_terms(_fit_terms(self.ink_light(ink), self, self.start, 3 * _STEPS))


@dataclass(frozen=True)
class ShownColors:
    """What a photograph makes of a print's light: `matrix` (3×4) maps it, then middle gray rises by `tone` (3). `kind`
    says how it was found: "terms", "affine12" or "white_black".
    """

    matrix: np.ndarray
    tone: np.ndarray | float = 0.0
    kind: str = "terms"

    @staticmethod
    def of_terms(terms: np.ndarray) -> "ShownColors":
        """Return the colors of `terms`: veil, log gains, tone (3 each), chroma; 0 has no effect. B×10 show B×N×3."""
        veil, gains, chroma = terms[..., :3], np.exp(terms[..., 3:6]), terms[..., 9:, None]
        mixing = (1 + chroma) * np.eye(3) - chroma * np.array(LUMINANCE)
        matrix = np.concatenate([(gains * (1 - veil))[..., None] * mixing, (gains * veil)[..., None]], -1)
        return ShownColors(matrix, terms[..., 6:9] if terms.ndim == 1 else terms[..., None, 6:9])

    def show(self, light: np.ndarray) -> np.ndarray:
        """Return the light `... × 3` that the photograph shows of a print's light."""
        shown = np.concatenate([light, np.ones_like(light[..., :1])], -1) @ self.matrix.swapaxes(-1, -2)
        return linear_from_srgb(lift_tone(srgb_from_linear(shown), self.tone)) if np.any(self.tone) else shown

    def undo(self, seen: np.ndarray) -> np.ndarray:
        """Return the print's light `... × 3` of light in the photograph."""
        return (lower_light(seen, self.tone) - self.matrix[:, 3]) @ np.linalg.inv(self.matrix[:, :3]).T


def lower_light(light: np.ndarray, tone: np.ndarray | float) -> np.ndarray:
    """Return light as it was before a photograph's tone (`lift_tone`) was applied."""
    if not np.any(tone):
        return light
    codes, slope = srgb_from_linear(light), 1 + 4 * tone
    return linear_from_srgb(2 * codes / (slope + np.sqrt(np.maximum(slope**2 - 16 * tone * codes, 0))))


def added_terms(promised: np.ndarray) -> np.ndarray:
    """Return the quadratic's terms `9 × ...` of linear light `... × 3`, each contiguous; 0 for bare paper."""
    r, g, b = 1 - np.moveaxis(srgb_from_linear(np.clip(promised, 0, 1)), -1, 0)
    terms = np.empty((INK_TERMS, *r.shape), promised.dtype)
    for into, term in zip(terms, (r, g, b, r * r, g * g, b * b, r * g, g * b, b * r), strict=True):
        into[...] = term
    return terms


def add_ink(promised: np.ndarray, ink: np.ndarray) -> np.ndarray:
    """Return the light of a print in this ink, `... × 3` of the same type, from the known printer's light."""
    added = ink.T.astype(promised.dtype) @ added_terms(promised).reshape(INK_TERMS, -1)
    return np.clip(promised + added.T.reshape(promised.shape), 0, 1)


def choose_cells(
    seen: np.ndarray, means: np.ndarray, paper: np.ndarray, seen_ink: np.ndarray, ink: np.ndarray | None
) -> CellColors:
    """Choose cells of one photograph from `seen` h×w×3 (NaN: unread) and `means` h×w×12 of the promised light and its
    terms. Paper and marker ink, promised as `ink`, are added unless `ink` is None.
    """
    inner = np.zeros(seen.shape[:2], bool)  # blur mixes what lies around the print into the rim
    inner[1:-1, 1:-1] = np.isfinite(seen[1:-1, 1:-1]).all(-1)
    # errors of place and blur count less where neighbors are alike
    uneven = np.abs(means[..., :3] - cv2.blur(means[..., :3], (3, 3))).sum(-1)[inner]
    chosen = np.flatnonzero(inner)[uneven <= np.quantile(uneven, _EVEN_SHARE)] if uneven.size else np.zeros(0, int)
    if len(chosen) > _MOST_CELLS:
        chosen = np.random.default_rng(0).choice(chosen, _MOST_CELLS, replace=False)
    means, anchors = means.reshape(-1, means.shape[-1])[chosen], max(len(chosen) // CELLS_PER_ANCHOR, 1)
    anchors, ink = (0, paper) if ink is None else (anchors, ink)
    ends, seen_ends = np.repeat([np.ones(3), ink], anchors, 0), np.repeat([paper, seen_ink], anchors, 0)
    return CellColors(
        np.concatenate([means[:, :3], ends]),
        np.concatenate([means[:, 3:], added_terms(ends).T]),
        np.concatenate([seen.reshape(-1, 3)[chosen], seen_ends]),
        np.concatenate([np.zeros(3), np.log(np.maximum(paper, 1e-3)), np.zeros(4)]),
    )


def fit_ink_and_photos(photos: Sequence[CellColors], rounds: int = 8) -> tuple[np.ndarray, list[np.ndarray]]:
    """Fit the print's ink 9×3 and photographs' terms (10,) in turn; terms that all share move to the ink."""
    terms = [cells.start for cells in photos]
    promised, rows = (np.concatenate([getattr(cells, name) for cells in photos]) for name in ("promised", "terms"))
    ink = np.zeros((INK_TERMS, 3))
    # each photograph counts as much as any other
    share = np.concatenate([np.full(len(cells.seen), 1 / max(len(cells.seen), 1)) for cells in photos])
    for _ in range(rounds):
        shared = np.mean([t - cells.start for cells, t in zip(photos, terms, strict=True)], 0)
        shared[:3] = np.min(terms, 0)[:3]  # no veil takes light away: only what all have in common may be ink
        terms = [t - shared for t in terms]
        seen = [ShownColors.of_terms(t).undo(cells.seen) for cells, t in zip(photos, terms, strict=True)]
        ink = _fit_ink(promised, rows, np.concatenate(seen), share, ink)
        light = [cells.ink_light(ink) for cells in photos]
        terms = [_fit_terms(*pair, t) for pair, t in zip(zip(light, photos, strict=True), terms, strict=True)]
    return ink, terms


def affine12(photographed: np.ndarray, promised: np.ndarray) -> ShownColors | None:
    """Fit a robust affine map to N×3 colors; None if they are too few or too similar to determine it. It maps promised
    to photographed colors: the promise is exact, and glare on a color, an outlier of the dependent variable, does not
    pull the map towards itself.
    """
    if len(photographed) < LEAST_COLORS:
        return None
    rows = np.column_stack([promised, np.ones(len(promised))])
    singular = np.linalg.svd(rows / np.maximum(np.linalg.norm(rows, axis=0), 1e-12), compute_uv=False)
    if singular[-1] < 0.02 * singular[0]:
        return None
    # errors are weighted by the eye's sensitivity: steps of code values are finer in the dark
    eye = 1 / (np.maximum(photographed.mean(1), 0) + 0.05) ** 0.6
    weight, photographed_from_promised = np.ones(len(photographed)), np.zeros((3, 4))
    huber = lambda error: np.minimum(1, 1.345 / np.maximum(error, 1e-12))  # noqa: E731  # for convergence from afar
    tukey = lambda error: np.maximum(1 - (error / 4.685) ** 2, 0) ** 2  # noqa: E731  # 0 for outliers
    for weigh, max_rounds in ((huber, 10), (tukey, 20)):
        for _ in range(max_rounds):
            w = (eye * np.sqrt(weight))[:, None]
            weighted = rows * w  # the normal equations take a fifth of the time, and are well conditioned here
            normal, moment = weighted.T @ weighted, weighted.T @ (photographed * w)
            photographed_from_promised = np.linalg.lstsq(normal, moment, rcond=None)[0].T
            miss = rows @ photographed_from_promised.T - photographed
            error = eye * np.sqrt(np.einsum("nc,nc->n", miss, miss))  # a fifth of the time of np.linalg.norm
            spread = max(1.4826 * float(np.median(error)), 1e-6)
            weight, previous = weigh(error / spread), weight
            if (weight > 0).sum() < LEAST_COLORS - 2:
                return None
            if np.abs(weight - previous).max() < _CONVERGED:
                break
    if np.linalg.cond(photographed_from_promised[:, :3]) > 50:  # no camera mixes its channels that much
        return None
    return ShownColors(photographed_from_promised, kind="affine12")


def white_black(paper: np.ndarray, ink: np.ndarray, promised_ink: np.ndarray) -> ShownColors:
    """Return the map per channel from paper (1) and `promised_ink` to photographed paper and ink."""
    gain = np.maximum(paper - ink, 1e-3) / np.maximum(1 - promised_ink, 1e-3)  # a printer's file may say white ink
    return ShownColors(np.column_stack([np.diag(gain), ink - gain * promised_ink]), kind="white_black")


def _fit_ink(
    promised: np.ndarray, rows: np.ndarray, light: np.ndarray, share: np.ndarray, ink: np.ndarray
) -> np.ndarray:
    """Fit the coefficients to light N×3, robustly from `ink` on; errors are weighted as the eye sees them."""
    eye = 1 / (promised.mean(1) + 0.03) ** 0.667
    for _ in range(2):
        miss = eye * np.linalg.norm(light - promised - rows @ ink, axis=1) / _LIGHT_NOISE
        weight = (share * eye**2 / np.sqrt(1 + miss**2))[:, None]
        square = (rows * weight).T @ rows
        ridge = _INK_RIDGE / len(light) * np.trace(square) / INK_TERMS * np.eye(INK_TERMS)
        ink = np.linalg.solve(square + ridge, (rows * weight).T @ (light - promised))
    return ink


def _fit_terms(light: np.ndarray, cells: CellColors, terms: np.ndarray, steps: int = _STEPS) -> np.ndarray:
    """Fit the terms that take a print's light to a photograph's: damped Gauss-Newton on robust CIELAB distances."""
    seen, damping = _lab(cells.seen), 1e-3

    def miss(terms: np.ndarray) -> np.ndarray:
        return _lab(ShownColors.of_terms(terms).show(light)) - seen

    def cost(apart: np.ndarray, terms: np.ndarray) -> float:
        distance = np.sqrt((apart**2).sum(1) + _LAB_NOISE**2).mean()
        return float(distance + _TERMS_RIDGE * ((terms - cells.start) ** 2).sum())

    apart = miss(terms)
    best = cost(apart, terms)
    for _ in range(steps):
        slopes = (miss(terms + _PROBE * np.eye(len(terms))) - apart) / _PROBE
        weight = 1 / np.sqrt((apart**2).sum(1) + _LAB_NOISE**2)[:, None] / len(light)
        flat, weighted = (each.reshape(len(terms), -1) for each in (slopes, slopes * weight))
        square = weighted @ flat.T + 2 * _TERMS_RIDGE * np.eye(len(terms))
        slope = weighted @ apart.ravel() + 2 * _TERMS_RIDGE * (terms - cells.start)
        step = np.linalg.solve(square + damping * np.diag(np.diag(square)), slope)
        moved = cells.start + np.clip(terms - step - cells.start, -_FARTHEST, _FARTHEST)
        moved_apart = miss(moved)
        if (moved_cost := cost(moved_apart, moved)) >= best:
            damping *= 10
            continue
        gained, terms, apart, best, damping = best - moved_cost, moved, moved_apart, moved_cost, damping / 3
        if gained < 1e-3:
            break
    return terms


def _lab(light: np.ndarray) -> np.ndarray:
    return lab_from_linear(np.clip(light, 1e-6, 1))
