"""The piece that is cut out and put on the object: its markers, and the design everywhere else.

Millimeters from the top-left corner of the cut line, x right, y down. A marker is 7 modules wide, has a module of white
around it (its quiet zone), and lies a millimeter inside the cut line, to allow for imprecise cutting. Markers sit in
the corners and, on a piece that bends or is long, along its sides. They cover the design: `marker_image` gives their
pixels and colors, exactly (the mean *light* of each pixel's area), since everything is an axis-aligned rectangle.

Marker ids and the sheet id are derived from SHA-256, so they are the same on every machine and in every version. The
sheet id does not depend on the design, because the piece is rendered with its marker ids during optimization.
"""

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

SHEET_KINDS = ("design", "mean", "gray", "noise", "blank")
IDS_PER_KIND = 166  # markers of one kind of a sheet, of the dictionary's thousand
SCISSORS_MM = 1.0  # distance from a quiet zone to the cut line
SMALLEST_MARKER_MM = 8.0
MAX_CORNER_SHARE = 0.29  # of the shorter side, for a marker with its white: four leave 2/3 of a square to the design
MAX_GAP = 12.0  # between two markers of a long side, in markers; on bent paper a side has one in its middle
MIN_STRIP_MM = 2.0  # of design between a quiet zone and the cut line; narrower strips are white, too
CELLS = 16  # of the noise control, along the shorter side


@dataclass(frozen=True)
class PieceMarker:
    """An ArUco marker of a piece or page: outer corners of its black square, clockwise from the code's top-left."""

    id: int
    corners_mm: tuple[PointMm, PointMm, PointMm, PointMm]


@dataclass(frozen=True)
class Piece:
    """A piece's geometry; `size_mm` is the cut line's. The corner markers come first, clockwise from the top-left."""

    size_mm: tuple[float, float]
    markers: tuple[PieceMarker, ...]
    module_mm: float

    @property
    def marker_mm(self) -> float:
        """Side of a marker's black square."""
        return self.module_mm * MARKER_MODULES

    @property
    def reserved_mm(self) -> tuple[RectMm, ...]:
        """The rectangle of each marker: with its quiet zone, extended over narrow strips at the cut line."""
        return tuple(_extend_to_cut(grow_rect(marker_rect(m), self.module_mm), self.size_mm) for m in self.markers)


def sheet_id(settings: dict[str, Any], seed: int) -> str:
    """Hash settings and seed to ten of 0-9A-Z; the order of keys does not matter, but 1 and 1.0 differ."""
    text = json.dumps({"settings": settings, "seed": seed}, sort_keys=True, separators=(",", ":"), allow_nan=False)
    number = int.from_bytes(hashlib.sha256(text.encode()).digest(), "big")
    return "".join("0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZ"[number // 36**i % 36] for i in range(10))


def page_id(template: StrictModel) -> str:
    """The sheet id of a page that shows its template only: equal templates have equal ids."""
    return sheet_id({"template": identity_settings(template)}, 0)


def marker_ids(sheet_id: str, kind: str, count: int) -> list[int]:
    """The first `count` marker ids of one kind of sheet; the kinds of one sheet id have no ids in common."""
    if count > IDS_PER_KIND:
        raise Refused(f"at most {IDS_PER_KIND} markers on one sheet", f"{count}", "use larger or fewer tiles")
    start = SHEET_KINDS.index(_check_kind(kind)) * IDS_PER_KIND
    return list(hash_order(sheet_id, 1000)[start : start + count])


@lru_cache(maxsize=64)
def hash_order(text: str, count: int) -> tuple[int, ...]:
    """The numbers 0..count-1, ordered by SHA-256 of `text` and each number."""
    return tuple(sorted(range(count), key=lambda i: hashlib.sha256(f"{text}:{i}".encode()).digest()))


def marker_size_mm(needed_mm: float, piece_mm: tuple[float, float]) -> float:
    """The side of the markers to print: `needed_mm`, but at least 8 mm and at most the largest multiple of 0.1 mm that
    leaves the design its share. Refused for a piece too small for 8 mm markers.
    """
    wanted, min_side = max(needed_mm, SMALLEST_MARKER_MM), _corner_mm(SMALLEST_MARKER_MM) / MAX_CORNER_SHARE
    if min(piece_mm) < min_side:
        expected = f"a piece of at least {math.ceil(min_side)} mm, which has room for {SMALLEST_MARKER_MM:g} mm markers"
        raise Refused(expected, f"{piece_mm[0]:g} × {piece_mm[1]:g} mm", "make the patch larger")
    largest = (MAX_CORNER_SHARE * min(piece_mm) - SCISSORS_MM) * MARKER_MODULES / (MARKER_MODULES + 2)
    return wanted if largest >= wanted else math.floor(largest * 10 + 1e-6) / 10


def smallest_piece_mm(marker_mm: float = SMALLEST_MARKER_MM) -> int:
    """The shortest side of a piece with four markers of a size, in whole millimeters."""
    return math.ceil(_corner_mm(marker_mm) / MAX_CORNER_SHARE)


def lay_out_piece(
    piece_mm: tuple[float, float], marker_mm: float, sheet_id: str, kind: str, bends: bool = False
) -> Piece:
    """Lay out a piece with markers in its corners and along long or bent sides; `marker_mm` = 0 means none."""
    if not marker_mm:
        return Piece(piece_mm, (), 0.0)
    module = marker_mm / MARKER_MODULES
    edge = SCISSORS_MM + module
    (left, right), (top, bottom) = ((edge, side - edge - marker_mm) for side in piece_mm)
    places = [(left, top), (right, top), (right, bottom), (left, bottom)]
    xs, ys = (_positions_between(edge, side - edge - marker_mm, marker_mm, bends) for side in piece_mm)
    places += [(x, y) for x in xs for y in (top, bottom)] + [(x, y) for y in ys for x in (right, left)]
    ids = marker_ids(sheet_id, kind, len(places))
    markers = tuple(square_marker(id_, place, marker_mm) for id_, place in zip(ids, places, strict=True))
    return Piece(piece_mm, markers, module)


def _positions_between(first: float, last: float, marker_mm: float, bends: bool) -> list[float]:
    """Positions of the markers between a side's two corner markers, at even distances."""
    gap = last - first - marker_mm
    count = max(math.ceil(gap / (MAX_GAP * marker_mm)) - 1, 1 if bends and gap >= 3 * marker_mm else 0)
    return [first + (last - first) * i / (count + 1) for i in range(1, count + 1)]


def _corner_mm(marker_mm: float) -> float:
    """The part of a side that a corner marker occupies with its white."""
    return marker_mm * (MARKER_MODULES + 2) / MARKER_MODULES + SCISSORS_MM


def _extend_to_cut(rect: RectMm, size_mm: tuple[float, float]) -> RectMm:
    x0, y0, x1, y1 = rect[0], rect[1], rect[0] + rect[2], rect[1] + rect[3]
    low = [0.0 if v <= MIN_STRIP_MM + 1e-6 else v for v in (x0, y0)]
    high = [side if side - v <= MIN_STRIP_MM + 1e-6 else v for v, side in zip((x1, y1), size_mm, strict=True)]
    return low[0], low[1], high[0] - low[0], high[1] - low[1]


def with_ids(piece: Piece, sheet_id: str, kind: str) -> Piece:
    """A copy of the piece with the marker ids of another sheet or kind."""
    ids = marker_ids(sheet_id, kind, len(piece.markers))
    markers = tuple(replace(marker, id=id_) for id_, marker in zip(ids, piece.markers, strict=True))
    return replace(piece, markers=markers)


def square_marker(id_: int, corner_mm: PointMm, size_mm: float) -> PieceMarker:
    """An upright marker by its top-left corner and side."""
    (x, y), side = map(float, corner_mm), float(size_mm)
    return PieceMarker(id_, ((x, y), (x + side, y), (x + side, y + side), (x, y + side)))


def move_marker(marker: PieceMarker | Marker, shift_mm: PointMm) -> PieceMarker:
    """A copy of the marker, shifted."""
    a, b, c, d = ((round(x + shift_mm[0], 6), round(y + shift_mm[1], 6)) for x, y in marker.corners_mm)
    return PieceMarker(marker.id, (a, b, c, d))


def manifest_marker(marker: PieceMarker, page: int = 1) -> Marker:
    """The marker's entry in the manifest."""
    return Marker(dictionary=DICTIONARY, id=marker.id, corners_mm=marker.corners_mm, page=page)


def marker_rect(marker: PieceMarker | Marker) -> RectMm:
    """The marker's black square."""
    (x, y), (x1, _) = marker.corners_mm[:2]
    return x, y, x1 - x, x1 - x


def marker_rects_mm(marker: PieceMarker) -> list[RectMm]:
    """The marker's black area as rectangles that touch but do not overlap: one for each run of black modules."""
    x, y, side, _ = marker_rect(marker)
    return black_runs(marker_cells(DICTIONARY, [marker.id])[0] == 0, (x, y), side / MARKER_MODULES)


def black_runs(dark: np.ndarray, corner_mm: PointMm, module_mm: float) -> list[RectMm]:
    """A rectangle for each run of True in a row of a boolean image H×W, from the top down."""
    steps = np.diff(np.pad(dark.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    rows, starts = np.nonzero(steps == 1)
    lengths, (x, y) = np.nonzero(steps == -1)[1] - starts, corner_mm
    return [
        (x + start * module_mm, y + row * module_mm, length * module_mm, module_mm)
        for row, start, length in zip(rows.tolist(), starts.tolist(), lengths.tolist(), strict=True)
    ]


def marker_image(piece: Piece, design_px: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """The markers in a design of (width, height) pixels: float32 sRGB H×W×3, white elsewhere, each pixel the exact mean
    light of its area; and bool H×W, True for pixels that touch `reserved_mm`.
    """
    (width, height), scale = design_px, np.array(design_px) / piece.size_mm  # px per mm, along x and y
    coverage, reserved = np.zeros((height, width)), np.zeros((height, width), bool)
    for marker in piece.markers:
        for x, y, w, h in marker_rects_mm(marker):
            _add_coverage(coverage, (x * scale[0], y * scale[1], (x + w) * scale[0], (y + h) * scale[1]))
    for x, y, w, h in piece.reserved_mm:
        x0, y0 = (max(math.floor(v * s + 1e-6), 0) for v, s in zip((x, y), scale, strict=True))
        x1, y1 = (math.ceil(v * s - 1e-6) for v, s in zip((x + w, y + h), scale, strict=True))
        reserved[y0:y1, x0:x1] = True
    return np.repeat(srgb_from_linear(np.clip(1 - coverage, 0, 1)).astype(np.float32)[..., None], 3, 2), reserved


def whiten_marker_pixels(design: np.ndarray, piece: Piece) -> np.ndarray:
    """Set the pixels of a uint8 H×W×3 design that belong to markers to white, as it goes to the printer."""
    _, reserved = marker_image(piece, (design.shape[1], design.shape[0]))
    return np.where(reserved[..., None], np.uint8(255), design)


def control_design(kind: str, design: np.ndarray, sheet_id: str, piece: Piece | None = None) -> np.ndarray:
    """The pixels that a control sheet prints in place of a uint8 H×W×3 design; those of a piece's markers are white.

    "mean": its mean color, averaged in light; "gray": sRGB 128; "noise": random cells, 16 along the shorter side;
    "blank": white paper; "design": the design.
    """
    height, width = design.shape[:2]
    free = np.ones((height, width), bool) if piece is None else ~marker_image(piece, (width, height))[1]
    if _check_kind(kind) == "mean":
        mean = linear_from_srgb(design[free] / 255).mean(0)
        control = np.broadcast_to(codes_from_srgb(srgb_from_linear(mean)), design.shape)
    elif kind == "noise":
        control = _noise_cells(height, width, sheet_id)
    else:
        control = design if kind == "design" else np.full_like(design, 128 if kind == "gray" else 255)
    return np.where(free[..., None], control, np.uint8(255))


def _check_kind(kind: str) -> str:
    if kind not in SHEET_KINDS:
        raise Refused("a kind of sheet", f'"{kind}"', spelling_hint(kind, SHEET_KINDS))
    return kind


def _noise_cells(height: int, width: int, sheet_id: str) -> np.ndarray:
    cell = max(min(height, width) / CELLS, 1)
    rows, columns = math.ceil(height / cell - 1e-9), math.ceil(width / cell - 1e-9)
    # SHAKE gives any number of uniform bytes, the same in every version of every library
    data = hashlib.shake_256(f"{sheet_id}:noise".encode()).digest(rows * columns * 3)
    y, x = (np.arange(height) / cell).astype(int), (np.arange(width) / cell).astype(int)
    return np.frombuffer(data, np.uint8).reshape(rows, columns, 3)[y[:, None], x]


def _add_coverage(coverage: np.ndarray, box: tuple[float, float, float, float]) -> None:
    """Add to each pixel, in place, the share of its area within a box (x0, y0, x1, y1) in pixels."""
    x0, y0, x1, y1 = box
    columns = np.arange(max(math.floor(x0), 0), min(math.ceil(x1), coverage.shape[1]))
    rows = np.arange(max(math.floor(y0), 0), min(math.ceil(y1), coverage.shape[0]))
    if not len(columns) or not len(rows):  # the box lies outside
        return
    in_x = np.clip(np.minimum(columns + 1, x1) - np.maximum(columns, x0), 0, 1)
    in_y = np.clip(np.minimum(rows + 1, y1) - np.maximum(rows, y0), 0, 1)
    coverage[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] += in_y[:, None] * in_x
