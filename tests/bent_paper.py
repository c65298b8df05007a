"""A printed sheet, and paper as functions from page millimeters to points in space, none of them the tool's own.

Arc lengths of bent paper are integrated numerically, so that it does not stretch. The sheet is printed by another
printer than the one that its look was promised with.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import torch
from synthetic_photos import noisy_design, some_design

from patchproof.base.color import linear_from_srgb
from patchproof.base.geometry import look_at
from patchproof.channel.printer import load_printer
from patchproof.evidence.surface import PromisedColors, Surface, promised_of, surface_of
from patchproof.sheets.content import png_base64
from patchproof.sheets.manifest import Manifest, design_sha256
from patchproof.sheets.piece import Piece, lay_out_piece, marker_image

SIDE_MM, MARKER_MM, PAGE_PER_MM = 140.0, 14.0, 8
CENTER = np.array([SIDE_MM, SIDE_MM]) / 2

Place = Callable[[np.ndarray], np.ndarray]
"""Page millimeters N×2 from the sheet's middle to points N×3 in space; z points into the paper, (0, 0) becomes 0."""


DESIGNS: dict[str, Callable[[], np.ndarray]] = {
    "noisy": lambda: (noisy_design() * 255).astype(np.uint8),
    "smooth": some_design,
    "plain": lambda: np.full((140, 140, 3), 150, np.uint8),
}


@cache
def sheet(bends: bool, design: str) -> tuple[Surface, PromisedColors]:
    """The surface, and how it was promised to look."""
    codes = DESIGNS[design]()
    markers = [
        dict(dictionary="DICT_5X5_1000", id=m.id, corners_mm=m.corners_mm, page=1) for m in _piece(bends).markers
    ]
    whole = (0.0, 0.0, SIDE_MM, SIDE_MM)
    manifest = Manifest.model_validate(
        dict(
            version=2,
            sheet_id="TESTSHEET0",
            kind="design",
            page_mm=(SIDE_MM, SIDE_MM),
            design=dict(
                sha256=design_sha256(codes), rect_mm=whole, size_px=codes.shape[1::-1], page=1, png=png_base64(codes)
            ),
            markers=markers,
            chart=(),
            cut_mm=whole,
            ruler_mm=(100.0, 100.0),
            tiles=(),
            promise=None,
            settings={"printer": {"profile": "coated"}},
        )
    )
    surface = surface_of(manifest)
    return surface, promised_of(manifest, surface, load_printer("coated"))


def _piece(bends: bool, sheet_id: str = "TESTSHEET0") -> Piece:
    return lay_out_piece((SIDE_MM, SIDE_MM), MARKER_MM, sheet_id, "design", bends)


@cache
def printed_page(bends: bool, design: str) -> np.ndarray:
    """The printed page's linear light at `PAGE_PER_MM`, H×W×3."""
    return printed(bends, DESIGNS[design]())


def printed(
    bends: bool,
    codes: np.ndarray,
    sheet_id: str = "TESTSHEET0",
    moved: np.ndarray | None = None,
    marker_shift_mm: tuple[float, float] = (0.0, 0.0),
) -> np.ndarray:
    """A page with these codes; `moved` (2×3, mm from the middle) has them elsewhere, one marker is shifted."""
    piece, size = _piece(bends, sheet_id), round(SIDE_MM * PAGE_PER_MM)
    x, y = (round(v * PAGE_PER_MM) for v in marker_shift_mm)
    first = replace(piece, markers=piece.markers[:1])
    image, reserved = marker_image(replace(piece, markers=piece.markers[1:]) if x or y else piece, (size, size))
    if x or y:
        single, place = (np.roll(a, (y, x), (0, 1)) for a in marker_image(first, (size, size)))
        image, reserved = np.where(place[..., None], single, image), reserved | place
    page = codes / 255.0
    if moved is not None:
        page = cv2.resize(page, (size, size), interpolation=cv2.INTER_NEAREST)
        middle = np.array([[PAGE_PER_MM, 0, size / 2 - 0.5], [0, PAGE_PER_MM, size / 2 - 0.5], [0, 0, 1.0]])
        matrix = middle @ np.vstack([moved, [0, 0, 1]]) @ np.linalg.inv(middle)
        page = cv2.warpAffine(page, matrix[:2], (size, size), flags=cv2.INTER_LINEAR, borderValue=(1, 1, 1))
    light = cv2.resize(_printed_light(page), (size, size), interpolation=cv2.INTER_NEAREST)
    light[reserved] = _printed_light(image[reserved][None])[0]
    return light


def _printed_light(srgb: np.ndarray) -> np.ndarray:
    """Linear light H×W×3 that another printer than the promise's makes of sRGB."""
    with torch.inference_mode():
        page = load_printer("uncoated").apply(torch.tensor(srgb.transpose(2, 0, 1)[None], dtype=torch.float32))
    return linear_from_srgb(page[0].numpy().transpose(1, 2, 0))


def flat(points: np.ndarray) -> np.ndarray:
    """Flat paper."""
    return np.vstack([points.T, np.zeros(len(points))]).T


def bent(slope: Callable[[np.ndarray], np.ndarray], direction_rad: float) -> Place:
    """Paper whose slope in radians depends on the way along one direction; slope 0 at its middle keeps the middle's."""
    ways = np.linspace(-120, 120, 4801)
    angle, step = slope(ways), ways[1] - ways[0]
    across, depth = (np.cumsum(f(angle)) * step for f in (np.cos, np.sin))
    across, depth = (np.interp(ways, ways + step / 2, v) - np.interp(0, ways + step / 2, v) for v in (across, depth))
    turn = np.array([[np.cos(direction_rad), -np.sin(direction_rad)], [np.sin(direction_rad), np.cos(direction_rad)]])

    def place(points: np.ndarray) -> np.ndarray:
        along, rulings = turn.T @ points.T
        xy = turn @ [np.interp(along, ways, across), rulings]
        return np.vstack([xy, np.interp(along, ways, depth)]).T

    return place


def rolled(radius_mm: float, direction_rad: float) -> Place:
    """Round a cylinder, towards the camera where the radius is positive."""
    return bent(lambda way: way / radius_mm, direction_rad)


def folded(angle_deg: float, at_mm: float, direction_rad: float) -> Place:
    """Folded along a line at that distance from the middle."""
    return bent(lambda way: np.radians(angle_deg) * (way * np.sign(at_mm) > abs(at_mm)), direction_rad)


def cone(bend: float, change: float, direction_rad: float) -> Place:
    """More bent at one end than at the other."""
    turn = np.array([[np.cos(direction_rad), -np.sin(direction_rad)], [np.sin(direction_rad), np.cos(direction_rad)]])

    def place(points: np.ndarray) -> np.ndarray:
        x, y = (points @ turn).T / 70
        k = bend * (1 + change * y)
        angle = k * x
        across, depth = x * np.sinc(angle / np.pi), x * np.sinc(angle / 2 / np.pi) * np.sin(angle / 2)
        return np.column_stack([70 * np.column_stack([across, y]) @ turn.T, 70 * depth])

    return place


def camera(azimuth_deg, elevation_deg, distance_mm, roll_deg=0.0, aside_mm=(0.0, 0.0)) -> np.ndarray:
    """`camera_from_page` with the page's origin at the sheet's middle."""
    az, el = np.radians([azimuth_deg, elevation_deg])
    eye = distance_mm * np.array([np.cos(el) * np.sin(az), np.sin(el), np.cos(el) * np.cos(az)])
    return look_at(eye, [*aside_mm, 0], roll_deg) @ np.diag([1.0, -1.0, -1.0, 1.0])
