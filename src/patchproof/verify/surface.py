"""What a manifest says about the printed surface, as the judge needs it: where things lie, how they should look.

In: a manifest and a printer model. Out: `Surface` (millimetres) and `Promised` (media-relative linear light: paper is
1). Only the page that carries the design counts; the pages of a tiled piece are brought into that page's millimetres.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from patchproof.color import linear_from_srgb
from patchproof.photo.label import Label, label_of
from patchproof.sheet.manifest import Manifest

_LARGEST_PX = 512  # of the design as it is compared; photographs never resolve more


@dataclass(frozen=True)
class Surface:
    """Markers 4×2 mm by id (`piece_ids`: those inside the cut), rectangles in mm, the piece's swatches sRGB N×3."""

    dictionary: str
    corners_mm: dict[int, np.ndarray]
    piece_ids: frozenset[int]
    rect_mm: tuple[float, float, float, float]
    center_mm: tuple[float, float]
    swatch_rects_mm: tuple[tuple[float, float, float, float], ...]
    swatches_srgb: np.ndarray
    label: Label  # what the page's code says
    page_mm: tuple[float, float] | None  # None where the code lies on another page than the design

    @property
    def page_ids(self) -> frozenset[int]:
        """Markers of the page outside of the cut."""
        return frozenset(self.corners_mm) - self.piece_ids


@dataclass(frozen=True)
class Promised:
    """Linear light as the printer model has it: design H×W×3 (None on pages without), swatches N×3, marker ink (3,)."""

    design: np.ndarray | None
    swatches: np.ndarray
    ink: np.ndarray


def surface_of(manifest: Manifest) -> Surface:
    """The surface of the design's page; without a design, of the first page with markers, measured over the cut."""
    page = manifest.design.page if manifest.design else min(m.page for m in manifest.markers)
    to_page = _page_from_pages(manifest, page)
    markers = [m for m in manifest.markers if m.page in to_page and m.dictionary == manifest.markers[0].dictionary]
    corners = {m.id: _carry(to_page[m.page], m.corners_mm) for m in markers}
    x, y, w, h = manifest.cut_mm
    inside = lambda p: bool((p >= [x, y]).all() and (p <= [x + w, y + h]).all())  # noqa: E731
    # the frame of a tiled piece lies on several pages, around the design rather than inside of one page's cut
    piece = frozenset(corners) if manifest.tiles else frozenset(i for i, c in corners.items() if inside(c))
    swatches = [s for s in manifest.chart if s.page == page and inside(np.reshape(_ends(s.rect_mm), (2, 2)))]
    rect = manifest.design.rect_mm if manifest.design else manifest.cut_mm
    return Surface(
        manifest.markers[0].dictionary,
        corners,
        piece,
        rect,
        (rect[0] + rect[2] / 2, rect[1] + rect[3] / 2),
        tuple(s.rect_mm for s in swatches),
        np.array([s.srgb for s in swatches]).reshape(-1, 3),
        label_of(manifest),
        None if manifest.tiles else manifest.page_mm,
    )


def promised_of(manifest: Manifest, surface: Surface, printer) -> Promised:
    """How design, swatches and ink should look; `printer.apply` maps sRGB tensors N×3×H×W to media-relative sRGB."""
    import torch

    def printed(srgb: np.ndarray) -> np.ndarray:
        tensor = torch.from_numpy(np.ascontiguousarray(srgb.transpose(2, 0, 1), np.float32))[None]
        with torch.inference_mode():
            return linear_from_srgb(printer.apply(tensor)[0].numpy().transpose(1, 2, 0).astype(float))

    colors = np.concatenate([surface.swatches_srgb, [[0.0, 0.0, 0.0]]])[None]
    swatches = printed(colors)[0]
    design = None
    if manifest.design:
        design = printed(manifest.design.pixels() / 255.0).astype(np.float32)
        shrink = _LARGEST_PX / max(design.shape[:2])
        if shrink < 1:
            size = max(1, round(design.shape[1] * shrink)), max(1, round(design.shape[0] * shrink))
            design = cv2.resize(design, size, interpolation=cv2.INTER_AREA)
    return Promised(design, swatches[:-1], swatches[-1])


def _ends(rect):
    x, y, w, h = rect
    return [x, y, x + w, y + h]


def _carry(matrix, points) -> np.ndarray:
    return np.asarray(points, float) @ matrix[:, :2].T + matrix[:, 2]


def _page_from_pages(manifest: Manifest, page: int) -> dict[int, np.ndarray]:
    """2×3 maps from each page's millimetres to those of `page`."""
    square = {t.page: np.vstack([np.array(t.page_from_design_mm), [0, 0, 1]]) for t in manifest.tiles}
    if page not in square:
        return {page: np.eye(3)[:2]}
    return {number: (square[page] @ np.linalg.inv(matrix))[:2] for number, matrix in square.items()}
