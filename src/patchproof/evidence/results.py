"""report.json, as types: what was found in each photograph and what all of them say together.

Lengths in mm and px as named, angles in degrees, rates in [0, 1]; null is "not measured". `measured` implies judged,
except in page checks.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any, Literal

from pydantic import Field

from patchproof.strict import Finite, Strict

Status = Literal["judged", "measured", "rejected"]
Row = tuple[Finite, Finite, Finite]


class Prediction(Strict):
    """What one network makes of one photograph; `target_confidence` sums over the accepted labels."""

    label: str
    confidence: Finite
    target_confidence: Finite
    recognized: bool


class SwatchSeen(Strict):
    """One swatch that was readable: sRGB as sent, as the promise's printer has it and as seen after the color fit."""

    srgb: Row
    promised: Row
    seen: Row
    delta_e00: Finite


class PhotoEntry(Strict):
    """One photograph; a rejected one is not counted."""

    file: str
    status: Status
    sha256: str | None = None  # of the file's bytes
    photo_px: tuple[int, int] | None = None  # width and height, upright
    code: str | None = None
    figure: Finite | None = None
    threshold: Finite | None = None
    advice: str | None = None
    markers_found: int = 0
    residual_mm: Finite | None = None
    px_per_mm: Finite | None = None
    scale_x: Finite | None = None
    scale_y: Finite | None = None
    scale_x_over_y: Finite | None = None  # the print's proportions alone, from a calibrated camera
    tilt_deg: Finite | None = None
    azimuth_deg: Finite | None = None  # null where the uncertainty is too large to tell left from right
    azimuth_uncertainty_deg: Finite | None = None  # 95 %, from the corners alone
    distance_mm: Finite | None = None
    contrast: Finite | None = None
    blur_px: Finite | None = None
    corner_uncertainty_mm: Finite | None = None
    curl_radius_mm: Finite | None = None  # of paper that was unrolled; negative where it is hollow
    delta_e00_mean: Finite | None = None
    delta_e00_p95: Finite | None = None
    color_fit: str | None = None
    clipped_share: Finite | None = None  # of the design
    glossy_share: Finite | None = None
    swatches: tuple[SwatchSeen, ...] = ()
    homography_px_from_mm: tuple[Row, Row, Row] | None = None
    predictions: dict[str, Prediction] = Field(default_factory=dict)


class ModelRate(Strict):
    """One network's rate over the judged photographs."""

    rate: Finite | None
    interval: tuple[Finite, Finite] | None


class LedgerShare(Strict):
    """One step's share of the loss between promise and photograph."""

    share: Finite
    interval: tuple[Finite, Finite] | None


@dataclass(frozen=True)
class Ledger:
    """Shares by step in their order, mean confidence of the ideal pictures and of the photographs, and their number.

    `culprit` is the step that clearly costs the most, None where none does.
    """

    shares: dict[str, LedgerShare]
    culprit: str | None
    ideal: float
    photo: float
    photos: int


class Summary(Strict):
    """All photographs together, for the promise's primary model."""

    photos: int
    judged: int
    measured: int
    rate: Finite | None
    interval: tuple[Finite, Finite] | None
    prediction_interval: tuple[int, int] | None
    verdict: Literal["kept", "broken", "cannot_tell"]
    effect: Literal["shown", "not_shown", "not_tested"]
    matched_rate: Finite | None
    ledger: dict[str, LedgerShare] | None = None
    culprit: str | None = None
    reason: str = ""  # for the verdict, in a sentence
    models: dict[str, ModelRate] = Field(default_factory=dict)


@dataclass(frozen=True)
class Control:
    """Photographs of one control and how the patch compares; null where there was nothing to compare."""

    name: str
    recognized: int
    n: int
    interval: tuple[float, float]
    pairs: int = 0
    difference: float | None = None
    difference_interval: tuple[float, float] | None = None
    p_value: float | None = None
    shown: bool | None = None


class Origin(Strict):
    """What a report rests on besides the photographs: options as given, SHA-256 by name, versions by library."""

    options: dict[str, Any] = Field(default_factory=dict)
    sha256: dict[str, str | None] = Field(default_factory=dict)
    versions: dict[str, str] = Field(default_factory=dict)


class Report(Strict):
    """A whole report.json."""

    sheet_id: str
    photos: tuple[PhotoEntry, ...]
    summary: Summary
    controls: tuple[Control, ...] = ()
    origin: Origin = Origin()

    def dump(self) -> str:
        """Its JSON text: the same report gives the same bytes."""
        return json.dumps(self.model_dump(mode="json"), indent=1, allow_nan=False) + "\n"


@dataclass(frozen=True)
class Evidence:
    """A report, and the ledger with what its chart needs besides the shares."""

    report: Report
    ledger: Ledger | None = None

    def notes(self) -> dict[str, Any]:
        """The ledger as plain data, for the page."""
        if self.ledger is None:
            return {}
        return {"ledger": vars(self.ledger) | {"shares": {k: v.model_dump() for k, v in self.ledger.shares.items()}}}
