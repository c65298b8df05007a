"""SHEET.json: the exact geometry of a printed sheet and the promise that was made before printing.

Millimeters from the page's top-left corner, x right, y down; pages count from 1; rates in [0, 1]; unknown figures null.
Verification knows of a design only its manifest, which therefore holds the design's pixels (PNG, base64) and their
SHA-256 over the raw RGB bytes, row by row.
"""

import base64
import hashlib
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, create_model, field_validator, model_validator

from patchproof.base.errors import Refused
from patchproof.base.geometry import corner_turns
from patchproof.base.goal import GainWord, Goal, points_text
from patchproof.base.input import open_image, read_json
from patchproof.base.output import json_text
from patchproof.base.sessions import RatePosterior, count_by_session, rate_posterior
from patchproof.base.text import command_text
from patchproof.base.validation import Finite, NotNegativeRange, Share, StrictModel, validate_model

Mm = Annotated[Finite, Field(ge=-1e5, le=1e5)]
SizeMm = Annotated[Finite, Field(ge=0.1, le=1e5)]
Point = tuple[Mm, Mm]
Rect = tuple[Mm, Mm, SizeMm, SizeMm]
Interval = tuple[Share, Share]
SignedInterval = tuple[Finite, Finite]
PAGE_CODE_PATTERN = "^patchproof:([0-9A-Z]{10}):([0-9a-z]+)$"  # text of a page's QR code
_MIN_MARKER_MM = 1.0
PageNumber = Annotated[int, Field(ge=1, le=1000)]
MAX_PRINTED_PX = 2048  # of a design's side as it is printed; up to 512 are optimized
DesignSidePx = Annotated[int, Field(ge=1, le=MAX_PRINTED_PX)]
Count = Annotated[int, Field(ge=1, le=1_000_000)]


class Design(StrictModel):
    """The printed pixels and their place."""

    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    rect_mm: Rect
    size_px: tuple[DesignSidePx, DesignSidePx]
    page: PageNumber
    png: str

    def pixels(self) -> np.ndarray:
        """Decode the design to uint8 H×W×3 sRGB; refused if its hash is not `sha256`."""
        expected, do = "the design's pixels in the manifest", "make the sheet again"
        try:
            png = base64.b64decode(self.png, validate=True)
        except ValueError as error:
            raise Refused(expected, f"text that is not base64 ({error})", do) from error
        with open_image(png, expected, do) as image:
            if image.size != self.size_px:
                raise ValueError(f"{image.width} × {image.height} pixels")
            pixels = np.asarray(image.convert("RGB"))
        if (found := design_sha256(pixels)) != self.sha256:
            got = f"pixels with SHA-256 {found[:16]}..."
            raise Refused(f"the design with SHA-256 {self.sha256[:16]}... in the manifest", got, do)
        return pixels


class Marker(StrictModel):
    """One ArUco marker: outer corners of its black square, clockwise from the top-left of the code."""

    dictionary: Annotated[str, Field(pattern="^DICT_(4X4|5X5|6X6|7X7)_(50|100|250|1000)$")]
    id: Annotated[int, Field(ge=0)]
    corners_mm: tuple[Point, Point, Point, Point]
    page: PageNumber

    @model_validator(mode="after")
    def _is_plausible(self) -> "Marker":
        if self.id >= int(self.dictionary.rpartition("_")[2]):
            raise ValueError(f"marker {self.id} is not in {self.dictionary}")
        if (corner_turns(np.array(self.corners_mm)) < _MIN_MARKER_MM**2).any():
            raise ValueError(f"marker {self.id} must have clockwise corners and sides over {_MIN_MARKER_MM:g} mm")
        return self


class Swatch(StrictModel):
    """One swatch of known sRGB color."""

    rect_mm: Rect
    srgb: tuple[Share, Share, Share]
    page: PageNumber


class Tile(StrictModel):
    """One page of a piece larger than the page. The piece's own markers lie within `cut_mm`; other markers lie in the
    trimmed margin and on the flaps, and are for checks of single pages.
    """

    page: PageNumber
    page_from_design_mm: tuple[tuple[Mm, Mm, Mm], tuple[Mm, Mm, Mm]]
    cut_mm: Rect  # on the page: the part that is visible when the piece is assembled

    @model_validator(mode="after")
    def _invertible(self) -> "Tile":
        (a, b, _), (c, d, _) = self.page_from_design_mm
        if not 0.5 < a * d - b * c < 2:  # both are millimeters
            raise ValueError(f"must have page_from_design_mm of determinant 1, not {a * d - b * c:g}")
        return self


class Target(StrictModel):
    """The label to recognize; `indices` are all labels that count, the target's first."""

    label: str
    indices: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)]
    goal: Goal


class ModelClaim(StrictModel):
    """One network's promised rate. `name` is that of the scene file, `sha256` that of the network's file if it has one,
    `least_score` a detector's smallest score that counts.
    """

    name: str
    sha256: str | None
    rate: Share
    interval: Interval
    confidence: Share
    least_score: Share | None = None


class ControlClaim(StrictModel):
    """A control's rate on `n` of the same conditions; `difference` is the design's rate there minus the control's."""

    n: Count
    rate: Share
    interval: Interval
    confidence: Share
    difference: Finite
    difference_interval: SignedInterval


class ConditionClaim(StrictModel):
    """The observable figures of one promised condition, and whether the design was recognized under it."""

    px_per_mm: Annotated[Finite, Field(ge=0, le=1e4)] | None
    tilt_deg: Annotated[Finite, Field(ge=0, le=180)] | None
    azimuth_deg: Annotated[Finite, Field(ge=-360, le=360)] | None
    contrast: Annotated[Finite, Field(ge=-4, le=4)] | None
    blur_px: Annotated[Finite, Field(ge=0, le=1000)] | None
    recognized: bool


class Promise(StrictModel):
    """The rate of the primary (first) model, predicted before printing from `n` conditions, of which `per_session`
    successive ones form a session. `places` numbers each session's place if some share one. A `draft` is a preview from
    few conditions. `outermost_mm` are the object's outermost points in the piece's frame, for comparing a detector's
    boxes with the object.
    """

    target: Target
    models: Annotated[tuple[ModelClaim, ...], Field(min_length=1)]
    rate: Share
    interval: Interval
    n: Count
    per_session: Count = 1
    places: tuple[Annotated[int, Field(ge=0, le=10**6)], ...] = ()
    draft: bool = False
    outermost_mm: Annotated[tuple[tuple[Mm, Mm, Mm], ...], Field(max_length=2000)] = ()
    controls: dict[str, ControlClaim]
    conditions: tuple[ConditionClaim, ...]
    SHOWN: ClassVar[tuple[str, ...]] = ("target.label", "rate", "interval", "n", "best_control")

    @model_validator(mode="after")
    def _lists_all_conditions(self) -> "Promise":
        if len(self.conditions) != self.n:
            raise ValueError(f"must list all of its {self.n} conditions, not {len(self.conditions)}")
        return self

    @property
    def sessions(self) -> int:
        """The number of sessions among the conditions."""
        return -(-self.n // self.per_session)

    @cached_property
    def posterior(self) -> RatePosterior:
        """The posterior of the rate given the conditions, which predicts new photographs."""
        hits = [condition.recognized for condition in self.conditions]
        places = self.places if len(self.places) == self.sessions else ()
        return rate_posterior(*count_by_session(hits, self.per_session, places))

    @property
    def best_control(self) -> str:
        """The name of the control that is hardest to beat."""
        return self.target.goal.hardest({name: claim.difference_interval for name, claim in self.controls.items()})

    @property
    def answer(self) -> GainWord:
        """The answer to whether the design helps, from its difference to its best control."""
        return self.target.goal.answer(self.controls[self.best_control].difference_interval)

    def command(self, run: str = "RUN") -> str:
        """The command for a promise that tells more: in full after a draft, else from four times the views."""
        return command_text("promise", run, *([] if self.draft else ["--n", 4 * self.n]))

    @property
    def headline(self) -> str:
        """A sentence with the difference to the best control; rates in these views are not the promised one."""
        control, draft = self.controls[self.best_control], f"Draft of {self.n} views (preliminary): " * self.draft
        points = points_text(control.rate + control.difference, control.rate, control.difference_interval)
        beside = f"beside its best control ({self.best_control}) in the same {control.n} views"
        return f"{draft}{self.target.goal.words[self.answer]}: {points} {beside}."

    def html(self, picture: np.ndarray | None = None) -> str:
        """Return the promise as a notebook shows it: bars of the design's rate and its controls', and a picture."""
        from patchproof.base.notebook import notebook_html

        rows = {"target": f"{self.target.goal} {self.target.label}", "network": self.models[0].name}
        rates = {f"design, {self.n} views": (self.rate, self.interval)}
        rates |= {kind: (claim.rate, claim.interval) for kind, claim in self.controls.items()}
        return notebook_html(self.headline, rows, rates, picture)

    _repr_html_ = html


_table: Any = create_model  # the stub of create_model lacks unions
# The settings that verification reads; other keys may hold anything.
_VerifiedSettings = _table(
    "_VerifiedSettings",
    printer=(_table("_Printer", profile=(str, "")) | None, None),
    camera=(_table("_Camera", noise=(NotNegativeRange, ()), photo_px=(tuple[Count, Count] | None, None)), None),
    target=(_table("_Target", label=(str | int, ""), accept=(tuple[str | int, ...], ())), None),
    sheet=(_table("_Sheet", template=(str, ""), markers=(bool, True)), None),
    printer_file=(_table("_PrinterFile", npz=str, head=dict[str, Any]) | None, None),  # of a printer without a name
    imported=(_table("_Imported", file=str, sha256=str) | None, None),  # a design that was made elsewhere
)


class Manifest(StrictModel):
    """A whole SHEET.json; `design` and `promise` are null on pages without one."""

    version: Literal[2]
    sheet_id: Annotated[str, Field(pattern="^[0-9A-Z]{10}$")]
    kind: str  # "design", or a control: "mean", "gray", "noise", "blank"
    page_mm: tuple[SizeMm, SizeMm]
    design: Design | None
    markers: tuple[Marker, ...]  # none with sheet.markers = false
    chart: tuple[Swatch, ...]
    cut_mm: Rect
    ruler_mm: tuple[SizeMm, SizeMm]
    page_code: Annotated[str, Field(pattern=PAGE_CODE_PATTERN)] | None = None  # of a page that several designs share
    plan_page: PageNumber | None = None  # the page for people: the place of the piece, and how to photograph it
    tiles: tuple[Tile, ...] = ()
    promise: Promise | None
    settings: dict[str, Any]
    SHOWN: ClassVar[tuple[str, ...]] = ("sheet_id", "kind", "page_mm", "promise")

    def _repr_html_(self) -> str | None:
        return self.promise and self.promise.html(self.design and self.design.pixels())

    @field_validator("settings")
    @classmethod
    def _usable(cls, settings: dict[str, Any]) -> dict[str, Any]:
        _VerifiedSettings.model_validate(settings)
        return settings

    @model_validator(mode="after")
    def _design_fills_the_piece(self) -> "Manifest":
        if self.design is not None and self.design.rect_mm != self.cut_mm:
            raise ValueError("make the sheet again: design.rect_mm is not cut_mm, and a design fills its piece")
        if not self.markers and self.settings.get("sheet", {}).get("markers", True):
            why = "it has no markers, and sheet.markers = false is not in its settings"
            raise ValueError(f"make the sheet again: {why}")
        return self

    @property
    def code(self) -> str:
        """The text of the page's QR code: the sheet's id, and 16 digits of the design's SHA-256, or the kind without
        one. A page of several designs has an id of its own, and digits of a hash over theirs.
        """
        content = self.design.sha256[:16] if self.design else self.kind
        return self.page_code or f"patchproof:{self.sheet_id}:{content}"

    def page_from_design_page(self, page: int) -> np.ndarray:
        """Map 3×3 from millimeters of the design's page (without a design: the first tile's) to those of another
        tile's page; the identity for pages without a tile.
        """
        maps = {tile.page: np.vstack([np.array(tile.page_from_design_mm), [0, 0, 1]]) for tile in self.tiles}
        if page not in maps:
            return np.eye(3)
        return maps[page] @ np.linalg.inv(maps[self.design.page if self.design else self.tiles[0].page])


def design_sha256(pixels: np.ndarray) -> str:
    """SHA-256 of uint8 H×W×3 pixels, row by row."""
    return hashlib.sha256(np.ascontiguousarray(pixels, np.uint8).tobytes()).hexdigest()


def dump_manifest(manifest: Manifest) -> str:
    """Format a manifest as JSON; equal manifests give equal bytes."""
    return json_text(manifest.model_dump())


def load_manifest(path: str | Path) -> Manifest:
    """Load a SHEET.json; refused if it is missing, damaged, or not a manifest."""
    missing = "name the JSON that was written beside the PDF"
    if Path(path).suffix.lower() == ".pdf":
        raise Refused("a manifest (SHEET.json)", f"{path}, a PDF", missing)
    data = read_json(path, "a manifest (SHEET.json)", "make the sheet again", missing)
    return validate_model(Manifest, data, str(path))
