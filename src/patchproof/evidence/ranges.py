"""What the promise covered, and which photographs lie outside of it or near to which of its conditions.

In: the promise's conditions, as far as a photograph can show them. Out: `PromisedRanges` (smallest and largest with a
margin of 10 %), and `matched_rate`, the promised rate at the conditions nearest to the photographs. A network sees
every photograph at one size, so a photograph with more pixels than the promised ones is compared as if it had theirs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from patchproof.evidence.results import PhotoEntry
from patchproof.photo.cannot import CannotJudge
from patchproof.sheets.manifest import ConditionClaim, Manifest

MARGIN = 0.10  # of the range's width
_LEAST_ANGLE_MARGIN_DEG = 3.0  # a nearly frontal view's tilt is no better known than this
_LEAST_SCALE_MARGIN = 0.10  # of the value itself
_NEAREST = 15  # conditions per photo: enough to smooth single draws, few enough to stay near
_ADVICE = {
    "px_per_mm": ("come closer", "step back"),
    "tilt_deg": ("look more from the side", "look less from the side"),
    "azimuth_deg": ("move to the right", "move to the left"),
}


@dataclass(frozen=True)
class PromisedRanges:
    """Allowed (low, high) by figure, margins included; figures that no condition has are not limited.

    Pixels are those of photographs whose shorter side has `side_px`, where that is known.
    """

    limits: dict[str, tuple[float, float]]
    side_px: float | None = None

    def violated(self, entry: PhotoEntry, trust_angles: bool) -> CannotJudge | None:
        """The first figure of the photo that the promise does not cover."""
        figures = _figures(entry, self.side_px)
        for name, (low, high) in self.limits.items():
            value = figures.get(name)
            if value is None or (name != "px_per_mm" and not trust_angles):
                continue
            if name == "azimuth_deg" and entry.pose is not None:  # left out only where it is sure to lie outside
                low, high = low - entry.pose.azimuth_uncertainty_deg, high + entry.pose.azimuth_uncertainty_deg
            if low <= value <= high:
                continue
            below = value < low
            do = _ADVICE[name][0 if below else 1]
            unit = f" at {self.side_px:g} px of the shorter side" if name == "px_per_mm" and self.side_px else ""
            advice = f"{name} is {value:.3g}{unit}, the promise covers {low:.3g} to {high:.3g}: {do}"
            return CannotJudge("out_of_range", value, low if below else high, advice)
        return None


def promised_side_px(manifest: Manifest) -> float | None:
    """Pixels of the shorter side of the photographs that were promised; None where the settings do not say."""
    camera = manifest.settings.get("camera")
    sides = camera.get("photo_px") if isinstance(camera, dict) else None
    if not isinstance(sides, list | tuple) or not sides:
        return None
    return float(min(sides)) if all(isinstance(v, int | float) and v >= 1 for v in sides) else None


def promised_ranges(conditions: Sequence[ConditionClaim], side_px: float | None = None) -> PromisedRanges:
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
    return PromisedRanges(limits, side_px)


def matched_rate(
    entries: Iterable[PhotoEntry], conditions: Sequence[ConditionClaim], side_px: float | None = None
) -> float | None:
    """Mean over photos of the rate at their nearest promised conditions; None where nothing can be compared."""
    rates = [_rate_near(_figures(entry, side_px), conditions) for entry in entries]
    rates = [rate for rate in rates if rate is not None]
    return float(np.mean(rates)) if rates else None


def _figures(entry: PhotoEntry, side_px: float | None) -> dict[str, float]:
    """The known ones of the figures that conditions have, pixels as a photograph of that shorter side shows them."""
    geometry, azimuth_deg = entry.geometry, entry.pose and entry.pose.azimuth_deg
    if geometry is None:
        return {}
    scale = 1.0 if side_px is None or entry.photo_px is None else side_px / min(entry.photo_px)
    figures = {"px_per_mm": scale * geometry.px_per_mm, "tilt_deg": geometry.tilt_deg}
    figures |= {} if azimuth_deg is None else {"azimuth_deg": azimuth_deg}
    return figures | {"contrast": geometry.contrast, "blur_px": scale * geometry.blur_px}


def _rate_near(figures: Mapping[str, float], conditions: Sequence[ConditionClaim]) -> float | None:
    names = list(figures)
    full = [c for c in conditions if all(getattr(c, n) is not None for n in names)]
    if len(full) < len(conditions) / 2:  # the promise does not have all of the photo's figures: use those it has
        names = [n for n in names if sum(getattr(c, n) is not None for c in conditions) > len(conditions) / 2]
        full = [c for c in conditions if all(getattr(c, n) is not None for n in names)]
    if not names or not full:
        return None
    table = np.array([[getattr(c, n) for n in names] for c in full])
    spread = np.maximum(table.std(0), 1e-9)
    distance = np.linalg.norm((table - [figures[n] for n in names]) / spread, axis=1)
    nearest = np.argsort(distance, kind="stable")[:_NEAREST]
    return float(np.mean([full[i].recognized for i in nearest]))
