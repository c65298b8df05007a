"""The ranges of view that the promise covers.

In: the promise's conditions, as far as a photograph can show them. Out: `PromisedRanges` (smallest and largest with a
margin of 10 %). A network sees every photograph at one size, so pixels of a photograph are scaled to the size of the
promised photographs.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from patchproof.evidence.results import PhotoEntry
from patchproof.photo.rejection import PhotoRejected
from patchproof.sheets.manifest import ConditionClaim

MARGIN = 0.10  # of the range's width
_LEAST_ANGLE_MARGIN_DEG = 3.0  # a nearly frontal view's tilt is no better known than this
_LEAST_SCALE_MARGIN = 0.10  # of the value itself
_ADVICE = {
    "px_per_mm": ("come closer", "step back"),
    "tilt_deg": ("look more from the side", "look less from the side"),
    "azimuth_deg": ("move to the right", "move to the left"),
}


@dataclass(frozen=True)
class PromisedRanges:
    """Allowed (low, high) by figure, margins included, of those that conditions have. Pixels are those of photographs
    whose shorter side has `side_px`, where that is known.
    """

    limits: dict[str, tuple[float, float]]
    side_px: float | None = None

    def violated(self, entry: PhotoEntry, trust_angles: bool) -> PhotoRejected | None:
        """Reject the photo by its first figure outside of the ranges; None if all lie inside."""
        figures = figures_of(entry, self.side_px)
        for name, (low, high) in self.limits.items():
            value = figures.get(name)
            if value is None or (name != "px_per_mm" and not trust_angles):
                continue
            if name == "azimuth_deg" and entry.pose is not None:  # rejected only if it lies outside at 95 %
                low, high = low - entry.pose.azimuth_uncertainty_deg, high + entry.pose.azimuth_uncertainty_deg
            if low <= value <= high:
                continue
            do, limit = _ADVICE[name][value > high], low if value < low else high
            unit = f" at {self.side_px:g} px of the shorter side" if name == "px_per_mm" and self.side_px else ""
            advice = f"{name} is {value:.3g}{unit}, the promise covers {low:.3g} to {high:.3g}: {do}"
            return PhotoRejected("out_of_range", value, limit, advice)
        return None


def promised_ranges(conditions: Sequence[ConditionClaim], side_px: float | None = None) -> PromisedRanges:
    """Compute the spans of the promised conditions, each with its margin."""
    limits = {}
    for name in _ADVICE:
        if values := [v for c in conditions if (v := getattr(c, name)) is not None]:
            low, high = min(values), max(values)
            is_scale = name == "px_per_mm"
            least = [_LEAST_SCALE_MARGIN * end if is_scale else _LEAST_ANGLE_MARGIN_DEG for end in (low, high)]
            below, above = (max(MARGIN * (high - low), margin) for margin in least)
            limits[name] = low - below, high + above
    return PromisedRanges(limits, side_px)


def figures_of(entry: PhotoEntry, side_px: float | None) -> dict[str, float]:
    """Figures of a photo that promises have ranges of, if known; pixels are scaled to a shorter side of `side_px`."""
    geometry, azimuth_deg = entry.geometry, entry.pose and entry.pose.azimuth_deg
    if geometry is None:
        return {}
    scale = 1.0 if side_px is None or entry.photo_px is None else side_px / min(entry.photo_px)
    figures = {"px_per_mm": scale * geometry.px_per_mm}
    figures |= {} if geometry.tilt_deg is None else {"tilt_deg": geometry.tilt_deg}
    return figures | ({} if azimuth_deg is None else {"azimuth_deg": azimuth_deg})
