"""Options of a verification, and the `Task` that every photograph is measured against, made of them and a manifest."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from patchproof.evidence.classify import Judges
from patchproof.evidence.ranges import PromisedRanges, promised_ranges
from patchproof.evidence.surface import PromisedColors, Surface, promised_of, surface_of
from patchproof.sheets.manifest import Manifest

if TYPE_CHECKING:
    from patchproof.channel.lens import Camera
    from patchproof.channel.printer import Printer
    from patchproof.classifier import Classifier
    from patchproof.evidence.annotations import DrawnBox, NamedCorners

LEDGER_PHOTOS = 24  # each costs 16 classifications; 24 leave intervals of some ± 5 points


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
    boxes: "Mapping[str, DrawnBox]" = field(default_factory=dict)
    corners: "Mapping[str, NamedCorners]" = field(default_factory=dict)
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


def task_of(manifest: Manifest, options: Options, judges: Judges | None) -> Task:
    """Make the task of a verification; without `judges` photographs are not classified."""
    surface = surface_of(manifest)
    promised = promised_of(manifest, surface, options.printer)
    photo_px, conditions = manifest.settings.get("camera", {}).get("photo_px"), ()
    if manifest.promise is not None:
        conditions = manifest.promise.conditions
    ranges = promised_ranges(conditions, float(min(photo_px)) if photo_px else None)
    sizes = tuple(sorted({model.input_px for model in judges.models})) if judges else ()
    camera = options.scan_dpi, options.camera, photo_px and tuple(photo_px)
    find = manifest.design.pixels() if options.find and manifest.design else None
    return Task(surface, promised, ranges, sizes, *camera, find)
