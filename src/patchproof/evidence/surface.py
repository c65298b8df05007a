"""What a manifest says about the printed surface, as the judge needs it: where things lie, how they should look.

In: a manifest and a printer model. Out: `Surface` (millimetres) and `Promised` (media-relative linear light: paper is
1). Only the page that carries the design counts. A piece in tiles is one surface when assembled, in the millimetres of
the design's page; each of its pages is another, by which scans and photographs of it are known.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from patchproof.color import linear_from_srgb
from patchproof.geometry import rect_corners
from patchproof.photo.detect import cells_of
from patchproof.photo.label import Label, label_of
from patchproof.sheets.manifest import Manifest

if TYPE_CHECKING:
    from patchproof.channel.printer import Printer

_LARGEST_PX = 512  # of the design as it is compared; photographs never resolve more
_LARGEST_PIECE_PX = 1024  # of the piece as it is put back


@dataclass(frozen=True)
class Surface:
    """Markers 4×2 mm by id (`piece_ids`: those inside the cut), rectangles in mm, the piece's swatches sRGB N×3."""

    dictionary: str
    corners_mm: dict[int, np.ndarray]
    piece_ids: frozenset[int]
    rect_mm: tuple[float, float, float, float]
    center_mm: tuple[float, float]
    piece_mm: tuple[float, float, float, float]
    swatch_rects_mm: tuple[tuple[float, float, float, float], ...]
    swatches_srgb: np.ndarray
    label: Label  # what the page's code says
    page_mm: tuple[float, float] | None  # None where the code lies on another page than the design
    pages: tuple[Surface, ...] = ()  # of a piece in tiles: each uncut page, which carries no piece ids

    @property
    def all_ids(self) -> frozenset[int]:
        """Its own markers and those of its pages."""
        return frozenset(self.corners_mm).union(*(page.corners_mm for page in self.pages))

    @property
    def page_ids(self) -> frozenset[int]:
        """Markers of the page outside of the cut."""
        return frozenset(self.corners_mm) - self.piece_ids


@dataclass(frozen=True)
class Promised:
    """Linear light as the printer model has it: design H×W×3, swatches N×3, marker ink (3,)."""

    design: np.ndarray
    swatches: np.ndarray
    ink: np.ndarray


def surface_of(manifest: Manifest) -> Surface:
    """The surface of the design's page; without a design, of the first page with markers, measured over the cut."""
    if manifest.tiles:
        return _assembled(manifest)
    page = manifest.design.page if manifest.design else min(m.page for m in manifest.markers)
    corners = {m.id: np.array(m.corners_mm) for m in _known(manifest) if m.page == page}
    piece = frozenset(i for i, c in corners.items() if _inside(manifest.cut_mm, c))
    swatches = [s for s in manifest.chart if s.page == page and _inside(manifest.cut_mm, rect_corners(s.rect_mm))]
    rect = manifest.design.rect_mm if manifest.design else manifest.cut_mm
    rects, colors = [s.rect_mm for s in swatches], [s.srgb for s in swatches]
    return _surface(manifest, corners, piece, rect, rects, colors)


def _assembled(manifest: Manifest) -> Surface:
    """The piece glued together, in the millimetres of the design's page (the first tile's without a design)."""
    page = manifest.design.page if manifest.design else manifest.tiles[0].page
    to_page, cuts = _page_from_pages(manifest, page), {tile.page: tile.cut_mm for tile in manifest.tiles}
    markers = [m for m in _known(manifest) if m.page in cuts]
    carried = {m.id: _carry(to_page[m.page], m.corners_mm) for m in markers}
    shown = frozenset(m.id for m in markers if _inside(cuts[m.page], np.array(m.corners_mm)))
    swatches = [s for s in manifest.chart if s.page in cuts]
    pages = [
        _surface(manifest, {m.id: carried[m.id] for m in markers if m.page == number}, frozenset(), rect)
        for number, rect in ((n, _carry_rect(to_page[n], cut)) for n, cut in cuts.items())
    ]
    for number in sorted({m.page for m in _known(manifest)} - set(cuts)):  # the page with the chart
        corners = {m.id: np.array(m.corners_mm) for m in _known(manifest) if m.page == number}
        low, high = np.concatenate(list(corners.values())).min(0), np.concatenate(list(corners.values())).max(0)
        pages.append(_surface(manifest, corners, frozenset(), tuple(float(v) for v in (*low, *(high - low)))))
    piece = {i: c for i, c in carried.items() if i in shown}
    rect = manifest.design.rect_mm if manifest.design else manifest.cut_mm
    rects, colors = [_carry_rect(to_page[s.page], s.rect_mm) for s in swatches], [s.srgb for s in swatches]
    return _surface(manifest, piece, shown, rect, rects, colors, tuple(pages))


def _surface(manifest, corners, piece, rect, swatch_rects=(), colors=(), pages=()) -> Surface:
    return Surface(
        manifest.markers[0].dictionary,
        corners,
        piece,
        rect,
        (rect[0] + rect[2] / 2, rect[1] + rect[3] / 2),
        manifest.cut_mm,
        tuple(swatch_rects),
        np.array(colors).reshape(-1, 3),
        label_of(manifest),
        None if manifest.tiles else manifest.page_mm,
        pages,
    )


def promised_of(manifest: Manifest, surface: Surface, printer: Printer) -> Promised | None:
    """How design, swatches and ink should look; None on pages without a design."""
    import torch

    def printed(srgb: np.ndarray) -> np.ndarray:
        tensor = torch.from_numpy(np.ascontiguousarray(srgb.transpose(2, 0, 1), np.float32))[None]
        with torch.inference_mode():
            return linear_from_srgb(printer.apply(tensor)[0].numpy().transpose(1, 2, 0).astype(float))

    if manifest.design is None:
        return None
    swatches = printed(np.concatenate([surface.swatches_srgb, [[0.0, 0.0, 0.0]]])[None])[0]
    return Promised(reduced(printed(manifest.design.pixels() / 255.0)), swatches[:-1], swatches[-1])


def piece_picture(surface: Surface, design: np.ndarray, swatches: np.ndarray, ink: np.ndarray) -> np.ndarray:
    """The whole piece, frame and all, as float32 linear light H×W×3 over `piece_mm`: white paper and what is on it.

    Scissors, folds and what a shop adds beside the frame are left out. Edges fall on whole pixels.
    """
    x, y, w, h = surface.piece_mm
    px_per_mm = _LARGEST_PIECE_PX / max(w, h)
    picture = np.ones((max(1, round(h * px_per_mm)), max(1, round(w * px_per_mm)), 3), np.float32)

    def paste(rect, pixels: np.ndarray, how: int) -> None:
        corners = (np.array(rect_corners(rect))[[0, 2]] - (x, y)) * px_per_mm
        (x0, y0), (x1, y1) = np.clip(np.rint(corners), 0, picture.shape[1::-1]).astype(int)
        if x1 > x0 and y1 > y0:
            size = int(x1 - x0), int(y1 - y0)
            picture[y0:y1, x0:x1] = cv2.resize(pixels.astype(np.float32), size, interpolation=how)

    ids = sorted(surface.piece_ids)
    printed = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, surface.dictionary))
    for i, cells in zip(ids, cells_of(printed, ids) if ids else (), strict=True):
        low, high = surface.corners_mm[i].min(0), surface.corners_mm[i].max(0)
        paste((*low, *(high - low)), ink + cells[..., None] * (1 - ink), cv2.INTER_NEAREST)
    for rect, color in zip(surface.swatch_rects_mm, swatches, strict=True):
        paste(rect, color[None, None], cv2.INTER_NEAREST)
    paste(surface.rect_mm, design, cv2.INTER_AREA)
    return picture


def reduced(linear: np.ndarray) -> np.ndarray:
    """A design's light H×W×3 at the size at which it is compared, float32."""
    linear = linear.astype(np.float32)
    shrink = _LARGEST_PX / max(linear.shape[:2])
    if shrink >= 1:
        return linear
    size = max(1, round(linear.shape[1] * shrink)), max(1, round(linear.shape[0] * shrink))
    return cv2.resize(linear, size, interpolation=cv2.INTER_AREA)


def _known(manifest: Manifest) -> list:
    return [m for m in manifest.markers if m.dictionary == manifest.markers[0].dictionary]


def _inside(rect, points: np.ndarray) -> bool:
    x, y, w, h = rect
    return bool((points >= [x, y]).all() and (points <= [x + w, y + h]).all())


def _carry_rect(matrix, rect) -> tuple[float, float, float, float]:
    (x0, y0), _, (x1, y1), _ = _carry(matrix, rect_corners(rect)).tolist()
    return x0, y0, x1 - x0, y1 - y0


def _carry(matrix, points) -> np.ndarray:
    return np.asarray(points, float) @ matrix[:, :2].T + matrix[:, 2]


def _page_from_pages(manifest: Manifest, page: int) -> dict[int, np.ndarray]:
    """2×3 maps from each tile's millimetres to those of `page`."""
    square = {t.page: np.vstack([np.array(t.page_from_design_mm), [0, 0, 1]]) for t in manifest.tiles}
    return {number: (square[page] @ np.linalg.inv(matrix))[:2] for number, matrix in square.items()}
