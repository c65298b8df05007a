"""Tell by a print's pixels whether it shows the sheet's design, and whether an ink is missing or wrong.

In: coarse cells of the design as photographed and as promised. Out: a `DesignMatch`. Cells are compared as the square
root of light over paper, less the mean of their surroundings: shadows, veils and a print's usual errors of color leave
that structure, and another design lacks it. How a channel follows the promised one, where the others do not, is its
ink's contrast: on 29 photographs of real prints the weakest had 0.32 of the strongest's, on prints without it 0.14.
Left out on purpose: bands of clogged nozzles, and inks that only a composite black would show.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from patchproof.base.color import ciede2000, lab_from_linear
from patchproof.evidence.results import Remark
from patchproof.photo.quality import FrameLight
from patchproof.photo.rejection import PhotoRejected

LEAST_FOUND = 0.35  # of the cells with detail, in their places: other designs show 0.33 at most, its own prints 0.8
LEAST_LIKENESS = 0.6  # correlation of structure
LEAST_INK, WEAK_INK = 0.2, 0.3  # contrast: of the strongest ink's
_LEAST_PLAIN_INK = 0.55  # the same of grays without structure, by the light absorbed: real prints have 0.65 and more
_MOST_COLOR = 30.0  # ΔE00 without structure: real prints are off by 5 to 17
_LEAST_CELLS, _LEAST_DETAILED = 40, 6
# of the square root of light: promised, and shown where none is: glare makes 0.04, other designs 0.09 and more
_LEAST_STRUCTURE, _MOST_STRUCTURE = 0.01, 0.065
_SURROUNDINGS = 1 / 8  # of the shorter side: standard deviation of the mean that is subtracted
_LEAST_CHROMA, _LEAST_COLORFUL = 0.1, 0.15  # of the largest singular value: of the gains, in the design's colors
_INKS = ("cyan", "magenta", "yellow")
_OTHER_ADVICE = "between its markers is another design than the sheet's: name that design's JSON, or print this sheet"
_INK_ADVICE = "{} ink is missing or wrong, or the print is gray: check the printer's inks and nozzles and print again"
_WEAK_ADVICE = "{} ink is weak in this print: it counts, but check the printer's nozzles before you print more"
_UNTOLD_ADVICE = "too little of the design is resolved to tell it from another: come closer"


@dataclass(frozen=True)
class DesignMatch:
    """Correlation with the promised structure (None: there is none), trouble with an ink or, without structure, with
    the design; an ink that is weak.
    """

    likeness: float | None = None
    trouble: PhotoRejected | None = None
    weak_ink: Remark | None = None

    def trouble_beside(self, trouble: PhotoRejected | None, found: float, detailed: int) -> PhotoRejected | None:
        """Return the photograph's other `trouble`, beside which only structure counts, or that the design cannot be
        told. Raises `PhotoRejected` for another design or a missing ink. `found` is the share of the `detailed` cells
        that were found near their places.
        """
        # what covers markers may cover the design, and full white shows none
        if trouble is not None and trouble.code in ("too_few_markers", "clipped"):
            return trouble
        own, least = self.trouble, LEAST_FOUND if detailed >= _LEAST_DETAILED else 0.0
        if own is not None and own.code != "too_small" and (trouble is None or self.likeness is not None):
            raise own
        likeness = 1.0 if self.likeness is None or trouble is not None else self.likeness
        for figure, limit in ((found, least), (likeness, LEAST_LIKENESS)):
            if not figure >= limit:
                raise PhotoRejected("other_design", figure, limit, _OTHER_ADVICE)
        return trouble or (None if least or own is None else own)


def match_design(seen: np.ndarray, promised: np.ndarray, usable: np.ndarray, light: FrameLight) -> DesignMatch:
    """Compare linear light H×W×3 of cells as seen and as promised, where `usable`."""
    if (count := int(usable.sum())) < _LEAST_CELLS:
        return DesignMatch(trouble=PhotoRejected("too_small", count, _LEAST_CELLS, _UNTOLD_ADVICE))
    paper = np.maximum(light.paper, 1e-3)
    veil = float(np.clip((light.ink / paper).min(), 0, 0.5))
    seen, promised = np.sqrt(np.clip((seen / paper - veil) / (1 - veil), 0, 1.2)), np.sqrt(np.clip(promised, 0, 1))
    y, x = (_less_surroundings(v, usable)[usable] for v in (seen, promised))
    means = np.median(seen[usable], 0), promised[usable].mean(0)
    structure_x, structure_y = (float(np.median(np.abs(v))) for v in (x, y))  # medians: blur spreads markers' light
    if structure_x < _LEAST_STRUCTURE:
        return DesignMatch(trouble=_plain_trouble(*means, structure_y))
    gains = _robust_gains(x, y)
    likeness, diagonal = float(np.corrcoef((x @ gains).ravel(), y.ravel())[0, 1]), np.diag(gains)
    largest, second, _ = np.linalg.svd(gains, compute_uv=False)
    contrast, ink = float(diagonal.min() / max(diagonal.max(), 1e-6)), _INKS[int(diagonal.argmin())]
    contrast = contrast if second > _LEAST_CHROMA * largest else 0.0
    if not likeness >= LEAST_LIKENESS or diagonal.max() <= 0:  # a negative is another design
        return DesignMatch(likeness)
    own = np.linalg.svd(x, compute_uv=False)
    if own[2] < _LEAST_COLORFUL * own[0]:  # a design in gray or two inks does not tell their contrasts apart
        return DesignMatch(likeness, _plain_trouble(*means, 0.0))
    if contrast < LEAST_INK:
        return DesignMatch(likeness, PhotoRejected("wrong_ink", contrast, LEAST_INK, _INK_ADVICE.format(ink)))
    weak = Remark(code="weak_ink", figure=contrast, threshold=WEAK_INK, advice=_WEAK_ADVICE.format(ink))
    return DesignMatch(likeness, weak_ink=weak if contrast < WEAK_INK else None)


def _plain_trouble(seen: np.ndarray, promised: np.ndarray, structure: float) -> PhotoRejected | None:
    """Compare square roots of light (3,) of a design without structure, and the structure that was seen."""
    if structure > _MOST_STRUCTURE:
        return PhotoRejected("other_design", structure, _MOST_STRUCTURE, _OTHER_ADVICE)
    absorbed, is_gray = (1 - seen) / np.maximum(1 - promised, 0.1), (1 - promised).min() > 0.6 * (1 - promised).max()
    contrast, ink = float(absorbed.min() / max(absorbed.max(), 1e-6)), _INKS[int(absorbed.argmin())]
    if contrast < _LEAST_PLAIN_INK and is_gray and promised.max() < 0.85:
        return PhotoRejected("wrong_ink", contrast, _LEAST_PLAIN_INK, _INK_ADVICE.format(ink))
    delta = float(ciede2000(lab_from_linear(promised**2), lab_from_linear(seen**2)))
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
