"""What a sheet carries: the piece with its design, and the manifest that says where everything lies.

In: a piece, the design's pixels, the promise. Out: the words and the code of its page, and a `Manifest`.
"""

from __future__ import annotations

import base64
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from patchproof.base.errors import Refused
from patchproof.base.output import image_bytes
from patchproof.sheets.layout import PageLayout
from patchproof.sheets.manifest import Design, Manifest, Promise, Swatch, design_sha256
from patchproof.sheets.piece import Piece, manifest_marker, whiten_marker_pixels
from patchproof.sheets.rects import RectMm, size_text
from patchproof.sheets.template import BoardTemplate, Template


@dataclass(frozen=True, eq=False)
class SheetContent:
    """A piece and what belongs to it; `design_srgb8` is uint8 H×W×3, or None for white paper. Other pixels are refused,
    and those that the markers need become white.

    `kind` is "design", or the control that it is.
    """

    piece: Piece
    sheet_id: str
    kind: str
    design_srgb8: np.ndarray | None
    promise: Promise | None = None
    settings: dict[str, Any] = field(default_factory=dict)
    bent: bool = False  # goes round the object

    def __post_init__(self):
        pixels = self.design_srgb8
        if pixels is None:
            return
        if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] != 3 or not pixels.size:
            raise Refused("a design of uint8 H×W×3 pixels", f"{pixels.dtype} {pixels.shape}", "convert it to 8-bit RGB")
        object.__setattr__(self, "design_srgb8", whiten_marker_pixels(pixels, self.piece))

    @property
    def code(self) -> str:
        """What the QR code says: the sheet's id and 16 digits of the design's SHA-256, or the kind without one."""
        content = self.kind if self.design_srgb8 is None else design_sha256(self.design_srgb8)[:16]
        return f"patchproof:{self.sheet_id}:{content}"

    @property
    def name(self) -> str:
        """What the piece is, for whoever finds it: its kind and the target's label."""
        label = (self.settings.get("target") or {}).get("label")
        return self.kind if label is None else f"{self.kind} · {label}"

    @property
    def words(self) -> dict[str, str]:
        """What a template's words stand for on its page."""
        size, kind = size_text(self.piece.size_mm), self.kind
        if self.promise is not None and self.promise.worth != "better":
            kind = f"{kind}, {self.promise.worth} than {self.promise.best_control}"
        if self.promise is not None and self.promise.draft:
            kind = f"draft {kind}"
        fix = "Wrap the piece smoothly round the object" if self.bent else "Fix the piece flat on the object"
        return {"sheet_id": self.sheet_id, "kind": kind, "design": size, "piece": size, "fix": fix}

    def pictures(self, rect_mm: RectMm) -> tuple[tuple[RectMm, np.ndarray], ...]:
        """The design in that rectangle, or nothing."""
        return () if self.design_srgb8 is None else ((rect_mm, self.design_srgb8),)

    def manifest(self, page: PageLayout, template: Template, cut_mm: RectMm, design_page: int = 1) -> Manifest:
        """The manifest of its page, and of its design within the cut line."""
        manifest = page_manifest(page, template, cut_mm, self.sheet_id, self.kind, self.settings)
        design, pixels = None, self.design_srgb8
        if pixels is not None:
            sha256, size_px, png = design_sha256(pixels), pixels.shape[1::-1], png_base64(pixels)
            design = Design(sha256=sha256, rect_mm=cut_mm, size_px=size_px, page=design_page, png=png)
        return manifest.changed(design=design, promise=self.promise)


def page_manifest(
    page: PageLayout,
    template: Template | BoardTemplate,
    cut_mm: RectMm,
    sheet_id: str,
    kind: str,
    settings: dict[str, Any],
) -> Manifest:
    """The manifest of a sheet's one page, without a design."""
    return Manifest(
        version=2,
        sheet_id=sheet_id,
        kind=kind,
        page_mm=page.page_mm,
        design=None,
        markers=tuple(manifest_marker(marker) for marker in page.markers),
        chart=tuple(Swatch(rect_mm=rect, srgb=srgb, page=1) for rect, srgb in page.swatches),
        cut_mm=cut_mm,
        ruler_mm=(template.ruler.length_mm, template.ruler.length_mm),
        promise=None,
        settings=settings,
    )


def png_base64(pixels: np.ndarray) -> str:
    """uint8 H×W×3 pixels as a PNG in base64."""
    return base64.b64encode(image_bytes(pixels, "PNG", {"optimize": True})).decode()
