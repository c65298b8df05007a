"""A bank card in the page's printed outline: what its straight edges say of the print's size.

In: a photograph, the page's homography, where the outline is printed, and a pinhole matrix. Out: `CardScale`, or
`NoCard` with the reason. Each of the four lines that `card_lines` finds is fitted stretch by stretch with what blur,
the printed outline, a contact shadow and the card's own side wall add beside it. The card's face lies 0.76 mm nearer to
the camera than the page: its corners are carried to the plane of the face, not of the page.

Sizes: ISO/IEC 7810:2019, ID-1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from patchproof.geometry import apply_homography, local_scale, plane_pose
from patchproof.photo.card_lines import (
    CARD_MM,
    CORNER_MM,
    MOST_OFF_SHAPE,
    SCALES,
    NoCard,
    find_rectangle,
    middle_of,
    sides_of,
    view_of_outline,
)

THICKNESS_MM = 0.76
TOLERANCE_MM = 0.13  # ISO/IEC 7810: the sizes of cards in use, either way
MOST_UNCERTAIN = 0.01  # a vaguer scale could not tell a print at 100 % from one that is off
OUTLINE_MM, OUTLINE_LIGHT = 0.2, 0.17  # how wide the page draws it, and its gray in linear light
_MOST_CROOKED_MM, _MOST_SKEW_DEG = 0.35, 1.0
_NEAR_MM = 0.7  # beyond this of an edge as first found, swatches and markers are not looked at
_SHADOW_MM = 0.7  # how far the card's shadow reaches: about its thickness
_SLOPE_ERROR = 0.004  # between sides: a page printed 1.13 times wider than high shears a card turned by 2° so far
_EDGE_MM = 0.08  # what a rim, a shadow or the outline still moves a fitted edge by (measured 0.00 to 0.15)
_WALL_SHARE = 0.5  # how far, in wall widths, a wall of the face's color or paper's may have drawn an edge (1σ)


@dataclass(frozen=True)
class CardScale:
    """The print's size over the intended one along x and y, and its relative 95 % uncertainty (of the worse)."""

    x: float
    y: float
    uncertainty: float
    corners_px: np.ndarray  # 4×2, where the sides of the card's face meet


def card_scale(
    srgb: np.ndarray,
    px_from_mm: np.ndarray,
    outline_mm,
    printed_mm,
    matrix_px: np.ndarray,
    focal_error: float,
    blur_px: float,
    paper: np.ndarray,
    ratio: tuple[float, float],
) -> CardScale:
    """The print's scale; `printed_mm` are the rectangles printed round the outline, `focal_error` is relative,
    `paper` linear light (3,), `ratio` x over y and its uncertainty."""
    view = view_of_outline(srgb, px_from_mm, outline_mm, paper)
    sides = sides_of(outline_mm)
    walls = [_wall_mm(px_from_mm, matrix_px, s.start + s.along * s.length / 2, s.outward) for s in sides]
    wall = np.array([walls[1] + walls[3], walls[0] + walls[2]])  # shown beyond the face along x and y
    lines = find_rectangle(view, sides, ratio, wall)
    lines, crooked_mm, error_mm = _refined(view, sides, lines, printed_mm, px_from_mm, matrix_px, blur_px)
    if crooked_mm > _MOST_CROOKED_MM:
        raise NoCard(f"the card's edges are not straight ({crooked_mm:.2f} mm): press it flat, clear of other things")
    corners_px = apply_homography(px_from_mm, _corners(sides, lines))
    face = apply_homography(np.linalg.inv(_raised(px_from_mm, matrix_px)), corners_px)
    x, y, skew_deg = _sizes(face)
    if skew_deg > _MOST_SKEW_DEG:
        raise NoCard(f"the card's corners are off a right angle by {skew_deg:.1f}°: lay a bank card flat")
    (x, y), error = _reconciled(np.array([x, y]), wall / CARD_MM, error_mm / CARD_MM, ratio)
    parallax = THICKNESS_MM * local_scale(px_from_mm, middle_of(outline_mm))[0] / matrix_px[0, 0] * focal_error
    uncertainty = float(np.sqrt((2 * error) ** 2 + (TOLERANCE_MM / CARD_MM[1]) ** 2 + parallax**2))
    if uncertainty > MOST_UNCERTAIN:
        raise NoCard(
            f"the card's edges leave {uncertainty * 100:.1f} % open: use a plain colored card, seen from above"
        )
    return CardScale(x, y, uncertainty, corners_px)


def _refined(view, sides, lines, printed_mm, px_from_mm, matrix_px, blur_px):
    """Lines fitted to stretches; with the stretches' largest spread and the 1σ error of width and height, in mm."""
    slope = None
    for reach_mm in (0.8, 0.4):  # the second round's window lies about the first one's line
        fits = []
        for side, line in zip(sides, lines, strict=True):
            middle = side.start + side.along * side.length / 2
            sigma_mm = _blur_mm(px_from_mm, middle, side.outward, blur_px, view.px_per_mm)
            wall_mm = _wall_mm(px_from_mm, matrix_px, middle, side.outward)
            s, at = _stretches(view, side, line, printed_mm, reach_mm, sigma_mm, wall_mm)
            fits.append(_robust_line(s - side.length / 2, at, slope))
        lines, spread, error = zip(*fits, strict=True)
        slope = float(np.median([line[1] for line in lines]))  # a rectangle is turned as a whole
    return lines, max(spread), np.hypot([error[1], error[0]], [error[3], error[2]])


def _blur_mm(px_from_mm, point, direction, blur_px, view_px_per_mm) -> float:
    """σ across a side in mm: the photograph's blur, its pixels and the two interpolations."""
    ends = apply_homography(px_from_mm, np.array([point - 0.5 * direction, point + 0.5 * direction]))
    px_per_mm = np.linalg.norm(ends[1] - ends[0])
    return float(np.sqrt((blur_px**2 + 1 / 4) / px_per_mm**2 + 1 / 6 / view_px_per_mm**2))


def _wall_mm(px_from_mm, matrix_px, point, outward) -> float:
    """How wide the card's side wall shows beyond its face in page mm, 0 where the side looks away from the camera."""
    pose = plane_pose(px_from_mm, matrix_px)
    eye = -pose[:3, :3].T @ pose[:3, 3] - [*point, 0.0]
    return max(0.0, float(THICKNESS_MM * (eye[:2] @ outward) / -eye[2]))


def _stretches(view, side, line, printed_mm, reach_mm, sigma_mm, wall_mm):
    """(s, t) in mm of the face's edge in stretches along a side."""
    (d, slope), count = line, max(8, round((side.length - 2 * CORNER_MM) / 4))
    ends = np.linspace(CORNER_MM, side.length - CORNER_MM, count + 1)
    s = (ends[:-1, None] + ends[1:, None]) / 2 + np.linspace(-0.5, 0.5, 9) * (ends[1] - ends[0]) * 8 / 9
    t = np.arange(-0.7 - reach_mm, 0.7 + reach_mm + wall_mm, 1 / view.px_per_mm)
    base = d + slope * (s - side.length / 2)
    points = side.points(s[:, :, None] + 0 * t, base[:, :, None] + t)
    light = view.at(points).mean(1)  # count × T × 3
    printed = _in_any(points, printed_mm, 2 * sigma_mm).any(1)
    places = np.arange(-reach_mm, reach_mm + 1e-9, 0.04)
    center, base = s.mean(1), base.mean(1)
    at = []
    for profile, offset, other in zip(light, base, printed, strict=True):
        cost = np.array([_misfit(profile, t, other, place, -offset, sigma_mm, wall_mm) for place in places])
        at.append(offset + _valley(places, cost))
    return center, np.array(at)


def _in_any(points, rects, grown) -> np.ndarray:
    """Whether each of `... × 2` points lies in one of the rectangles, made larger on all sides."""
    inside = np.zeros(points.shape[:-1], bool)
    for x, y, w, h in rects:
        inside |= ((points > [x - grown, y - grown]) & (points < [x + w + grown, y + h + grown])).all(-1)
    return inside


def _misfit(profile, t, printed, place, outline, sigma, wall) -> float:
    """Squared error of the best levels of face, paper and wall with the face's edge at `place`.

    What is `printed` farther out than the edge may be is left out.
    """
    end = place + wall
    face, paper = ndtr((place - t) / sigma), ndtr((t - end) / sigma)
    line = [max(outline + half * OUTLINE_MM, end) for half in (-0.5, 0.5)]  # what of the outline the card leaves free
    line_seen = ndtr((t - line[0]) / sigma) - ndtr((t - line[1]) / sigma)
    wall_seen = 1 - face - paper
    shadow = paper * np.exp(-((np.maximum(t - end, 0) / _SHADOW_MM) ** 2))
    columns = [face, paper + wall_seen - (1 - OUTLINE_LIGHT) * line_seen, face * (t - place), shadow]
    # soft priors in units of paper's light: an even face, a weak shadow, a wall like paper
    priors = [0, 0, 0.1, 0.05]
    if wall > 0.05:
        columns.append(wall_seen)
        priors.append(0.1)
    known = ~(printed & (t > _NEAR_MM))
    rows = np.vstack([np.column_stack(columns)[known], np.diag(priors)])
    targets = np.vstack([profile[known], np.zeros((len(priors), 3))])
    basis = np.linalg.qr(rows)[0]
    return float((targets**2).sum() - ((basis.T @ targets) ** 2).sum())


def _valley(places, cost) -> float:
    """The lowest place, by a parabola through its neighbors."""
    i = int(np.clip(cost.argmin(), 1, len(cost) - 2))
    a, b, c = cost[i - 1 : i + 2]
    return float(places[i] + (places[1] - places[0]) * 0.5 * (a - c) / max(a - 2 * b + c, 1e-12))


def _robust_line(s, t, slope):
    """((d, slope), spread, error of d) of t = d + slope s by Tukey weights, near to `slope` where it is given."""
    weight, spread = np.ones(len(s)), 0.1
    for _ in range(15):
        rows, told = np.column_stack([np.ones(len(s)), s]) * np.sqrt(weight)[:, None], t * np.sqrt(weight)
        if slope is not None:
            rows, told = np.vstack([rows, [0, spread / _SLOPE_ERROR]]), np.append(told, slope * spread / _SLOPE_ERROR)
        d, tilt = np.linalg.lstsq(rows, told, rcond=None)[0]
        off = t - d - tilt * s
        spread = max(1.4826 * float(np.median(np.abs(off))), 0.01)
        weight = np.maximum(1 - (off / (4.685 * spread)) ** 2, 0) ** 2
    return (float(d), float(tilt)), spread, spread / np.sqrt(max(float(weight.sum()), 1.0))


def _corners(sides, lines) -> np.ndarray:
    """Page mm 4×2 where each side meets the one before it: top-left first, clockwise."""
    points, directions = [], []
    for side, (d, slope) in zip(sides, lines, strict=True):
        points.append(side.start + side.along * side.length / 2 + side.outward * d)
        directions.append(side.along + slope * side.outward)
    corners = []
    for i in range(4):
        p, u, q, v = points[i], directions[i], points[i - 1], directions[i - 1]
        along = np.linalg.solve(np.column_stack([u, -v]), q - p)[0]
        corners.append(p + along * u)
    return np.array(corners)


def _raised(px_from_mm, matrix_px) -> np.ndarray:
    """The homography of the plane of the card's face, a card's thickness above the page."""
    size = np.linalg.norm((np.linalg.inv(matrix_px) @ px_from_mm)[:, :2], axis=0).mean()
    toward = plane_pose(px_from_mm, matrix_px)[:3, 2] * -THICKNESS_MM
    sign = np.sign((np.linalg.inv(matrix_px) @ px_from_mm)[2, 2])
    raised = px_from_mm.copy()
    raised[:, 2] += sign * size * (matrix_px @ toward)
    return raised


def _sizes(face) -> tuple[float, float, float]:
    """(x, y, skew in degrees): the scales that make these corners in page mm a card of true size."""
    a = (face[1] - face[0] + face[2] - face[3]) / 2
    b = (face[3] - face[0] + face[2] - face[1]) / 2
    x2, y2 = np.linalg.solve(np.array([a**2, b**2]), np.array(CARD_MM) ** 2)
    if not (x2 > 0 and y2 > 0):
        raise NoCard("the edges in the card's outline do not make an ID-1 card (85.60 × 53.98 mm): lay one in straight")
    scale = np.sqrt([x2, y2])
    true = face * scale
    sides = np.roll(true, -1, axis=0) - true
    before = np.roll(sides, 1, axis=0)
    cosine = (sides * before).sum(1) / np.linalg.norm(sides, axis=1) / np.linalg.norm(before, axis=1)
    return float(scale[0]), float(scale[1]), float(np.degrees(np.abs(np.arcsin(cosine)).max()))


def _reconciled(size, wall, error, ratio) -> tuple[tuple[float, float], float]:
    """Scales (x, y) that fit the card's size, the x:y ratio, and a share of the side wall in the edges; 1σ error.

    Where the wall looks like the face, the edge that shows is the wall's foot, where it looks like paper, the face's
    own. The share is one unknown for both directions, which the ratio settles at most angles. All in logarithms.
    """
    ratio_error = max(ratio[1] / 2, 1e-4)
    noise = np.hypot(error, _EDGE_MM / np.array(CARD_MM))
    rows = np.array([[1, 0, -wall[0]], [0, 1, -wall[1]], [1, -1, 0], [0, 0, 1.0]])
    told = np.array([*np.log(size), np.log(ratio[0]), 0.0])
    weight = 1 / np.array([*noise, ratio_error, _WALL_SHARE])
    found, *_ = np.linalg.lstsq(rows * weight[:, None], told * weight, rcond=None)
    misfit = (told - rows @ found) * weight
    off = np.log(size[0] / size[1]) - np.log(ratio[0])
    allowed = MOST_OFF_SHAPE + ratio[1] + np.abs(wall).max()
    x, y = np.exp(found[:2])
    if not all(SCALES[0] < v < SCALES[1] for v in (x, y)) or abs(off) > allowed:
        raise NoCard(
            f"what lies in the outline is {off * 100:+.1f} % off an ID-1 card's shape: lay a bank card in straight"
        )
    covariance = np.linalg.inv((rows * weight[:, None]).T @ (rows * weight[:, None]))
    more = max(1.0, float(np.sqrt((misfit**2).sum())))
    return (float(x), float(y)), float(more * np.sqrt(covariance[[0, 1], [0, 1]].max()))
