"""The piece that is cut out and put on the object: the design all over it, but for the markers.

Millimeters from the top-left corner of the cut line, x right, y down. A marker is 7 modules wide, with a module of
white round it (its quiet zone), and lies a millimeter inside the cut line, for the scissors. Markers sit in the four
corners and, on a piece that bends or is long, along its sides. What belongs to a marker is white or black whatever the
design has there: `marker_image` says which of a design's pixels that are, and what they look like. It is exact, since
all is axis-aligned rectangles: each pixel has the mean *light* of what covers it.

Ids and the sheet's name come from SHA-256 alone: they stay the same on every machine and in every version. The sheet
id is fixed before optimizing and never taken from the design, because the piece is rendered with its marker ids.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from patchproof.base.color import codes_from_srgb, linear_from_srgb, srgb_from_linear
from patchproof.base.errors import Refused
from patchproof.base.settings import identity_settings
from patchproof.base.validation import StrictModel, spelling_hint
from patchproof.sheets.manifest import Marker
from patchproof.sheets.markers import DICTIONARY, MARKER_MODULES, marker_cells
from patchproof.sheets.rects import PointMm, RectMm, grow_rect

SHEET_KINDS = ("design", "mean", "gray", "noise", "shuffled", "blank")
SCISSORS_MM = 1.0
SMALLEST_MARKER_MM = 8.0
LARGEST_CORNER = 0.29  # of the piece's shorter side, white and all: four leave two thirds of a square to the design
LONGEST_GAP = 12.0  # markers between two of a long side; on bent paper a side has one in its middle
SLIVER_MM = 2.0  # between a quiet zone and the cut line; narrower ones are white, too
CELLS = 16  # of the noise and shuffled controls, along the shorter side


@dataclass(frozen=True)
class PieceMarker:
    """An ArUco marker: outer corners of its black square, clockwise from the code's top-left."""

    id: int
    corners_mm: tuple[PointMm, PointMm, PointMm, PointMm]


@dataclass(frozen=True)
class Piece:
    """Geometry of a piece; `size_mm` is the cut line, corner markers come first (clockwise from the top-left)."""

    size_mm: tuple[float, float]
    markers: tuple[PieceMarker, ...]
    module_mm: float

    @property
    def marker_mm(self) -> float:
        """Side of a marker's black square."""
        return self.module_mm * MARKER_MODULES

    @property
    def reserved_mm(self) -> tuple[RectMm, ...]:
        """What belongs to each marker: its quiet zone, and what slivers it would leave at the cut line."""
        return tuple(_to_the_cut(grow_rect(marker_rect(m), self.module_mm), self.size_mm) for m in self.markers)


def sheet_id(settings: dict[str, Any], seed: int) -> str:
    """Ten of 0-9A-Z from settings and seed; the order of keys does not matter, but 1 and 1.0 are different settings."""
    text = json.dumps({"settings": settings, "seed": seed}, sort_keys=True, separators=(",", ":"), allow_nan=False)
    number = int.from_bytes(hashlib.sha256(text.encode()).digest(), "big")
    return "".join("0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZ"[number // 36**i % 36] for i in range(10))


def page_id(template: StrictModel) -> str:
    """The sheet id of a page that shows nothing but its template: equal templates give equal pages."""
    return sheet_id({"template": identity_settings(template)}, 0)


def marker_ids(sheet_id: str, kind: str, count: int) -> list[int]:
    """The first `count` marker ids of one kind of sheet; no two kinds of one sheet id share any."""
    block = 1000 // len(SHEET_KINDS)
    if count > block:
        raise Refused(f"at most {block} markers on one sheet", f"{count}", "use larger or fewer tiles")
    start = SHEET_KINDS.index(_known(kind)) * block
    return list(hash_order(sheet_id, 1000)[start : start + count])


@lru_cache(maxsize=64)
def hash_order(text: str, count: int) -> tuple[int, ...]:
    """0..count-1, shuffled by SHA-256 of `text` and each number: the same order for ever."""
    return tuple(sorted(range(count), key=lambda i: hashlib.sha256(f"{text}:{i}".encode()).digest()))


def marker_size_mm(needed_mm: float, piece_mm: tuple[float, float]) -> float:
    """The marker to print: what is needed (never under 8 mm), else the largest that leaves the design its share, in
    whole 0.1 mm.
    """
    wanted, least = max(needed_mm, SMALLEST_MARKER_MM), _corner_mm(SMALLEST_MARKER_MM) / LARGEST_CORNER
    if min(piece_mm) < least:
        raise Refused(
            f"a piece of at least {math.ceil(least)} mm, beside {SMALLEST_MARKER_MM:g} mm markers",
            f"{piece_mm[0]:g} × {piece_mm[1]:g} mm",
            "make the patch larger",
        )
    fitting = (LARGEST_CORNER * min(piece_mm) - SCISSORS_MM) * MARKER_MODULES / (MARKER_MODULES + 2)
    return wanted if fitting >= wanted else math.floor(fitting * 10 + 1e-6) / 10


def smallest_piece_mm(marker_mm: float = SMALLEST_MARKER_MM) -> int:
    """The shorter side that four markers of a size ask for, in whole millimeters."""
    return math.ceil(_corner_mm(marker_mm) / LARGEST_CORNER)


def lay_out_piece(
    piece_mm: tuple[float, float], marker_mm: float, sheet_id: str, kind: str, bends: bool = False
) -> Piece:
    """The piece of that size, with a marker in each corner and as many along its sides as it needs."""
    module = marker_mm / MARKER_MODULES
    edge = SCISSORS_MM + module
    (left, right), (top, bottom) = ((edge, side - edge - marker_mm) for side in piece_mm)
    places = [(left, top), (right, top), (right, bottom), (left, bottom)]
    xs, ys = (_between(edge, side - edge - marker_mm, marker_mm, bends) for side in piece_mm)
    places += [(x, y) for x in xs for y in (top, bottom)] + [(x, y) for y in ys for x in (right, left)]
    ids = marker_ids(sheet_id, kind, len(places))
    markers = tuple(square_marker(id_, place, marker_mm) for id_, place in zip(ids, places, strict=True))
    return Piece(piece_mm, markers, module)


def _between(first: float, last: float, marker_mm: float, bends: bool) -> list[float]:
    """Where markers begin between a side's two corner markers, evenly apart."""
    gap = last - first - marker_mm
    count = max(math.ceil(gap / (LONGEST_GAP * marker_mm)) - 1, 1 if bends and gap >= 3 * marker_mm else 0)
    return [first + (last - first) * i / (count + 1) for i in range(1, count + 1)]


def _corner_mm(marker_mm: float) -> float:
    """How much of a side a corner marker takes, white and all."""
    return marker_mm * (MARKER_MODULES + 2) / MARKER_MODULES + SCISSORS_MM


def _to_the_cut(rect: RectMm, size_mm: tuple[float, float]) -> RectMm:
    x0, y0, x1, y1 = rect[0], rect[1], rect[0] + rect[2], rect[1] + rect[3]
    low = [0.0 if v <= SLIVER_MM + 1e-6 else v for v in (x0, y0)]
    high = [side if side - v <= SLIVER_MM + 1e-6 else v for v, side in zip((x1, y1), size_mm, strict=True)]
    return low[0], low[1], high[0] - low[0], high[1] - low[1]


def with_ids(piece: Piece, sheet_id: str, kind: str) -> Piece:
    """The same piece with the marker ids of another sheet or kind."""
    ids = marker_ids(sheet_id, kind, len(piece.markers))
    markers = tuple(replace(marker, id=id_) for id_, marker in zip(ids, piece.markers, strict=True))
    return replace(piece, markers=markers)


def square_marker(id_: int, corner_mm: PointMm, size_mm: float) -> PieceMarker:
    """A marker with its top-left corner there."""
    (x, y), side = map(float, corner_mm), float(size_mm)
    return PieceMarker(id_, ((x, y), (x + side, y), (x + side, y + side), (x, y + side)))


def moved_marker(marker: PieceMarker, by: PointMm) -> PieceMarker:
    """The marker elsewhere."""
    a, b, c, d = ((round(x + by[0], 6), round(y + by[1], 6)) for x, y in marker.corners_mm)
    return PieceMarker(marker.id, (a, b, c, d))


def manifest_marker(marker: PieceMarker, page: int = 1) -> Marker:
    """The marker as the manifest carries it."""
    return Marker(dictionary=DICTIONARY, id=marker.id, corners_mm=marker.corners_mm, page=page)


def marker_rect(marker: PieceMarker) -> RectMm:
    """The marker's black square."""
    (x, y), (x1, _) = marker.corners_mm[:2]
    return x, y, x1 - x, x1 - x


def marker_rects_mm(marker: PieceMarker) -> list[RectMm]:
    """The marker's black as rectangles that touch but never overlap: one for each run of black modules in a row."""
    x, y, side, _ = marker_rect(marker)
    return black_runs(_marker_modules(marker.id), (x, y), side / MARKER_MODULES)


def black_runs(dark: np.ndarray, corner_mm: PointMm, module_mm: float) -> list[RectMm]:
    """A rectangle for each run of True in a row of a boolean image, from the top down."""
    steps = np.diff(np.pad(dark.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    rows, starts = np.nonzero(steps == 1)
    lengths, (x, y) = np.nonzero(steps == -1)[1] - starts, corner_mm
    return [
        (x + start * module_mm, y + row * module_mm, length * module_mm, module_mm)
        for row, start, length in zip(rows.tolist(), starts.tolist(), lengths.tolist(), strict=True)
    ]


def marker_image(piece: Piece, design_px: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """What a design of (width, height) pixels must leave to the markers, float32 sRGB H×W×3 (white elsewhere), and
    which pixels that are, bool H×W: all that touch what is reserved, so that quiet zones are a module wide at least.

    A pixel is the mean light of what covers it, in sRGB code values: a box filter without error, since a marker
    consists of disjoint rectangles alone.
    """
    (width, height), scale = design_px, np.array(design_px) / piece.size_mm  # px per mm, along x and y
    coverage, reserved = np.zeros((height, width)), np.zeros((height, width), bool)
    for marker in piece.markers:
        for x, y, w, h in marker_rects_mm(marker):
            _cover(coverage, (x * scale[0], y * scale[1], (x + w) * scale[0], (y + h) * scale[1]))
    for x, y, w, h in piece.reserved_mm:
        x0, y0 = (max(math.floor(v * s + 1e-6), 0) for v, s in zip((x, y), scale, strict=True))
        x1, y1 = (math.ceil(v * s - 1e-6) for v, s in zip((x + w, y + h), scale, strict=True))
        reserved[y0:y1, x0:x1] = True
    gray = srgb_from_linear(np.clip(1 - coverage, 0, 1)).astype(np.float32)
    return np.repeat(gray[..., None], 3, 2), reserved


def whiten_marker_pixels(design: np.ndarray, piece: Piece) -> np.ndarray:
    """A uint8 H×W×3 design as it goes to the printer: white where the markers' own pixels are."""
    _, reserved = marker_image(piece, (design.shape[1], design.shape[0]))
    return np.where(reserved[..., None], np.uint8(255), design)


def control_design(kind: str, design: np.ndarray, sheet_id: str, piece: Piece | None = None) -> np.ndarray:
    """What a control sheet prints in place of a uint8 H×W×3 design, in as many pixels; those of a piece's markers are
    white.

    "mean": its mean color, averaged in light; "gray": sRGB 128; "noise": random cells, 16 along the shorter side;
    "shuffled": the design's own 16 × 16 cells in another order (those with a marker's pixel stay, as do pixels left
    over at the right and bottom); "blank": white paper; "design": the design.
    """
    height, width = design.shape[:2]
    free = np.ones((height, width), bool) if piece is None else ~marker_image(piece, (width, height))[1]
    if _known(kind) == "mean":
        mean = linear_from_srgb(design[free] / 255).mean(0)
        control = np.broadcast_to(codes_from_srgb(srgb_from_linear(mean)), design.shape)
    elif kind == "noise":
        control = _noise(height, width, sheet_id)
    elif kind == "shuffled":
        control = _shuffled(design, free, sheet_id)
    else:
        control = design if kind == "design" else np.full_like(design, 128 if kind == "gray" else 255)
    return np.where(free[..., None], control, np.uint8(255))


def _known(kind: str) -> str:
    if kind not in SHEET_KINDS:
        raise Refused("a kind of sheet", f'"{kind}"', spelling_hint(kind, SHEET_KINDS))
    return kind


def _noise(height: int, width: int, sheet_id: str) -> np.ndarray:
    cell = max(min(height, width) / CELLS, 1)
    rows, columns = math.ceil(height / cell - 1e-9), math.ceil(width / cell - 1e-9)
    # SHAKE gives as many uniform bytes as wanted, the same in every version of every library
    data = hashlib.shake_256(f"{sheet_id}:noise".encode()).digest(rows * columns * 3)
    cells = np.frombuffer(data, np.uint8).reshape(rows, columns, 3)
    y, x = (np.arange(height) / cell).astype(int), (np.arange(width) / cell).astype(int)
    return cells[y[:, None], x]


def _shuffled(design: np.ndarray, free: np.ndarray, sheet_id: str) -> np.ndarray:
    height, width = design.shape[:2]
    rows, columns = min(CELLS, height), min(CELLS, width)
    h, w = height // rows, width // columns

    def cells(image: np.ndarray) -> np.ndarray:
        """A view: rows × columns × h × w (× 3)."""
        return image[: rows * h, : columns * w].reshape(rows, h, columns, w, *image.shape[2:]).swapaxes(1, 2)

    result, moving = design.copy(), np.argwhere(cells(free).all((2, 3)))
    order = moving[list(hash_order(f"{sheet_id}:shuffled", len(moving)))]
    cells(result)[tuple(moving.T)] = cells(design)[tuple(order.T)]
    return result


@lru_cache(maxsize=256)
def _marker_modules(id_: int) -> np.ndarray:
    """7×7, True where the marker is black."""
    return marker_cells(DICTIONARY, [id_])[0] == 0


def _cover(coverage: np.ndarray, box: tuple[float, float, float, float]) -> None:
    """Add a rectangle in pixels: each pixel gets the share of it that lies inside, in place."""
    x0, y0, x1, y1 = box
    columns = np.arange(max(math.floor(x0), 0), min(math.ceil(x1), coverage.shape[1]))
    rows = np.arange(max(math.floor(y0), 0), min(math.ceil(y1), coverage.shape[0]))
    if not len(columns) or not len(rows):  # all of it outside
        return
    in_x = np.clip(np.minimum(columns + 1, x1) - np.maximum(columns, x0), 0, 1)
    in_y = np.clip(np.minimum(rows + 1, y1) - np.maximum(rows, y0), 0, 1)
    coverage[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] += in_y[:, None] * in_x
