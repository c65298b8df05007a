"""report.json, as types: what was measured in each photograph and what all of them say together.

Lengths in mm and px as named, angles in degrees, rates in [0, 1]; null is "not measured". `measured` implies judged,
except in page checks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from patchproof.base.goal import Goal
from patchproof.base.notebook import notebook_html, rate_text
from patchproof.base.validation import Finite, StrictModel
from patchproof.photo.rejection import PhotoRejected

Status = Literal["judged", "measured", "rejected"]
VerdictWord = Literal["kept", "broken", "cannot_tell"]
BenefitWord = Literal["helps", "no_better", "worse", "not_shown"]
Effect = Literal["shown", "not_shown", "not_tested"]
Required = Literal["kept", "helps"]  # of a verification that scripts go on from
Row = tuple[Finite, Finite, Finite]
# where the focal length is from: a camera file; EXIF, which the sheet's own perspective confirms, is too weak to check
# (so that there is no distance), or contradicts; EXIF of a picture of another size or shape, which is not used; nowhere
FocalSource = Literal["calibrated", "confirmed", "unchecked", "contradicted", "cropped", "unknown"]


class Prediction(StrictModel):
    """What one network makes of one photograph; `target_confidence` sums over the accepted labels."""

    label: str
    confidence: Finite
    target_confidence: Finite
    recognized: bool


class Geometry(StrictModel):
    """Where the sheet lies in a photograph, how sure that is, and how sharp and bright the print's markers came out."""

    residual_mm: Finite
    px_per_mm: Finite
    tilt_deg: Finite
    contrast: Finite
    blur_px: Finite
    corner_uncertainty_mm: Finite
    curl_radius_mm: Finite | None = None  # of paper that was unrolled; negative where it is hollow
    homography_px_from_mm: tuple[Row, Row, Row] | None = None  # null for paper that was unrolled
    tilt_uncertainty_deg: Finite | None = None  # 95 %, as all uncertainties are
    bend_mm: Finite = 0.0  # the part of the residual that is no noise: of paper that no plane and no cylinder explains
    design_shift_mm: Finite | None = None  # of the design's own cells, 90 % point; null where it shows no texture
    focal: FocalSource = "unknown"


class CameraPose(StrictModel):
    """What a camera of known focal length says besides; null where it cannot tell."""

    azimuth_uncertainty_deg: Finite  # 95 %, from the corners and the focal length
    azimuth_deg: Finite | None = None  # null where the uncertainty is too large to tell left from right
    distance_mm: Finite | None = None
    distance_uncertainty_mm: Finite | None = None
    scale_x_over_y: Finite | None = None  # the print's proportions alone, from a calibrated camera


class Scale(StrictModel):
    """Printed length over intended length along the page."""

    scale_x: Finite
    scale_y: Finite


class Color(StrictModel):
    """The design's color against its promise after a fit; no difference where too much of it is clipped."""

    color_fit: str
    clipped_share: Finite  # of the design
    glossy_share: Finite
    delta_e00_mean: Finite | None = None
    delta_e00_p95: Finite | None = None


class Remark(StrictModel):
    """What to do about a photograph; where something is wrong with it, its code, the figure that decided, its limit."""

    advice: str
    code: str | None = None
    figure: Finite | None = None
    threshold: Finite | None = None

    @classmethod
    def of(cls, cannot: PhotoRejected) -> Remark:
        """The remark that says why."""
        return cls(code=cannot.code, figure=cannot.figure, threshold=cannot.threshold, advice=cannot.advice)


_PARTS = {"geometry": Geometry, "pose": CameraPose, "scale": Scale, "color": Color, "remark": Remark}
# one photograph in report.json, in this order
PHOTO_KEYS = """
    file status sha256 photo_px code figure threshold advice markers_found residual_mm px_per_mm scale_x scale_y
    scale_x_over_y tilt_deg tilt_uncertainty_deg azimuth_deg azimuth_uncertainty_deg distance_mm
    distance_uncertainty_mm focal contrast blur_px corner_uncertainty_mm bend_mm design_shift_mm
    curl_radius_mm delta_e00_mean delta_e00_p95 color_fit clipped_share glossy_share homography_px_from_mm box forecast
    predictions""".split()


class PhotoEntry(StrictModel):
    """One photograph in the parts that were measured; a rejected one is not counted.

    As JSON the figures of all parts lie side by side, null where a part is not there.
    """

    file: str
    status: Status
    sha256: str | None = None  # of the file's bytes
    photo_px: tuple[int, int] | None = None  # width and height, upright
    markers_found: int = 0
    geometry: Geometry | None = None
    pose: CameraPose | None = None
    scale: Scale | None = None
    color: Color | None = None
    remark: Remark | None = None
    # the object's, where a detector is asked and it is known: left, top, right, bottom as shares of the middle square
    box: tuple[Finite, Finite, Finite, Finite] | None = None
    forecast: Finite | None = None  # the chance of being recognized, by rendering the run's scene at its measured view
    predictions: dict[str, Prediction] = Field(default_factory=dict)

    @property
    def code(self) -> str | None:
        """What is wrong with it."""
        return None if self.remark is None else self.remark.code

    @model_validator(mode="before")
    @classmethod
    def _parts_of(cls, data: Any) -> Any:
        """A part is there where its first figure is, which is never null."""
        if not isinstance(data, dict):
            return data
        data = dict(data)
        for name, kind in _PARTS.items():
            figures = {key: data.pop(key) for key in kind.model_fields if key in data}
            if figures.get(next(iter(kind.model_fields))) is not None:
                data[name] = figures
        return data

    @model_serializer(mode="wrap")
    def _side_by_side(self, plain: SerializerFunctionWrapHandler) -> dict[str, Any]:
        parts = plain(self)
        figures = parts | {key: value for name in _PARTS for key, value in (parts[name] or {}).items()}
        return {key: figures.get(key) for key in PHOTO_KEYS}


class ModelRate(StrictModel):
    """One network's rate over the judged photographs."""

    rate: Finite | None
    interval: tuple[Finite, Finite] | None


class LedgerShare(StrictModel):
    """One step's share of the loss between promise and photograph."""

    share: Finite
    interval: tuple[Finite, Finite] | None


class Ledger(StrictModel):
    """Shares by step in their order, mean confidence of the ideal pictures and of the photographs, and their number.

    `culprit` is the step that clearly costs the most, None where none does.
    """

    shares: dict[str, LedgerShare]
    culprit: str | None
    ideal: float
    photo: float
    photos: int


class EstimatedControl(StrictModel):
    """A control put into photographs of the patch: its rate there, and the patch's own minus that, with 95 %."""

    name: str
    rate: Finite
    difference: Finite
    difference_interval: tuple[Finite, Finite]


class EffectEstimate(StrictModel):
    """The effect as estimated from so many photographs. Where the design itself was put back, a share `agree` of them
    kept its answer; too few of them leave no controls.
    """

    photos: int
    agree: Finite
    controls: tuple[EstimatedControl, ...] = ()


class Forecast(StrictModel):
    """What was to be expected of so many photographs at their own measured views, and what they showed: counts, and
    Brier scores of the chances and of the promised rate in their place.
    """

    photos: int
    expected: Finite
    interval: tuple[int, int]
    recognized: int
    brier: Finite
    brier_promise: Finite


class SessionCount(StrictModel):
    """One session's judged photographs, and how many of them were recognized."""

    name: str
    recognized: int
    judged: int


class Benefit(StrictModel):
    """What the patch is worth beside the control that decided it, whose rate is the promise's unless `photographed`."""

    word: BenefitWord
    goal: Goal
    control: str
    control_rate: Finite
    difference: Finite
    difference_interval: tuple[Finite, Finite]
    photographed: bool


class Summary(StrictModel):
    """All photographs together, for the promise's primary model. The rate's interval knows how much sessions differ,
    and `sessions_known_from` says how sessions were told apart; `left_out` names what was not looked at.
    """

    photos: int
    judged: int
    measured: int
    rate: Finite | None
    interval: tuple[Finite, Finite] | None
    prediction_interval: tuple[int, int] | None
    verdict: VerdictWord
    effect: Effect
    matched_rate: Finite | None
    ledger: dict[str, LedgerShare] | None = None
    culprit: str | None = None
    reason: str = ""  # for the verdict, in a sentence
    next_step: str = ""  # what to do where photographs cannot tell
    worth: Benefit | None = None  # beside its controls; null where there is nothing to compare
    left_out: tuple[str, ...] = ()
    background: str = ""  # what stood behind the object when the promise was made
    draft_views: int = 0  # of a promise that is a draft: from how many views
    models: dict[str, ModelRate] = Field(default_factory=dict)
    sessions: tuple[SessionCount, ...] = ()
    sessions_known_from: str = ""
    estimated: EffectEstimate | None = None
    forecast: Forecast | None = None

    def meets(self, required: Required) -> bool:
        """Whether the promise held; for "helps" also whether the patch helps, since a useless one that was promised to
        be useless keeps its promise.
        """
        helps = self.worth is not None and self.worth.word == "helps"
        return self.verdict == "kept" and (helps or required == "kept")


@dataclass(frozen=True)
class Control:
    """Photographs of one control and how the patch compares, null where there was nothing to compare; `difference` is
    patch minus control, `pairs` 0 where photographs are not paired.
    """

    name: str
    recognized: int
    n: int
    interval: tuple[float, float]
    pairs: int = 0
    difference: float | None = None
    difference_interval: tuple[float, float] | None = None
    p_value: float | None = None
    shown: bool | None = None


class Origin(StrictModel):
    """What a report rests on besides the photographs: options as given, SHA-256 by name, versions by library."""

    options: dict[str, Any] = Field(default_factory=dict)
    sha256: dict[str, str | None] = Field(default_factory=dict)
    versions: dict[str, str] = Field(default_factory=dict)


class Report(StrictModel):
    """A whole report.json; beside it the ledger, for its chart."""

    sheet_id: str
    photos: tuple[PhotoEntry, ...]
    summary: Summary
    controls: tuple[Control, ...] = ()
    origin: Origin = Origin()
    ledger: Ledger | None = Field(None, exclude=True)

    def _repr_html_(self) -> str:
        """The verdict in a notebook."""
        summary = self.summary
        rows = {"photographs": f"{summary.photos}, judged {summary.judged}, measured {summary.measured}"}
        if summary.rate is not None and summary.interval is not None:
            rows["recognized"] = rate_text(summary.rate, summary.interval)
        if summary.prediction_interval is not None:
            rows["promised"] = "{} to {} of {}".format(*summary.prediction_interval, summary.judged)
        rows |= {"reason": summary.reason, "next": summary.next_step or ""}
        return notebook_html(f"verdict: {summary.verdict}", {key: text for key, text in rows.items() if text})
