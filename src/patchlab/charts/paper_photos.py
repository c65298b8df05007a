"""Simulated photographs of flat paper whose true position is known.

In: a seed. Out: `Sheet`s and photographs. OpenCV draws a frame of eight markers; every pixel is traced back to the
paper, then developed by this module (area-averaged look-up, Gaussian blur and noise in linear light, JPEG). So our
renderer and our page do not judge themselves.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from patchproof.base.color import photo_codes_from_srgb, srgb_from_linear
from patchproof.base.geometry import apply_homography, intrinsics, look_at, rect_corners
from patchproof.sheets.markers import DICTIONARY, aruco_dictionary

MarkerCorners = Mapping[int, np.ndarray]  # corners 4×2 by marker
PIECE_MM, MARKER_MM = 140.0, 14.0
DESIGN_MM = (20.0, 20.0, 100.0, 100.0)
_ASIDE_DEG = np.array([50.0, 30.0])  # of the camera, to either side and up or down
_RASTER_PX_PER_MM = 10
_SAMPLES = 3  # along each side of a pixel


@dataclass(frozen=True)
class Sheet:
    """Flat paper seen by a camera."""

    px_from_mm: np.ndarray
    size_px: tuple[int, int]

    def px(self, mm: np.ndarray) -> np.ndarray:
        """Pixels N×2 of points N×2 in mm on the paper."""
        return apply_homography(self.px_from_mm, np.asarray(mm, float))

    def mm(self, px: np.ndarray) -> np.ndarray:
        """Points N×2 in mm on the paper at pixels N×2."""
        return apply_homography(np.linalg.inv(self.px_from_mm), px)


@lru_cache(maxsize=1)
def corners_mm() -> dict[int, np.ndarray]:
    """Corners 4×2 in mm of the frame's eight markers, at the corners and the middles of the sides."""
    near, middle, far = 2.0, (PIECE_MM - MARKER_MM) / 2, PIECE_MM - 2.0 - MARKER_MM
    places = [(x, y) for y in (near, middle, far) for x in (near, middle, far) if (x, y) != (middle, middle)]
    return {100 + i: rect_corners([x, y, MARKER_MM, MARKER_MM]) for i, (x, y) in enumerate(places)}


def draw_sheet(seed: int, size_px: tuple[int, int]) -> tuple[Sheet, np.random.Generator]:
    """A sheet that fills about a third of a photograph's height, and the generator that draws its photograph."""
    rng = np.random.default_rng([seed, 1])
    azimuth, elevation = np.radians(rng.uniform(-_ASIDE_DEG, _ASIDE_DEG))
    toward = [np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)]
    world_from_piece = np.diag([1.0, -1.0, -1.0, 1.0])
    world_from_piece[:2, 3] = [-PIECE_MM / 2, PIECE_MM / 2]
    camera_from_world = look_at(rng.uniform(350, 700) * np.array(toward), [0, 0, 0], rng.uniform(-20, 20))
    piece_plane = (camera_from_world @ world_from_piece)[:3, [0, 1, 3]]
    return Sheet(intrinsics(50.0, size_px) @ piece_plane, size_px), rng


def photograph_paper(sheet: Sheet, rng: np.random.Generator, dictionary: str = DICTIONARY) -> np.ndarray:
    """uint8 H×W×3 photograph of the sheet with markers of a dictionary, on a blurred background."""
    clutter = rng.uniform(0.05, 0.6, (24, 32)).astype(np.float32)
    picture, raster = cv2.resize(clutter, sheet.size_px, interpolation=cv2.INTER_CUBIC), _draw_raster(rng, dictionary)
    border = sheet.px(rect_corners([0, 0, PIECE_MM, PIECE_MM]))
    left, top = np.clip(np.floor(border.min(0)).astype(int) - 2, 0, sheet.size_px)
    right, bottom = np.clip(np.ceil(border.max(0)).astype(int) + 2, 0, sheet.size_px)
    y, x = np.mgrid[top:bottom, left:right] + 0.5
    mm = sheet.mm(np.column_stack([x.ravel(), y.ravel()])).reshape(*x.shape, 2)
    # the map from pixels to paper is smooth: between pixels it is linear to a thousandth of a pixel
    fine = (_SAMPLES * (right - left), _SAMPLES * (bottom - top))
    points = cv2.resize(mm.astype(np.float32), fine, interpolation=cv2.INTER_LINEAR)
    inside = np.asarray(((points > 0) & (points < PIECE_MM)).all(2), np.float32)
    column, row = cv2.split(points * _RASTER_PX_PER_MM - 0.5)
    light = cv2.multiply(inside, cv2.remap(raster, column, row, cv2.INTER_NEAREST))
    light, cover = (cv2.resize(part, x.shape[::-1], interpolation=cv2.INTER_AREA) for part in (light, inside))
    picture[top:bottom, left:right] = picture[top:bottom, left:right] * (1 - cover) + light
    return _develop(picture, rng)


def _draw_raster(rng: np.random.Generator, dictionary: str) -> np.ndarray:
    """Draw the piece's light H×W: markers, and a smooth random design."""
    side, marker_px = (round(mm * _RASTER_PX_PER_MM) for mm in (PIECE_MM, MARKER_MM))
    raster = np.full((side, side), 0.95, np.float32)
    x, y, width, height = (round(v * _RASTER_PX_PER_MM) for v in DESIGN_MM)
    design = rng.uniform(0.05, 0.9, (12, 12)).astype(np.float32)
    raster[y : y + height, x : x + width] = cv2.resize(design, (width, height), interpolation=cv2.INTER_LINEAR)
    for marker_id, corners in corners_mm().items():
        column, row = np.round(corners[0] * _RASTER_PX_PER_MM).astype(int)
        code = cv2.aruco.generateImageMarker(aruco_dictionary(dictionary), marker_id, marker_px) / 255
        raster[row : row + marker_px, column : column + marker_px] = 0.03 + 0.92 * code
    return raster


def _develop(light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Develop light H×W into uint8 H×W×3 with drawn exposure, blur, noise and JPEG."""
    light = cv2.GaussianBlur(rng.uniform(0.3, 0.9) * light, (0, 0), rng.uniform(0.3, 1.2))
    light += rng.normal(0, rng.uniform(0, 0.01), light.shape).astype(np.float32)
    codes = photo_codes_from_srgb(srgb_from_linear(light.clip(0, 1)))
    jpeg = cv2.imencode(".jpg", codes, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(60, 96))])[1]
    return np.repeat(np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_GRAYSCALE))[..., None], 3, 2)
