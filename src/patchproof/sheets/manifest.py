"""SHEET.json: the exact geometry of a printed sheet and the promise that was made before printing.

Millimeters from the page's top-left corner, x right, y down; pages count from 1; rates in [0, 1]; unknown figures null.
The manifest is all that the judge gets to see of the design's making, so it carries the design's own pixels (PNG,
base64) beside their SHA-256, which is taken over the raw RGB bytes, row by row.
"""

from __future__ import annotations

import base64
import hashlib
import json
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, create_model, field_validator, model_validator

from patchproof.base.errors import Refused
from patchproof.base.goal import Goal
from patchproof.base.input import open_image, read_json
from patchproof.base.notebook import notebook_html, rate_text
from patchproof.base.sessions import RatePosterior, count_by_session, rate_posterior
from patchproof.base.validation import Finite, NotNegativeRange, Share, StrictModel, validate_model

Mm = Annotated[Finite, Field(ge=-1e5, le=1e5)]
SizeMm = Annotated[Finite, Field(ge=0.1, le=1e5)]
Point = tuple[Mm, Mm]
Rect = tuple[Mm, Mm, SizeMm, SizeMm]
Interval = tuple[Share, Share]
SignedInterval = tuple[Finite, Finite]
Comparison = Literal["better", "no better", "worse"]
PAGE_CODE = "^patchproof:([0-9A-Z]{10}):([0-9a-z]+)$"  # what a page's QR code says
_LEAST_MARKER_MM = 1.0
Page = Annotated[int, Field(ge=1, le=1000)]
DesignSidePx = Annotated[int, Field(ge=1, le=2048)]  # designs have up to 512 pixels
Count = Annotated[int, Field(ge=1, le=1_000_000)]


class Design(StrictModel):
    """The printed pixels and where they lie."""

    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    rect_mm: Rect
    size_px: tuple[DesignSidePx, DesignSidePx]
    page: Page
    png: str

    def pixels(self) -> np.ndarray:
        """The design as uint8 H×W×3 sRGB; refused where it is not the one that the hash names."""
        expected, do = "the design's pixels in the manifest", "make the sheet again"
        try:
            png = base64.b64decode(self.png, validate=True)
        except ValueError as error:
            raise Refused(expected, "none that can be read", do) from error
        with open_image(png, expected, do) as image:
            if image.size != self.size_px:
                raise ValueError(f"{image.width} × {image.height} pixels")
            pixels = np.asarray(image.convert("RGB"))
        if design_sha256(pixels) != self.sha256:
            raise Refused("the design that the manifest names", "other pixels", do)
        return pixels


class Marker(StrictModel):
    """One ArUco marker: outer corners of its black square, clockwise from the top-left of the code."""

    dictionary: Annotated[str, Field(pattern="^DICT_(4X4|5X5|6X6|7X7)_(50|100|250|1000)$")]
    id: Annotated[int, Field(ge=0)]
    corners_mm: tuple[Point, Point, Point, Point]
    page: Page

    @model_validator(mode="after")
    def _possible(self) -> Marker:
        if self.id >= int(self.dictionary.rpartition("_")[2]):
            raise ValueError(f"marker {self.id} is not one of {self.dictionary}")
        for i in range(4):  # twice the area of each corner's triangle, y down
            (ax, ay), (bx, by), (cx, cy) = (self.corners_mm[(i + j) % 4] for j in range(3))
            if (bx - ax) * (cy - by) - (by - ay) * (cx - bx) < _LEAST_MARKER_MM**2:
                raise ValueError(f"marker {self.id} must run clockwise round more than {_LEAST_MARKER_MM:g} mm")
        return self


class Swatch(StrictModel):
    """One patch of known sRGB color."""

    rect_mm: Rect
    srgb: tuple[Share, Share, Share]
    page: Page


class Tile(StrictModel):
    """One page of a piece larger than the page. The piece's markers on it are those within `cut_mm`; the others lie in
    its trimmed margin and on its flaps, and serve to check the page alone.
    """

    page: Page
    page_from_design_mm: tuple[tuple[Mm, Mm, Mm], tuple[Mm, Mm, Mm]]
    cut_mm: Rect  # on the page: what shows of it when the piece is assembled

    @model_validator(mode="after")
    def _invertible(self) -> Tile:
        (a, b, _), (c, d, _) = self.page_from_design_mm
        if not 0.5 < a * d - b * c < 2:  # both are millimeters
            raise ValueError("must have page_from_design_mm that turns and shifts")
        return self


class Target(StrictModel):
    """What should be recognized; `indices` are the labels that count, the target's first."""

    label: str
    indices: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)]
    goal: Goal


class ModelClaim(StrictModel):
    """One network's promised rate. Its name is as written; SHA-256 of its file where there is one; of a detector the
    score from which on its boxes count.
    """

    name: str
    sha256: str | None
    rate: Share
    interval: Interval
    confidence: Share
    least_score: Share | None = None


class ControlClaim(StrictModel):
    """A control on `n` of the same conditions; `difference` is the design's rate there minus the control's."""

    n: Count
    rate: Share
    interval: Interval
    confidence: Share
    difference: Finite
    difference_interval: SignedInterval


class ConditionClaim(StrictModel):
    """What a photograph can show of one promised condition, and whether it was recognized."""

    px_per_mm: Annotated[Finite, Field(ge=0, le=1e4)] | None
    tilt_deg: Annotated[Finite, Field(ge=0, le=180)] | None
    azimuth_deg: Annotated[Finite, Field(ge=-360, le=360)] | None
    contrast: Annotated[Finite, Field(ge=-4, le=4)] | None
    blur_px: Annotated[Finite, Field(ge=0, le=1000)] | None
    recognized: bool


class Promise(StrictModel):
    """The predicted rate of the primary (first) model, made before printing: of `n` conditions, `per_session` in a row
    of one session. `places` has a number for each session's place where some share one. A `draft` was made of few
    conditions, to try things out. `outermost_mm` are the object's outermost points in the piece's frame, where a
    detector's boxes are compared with it.
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

    @model_validator(mode="after")
    def _says_all_conditions(self) -> Promise:
        if len(self.conditions) != self.n:
            raise ValueError(f"must say all of its {self.n} conditions, not {len(self.conditions)}")
        return self

    @property
    def sessions(self) -> int:
        """How many sessions it was made of."""
        return -(-self.n // self.per_session)

    @cached_property
    def spread(self) -> RatePosterior:
        """What its conditions say of photographs to come."""
        hits = [condition.recognized for condition in self.conditions]
        places = self.places if len(self.places) == self.sessions else ()
        return rate_posterior(*count_by_session(hits, self.per_session, places))

    @property
    def best_control(self) -> str:
        """The control that is hardest to beat."""
        return max(self.controls, key=lambda name: self.target.goal.sign * self.controls[name].rate)

    @property
    def worth(self) -> Comparison:
        """The design beside its best control: "better" or "worse" where the interval of their difference says so."""
        ends = [self.target.goal.sign * end for end in self.controls[self.best_control].difference_interval]
        return "better" if min(ends) > 0 else "worse" if max(ends) < 0 else "no better"

    @property
    def hint(self) -> str:
        """How a draft's sentences begin."""
        return f"Draft of {self.n} views, no more than a hint: " if self.draft else ""

    @property
    def headline(self) -> str:
        """What the design is worth, in a sentence; the rates are those of the views that both were shown in."""
        control = self.controls[self.best_control]
        low, high = (100 * end for end in control.difference_interval)
        advice = "" if self.worth == "better" else " Try another place, size or seed before printing it."
        rate = control.rate + control.difference
        shared = "" if abs(rate - self.rate) < 5e-4 else " in the same views"
        points = f"{100 * control.difference:+.1f} points [{low:+.1f}, {high:+.1f}]"
        return (
            f"{self.hint}{self.worth} than its best control ({self.best_control}): {rate:.1%} beside "
            f"{control.rate:.1%} recognized{shared}, {points}.{advice}"
        )

    def figures(self) -> dict[str, str]:
        """The target, rate, interval and controls as text, in the order to be read."""
        rows = {"target": f"{self.target.goal} {self.target.label}", "network": self.models[0].name}
        rows |= {f"recognized in {self.n} views": rate_text(self.rate, self.interval)}
        return rows | {kind: rate_text(claim.rate, claim.interval) for kind, claim in self.controls.items()}

    def _repr_html_(self) -> str:
        """The promise in a notebook."""
        return notebook_html(self.headline, self.figures())


_table: Any = create_model  # its types leave unions out
# What is read of a manifest's settings when its sheet is judged; other keys may say anything.
_Used = _table(
    "_Used",
    printer=(_table("_Printer", profile=(str, "")) | None, None),
    camera=(_table("_Camera", noise=(NotNegativeRange, ()), photo_px=(tuple[Count, Count] | None, None)), None),
    target=(_table("_Target", label=(str | int, ""), accept=(tuple[str | int, ...], ())), None),
    sheet=(_table("_Sheet", template=(str, "")), None),
    imported=(_table("_Imported", file=str, sha256=str) | None, None),  # a design that was made elsewhere
)


class Manifest(StrictModel):
    """A whole SHEET.json; `design` is null on pages that carry none, `promise` on pages that promise nothing."""

    version: Literal[2]
    sheet_id: Annotated[str, Field(pattern="^[0-9A-Z]{10}$")]
    kind: str  # "design", or a control: "mean", "gray", "noise", "shuffled", "blank"
    page_mm: tuple[SizeMm, SizeMm]
    design: Design | None
    markers: Annotated[tuple[Marker, ...], Field(min_length=1)]
    chart: tuple[Swatch, ...]
    cut_mm: Rect
    ruler_mm: tuple[SizeMm, SizeMm]
    page_code: Annotated[str, Field(pattern=PAGE_CODE)] | None = None  # of a page that several designs share
    plan_page: Page | None = None  # the page for people: where the piece goes, and how to photograph it
    tiles: tuple[Tile, ...] = ()
    promise: Promise | None
    settings: dict[str, Any]

    @field_validator("settings")
    @classmethod
    def _usable(cls, settings: dict[str, Any]) -> dict[str, Any]:
        _Used.model_validate(settings)
        return settings

    @model_validator(mode="after")
    def _design_fills_the_piece(self) -> Manifest:
        if self.design is not None and self.design.rect_mm != self.cut_mm:
            raise ValueError("make the sheet again: design.rect_mm is not cut_mm, and a design fills its piece")
        return self

    def page_from_design_page(self, page: int) -> np.ndarray:
        """3×3 from the millimeters that a piece of tiles has, those of the design's page (the first tile's without a
        design), to another tile's; pages without a tile keep their own.
        """
        square = {tile.page: np.vstack([np.array(tile.page_from_design_mm), [0, 0, 1]]) for tile in self.tiles}
        if page not in square:
            return np.eye(3)
        return square[page] @ np.linalg.inv(square[self.design.page if self.design else self.tiles[0].page])


def design_sha256(pixels: np.ndarray) -> str:
    """SHA-256 of uint8 H×W×3 pixels, row by row."""
    return hashlib.sha256(np.ascontiguousarray(pixels, np.uint8).tobytes()).hexdigest()


def dump_manifest(manifest: Manifest) -> str:
    """Its JSON text: the same manifest gives the same bytes."""
    return json.dumps(manifest.model_dump(), indent=1, allow_nan=False) + "\n"


def load_manifest(path: str | Path) -> Manifest:
    """A SHEET.json; refused in one sentence where it is missing, broken, or not one."""
    beside = "name the JSON that was written beside the PDF"
    data = read_json(path, "a manifest (SHEET.json)", "make the sheet again", beside)
    return validate_model(Manifest, data, str(path))
