"""What the promise covered, and which photographs lie outside of it or near to which of its conditions.

In: the promise's conditions, as far as a photograph can show them. Out: `PromisedRanges` (smallest and largest with a
margin of 10 %), and `matched_rate`, the promised rate at the conditions nearest to the photographs.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from patchproof.photo.cannot import CannotJudge
from patchproof.sheet.manifest import ConditionClaim
from patchproof.verify.results import PhotoEntry

MARGIN = 0.10  # of the range's width
_LEAST_ANGLE_MARGIN_DEG = 3.0  # a nearly frontal view's tilt is no better known than this
_LEAST_SCALE_MARGIN = 0.10  # of the value itself
_NEAREST = 15  # conditions per photo: enough to smooth single draws, few enough to stay near
_MATCHED_ON = ("px_per_mm", "tilt_deg", "azimuth_deg", "contrast", "blur_px")
_ADVICE = {
    "px_per_mm": ("come closer", "step back"),
    "tilt_deg": ("look more from the side", "look less from the side"),
    "azimuth_deg": ("move to the right", "move to the left"),
}


@dataclass(frozen=True)
class PromisedRanges:
    """Allowed (low, high) by figure, margins included; figures that no condition has are not limited."""

    limits: dict[str, tuple[float, float]]

    def violated(self, entry: PhotoEntry, trust_angles: bool) -> CannotJudge | None:
        """The first figure of the photo that the promise does not cover."""
        for name, (low, high) in self.limits.items():
            value = getattr(entry, name)
            if value is None or (name != "px_per_mm" and not trust_angles):
                continue
            if name == "azimuth_deg":  # a photograph is left out only where it is sure to lie outside
                low, high = low - (entry.azimuth_uncertainty_deg or 0), high + (entry.azimuth_uncertainty_deg or 0)
            if low <= value <= high:
                continue
            below = value < low
            do = _ADVICE[name][0 if below else 1]
            advice = f"{name} is {value:.3g}, the promise covers {low:.3g} to {high:.3g}: {do}"
            return CannotJudge("out_of_range", value, low if below else high, advice)
        return None


def promised_ranges(conditions: Sequence[ConditionClaim]) -> PromisedRanges:
    """The span of the promised conditions with its margin."""
    limits = {}
    for name in _ADVICE:
        values = [v for c in conditions if (v := getattr(c, name)) is not None]
        if not values:
            continue
        low, high = min(values), max(values)
        margin = MARGIN * (high - low)
        if name == "px_per_mm":
            limits[name] = low - max(margin, _LEAST_SCALE_MARGIN * low), high + max(margin, _LEAST_SCALE_MARGIN * high)
        else:
            margin = max(margin, _LEAST_ANGLE_MARGIN_DEG)
            limits[name] = low - margin, high + margin
    return PromisedRanges(limits)


def matched_rate(entries: Iterable[PhotoEntry], conditions: Sequence[ConditionClaim]) -> float | None:
    """Mean over photos of the rate at their nearest promised conditions; None where nothing can be compared."""
    rates = [_rate_near(entry, conditions) for entry in entries]
    rates = [rate for rate in rates if rate is not None]
    return float(np.mean(rates)) if rates else None


def _rate_near(entry: PhotoEntry, conditions: Sequence[ConditionClaim]) -> float | None:
    names = [n for n in _MATCHED_ON if getattr(entry, n) is not None]
    full = [c for c in conditions if all(getattr(c, n) is not None for n in names)]
    if len(full) < len(conditions) / 2:  # the promise does not have all of the photo's figures: use those it has
        names = [n for n in names if sum(getattr(c, n) is not None for c in conditions) > len(conditions) / 2]
        full = [c for c in conditions if all(getattr(c, n) is not None for n in names)]
    if not names or not full:
        return None
    table = np.array([[getattr(c, n) for n in names] for c in full])
    spread = np.maximum(table.std(0), 1e-9)
    distance = np.linalg.norm((table - [getattr(entry, n) for n in names]) / spread, axis=1)
    nearest = np.argsort(distance, kind="stable")[:_NEAREST]
    return float(np.mean([full[i].recognized for i in nearest]))
