"""The piece that is cut out and put on the object: the design in the middle of a frame of markers and swatches.

Millimeters from the top-left corner of the cut line, x right, y down. From the design outwards the frame is one
module of white (the markers' quiet zone), the markers (7 modules), one module of white, and 2 mm for the scissors.
Markers sit in the four corners and, where a side is long enough, in its middle, so that a hidden corner costs
nothing. Between them lie up to twelve swatches, so that color is measured on the object too. Everything in the frame
is an axis-aligned rectangle, hence `frame_image` can be exact: each pixel has the mean *light* of what covers it.

Ids and the sheet's name come from SHA-256 alone: they stay the same on every machine and in every version. The sheet
id is fixed before optimizing and never taken from the design, because the frame is rendered with its marker ids.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from patchproof.color import codes_of, linear_from_srgb, srgb_from_linear
from patchproof.settings import identifying
from patchproof.sheets.manifest import Marker
from patchproof.sheets.rects import PointMm, RectMm, SwatchRect
from patchproof.sheets.swatches import frame_swatches
from patchproof.strict import Refused, Strict, nearest

DICTIONARY = "DICT_5X5_1000"
KINDS = ("design", "mean", "gray", "noise", "shuffled", "blank")
MODULES = 7  # a 5×5 code and its black border
SCISSORS_MM = 2.0
SMALLEST_MARKER_MM = 8.0
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
    design_rect_mm: RectMm
    markers: tuple[PieceMarker, ...]
    swatches: tuple[SwatchRect, ...]
    module_mm: float


@dataclass(frozen=True)
class FrameImage:
    """A raster of the whole piece on the design's pixel grid.

    The design's texels are the pixels of `design_box_px` (x0, y0, width, height); the cut line falls on `piece_box_px`
    (x0, y0, x1, y1), in general between pixels. Beyond it the paper goes on white.
    """

    srgb: np.ndarray  # float32 H×W×3
    design_box_px: tuple[int, int, int, int]
    piece_box_px: tuple[float, float, float, float]


def sheet_id(settings: dict[str, Any], seed: int) -> str:
    """Ten of 0-9A-Z from settings and seed; the order of keys does not matter, but 1 and 1.0 are different settings."""
    text = json.dumps({"settings": settings, "seed": seed}, sort_keys=True, separators=(",", ":"), allow_nan=False)
    number = int.from_bytes(hashlib.sha256(text.encode()).digest(), "big")
    return "".join("0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZ"[number // 36**i % 36] for i in range(10))


def page_id(template: Strict) -> str:
    """The sheet id of a page that shows nothing but its template: equal templates give equal pages."""
    return sheet_id({"template": identifying(template)}, 0)


def marker_ids(sheet_id: str, kind: str, count: int) -> list[int]:
    """The first `count` marker ids of one kind of sheet; no two kinds of one sheet id share any."""
    block = 1000 // len(KINDS)
    if count > block:
        raise Refused(f"at most {block} markers on one sheet", f"{count}", "use larger or fewer tiles")
    start = KINDS.index(_known(kind)) * block
    return list(hash_order(sheet_id, 1000)[start : start + count])


@lru_cache(maxsize=64)
def hash_order(text: str, count: int) -> tuple[int, ...]:
    """0..count-1, shuffled by SHA-256 of `text` and each number: the same order for ever."""
    return tuple(sorted(range(count), key=lambda i: hashlib.sha256(f"{text}:{i}".encode()).digest()))


def frame_mm(marker_mm: float) -> float:
    """Width of the frame on each side of the design."""
    return marker_mm * (MODULES + 2) / MODULES + SCISSORS_MM


def marker_size_mm(needed_mm: float, design_mm: tuple[float, float], largest_piece_mm: tuple[float, float]) -> float:
    """The marker to print: what is needed (never under 8 mm), else the largest that fits, in whole 0.1 mm."""
    wanted = max(needed_mm, SMALLEST_MARKER_MM)
    room = min(piece - design for piece, design in zip(largest_piece_mm, design_mm, strict=True)) / 2
    fitting = (room - SCISSORS_MM) * MODULES / (MODULES + 2)
    if fitting >= wanted:
        return wanted
    fitting = math.floor(fitting * 10 + 1e-6) / 10
    if fitting < SMALLEST_MARKER_MM:
        widest, highest = (side - 2 * frame_mm(SMALLEST_MARKER_MM) for side in largest_piece_mm)
        raise Refused(
            f"a design of at most {widest:.0f} × {highest:.0f} mm, beside {SMALLEST_MARKER_MM:g} mm markers",
            f"{design_mm[0]:g} × {design_mm[1]:g} mm",
            "make the patch smaller or choose a larger template",
        )
    return fitting


def lay_out_piece(design_mm: tuple[float, float], marker_mm: float, sheet_id: str, kind: str) -> Piece:
    """The piece round a design of that size.

    A side as long as a marker gets one in its middle; swatches, four millimeters or larger, get what is left.
    """
    module, frame = marker_mm / MODULES, frame_mm(marker_mm)
    (w, h), edge = design_mm, SCISSORS_MM + module
    size = (w + 2 * frame, h + 2 * frame)
    right, bottom = size[0] - edge - marker_mm, size[1] - edge - marker_mm
    middle_x, middle_y = (size[0] - marker_mm) / 2, (size[1] - marker_mm) / 2
    places = [(edge, edge), (right, edge), (right, bottom), (edge, bottom)]
    if w >= marker_mm:
        places += [(middle_x, edge), (middle_x, bottom)]
    if h >= marker_mm:
        places += [(right, middle_y), (edge, middle_y)]
    ids = marker_ids(sheet_id, kind, len(places))
    markers = tuple(marker_at(id_, place, marker_mm) for id_, place in zip(ids, places, strict=True))
    swatches = frame_swatches(size, edge, marker_mm, module, (w >= marker_mm, h >= marker_mm))
    return Piece(size, (frame, frame, w, h), markers, swatches, module)


def with_ids(piece: Piece, sheet_id: str, kind: str) -> Piece:
    """The same piece with the marker ids of another sheet or kind."""
    ids = marker_ids(sheet_id, kind, len(piece.markers))
    markers = tuple(replace(marker, id=id_) for id_, marker in zip(ids, piece.markers, strict=True))
    return replace(piece, markers=markers)


def marker_at(id_: int, corner_mm: PointMm, size_mm: float) -> PieceMarker:
    """A marker with its top-left corner there."""
    (x, y), side = map(float, corner_mm), float(size_mm)
    return PieceMarker(id_, ((x, y), (x + side, y), (x + side, y + side), (x, y + side)))


def moved_marker(marker: PieceMarker, by: PointMm) -> PieceMarker:
    """The marker elsewhere."""
    a, b, c, d = ((round(x + by[0], 6), round(y + by[1], 6)) for x, y in marker.corners_mm)
    return PieceMarker(marker.id, (a, b, c, d))


def printed(marker: PieceMarker, page: int = 1) -> Marker:
    """The marker as the manifest carries it."""
    return Marker(dictionary=DICTIONARY, id=marker.id, corners_mm=marker.corners_mm, page=page)


def marker_rect(marker: PieceMarker) -> RectMm:
    """The marker's black square."""
    (x, y), (x1, _) = marker.corners_mm[:2]
    return x, y, x1 - x, x1 - x


def marker_rects_mm(marker: PieceMarker) -> list[RectMm]:
    """The marker's black as rectangles that touch but never overlap: one for each run of black modules in a row."""
    x, y, side, _ = marker_rect(marker)
    return black_runs(_marker_modules(marker.id), (x, y), side / MODULES)


def black_runs(dark: np.ndarray, corner_mm: PointMm, module_mm: float) -> list[RectMm]:
    """A rectangle for each run of True in a row of a boolean image, from the top down."""
    steps = np.diff(np.pad(dark.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    rows, starts = np.nonzero(steps == 1)
    lengths, (x, y) = np.nonzero(steps == -1)[1] - starts, corner_mm
    return [
        (x + start * module_mm, y + row * module_mm, length * module_mm, module_mm)
        for row, start, length in zip(rows.tolist(), starts.tolist(), lengths.tolist(), strict=True)
    ]


def frame_image(piece: Piece, design_px: tuple[int, int]) -> FrameImage:
    """The piece without its design (0.5 gray there) on the pixel grid of a design of (width, height) pixels.

    A pixel is the mean light of what covers it, in sRGB code values: a box filter without error, since the frame
    consists of disjoint rectangles alone.
    """
    design = np.array(piece.design_rect_mm)
    scale = np.array(design_px) / design[2:]  # px per mm, along x and y
    before = design[:2] * scale
    origin = np.ceil(before - 1e-9)  # whole pixels left of and above the design
    cut = np.concatenate([origin - before, origin - before + np.array(piece.size_mm) * scale])
    width, height = (int(v) for v in np.ceil(cut[2:] - 1e-9))
    linear = np.ones((height, width, 3))
    black = [(rect, (0.0, 0.0, 0.0)) for marker in piece.markers for rect in marker_rects_mm(marker)]
    for rect, srgb in [*black, *piece.swatches]:
        x0, y0 = cut[:2] + np.array(rect[:2]) * scale
        x1, y1 = np.array([x0, y0]) + np.array(rect[2:]) * scale
        _cover(linear, (x0, y0, x1, y1), linear_from_srgb(np.array(srgb)))
    image = srgb_from_linear(np.clip(linear, 0, 1)).astype(np.float32)
    (x, y), (w, h) = origin.astype(int), design_px
    image[y : y + h, x : x + w] = 0.5
    x0, y0, x1, y1 = map(float, cut)
    return FrameImage(image, (int(x), int(y), w, h), (x0, y0, x1, y1))


def control_design(kind: str, design: np.ndarray, sheet_id: str) -> np.ndarray:
    """What a control sheet prints in place of a uint8 H×W×3 design, in as many pixels.

    "mean": its mean color, averaged in light; "gray": sRGB 128; "noise": random cells, 16 along the shorter side;
    "shuffled": the design's own 16 × 16 cells in another order (pixels left over at the right and bottom stay);
    "blank": white paper; "design": the design.
    """
    height, width = design.shape[:2]
    if _known(kind) == "mean":
        mean = linear_from_srgb(design.reshape(-1, 3) / 255).mean(0)
        return np.broadcast_to(codes_of(srgb_from_linear(mean)), design.shape).copy()
    if kind == "noise":
        return _noise(height, width, sheet_id)
    if kind == "shuffled":
        return _shuffled(design, sheet_id)
    if kind == "design":
        return design.copy()
    return np.full_like(design, 128 if kind == "gray" else 255)


def _known(kind: str) -> str:
    if kind not in KINDS:
        raise Refused("a kind of sheet", f'"{kind}"', nearest(kind, KINDS))
    return kind


def _noise(height: int, width: int, sheet_id: str) -> np.ndarray:
    cell = max(min(height, width) / CELLS, 1)
    rows, columns = math.ceil(height / cell - 1e-9), math.ceil(width / cell - 1e-9)
    # SHAKE gives as many uniform bytes as wanted, the same in every version of every library
    data = hashlib.shake_256(f"{sheet_id}:noise".encode()).digest(rows * columns * 3)
    cells = np.frombuffer(data, np.uint8).reshape(rows, columns, 3)
    y, x = (np.arange(height) / cell).astype(int), (np.arange(width) / cell).astype(int)
    return cells[y[:, None], x]


def _shuffled(design: np.ndarray, sheet_id: str) -> np.ndarray:
    height, width = design.shape[:2]
    rows, columns = min(CELLS, height), min(CELLS, width)
    h, w = height // rows, width // columns
    cells = design[: rows * h, : columns * w].reshape(rows, h, columns, w, 3).swapaxes(1, 2).reshape(-1, h, w, 3)
    cells = cells[list(hash_order(f"{sheet_id}:shuffled", len(cells)))]
    result = design.copy()
    result[: rows * h, : columns * w] = (
        cells.reshape(rows, columns, h, w, 3).swapaxes(1, 2).reshape(rows * h, columns * w, 3)
    )
    return result


@lru_cache(maxsize=256)
def _marker_modules(id_: int) -> np.ndarray:
    """7×7, True where the marker is black."""
    import cv2

    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARY))
    return cv2.aruco.generateImageMarker(dictionary, id_, MODULES) == 0


def _cover(linear: np.ndarray, box: tuple[float, float, float, float], color: np.ndarray) -> None:
    """Put a rectangle on white: each pixel goes towards `color` by the share of it that lies inside, in place."""
    x0, y0, x1, y1 = box
    columns = np.arange(max(math.floor(x0), 0), min(math.ceil(x1), linear.shape[1]))
    rows = np.arange(max(math.floor(y0), 0), min(math.ceil(y1), linear.shape[0]))
    in_x = np.clip(np.minimum(columns + 1, x1) - np.maximum(columns, x0), 0, 1)
    in_y = np.clip(np.minimum(rows + 1, y1) - np.maximum(rows, y0), 0, 1)
    share = (in_y[:, None] * in_x)[:, :, None]
    linear[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] += share * (color - 1)
