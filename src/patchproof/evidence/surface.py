"""Geometry and colors of the printed surface, promised and as photographs show them.

In: a manifest and a printer model. Out: `Surface` (millimeters) and `PromisedColors` (media-relative linear light:
paper is 1). Only the page that carries the design counts. A piece in tiles is one surface when assembled, in the
millimeters of the design's page; each of its uncut pages is another surface, to recognize scans and photographs of it.

How the colors of this print differ from those that the promise's printer would have made is fitted to the cells of the
design in several photographs, as fine as each resolves: the print's ink and what each photograph makes of its light
(`channel.print_colors`), or nothing if the design's colors are too few or too alike. All photographs show one print:
light and noise differ from photo to photo, ink does not.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from patchproof.base.color import LUMINANCE, linear_from_srgb
from patchproof.base.errors import Refused
from patchproof.base.geometry import apply_homography, is_inside, rect_corners
from patchproof.base.resample import downscale
from patchproof.channel.print_colors import CellColors, added_terms, choose_cells
from patchproof.photo.detect import LINEAR_FLOAT32_FROM_CODE
from patchproof.photo.quality import CLIPPED_CODE, FrameLight
from patchproof.photo.rectify import least_px_per_mm, rectified_px, rectify, resize_by_area
from patchproof.sheets.manifest import Manifest, Rect
from patchproof.sheets.markers import DICTIONARY, MARKER_MODULES
from patchproof.sheets.piece import Piece, marker_image, marker_rect, square_marker

if TYPE_CHECKING:
    from patchproof.channel.printer import Printer

DESIGN_PX = 512  # of the design as it is compared; photographs never resolve more
_LARGEST_PIECE_PX = 1024  # of the piece as it is rendered into photographs
LEAST_CELLS = 30  # of a photograph: three for each coefficient of a channel
# Terms of cells that mix few colors have as few dimensions; of the sixth, the least share of the first's spread.
_LEAST_COLORS, _LEAST_SPREAD = 6, 1e-3
_CELLS = (16, 96)  # least and most along the design's shorter side
_LEAST_CELL_PX = 2.0
_PIXEL_BLUR_PX = 0.7  # of a pixel's own area and of interpolating between pixels
_MOST_CLIPPED = 0.05  # of a cell's pixels
_LEAST_LIGHT = 0.3  # promised of cells that tell the light of paper where there is none


@dataclass(frozen=True)
class Surface:
    """Markers' corners (4×2 mm) by id, `piece_ids` of those inside the cut, and `rect_mm`: the piece, which the design
    fills, or the part of it on one page of tiles.
    """

    dictionary: str
    corners_mm: dict[int, np.ndarray]
    piece_ids: frozenset[int]
    rect_mm: Rect
    label: str  # the text of the page's code
    page_mm: tuple[float, float] | None  # None if the code is on another page than the design
    pages: "tuple[Surface, ...]" = ()  # of a piece in tiles: each uncut page, which carries no piece ids
    bent: bool = False  # True if the piece was made to follow a curved surface
    outermost_mm: np.ndarray | None = None  # the object's outermost points P×3, for its box; z into the paper
    fov_deg: float = 45.0  # of the promised photographs, for those whose focal length is not known

    @property
    def without_markers(self) -> "Surface":
        """The surface of the same piece for photographs in which it is located by its design."""
        return replace(self, corners_mm={}, piece_ids=frozenset(), pages=())

    @property
    def is_piece(self) -> bool:
        """False for a page of a piece in tiles that has none of the piece's markers."""
        return bool(self.piece_ids) or not self.corners_mm

    @property
    def center_mm(self) -> tuple[float, float]:
        """The middle of the design."""
        x, y, w, h = self.rect_mm
        return x + w / 2, y + h / 2

    @property
    def page_ids(self) -> frozenset[int]:
        """Ids of the page's markers outside of the cut."""
        return frozenset(self.corners_mm) - self.piece_ids

    def on_marker(self, points_mm: np.ndarray, margin_mm: float) -> np.ndarray:
        """True for points N×2 within a marker of the piece, its quiet zone or the margin about it."""
        if not self.piece_ids:
            return np.zeros(len(points_mm), bool)
        markers = np.stack([self.corners_mm[i] for i in sorted(self.piece_ids)])
        margin = np.ptp(markers, axis=1) / MARKER_MODULES + margin_mm
        low, high = markers.min(1) - margin, markers.max(1) + margin
        return ((points_mm[:, None] > low) & (points_mm[:, None] < high)).all(2).any(1)


@dataclass(frozen=True)
class PromisedColors:
    """Linear light by the printer model: of the design with the markers that lie on it (H×W×3), of marker ink (3,)."""

    design: np.ndarray
    ink: np.ndarray


def surface_of(manifest: Manifest) -> Surface:
    """The surface of the design's page, or without a design of the first page with markers; its rectangle is the cut.
    Refused if the design's page has no markers, or is none of the tiles.
    """
    if not manifest.markers:
        return _surface(manifest, {}, frozenset(), manifest.cut_mm)
    pages = {tile.page for tile in manifest.tiles} or set(_corners_by_page(manifest))
    page = manifest.design.page if manifest.design else min(pages)
    if page not in pages:
        got = f"page {page} of a sheet with {', '.join(map(str, sorted(pages)))}"
        raise Refused("a design on a page with markers, or on a tile", got, "make the sheet again")
    if manifest.tiles:
        return _assembled(manifest)
    corners = _corners_by_page(manifest)[page]
    piece = frozenset(i for i, c in corners.items() if is_inside(c, manifest.cut_mm).all())
    return _surface(manifest, corners, piece, manifest.cut_mm)


def _assembled(manifest: Manifest) -> Surface:
    """The surface of a piece glued together, in mm of the design's page, or without a design of the first tile's."""
    to_page = {tile.page: np.linalg.inv(manifest.page_from_design_page(tile.page)) for tile in manifest.tiles}
    cuts, corners = {tile.page: tile.cut_mm for tile in manifest.tiles}, _corners_by_page(manifest)
    piece, pages = {}, []
    for number, cut in cuts.items():
        page_corners = {i: apply_homography(to_page[number], c) for i, c in corners.get(number, {}).items()}
        piece |= {i: page_corners[i] for i, c in corners.get(number, {}).items() if is_inside(c, cut).all()}
        (x0, y0), _, (x1, y1), _ = apply_homography(to_page[number], rect_corners(cut)).tolist()
        pages.append(_surface(manifest, page_corners, frozenset(), (x0, y0, x1 - x0, y1 - y0)))
    for number in sorted(corners.keys() - cuts.keys()):  # the page with the chart
        points = np.concatenate(list(corners[number].values()))
        x, y, w, h = (float(v) for v in (*points.min(0), *np.ptp(points, axis=0)))
        pages.append(_surface(manifest, corners[number], frozenset(), (x, y, w, h)))
    return _surface(manifest, piece, frozenset(piece), manifest.cut_mm, tuple(pages))


def _surface(manifest: Manifest, corners, piece_ids, rect_mm, pages=()) -> Surface:
    (left, top, *_), outermost = manifest.cut_mm, manifest.promise and manifest.promise.outermost_mm
    return Surface(
        dictionary=manifest.markers[0].dictionary if manifest.markers else DICTIONARY,
        corners_mm=corners,
        piece_ids=piece_ids,
        rect_mm=rect_mm,
        label=manifest.code,
        page_mm=None if manifest.tiles else manifest.page_mm,
        pages=pages,
        bent=(manifest.settings.get("patch") or {}).get("bend") is True,
        outermost_mm=np.array(outermost) + np.array([left, top, 0]) if outermost else None,
        fov_deg=(manifest.settings.get("view") or {}).get("fov_deg", 45.0),
    )


def promised_of(manifest: Manifest, surface: Surface, printer: "Printer") -> PromisedColors | None:
    """The promised colors of the sheet's design and ink; None without a design."""
    return None if manifest.design is None else printed_colors(manifest.design.pixels(), surface, printer)


def printed_colors(pixels: np.ndarray, surface: Surface, printer: "Printer") -> PromisedColors:
    """Colors that the printer model makes of a design (uint8 pixels H×W×3) in the sheet's place, and of its ink."""
    import torch

    def apply_printer(srgb: np.ndarray) -> np.ndarray:
        tensor = torch.from_numpy(np.ascontiguousarray(srgb.transpose(2, 0, 1), np.float32))[None]
        with torch.inference_mode():
            return linear_from_srgb(printer.apply(tensor)[0].numpy().transpose(1, 2, 0).astype(float))

    design, ink = apply_printer(pixels / 255.0).astype(np.float32), apply_printer(np.zeros((1, 1, 3)))[0, 0]
    return PromisedColors(downscale(with_markers(design, surface, ink), DESIGN_PX), ink)


def with_markers(design: np.ndarray, surface: Surface, ink: np.ndarray) -> np.ndarray:
    """Draw the markers that lie on the piece over the design's linear light H×W×3; `ink` is their black."""
    on_piece = {i: surface.corners_mm[i] for i in sorted(surface.piece_ids)}
    on_design = {i: corners for i, corners in on_piece.items() if is_inside(corners, surface.rect_mm).all()}
    if not on_design:
        return design
    zoom = max(1, DESIGN_PX // max(design.shape))  # markers need more pixels than a small design has
    design = design.repeat(zoom, 0).repeat(zoom, 1)  # a copy
    x, y, *size_mm = surface.rect_mm
    markers = tuple(square_marker(i, tuple(c[0] - (x, y)), float(c[1, 0] - c[0, 0])) for i, c in on_design.items())
    piece = Piece((size_mm[0], size_mm[1]), markers, marker_rect(markers[0])[2] / MARKER_MODULES)
    image, reserved = marker_image(piece, (design.shape[1], design.shape[0]))
    design[reserved] = (ink + linear_from_srgb(image[reserved]) * (1 - ink)).astype(np.float32)
    return design


def piece_picture(surface: Surface, design: np.ndarray) -> np.ndarray:
    """Resize a design of `with_markers` to the piece's shape: float32 linear light H×W×3 of at most 1024 pixels.

    Left out: inaccurate cuts, folds and anything that a print shop adds.
    """
    size_px = rectified_px(surface.rect_mm, _LARGEST_PIECE_PX / max(surface.rect_mm[2:]))
    return cv2.resize(design.astype(np.float32), size_px, interpolation=cv2.INTER_AREA)


def _corners_by_page(manifest: Manifest) -> dict[int, dict[int, np.ndarray]]:
    """Corners by page and id of the markers that have the first marker's dictionary."""
    pages: dict[int, dict[int, np.ndarray]] = {}
    for marker in manifest.markers:
        if marker.dictionary == manifest.markers[0].dictionary:
            pages.setdefault(marker.page, {})[marker.id] = np.array(marker.corners_mm)
    return pages


@dataclass(frozen=True)
class PhotographedDesign:
    """The design in one photograph: light of its cells h×w×3, NaN where unread, their blur in cells, paper and ink;
    `anchored` if paper and ink were seen beside it, not inferred from what was promised.
    """

    cells: np.ndarray
    blur_cells: float
    light: FrameLight
    anchored: bool = True

    @property
    def readable(self) -> int:
        """The number of cells that were read, without the rim."""
        return int(np.isfinite(self.cells[1:-1, 1:-1]).all(-1).sum())


def choose_photo_cells(photos: Sequence[PhotographedDesign], promised: PromisedColors) -> list[CellColors] | None:
    """Choose each photograph's cells for the fit; None if they are too few, or their colors too few or too alike."""
    if not photos or min(photo.readable for photo in photos) < LEAST_CELLS:
        return None
    maps = [*np.moveaxis(promised.design, -1, 0), *added_terms(promised.design)]
    read = []
    for photo in photos:
        means = cell_means(maps, photo.cells.shape, photo.blur_cells)
        light, ink = photo.light, promised.ink if photo.anchored else None
        paper = light.paper if photo.anchored else _paper_of_cells(photo.cells, means[..., :3], light.paper)
        read.append(choose_cells(photo.cells, means, paper, light.ink, ink))
    rows = np.concatenate([cells.terms for cells in read])
    spread = np.linalg.svd(rows.T @ rows, compute_uv=False) ** 0.5
    return None if spread[_LEAST_COLORS - 1] < _LEAST_SPREAD * spread[0] else read


def _paper_of_cells(seen: np.ndarray, promised: np.ndarray, paper: np.ndarray) -> np.ndarray:
    """Extrapolate light h×w×3 of cells over its promise to white: dot gain and dull inks darken what is not."""
    inner = np.isfinite(seen).all(-1)
    seen, promised, found = seen[inner], promised[inner], paper.copy()
    darkness = 1 - promised @ np.array(LUMINANCE)
    for channel in range(3):
        light = promised[:, channel] > _LEAST_LIGHT
        if light.sum() >= LEAST_CELLS:
            rows = np.column_stack([np.ones(light.sum()), 1 - promised[light, channel], darkness[light]])
            found[channel] = np.linalg.lstsq(rows, seen[light, channel] / promised[light, channel], rcond=None)[0][0]
    return np.clip(found, paper / 1.5, 1.5 * paper)


def design_cells(srgb: np.ndarray, px_from_mm: np.ndarray, rect_mm: Rect, blur_px: float) -> tuple[np.ndarray, float]:
    """Read the light of cells h×w×3 at `rect_mm` in a uint8 photograph, NaN where clipped; and its blur in cells."""
    px_per_mm, side_mm = least_px_per_mm(px_from_mm, rect_mm), min(rect_mm[2:])
    cells_per_mm = float(np.clip(side_mm * px_per_mm / max(_LEAST_CELL_PX, 2 * blur_px), *_CELLS)) / side_mm
    cells = rectify(LINEAR_FLOAT32_FROM_CODE[srgb], px_from_mm, rect_mm, cells_per_mm).astype(float)
    full = (srgb.max(-1, keepdims=True) >= CLIPPED_CODE).astype(np.float32)
    clipped = rectify(full, px_from_mm, rect_mm, cells_per_mm).reshape(cells.shape[:2]) > _MOST_CLIPPED
    blur_cells = float(np.hypot(blur_px, _PIXEL_BLUR_PX)) * cells_per_mm / px_per_mm
    return np.where(clipped[..., None], np.nan, cells), blur_cells


def cell_means(maps: Iterable[np.ndarray], shape: tuple[int, ...], blur_cells: float) -> np.ndarray:
    """Blur maps H×W of the design and average them to h×w cells, h×w×N."""
    height, width = shape[:2]
    means = []
    for fine in maps:  # one at a time: OpenCV averages four channels at most
        fine = resize_by_area(np.ascontiguousarray(fine), (2 * width, 2 * height))
        if blur_cells > 0.15:
            fine = cv2.GaussianBlur(fine, (0, 0), 2 * blur_cells, borderType=cv2.BORDER_REPLICATE)
        means.append(resize_by_area(fine, (width, height)))
    return np.stack(means, -1).astype(float)
