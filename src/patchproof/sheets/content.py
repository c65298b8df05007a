"""The content of a sheet: a piece with its design and promise, and the texts on the cut piece.

In: a piece, the design's pixels, the promise. Out: the texts and the QR code of its page, and its `Manifest`. The texts
on the piece lie in the outer millimeter of the corner markers' white, so that markers keep their module of white and
the design its pixels. They may be lost in cutting, and no measurement depends on them. Capitals of 0.7 mm are legible
at reading distance; higher ones would reach into the markers' quiet zones, and losing half of a quiet zone costs 0.1 mm
of a measured corner.
"""

import base64
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from patchproof.base.output import image_bytes
from patchproof.sheets.layout import CAP_HEIGHT, Box, Line, PageLayout, PageParts, text_width_mm
from patchproof.sheets.manifest import Design, Manifest, Promise, Swatch, design_sha256
from patchproof.sheets.piece import SCISSORS_MM, Piece, manifest_marker, whiten_marker_pixels
from patchproof.sheets.rects import PointMm, RectMm, size_text
from patchproof.sheets.template import AnyTemplate, Template, TextLine

SIZE_MM = 0.95  # font size
_CAPS_MM = SIZE_MM * CAP_HEIGHT
_ABOVE_MM = (SCISSORS_MM - _CAPS_MM) / 2  # capitals, and below them
KEEP_MARKERS = " Keep the squares in their white corners: they are part of the piece."
_INSET_MM = 0.4  # from the sides of the white: ten of the widest letters still fit beside an 8 mm marker
_ARROW_MM = 0.9  # width of the arrow and the space after it


@dataclass(frozen=True, eq=False)
class SheetContent:
    """A piece and its design: uint8 H×W×3, which becomes white at markers, or None for white paper. `kind` is "design",
    or the name of a control.
    """

    piece: Piece
    sheet_id: str
    kind: str
    design_srgb8: np.ndarray | None
    promise: Promise | None = None
    settings: dict[str, Any] = field(default_factory=dict)
    bent: bool = False  # it is wrapped around the object

    def __post_init__(self):
        if self.design_srgb8 is not None:
            object.__setattr__(self, "design_srgb8", whiten_marker_pixels(self.design_srgb8, self.piece))

    @property
    def code(self) -> str:
        """The QR code's text: the sheet's id, and 16 digits of the design's SHA-256 or the kind if there is none."""
        content = self.kind if self.design_srgb8 is None else design_sha256(self.design_srgb8)[:16]
        return f"patchproof:{self.sheet_id}:{content}"

    @property
    def name(self) -> str:
        """A name for people: the kind and the target's label."""
        label = (self.settings.get("target") or {}).get("label")
        return self.kind if label is None else f"{self.kind} · {label}"

    @property
    def words(self) -> dict[str, str]:
        """Values of the placeholders in a template's text."""
        size, kind = size_text(self.piece.size_mm), self.kind
        if self.promise is not None and self.promise.answer != "helps":
            does_not = self.promise.target.goal.words["does_not_help"]
            kind = f"{kind}, {does_not if self.promise.answer == 'does_not_help' else 'effect unknown'}"
        if self.promise is not None and self.promise.draft:
            kind = f"draft {kind}"
        fix = "Wrap the piece smoothly round the object" if self.bent else "Fix the piece flat on the object"
        keep = KEEP_MARKERS if self.piece.markers else ""
        return {"sheet_id": self.sheet_id, "kind": kind, "design": size, "piece": size, "fix": fix, "keep": keep}

    def pictures(self, rect_mm: RectMm) -> tuple[tuple[RectMm, np.ndarray], ...]:
        """The design at `rect_mm` as the pictures of a page; none for white paper."""
        return () if self.design_srgb8 is None else ((rect_mm, self.design_srgb8),)

    def manifest(self, page: PageLayout, template: Template | None, cut_mm: RectMm, design_page: int = 1) -> Manifest:
        """The manifest of the page, with the design within the cut line."""
        fields = {"sheet_id": self.sheet_id, "kind": self.kind, "settings": self.settings}
        design, pixels = None, self.design_srgb8
        if pixels is not None:
            sha256, size_px, png = design_sha256(pixels), pixels.shape[1::-1], png_base64(pixels)
            design = Design(sha256=sha256, rect_mm=cut_mm, size_px=size_px, page=design_page, png=png)
        return page_manifest(page, template, cut_mm, **fields).changed(design=design, promise=self.promise)


def page_manifest(page: PageLayout, template: AnyTemplate | None, cut_mm: RectMm, **fields: Any) -> Manifest:
    """The manifest of a page without a design; without a template the print's own sides are the rulers."""
    return Manifest(
        version=2,
        page_mm=page.page_mm,
        design=None,
        markers=tuple(manifest_marker(marker) for marker in page.markers),
        chart=tuple(Swatch(rect_mm=rect, srgb=srgb, page=1) for rect, srgb in page.swatches),
        cut_mm=cut_mm,
        ruler_mm=(template.ruler.length_mm, template.ruler.length_mm) if template else page.page_mm,
        promise=None,
        **fields,
    )


def png_base64(pixels: np.ndarray) -> str:
    """Encode uint8 H×W×3 pixels as a PNG in base64."""
    return base64.b64encode(image_bytes(pixels, "PNG", {"optimize": True})).decode()


def piece_words(content: SheetContent, corner: PointMm, holder: str = "piece") -> PageParts:
    """An arrow and "TOP" above the top-left marker, the sheet's id above the top-right one, and as much of the name as
    fits below the bottom-left one; `holder` is the name of the part of the page that contains them.
    """
    if not content.piece.markers:  # the design fills the piece
        return PageParts()
    top_left, top_right, _, bottom_left = content.piece.reserved_mm[:4]
    lines, texts, boxes = [], [], []
    for rect, text in ((top_left, "TOP"), (top_right, content.sheet_id), (bottom_left, content.name.upper())):
        arrow_mm = _ARROW_MM if rect is top_left else 0
        text = _shorten(text, rect[2] - 2 * _INSET_MM - arrow_mm)
        # in the middle of the outer millimeter of the white at the cut line
        y = _ABOVE_MM if rect[1] < SCISSORS_MM else rect[1] + rect[3] - _ABOVE_MM - _CAPS_MM
        left, top = corner[0] + rect[0] + _INSET_MM, corner[1] + y
        if arrow_mm:
            lines += _arrow(left, top)
        start, width = left + arrow_mm, text_width_mm(text, SIZE_MM, True)
        texts.append(TextLine(at_mm=(start, top + _CAPS_MM), size_mm=SIZE_MM, text=text, bold=True, gray=0.2))
        boxes.append(Box(f'words "{text}" of {holder}', (left, top, start + width - left, _CAPS_MM), holder))
    return PageParts(tuple(lines), tuple(texts), tuple(boxes))


def _arrow(left: float, top: float) -> list[Line]:
    """An arrow that points up, as high as capitals."""
    half = 0.25
    middle, tip = left + half, top + 0.05
    ends = ((middle, top + _CAPS_MM), (left, tip + half), (left + 2 * half, tip + half))
    return [Line((*end, middle, tip), 0.2) for end in ends]


def _shorten(text: str, width_mm: float) -> str:
    """As much of the text as fits into the width, with an ellipsis if it is cut."""
    if text_width_mm(text, SIZE_MM, True) <= width_mm:
        return text
    while text and text_width_mm(f"{text}…", SIZE_MM, True) > width_mm:
        text = text[:-1].rstrip()
    return f"{text}…" if text else ""
