"""Options of a verification, and the `Task` that every photograph is measured against, made of them and a manifest.

`PromisedRanges` are the spans of the promise's conditions, as far as a photograph can show them, with a margin of 10 %.
A network sees every photograph at one size, so pixels of a photograph are scaled to the size of the promised ones.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from patchproof.evidence.classify import Judges
from patchproof.evidence.results import PhotoEntry
from patchproof.evidence.surface import PromisedColors, Surface, promised_of, surface_of
from patchproof.photo.rejection import PhotoRejected
from patchproof.sheets.manifest import ConditionClaim, Manifest
from patchproof.sheets.piece import IDS_PER_KIND, SHEET_KINDS, marker_ids

if TYPE_CHECKING:
    from patchproof.channel.lens import Camera
    from patchproof.channel.printer import Printer
    from patchproof.classifier import Classifier
    from patchproof.evidence.annotations import Drawn

LEDGER_PHOTOS = 24  # each costs 16 classifications; 24 leave intervals of some ± 5 points
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


@dataclass(frozen=True)
class Options:
    """Everything besides photographs and manifest that a verification's figures depend on.

    `printer` is the printer model that the promise was made with. `camera` replaces the EXIF focal length and removes
    lens distortion. `ruler_mm` are the printed rulers (x, y) as measured by hand. `controls` is a folder of photographs
    of controls. At most `ledger_photos` photographs, evenly spread, go into the gap ledger (0: no ledger). `boxes` are
    those that somebody drew round the object (`annotations.load_boxes`), `corners` the design's that somebody named
    (`annotations.load_corners`), by photograph. `find`: search for the design itself where no marker can be read.
    """

    models: "Sequence[Classifier]"
    printer: "Printer"
    camera: "Camera | None" = None
    scan_dpi: float | None = None
    ruler_mm: tuple[float, float] | None = None
    controls: str | Path | None = None
    ledger_photos: int = LEDGER_PHOTOS
    boxes: "Mapping[str, Drawn]" = field(default_factory=dict)
    corners: "Mapping[str, Drawn]" = field(default_factory=dict)
    find: bool = False


@dataclass(frozen=True)
class Task:
    """Everything that one photograph is measured against; small enough to be sent to another process."""

    surface: Surface
    promised: PromisedColors | None
    ranges: PromisedRanges
    sizes_px: tuple[int, ...]  # of the networks' squares
    scan_dpi: float | None
    camera: "Camera | None"
    photo_px: tuple[int, int] | None  # of the promised photographs
    find: np.ndarray | None = None  # the design's pixels, to be searched for
    ids_by_kind: dict[str, frozenset[int]] = field(default_factory=dict)  # of markers, of the sheet and its controls


def task_of(manifest: Manifest, options: Options, judges: Judges | None) -> Task:
    """Make the task of a verification; without `judges` photographs are not classified."""
    surface = surface_of(manifest)
    photo_px = manifest.settings.get("camera", {}).get("photo_px")
    conditions = () if manifest.promise is None else manifest.promise.conditions
    ranges = promised_ranges(conditions, float(min(photo_px)) if photo_px else None)
    sizes = tuple(sorted({model.input_px for model in judges.models})) if judges else ()
    camera = options.scan_dpi, options.camera, photo_px and tuple(photo_px)
    find = manifest.design.pixels() if options.find and manifest.design else None
    most = min(len(surface.piece_ids), IDS_PER_KIND)
    ids = {kind: frozenset(marker_ids(manifest.sheet_id, kind, most)) for kind in SHEET_KINDS}
    ids["design"] = surface.piece_ids
    return Task(surface, promised_of(manifest, surface, options.printer), ranges, sizes, *camera, find, ids)
