"""Find a print by its own design in a photograph: no markers, nobody who names corners.

In: uint8 sRGB pixels, the design's pixels, its size on the page. Out: `DesignCorners` with their standard deviation, or
a `PhotoRejected` with the deciding figure. Each proposed place is refined on intensities less their surroundings, with
gain and offset per channel. It is accepted by its correlation at the photograph's resolution, in units of what chance
gives a design of so much structure: as it is, or with its channels mixed, as inks and light mix few saturated colors.
Left out on purpose: bent paper, and what is not proposed (see `design_places`).

Source: Baker and Matthews, Lucas-Kanade 20 Years On, IJCV 2004 (inverse compositional refinement).
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache, partial
from operator import itemgetter

import cv2
import numpy as np

from patchproof.base.geometry import apply_homography, fit_homography
from patchproof.base.resample import index_homography
from patchproof.photo import detect
from patchproof.photo.design_places import (
    SMALLEST_PRINT_PX,
    SearchedPhoto,
    draw_design,
    places_by_features,
    places_by_templates,
)
from patchproof.photo.detect import is_plausible_quad
from patchproof.photo.known_page import is_in_picture
from patchproof.photo.rectify import homography_jacobian
from patchproof.photo.registration import DesignCorners
from patchproof.photo.rejection import MIRRORED_ADVICE, PhotoRejected

# Of 186 other prints of its kind 6.6 at most, or 8.1 with mixed channels; but designs of one run are alike, and found.
LEAST_LIKENESS, LEAST_SIGNIFICANCE = 0.6, 7.0
_MIXTURE_GAIN = 3.0  # of significance, by chance: of prints that only mixtures show, the least had 10.8
# of significance, by which a mirrored or turned design fits better; of variance, by which it differs from the design
_MIRRORED_BY, _TURNED_BY, _LEAST_DIFFERENCE = 0.25, 2.0, 0.005
_LEAST_LEAD = 0.1  # of significance, over the same place with another corner first or mirrored
_REFINED_PX = (24, 48, 128)  # of the design's longer side, from coarse to fine
# likeness at a coarse size, of 127 places that were accepted 0.59 at least, and 0.36 in 152 after so many steps
_HOPELESS, _HOPELESS_STEPS = 0.25, 8
_PATIENCE = 6  # steps without a better one: answers and corners are those without a limit, to 0.01 px in 60 prints
# of the longer side: sigma of the mean that is subtracted; less for corners, which slow changes of light would move
_SURROUNDINGS, _FINE_SURROUNDINGS = 1 / 6, 1 / 16
_STEPS, _COLOR_STEPS, _MOST_SHIFT = 30, 10, 1 / 16
_UNIT = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])  # corners of a design in its own coordinates
_NOT_FOUND_ADVICE = (
    "the design was not found: show all of it, flat and sharp, on a twentieth of the picture's width or more, or name "
    "its corners, in --corners FILE or with a finger on the page of capture"
)
_SMALL_ADVICE = "the design is too small to be found with certainty: come closer"
_UNDIRECTED_ADVICE = "what was found fits as well when it is turned: show all of the design, or name its corners"
_ORDER_ADVICE = "its corners are named in another order: begin with the design's own top left one, then clockwise"
_SEVERAL_ADVICE = "more than one print of the design is in view: photograph one at a time"


@dataclass(frozen=True)
class FoundPlace:
    """A place of the design: its corners 4×2 px, correlation with the photograph there, the same in units of chance,
    and the standard deviation of a corner's coordinate in px.
    """

    corners_px: np.ndarray
    likeness: float
    significance: float
    sigma_px: float

    @property
    def accepted(self) -> bool:
        """True if no other picture looks so much like the design."""
        return self.likeness > LEAST_LIKENESS and self.significance > LEAST_SIGNIFICANCE

    def overlaps(self, other: "FoundPlace") -> bool:
        """True if the middle of either lies in the other."""
        pairs = (self.corners_px, other.corners_px), (other.corners_px, self.corners_px)
        return any(cv2.pointPolygonTest(a.astype(np.float32), b.mean(0).tolist(), False) > 0 for a, b in pairs)


def find_design(srgb: np.ndarray, design: np.ndarray, size_mm: tuple[float, float]) -> DesignCorners:
    """Find the one print of a design (uint8 H×W×3, `size_mm` wide and high) in a uint8 photograph.

    Raises `PhotoRejected`: "no_corners" without a print, "too_small", "several_sheets", "mirrored".
    """
    refiners = _refiners(srgb, design, size_mm)
    places = _find_places(refiners[0])
    found = [place for place in places if place.accepted]
    if not found:
        mirrored = _find_places(refiners[1], by_templates=False)
        if any(place.accepted for place in mirrored):
            raise PhotoRejected("mirrored", None, None, MIRRORED_ADVICE)
        best = max((place.likeness for place in places), default=0.0)
        raise PhotoRejected("no_corners", best, LEAST_LIKENESS, _NOT_FOUND_ADVICE)
    if len(found) > 1:
        raise PhotoRejected("several_sheets", len(found), 1, _SEVERAL_ADVICE)
    place, _, lead = _best_turn(refiners, found[0].corners_px)
    if lead < _LEAST_LEAD:
        raise PhotoRejected("no_corners", place.likeness, LEAST_LIKENESS, _UNDIRECTED_ADVICE)
    turned = place.significance > found[0].significance + _TURNED_BY
    place = (turned and refiners[0].refine(place.corners_px)) or found[0]
    side_px = detect.side_px(place.corners_px) * np.sqrt(min(size_mm) / max(size_mm)) / refiners[0].photo.zoom
    if side_px < SMALLEST_PRINT_PX:
        raise PhotoRejected("too_small", float(side_px), SMALLEST_PRINT_PX, _SMALL_ADVICE)
    return DesignCorners(place.corners_px, place.sigma_px, "found")


def refuse_other_order(srgb: np.ndarray, design: np.ndarray, size_mm: tuple[float, float], corners_px: np.ndarray):
    """Raise `PhotoRejected` if the design fits clearly better with another corner 4×2 px first, or mirrored."""
    place, turn, _ = _best_turn(_refiners(srgb, design, size_mm), corners_px)
    if turn:
        raise PhotoRejected("no_corners", place.likeness, LEAST_LIKENESS, _ORDER_ADVICE)


def _refiners(srgb: np.ndarray, design: np.ndarray, size_mm: tuple[float, float]) -> list["_Refiner"]:
    """Refiners of a design and of its mirror image, which share what is read of the photograph."""
    photo = SearchedPhoto(srgb)
    return [_Refiner(photo, each, size_mm) for each in (design, np.ascontiguousarray(design[:, ::-1]))]


def _best_turn(refiners: list["_Refiner"], corners_px: np.ndarray) -> tuple[FoundPlace, int, float]:
    """The place refined from corners 4×2 px with the first, or another that fits clearly better, as the design's first;
    its index; and its lead over others. Raises `PhotoRejected` if the mirrored design fits better. Images like the
    design itself don't count.
    """
    nowhere, turned = FoundPlace(corners_px, 0.0, 0.0, np.inf), range(4)
    places = [[each.refine(np.roll(corners_px, -turn, 0), False) or nowhere for turn in turned] for each in refiners]
    own, mirrored = (np.array([place.significance * place.accepted for place in each]) for each in places)
    small = [cv2.resize(each.design, (64, 64), interpolation=cv2.INTER_AREA).astype(float) for each in refiners]
    least = _LEAST_DIFFERENCE * small[0].var((0, 1)).mean()
    differ = [[((np.rot90(each, turn) - small[0]) ** 2).mean() > least for turn in turned] for each in small]
    if mirrored.max() > own.max() + _MIRRORED_BY and all(differ[1]):
        raise PhotoRejected("mirrored", None, None, MIRRORED_ADVICE)
    lead = float(own[0] - max((*own[differ[0]], *mirrored[differ[1]]), default=-np.inf))
    turn = int(own.argmax())
    if own[turn] > own[0] + _TURNED_BY and differ[0][turn]:
        return places[0][turn], turn, np.inf
    return places[0][0], 0, lead


def _find_places(refiner: "_Refiner", by_templates: bool = True) -> list[FoundPlace]:
    """Places of a design in a photograph that do not overlap, the most significant first, accepted or not."""
    sought = refiner.photo, refiner.design, refiner.size_mm
    places = _distinct(map(refiner.refine, places_by_features(*sought)))
    if by_templates and not (places and places[0].accepted):
        places = _distinct([*places, *map(refiner.refine, places_by_templates(*sought))])
    return places


def _distinct(places: Iterable[FoundPlace | None]) -> list[FoundPlace]:
    kept: list[FoundPlace] = []
    for place in sorted((p for p in places if p is not None), key=lambda p: -p.significance):
        if not any(place.overlaps(other) for other in kept):
            kept.append(place)
    return kept


class _Refiner:
    """Refine places of a design on intensities; holds the design at each size."""

    def __init__(self, photo: SearchedPhoto, design: np.ndarray, size_mm: tuple[float, float]):
        self.photo, self.design, self.size_mm = photo, design, size_mm
        self.template = partial(_small_design, design.tobytes(), design.shape, size_mm)

    def refine(self, quad: np.ndarray, closely: bool = True) -> FoundPlace | None:
        """The refined place, or None if it is none that a camera can see. To compare directions it need not be done
        `closely`: without mixed colors.
        """
        place, levels = None, self.photo.levels
        for longer_px in _REFINED_PX:
            if not is_plausible_quad(quad) or not is_in_picture(quad, levels[0]):
                return None
            side_px = detect.side_px(quad)
            most = max(24, 2 * round(0.5 * side_px * np.sqrt(max(self.size_mm) / min(self.size_mm))))
            size = min(longer_px, most)
            pixels = levels[int(np.clip(np.log2(max(side_px / size, 1)), 0, len(levels) - 1))]
            scale, template = levels[0].shape[1] / pixels.shape[1], self.template(size, _SURROUNDINGS)
            refined, likeness, sigma = template.align(pixels, quad / scale)
            likeness, significance = template.judge(pixels, refined, likeness)
            if closely and size in (most, _REFINED_PX[-1]) and likeness > LEAST_LIKENESS:
                finer = self.template(size, _FINE_SURROUNDINGS).align(pixels, refined, mixes=True)
                # where a part of a design is plain, mixtures of colors imitate shifts
                if np.abs(finer[0] - refined).max() * scale < _MOST_SHIFT * side_px:
                    refined, _, sigma = finer
            quad = refined * scale
            place = FoundPlace(quad, likeness, significance, sigma * scale)
            if size == most or likeness < _HOPELESS:
                break
        return place if is_plausible_quad(quad) and is_in_picture(quad, levels[0]) else None


class _SmallDesign:
    """A drawn design, its surroundings subtracted, with the derivatives of its colors by a homography's eight terms.

    Colors are three channels and their squares: inks, veils and tone curves mix them, which moves edges between colors
    by up to a pixel where gain and offset are all that may change.
    """

    def __init__(self, pixels: bytes, shape: tuple[int, ...], size_mm, longer_px: float, surroundings: float):
        drawn = draw_design(np.frombuffer(pixels, np.uint8).reshape(shape), size_mm, longer_px)
        self.size, sigma_px = (drawn.shape[1], drawn.shape[0]), surroundings * max(drawn.shape[:2])
        blur = {"kernelX": np.ones(1), "kernelY": cv2.getGaussianKernel(2 * round(4 * sigma_px) + 1, sigma_px)}
        eyes, edges = (np.eye(side, dtype=np.float32) for side in drawn.shape[:2]), cv2.BORDER_REPLICATE
        self.means = [cv2.sepFilter2D(eye, -1, **blur, borderType=edges) for eye in eyes]  # matrices that blur columns
        codes, deviation = self._less_surroundings(drawn, 1e-3)
        self.weight = deviation / max(float(deviation.sum()), 1e-6)
        squares, _ = self._less_surroundings(drawn.astype(np.float32) ** 2 / 255, 1e-3)
        self.colors, self.weighted = np.concatenate([codes, squares]), codes * self.weight
        colors = self.colors.reshape(6, *drawn.shape[:2])
        power = np.abs(np.fft.fft2(self.weighted.sum(0).reshape(colors.shape[1:]))) ** 2
        self.freedom = float(power.sum() ** 2 / max((power**2).sum(), 1e-12))  # independent pixels, as it were
        half = np.array(self.size) / 2
        self.unit_from_index = np.linalg.inv([[half[0], 0, half[0]], [0, half[1], half[1]], [0, 0, 1.0]])
        units = np.stack(np.meshgrid(*((np.arange(n) + 0.5) / n * 2 - 1 for n in self.size)), -1).reshape(-1, 2)
        by_x, by_y = (homography_jacobian(np.eye(3), units).reshape(-1, 2, 8) * half[:, None]).transpose(1, 2, 0)
        along_y, along_x = (slope.reshape(6, 1, -1) for slope in np.gradient(colors, axis=(1, 2)))
        self.by_term = along_x * by_x.astype(np.float32, order="C")  # 6 colors × 8 terms × pixels
        self.by_term += along_y * by_y.astype(np.float32, order="C")
        pairs = self.by_term.reshape(48, -1) @ self.by_term.reshape(48, -1).T
        self.curvature = pairs.reshape(6, 8, 6, 8).transpose(0, 2, 1, 3).astype(float)  # for each pair of colors 8×8

    def _less_surroundings(self, codes: np.ndarray, least: float) -> tuple[np.ndarray, np.ndarray]:
        """3×N codes with mean 0 in units of their deviation, if that is `least` or more, and the deviation 3×1."""
        planes = np.array(cv2.split(cv2.GaussianBlur(codes.astype(np.float32), (0, 0), 0.8)))
        planes = (planes - self.means[0] @ planes @ self.means[1].T).reshape(3, -1)
        planes -= planes.mean(1, keepdims=True)
        deviation = np.sqrt((planes**2).mean(1, keepdims=True))
        return planes / np.maximum(deviation, least), deviation

    def judge(self, srgb: np.ndarray, quad: np.ndarray, likeness: float) -> tuple[float, float]:
        """The design's likeness to a picture at corners 4×2 px, as it is or with its channels mixed, whichever is more
        in units of what chance gives (Fisher's transform), and that figure.
        """
        units = lambda share: float(np.arctanh(np.clip(share, -0.999, 0.999)) * np.sqrt(self.freedom))  # noqa: E731
        plain = likeness, units(likeness)
        if likeness < _HOPELESS:  # such as a negative, of which a mixture would make the design
            return plain
        seen, colors = self._seen(srgb, fit_homography(_UNIT, quad)), self.colors[:3]
        error = seen - _mixture(colors, seen).T @ colors
        left = float((error**2 * self.weight).sum() / (seen**2 * self.weight).sum())
        mixed = float(np.sqrt(max(0.0, 1 - left * (self.freedom - 1) / max(self.freedom - 4, 1))))
        return max(plain, (mixed, units(mixed) - _MIXTURE_GAIN), key=itemgetter(1))

    def _seen(self, srgb: np.ndarray, px_from_unit: np.ndarray) -> np.ndarray:
        """What a picture shows in the design's place, 3×N as `_less_surroundings` gives it."""
        index = index_homography(px_from_unit @ self.unit_from_index)
        how = None, cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, cv2.BORDER_REPLICATE
        return self._less_surroundings(cv2.warpPerspective(srgb, index, self.size, *how), 0.5)[0]

    def align(self, srgb: np.ndarray, quad: np.ndarray, mixes: bool = False) -> tuple[np.ndarray, float, float]:
        """Refine corners 4×2 px in a picture, if `mixes` with mixed colors; with the correlation of the channels there
        and the standard deviation of a corner's coordinate.
        """
        px_from_unit, best, hessian = fit_homography(_UNIT, quad), (-1.0, quad), np.eye(8)
        used, best_number = 6 if mixes else 3, 0
        colors, by_term, curvature = self.colors[:used], self.by_term[:used], self.curvature[:used, :used]
        for number in range(_COLOR_STEPS if mixes else _STEPS):
            if number > best_number + _PATIENCE or (number == _HOPELESS_STEPS and best[0] < _HOPELESS):
                break
            seen = self._seen(srgb, px_from_unit)
            likeness = float(np.vdot(self.weighted, seen)) / seen.shape[1]
            if likeness > best[0] or mixes:
                best, best_number = (likeness, apply_homography(px_from_unit, _UNIT)), number
            mixture = np.eye(3, dtype=np.float32) * max(likeness, 0.3)
            if mixes:
                mixture = _mixture(colors, seen)
            error = np.clip(seen - mixture.T @ colors, -1.5, 1.5) * self.weight
            hessian = np.tensordot(mixture * self.weight.T @ mixture.T, curvature)
            hessian += (1e-7 * np.trace(hessian) + 1e-9) * np.eye(8)  # a plain design has no slopes
            step = np.linalg.solve(hessian, (by_term @ (mixture @ error)[..., None]).sum(0)[:, 0])
            a, b, c, d, e, f, g, h = np.clip(step, -0.2, 0.2)
            px_from_unit = px_from_unit @ np.linalg.inv([[1 + a, b, c], [d, 1 + e, f], [g, h, 1]])
            if np.abs(step).max() < 2e-4 or not np.isfinite(px_from_unit).all():
                break
        likeness, corners = best
        variance = max(1 - likeness**2, 0.0) * self.colors.shape[1] / max(self.freedom, 1.0)
        return corners, likeness, _corner_sigma(px_from_unit, np.linalg.inv(hessian) * variance)


_small_design = lru_cache(maxsize=16)(_SmallDesign)  # at most 3 MB each; their sizes recur in photographs


def _mixture(colors: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """The matrix K×3 that makes of colors K×N what is nearest to what is seen, 3×N."""
    ridge = 1e-3 * seen.shape[1] * np.eye(len(colors))
    return np.linalg.solve(colors @ colors.T + ridge, colors @ seen.T).astype(np.float32)


def _corner_sigma(px_from_unit: np.ndarray, covariance: np.ndarray) -> float:
    """The standard deviation in px of a corner's coordinate, rms over the four."""
    by_corner = homography_jacobian(np.eye(3), _UNIT)
    variance = float(np.mean(np.einsum("ij,jk,ik->i", by_corner, covariance, by_corner)))
    unit_px = float(np.sqrt(abs(np.linalg.det(px_from_unit[:2, :2] / px_from_unit[2, 2]))))
    return max(0.05, unit_px * np.sqrt(max(variance, 0.0)))
