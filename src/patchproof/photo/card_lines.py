"""Where a bank card lies in its printed outline, roughly: four straight lines that make an ID-1 rectangle.

In: a photograph, the page's homography, the outline. Out: the outline's surroundings seen from above, its sides, and a
line for each, or `NoCard` with the reason. The card's edges are looked for around the outline as steps of light or
color that run the whole side, whatever is printed on the card; a line that has paper on both sides (the outline itself)
is none. Left out on purpose: cards that lie askew by more than 4°, and white cards, which do not stand out from paper.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
from scipy.ndimage import maximum_filter1d

from patchproof.color import linear_from_srgb
from patchproof.geometry import apply_homography, local_scale, rect_corners
from patchproof.photo.edges import sample

CARD_MM = (85.60, 53.98)
LEAST_PX_PER_MM = 2.0
SCALES = (0.90, 1.11)  # prints off by more are no prints of this page
_MARGIN_MM = 9.0  # a card on a print of 94 % reaches 5.5 mm over the outline
CORNER_MM = 7.0  # of each side's ends left out: the rounded corner, wherever the card lies in the outline
_GRID_MM, _GAP_MM, _BOX_MM = 0.1, 0.2, 0.7
_BEHIND = 9  # grid steps: farther inside than a printed edge out there reaches by blur and box
_MOST_TURNED = 0.04  # between sides as they are first found: soft shadows turn them
_OFF_SHAPE = 0.3  # what a per cent of the wrong shape costs
_OUTERMOST = 0.06  # what a millimetre farther out is worth beside the scores of four edges, 1.2 each at most
_SLOPES = np.linspace(-0.07, 0.07, 29)
_STRONG, _LEAST_SCORE = 0.15, 0.35  # a step of code values (of 1) that counts in full; mean over a side
_LEAST_STEP = 0.025  # of code values between the card's rim and paper, at half of a side's places or more
_LEAST_INK = 0.06  # of code values between paper and what lies inside of an edge
_REACH_MM, _BRIDGE_MM = (-8.0, 7.6), 0.45  # how far edges are looked for and what of it the outline's own blur takes
MOST_OFF_SHAPE = 0.012  # of the x:y ratio, beside its own uncertainty


class NoCard(ValueError):
    """No scale can be had from a card; the message is a sentence for people."""


@dataclass(frozen=True)
class Side:
    """One side of the outline: its start, unit vectors along and outwards, length in mm."""

    start: np.ndarray
    along: np.ndarray
    outward: np.ndarray
    length: float

    def points(self, s: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Page mm at s along and t outwards of the printed outline."""
        return self.start + s[..., None] * self.along + t[..., None] * self.outward


@dataclass(frozen=True)
class OutlineView:
    """The surroundings of the outline seen from above: linear light over paper's, H×W×3, at `px_per_mm`."""

    light: np.ndarray
    corner_mm: np.ndarray
    px_per_mm: float

    def at(self, points_mm: np.ndarray) -> np.ndarray:
        """Light ...×3 at page millimetres ...×2."""
        return sample(self.light, (points_mm - self.corner_mm) * self.px_per_mm)


def middle_of(rect) -> tuple[float, float]:
    """The middle of a rectangle x, y, width, height."""
    return rect[0] + rect[2] / 2, rect[1] + rect[3] / 2


def view_of_outline(srgb, px_from_mm, outline_mm, paper) -> OutlineView:
    """What lies in and around the outline; refused where it is cut off or too small in the picture."""
    x, y, w, h = outline_mm
    quad = apply_homography(px_from_mm, rect_corners((x - 1, y - 1, w + 2, h + 2)))
    if (quad < 1).any() or (quad > [srgb.shape[1] - 1, srgb.shape[0] - 1]).any():
        raise NoCard("the card's outline is not wholly in the picture: show all of it")
    px_per_mm, tilt_deg = local_scale(px_from_mm, middle_of(outline_mm))
    if px_per_mm < LEAST_PX_PER_MM:
        raise NoCard(f"{px_per_mm:.1f} px per mm at the card are too few, {LEAST_PX_PER_MM:g} are needed: come closer")
    finest = float(np.clip(2 * px_per_mm / np.sqrt(max(np.cos(np.radians(tilt_deg)), 0.1)), 5, 16))
    corner = np.array([x - _MARGIN_MM, y - _MARGIN_MM])
    size = tuple(int(np.ceil((side + 2 * _MARGIN_MM) * finest)) for side in (w, h))
    mm_from_index = np.array(
        [[1 / finest, 0, corner[0] + 0.5 / finest], [0, 1 / finest, corner[1] + 0.5 / finest], [0, 0, 1]]
    )
    reach = apply_homography(px_from_mm, rect_corners((*corner, w + 2 * _MARGIN_MM, h + 2 * _MARGIN_MM)))
    low = np.clip(np.floor(reach.min(0)).astype(int) - 2, 0, None)
    high = np.ceil(reach.max(0)).astype(int) + 2
    part = srgb[low[1] : high[1], low[0] : high[0]]
    linear = linear_from_srgb(np.arange(256) / 255).astype(np.float32)[part]
    index_from_px = np.array([[1, 0, -0.5 - low[0]], [0, 1, -0.5 - low[1]], [0, 0, 1.0]])
    light = cv2.warpPerspective(
        linear,
        index_from_px @ px_from_mm @ mm_from_index,
        size,
        None,
        cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        cv2.BORDER_REPLICATE,
    )
    return OutlineView(light / np.maximum(paper, 1e-3).astype(np.float32), corner, finest)


def sides_of(outline_mm) -> list[Side]:
    """Top, right, bottom, left, clockwise."""
    corners = rect_corners(outline_mm)
    ends = np.roll(corners, -1, axis=0)
    length = np.linalg.norm(ends - corners, axis=1)
    along = (ends - corners) / length[:, None]
    return [Side(c, a, np.array([a[1], -a[0]]), float(n)) for c, a, n in zip(corners, along, length, strict=True)]


def find_rectangle(view: OutlineView, sides: list[Side], ratio, wall) -> list[tuple[float, float]]:
    """The best four lines (offset d mm outwards at the side's middle, slope) that make an ID-1 rectangle."""
    paper = _paper_code(view, sides)
    candidates = [_candidates(view, side, paper) for side in sides]
    for name, found in zip(("upper", "right", "lower", "left"), candidates, strict=True):
        if not found:
            raise NoCard(f"no bank card stands out along the {name} side of its outline: lay a colored card there")
    best, chosen = -np.inf, None
    for four in product(*candidates):
        d, slope, score = np.array(four).T
        x = CARD_MM[0] / (sides[0].length + d[1] + d[3] - wall[0] / 2)
        y = CARD_MM[1] / (sides[1].length + d[0] + d[2] - wall[1] / 2)
        if np.ptp(slope) > _MOST_TURNED or not all(SCALES[0] < v < SCALES[1] for v in (x, y)):
            continue
        off = max(abs(x / y / ratio[0] - 1) - ratio[1], 0)
        if off > MOST_OFF_SHAPE + 0.01:
            continue
        # of rectangles that fit equally well the outermost: a card has frames printed on it, paper round it has not
        value = (
            score.sum()
            + _OUTERMOST * d.sum()
            - _OFF_SHAPE * (off / 0.01) ** 2
            - (np.ptp(slope) / _MOST_TURNED) ** 2 / 4
        )
        if value > best:
            best, chosen = value, [(float(a), float(b)) for a, b in zip(d, slope, strict=True)]
    if chosen is None:
        raise NoCard("the edges in the card's outline do not make an ID-1 card (85.60 × 53.98 mm): lay one in straight")
    return chosen


def _candidates(view: OutlineView, side: Side, paper: np.ndarray) -> list[tuple[float, float, float]]:
    """(d, slope, score) of straight steps along a side with something else than paper inside; at most eight."""
    s, t, codes = _codes(view, side)
    total = np.concatenate([np.zeros((len(s), 1, 3)), np.cumsum(codes, 1)], 1)
    gap, box = round(_GAP_MM / _GRID_MM), round(_BOX_MM / _GRID_MM)
    middle = np.arange(gap + box, len(t) - gap - box)
    inner = (total[:, middle - gap + 1] - total[:, middle - gap - box + 1]) / box
    outer = (total[:, middle + gap + box] - total[:, middle + gap]) / box
    step = np.linalg.norm(inner - outer, axis=2) / np.sqrt(3)
    behind = inner[:, : len(middle) - _BEHIND]  # what lies clear of the edge itself must not be paper
    step[:, _BEHIND:][np.linalg.norm(behind - paper, axis=2) / np.sqrt(3) < _LEAST_INK] = 0
    lines = []
    for slope in _SLOPES:
        shift = np.round(slope * (s - side.length / 2) / _GRID_MM).astype(int)
        columns = np.arange(len(middle)) + shift[:, None]
        valid = (columns >= 0) & (columns < len(middle))
        seen = np.where(valid, np.take_along_axis(step, np.clip(columns, 0, len(middle) - 1), 1), 0)
        score = np.minimum(seen / _STRONG, 1).mean(0) + 0.2 * seen.mean(0)
        enough = (seen > _LEAST_STEP).mean(0) > 0.5
        lines.append(np.where(enough, score, 0))
    scores = np.array(lines)
    best, reach = scores.max(0), gap + box  # a shoulder of a stronger step within the filter's reach is no line
    peaks = best == maximum_filter1d(best, 2 * reach + 1)
    at = [i for i in np.argsort(-best, kind="stable") if peaks[i] and best[i] > _LEAST_SCORE][:8]
    return [(float(t[middle[i]]), float(_SLOPES[scores[:, i].argmax()]), float(best[i])) for i in at]


def _codes(view: OutlineView, side: Side) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places along and across a side, and code values there; the printed outline is bridged, so that it is no step."""
    s = np.arange(CORNER_MM, side.length - CORNER_MM, 0.7)
    t = np.arange(*_REACH_MM, _GRID_MM)
    codes = np.clip(view.at(side.points(*np.broadcast_arrays(s[:, None], t))), 0, 1.5) ** (1 / 2.2)
    low, high = np.searchsorted(t, [-_BRIDGE_MM, _BRIDGE_MM])
    share = ((t[low:high] - t[low - 1]) / (t[high] - t[low - 1]))[:, None]
    codes[:, low:high] = codes[:, low - 1, None] * (1 - share) + codes[:, high, None] * share
    return s, t, codes


def _paper_code(view: OutlineView, sides: list[Side]) -> np.ndarray:
    """Code values (3,) of the paper round the outline: the light end of what lies there, whatever covers the rest."""
    around = np.concatenate(
        [codes[:, t > 0.5].reshape(-1, 3) for _, t, codes in (_codes(view, side) for side in sides)]
    )
    return np.median(around[around.sum(1) >= np.percentile(around.sum(1), 75)], axis=0)
