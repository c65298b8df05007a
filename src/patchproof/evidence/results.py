"""Types of report.json: the figures of each photograph, and the summary of all of them.

Lengths in mm and px as named, angles in degrees, rates in [0, 1]; null is "not measured". `measured` implies judged,
except in page checks.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from patchproof.base.goal import GainWord, Goal
from patchproof.base.output import image_pixels
from patchproof.base.validation import Finite, StrictModel
from patchproof.photo.rejection import PhotoRejected

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.figure import Figure

    from patchproof.base.notebook import Rates

Status = Literal["judged", "measured", "rejected"]
VerdictWord = Literal["kept", "broken", "cannot_tell"]
# How a control was compared, the strongest evidence first: photographed as the patch was; its pixels rendered into the
# patch's own photographs; simulated for the promise.
ControlSource = Literal["photographed", "rendered", "simulated"]
Required = Literal["kept", "helps"]  # what a script may require of a verification to continue
_Row = tuple[Finite, Finite, Finite]
# Source of the focal length. calibrated: a camera file. confirmed, unchecked, contradicted: EXIF, which the sheet's
# perspective confirms, is too weak to check (then there is no distance), or contradicts. cropped: EXIF is of a picture
# of another size or shape, and is not used. unknown: there is none.
FocalSource = Literal["calibrated", "confirmed", "unchecked", "contradicted", "cropped", "unknown"]

Located = Literal["markers", "corners", "found"]  # by the print's markers, by named corners, or by the design's pixels


class Prediction(StrictModel):
    """One network's answer to one photograph; `target_confidence` sums over the accepted labels. A detector's has the
    score from which its boxes count, and the surest box of the target.
    """

    label: str
    confidence: Finite
    target_confidence: Finite
    recognized: bool
    least_score: Finite | None = None
    target_box: tuple[Finite, Finite, Finite, Finite] | None = None  # in shares of the photograph's centered square


class Geometry(StrictModel):
    """The sheet's place in a photograph and its uncertainty, and sharpness and contrast of the print's markers."""

    residual_mm: Finite
    px_per_mm: Finite
    tilt_deg: Finite | None  # null where the focal length is contradicted
    contrast: Finite
    blur_px: Finite
    corner_uncertainty_mm: Finite
    curl_radius_mm: Finite | None = None  # of paper that was unrolled; negative where it is hollow
    homography_px_from_mm: tuple[_Row, _Row, _Row] | None = None  # null for paper that was unrolled
    tilt_uncertainty_deg: Finite | None = None  # 95 %, as all uncertainties are
    bend_mm: Finite = 0.0  # the part of the residual that is no noise: of paper that no plane and no cylinder explains
    design_shift_mm: Finite | None = None  # of the design's own cells, 90 % point; null where it shows no texture
    focal: FocalSource = "unknown"
    located: Located = "markers"


class CameraPose(StrictModel):
    """The camera's position, if its focal length is known; figures that are too uncertain are null."""

    azimuth_uncertainty_deg: Finite  # 95 %, from the corners and the focal length
    azimuth_deg: Finite | None = None  # null where the uncertainty is too large to tell left from right
    distance_mm: Finite | None = None
    distance_uncertainty_mm: Finite | None = None


class Scale(StrictModel):
    """Printed length over intended length along the page."""

    scale_x: Finite
    scale_y: Finite


class Color(StrictModel):
    """Color difference of the design from its promise after a color fit; null if too much is clipped, or too noisy."""

    color_fit: str
    clipped_share: Finite  # of the design
    glossy_share: Finite
    noise_delta_e00: Finite | None = None  # that the photograph alone makes of a right print
    delta_e00_mean: Finite | None = None
    delta_e00_p95: Finite | None = None


class Remark(StrictModel):
    """Advice about a photograph; if something is wrong with it, the code, the figure that decided and its limit."""

    advice: str
    code: str | None = None
    figure: Finite | None = None
    threshold: Finite | None = None

    @classmethod
    def of(cls, rejection: PhotoRejected) -> "Remark":
        """Make the remark that explains a rejection."""
        return cls(code=rejection.code, figure=rejection.figure, threshold=rejection.threshold, advice=rejection.advice)


_PARTS = {"geometry": Geometry, "pose": CameraPose, "scale": Scale, "color": Color, "remark": Remark}
_NOT_MEASURED = {key: None for kind in _PARTS.values() for key in kind.model_fields}


class PhotoEntry(StrictModel):
    """One photograph's figures, in parts (None: not measured); a rejected photograph is not counted.

    In JSON the figures of all parts lie side by side; those of missing parts are null.
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
    # the object's, for detectors: left, top, right, bottom as shares of the centered square
    box: tuple[Finite, Finite, Finite, Finite] | None = None
    said: tuple[str, ...] = ()  # what its file declares and was left aside; in JSON only where there is something
    predictions: dict[str, Prediction] = Field(default_factory=dict)

    @property
    def code(self) -> str | None:
        """The code of what is wrong with the photograph; None if nothing is."""
        return None if self.remark is None else self.remark.code

    @property
    def located(self) -> Located | None:
        """How the print was located; None if it was not."""
        return None if self.geometry is None else self.geometry.located

    @model_validator(mode="before")
    @classmethod
    def _group_figures(cls, data: Any) -> Any:
        """Group the figures of JSON into parts; a part exists if its first figure, which is never null, does."""
        if not isinstance(data, dict):
            return data
        data = dict(data)
        for name, kind in _PARTS.items():
            figures = {key: data.pop(key) for key in kind.model_fields if key in data}
            if figures.get(next(iter(kind.model_fields))) is not None:
                data[name] = figures
        return data

    @model_serializer(mode="wrap")
    def _flatten(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        data, figures = serialize(self), dict(_NOT_MEASURED)
        for name in _PARTS:
            figures |= data.pop(name) or {}
        return {key: value for key, value in data.items() if key != "said" or value} | figures


class Trace(StrictModel):
    """When and with which camera a photograph was taken (null: EXIF does not say), and the mean linear light of its
    frame, which shows the place (1 = full white).
    """

    minute: Finite | None
    camera: str
    frame: _Row


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

    `culprit` is the step that clearly costs the most; None if no step does.
    """

    shares: dict[str, LedgerShare]
    culprit: str | None
    ideal: float
    photo: float
    photos: int


@dataclass(frozen=True)
class Control:
    """Photographs of one control, compared with those of the patch (null: nothing to compare). `difference` is patch
    minus control over `sessions`, of the `rates` of both; `pairs` is 0 without pairs, `advice` says what is missing.
    """

    name: str
    recognized: int
    n: int
    interval: tuple[float, float]
    pairs: int = 0
    difference: float | None = None
    difference_interval: tuple[float, float] | None = None
    sessions: int = 0
    advice: str = ""
    shown: bool | None = None
    rates: tuple[float, float] | None = None
    patch_interval: tuple[float, float] | None = None


class EffectEstimate(StrictModel):
    """The patch's effect as estimated by rendering controls into its photographs. With the design itself rendered into
    them, a share `agree` got the original answer; only these are compared; too few mean no controls.
    """

    photos: int
    agree: Finite
    controls: tuple[Control, ...] = ()


class SessionCount(StrictModel):
    """One session's judged and recognized photographs; `same_as` names the session that a folder is part of."""

    name: str
    recognized: int
    judged: int
    same_as: str | None = None


class Benefit(StrictModel):
    """The answer to whether the patch helps: the comparison with the control that decides it. Its rate is that in the
    `photos` photographs of the patch that are compared; `advice` says why they cannot tell.
    """

    word: GainWord
    goal: Goal
    source: ControlSource
    photos: int
    rate: Finite
    interval: tuple[Finite, Finite]
    control: str
    control_rate: Finite
    control_interval: tuple[Finite, Finite]
    difference: Finite
    difference_interval: tuple[Finite, Finite]
    advice: str = ""


class Summary(StrictModel):
    """The summary of all photographs, for the promise's primary model. The rate's interval accounts for differences
    between sessions; `sessions_known_from` says how these were told apart, `sessions_note` which folders count as one.
    `looks` is the number of this look, as far as OUT or `capture` knows; `left_out` says which files were not used.
    """

    photos: int
    judged: int
    measured: int
    rate: Finite | None
    interval: tuple[Finite, Finite] | None
    prediction_interval: tuple[int, int] | None
    verdict: VerdictWord
    ledger: Ledger | None = None
    reason: str = ""  # for the verdict, in a sentence
    next_step: str = ""  # what is still needed, if the photographs cannot tell
    worth: Benefit | None = None  # by the strongest evidence; null if there is nothing to compare
    left_out: tuple[str, ...] = ()
    background: str = ""  # of the views that the promise was made from
    draft_views: int = 0  # that a draft of a promise was made from; 0 for a full promise
    models: dict[str, ModelRate] = Field(default_factory=dict)
    sessions: tuple[SessionCount, ...] = ()
    sessions_known_from: str = ""
    sessions_note: str = ""
    looks: int = 1
    looks_planned: int = 1
    estimated: EffectEstimate | None = None
    not_measured: dict[str, str] = Field(default_factory=dict)  # reasons by figure

    def meets(self, required: Required) -> bool:
        """True if the promise held; "helps" asks for more: a useless patch can keep a promise to be useless."""
        helps = self.worth is not None and self.worth.word == "helps"
        return self.verdict == "kept" and (helps or required == "kept")


class Origin(StrictModel):
    """Everything besides the photographs that a report depends on: options, SHA-256 by name, versions by library."""

    options: dict[str, Any] = Field(default_factory=dict)
    sha256: dict[str, str | None] = Field(default_factory=dict)
    versions: dict[str, str] = Field(default_factory=dict)
    notes: tuple[str, ...] = ()  # what is odd about the networks


class Report(StrictModel):
    """The content of report.json, and the report's folder, which is not written there."""

    sheet_id: str
    photos: tuple[PhotoEntry, ...]
    summary: Summary
    controls: tuple[Control, ...] = ()
    origin: Origin = Origin()
    folder: Path | None = Field(default=None, exclude=True)
    SHOWN: ClassVar[tuple[str, ...]] = ("sheet_id", "summary.verdict", "summary.rate", "summary.interval", "photos")

    def plot(self) -> "Figure":
        """Draw the rates as bars with their intervals beside a photograph, as a matplotlib figure."""
        from patchproof.base.notebook import rates_figure

        return rates_figure(f"verdict: {self.summary.verdict}", *self._rates_and_photo())

    def _repr_html_(self) -> str:
        from patchproof.base.notebook import notebook_html

        summary = self.summary
        rows = {"photographs": f"{summary.photos}, judged {summary.judged}, measured {summary.measured}"}
        if summary.prediction_interval is not None:
            rows["expected"] = "{} to {} of {}".format(*summary.prediction_interval, summary.judged)
        rows |= {name: text for name, text in (("reason", summary.reason), ("next", summary.next_step)) if text}
        return notebook_html(f"verdict: {summary.verdict}", rows, *self._rates_and_photo())

    def _rates_and_photo(self) -> "tuple[Rates, np.ndarray | None]":
        """Rates with their intervals by name, the patch's first ({}: nothing was judged); the first kept picture."""
        summary, worth, rates = self.summary, self.summary.worth, {}
        if summary.rate is not None and summary.interval is not None:
            rates[f"patch, {summary.judged} photographs"] = summary.rate, summary.interval
            rates |= {f"{c.name}, {c.n} photographs": (c.recognized / c.n, c.interval) for c in self.controls if c.n}
            if worth is not None and worth.source != "photographed":
                rates[f"{worth.control}, {worth.source}"] = worth.control_rate, worth.control_interval
        paths = [] if self.folder is None else sorted((self.folder / "pictures").glob("*.photo.jpg"))
        return rates, image_pixels(paths[0].read_bytes()) if paths else None
