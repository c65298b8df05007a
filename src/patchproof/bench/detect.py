"""The knobs of detection: at which size the search starts, how corners are refined, how large photographs are.

In: nothing. A frame of eight markers is drawn by OpenCV, seen through known homographies and photographed by means of
the test's own (area-averaged look-up, Gaussian blur and noise in linear light, JPEG), so that neither our renderer nor
our page is its own judge. Out: a chart by photo size: milliseconds per photograph against the error of the design's
corners.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from patchproof.bench.chart import Chart, Check, OnStage, Point, Series, Table
from patchproof.bench.measure import mean_interval, median_interval
from patchproof.color import photo_codes_of, srgb_from_linear
from patchproof.geometry import apply_homography, intrinsics, look_at, plane_homography, rect_corners
from patchproof.photo.cannot import CannotJudge
from patchproof.photo.complete import find_sheet
from patchproof.photo.detect import COARSEST_PX, DICTIONARY, levels, look, printed_markers, whole
from patchproof.photo.rectify import fit_page

SIZES_PX = ((1600, 1200), (2400, 1800), (4000, 3000))
COARSEST = (500, COARSEST_PX, 2000)
PIECE_MM, MARKER_MM, RASTER_PX_PER_MM = 140.0, 14.0, 10
DESIGN_MM = (20.0, 20.0, 100.0, 100.0)
SAMPLES = 3  # along each side of a pixel
MOST_MS = 333.0  # 12 megapixels, three a second


@dataclass(frozen=True)
class Shot:
    """A photograph with where the piece's millimetres truly lie in it."""

    srgb: np.ndarray
    px_from_mm: np.ndarray


def detect_charts(quick: bool, on_stage: OnStage) -> Iterator[Chart]:
    """Start size and refinement, one chart per photo size."""
    count = 3 if quick else 12
    for number, size_px in enumerate(SIZES_PX):
        shots = [shoot(size_px, seed) for seed in range(count)]
        megapixels = round(size_px[0] * size_px[1] / 1e6)
        points, found = [], []
        for coarsest_px in COARSEST:
            for name, find in (("fitted", find_fitted), ("OpenCV's", find_plain)):
                seconds, errors, share = tried(shots, find, coarsest_px)
                setting = f"{coarsest_px} px, {name}"
                default = coarsest_px == COARSEST_PX and find is find_fitted
                points.append(_point(setting, 1000 * seconds, errors, default))
                found.append((setting, f"{share:.1%}"))
        default = next(point for point in points if point.default)
        checks = [Check("px of corner error by default", default.error, 0.1)]
        if size_px == SIZES_PX[-1]:
            checks.append(Check("milliseconds by default", default.cost, MOST_MS))
        on_stage("detect", number + 1, len(SIZES_PX))
        yield Chart(
            name=f"levels_{megapixels}mp",
            title=f"Detection in photographs of {megapixels} MP: start size and refinement",
            cost_label="milliseconds of processor time per photograph",
            error_label="error of the design's corners, px (median)",
            series=(Series(f"{megapixels} MP", tuple(points)),),
            notes=(
                "the search starts at so many px; corners are fitted or OpenCV's",
                f"{count} photographs, tilt to 60°, blur to 1.2 px, JPEG 60 to 95; decoding is not counted",
            ),
            checks=tuple(checks),
            tables=(Table(("markers found", "share"), tuple(found)),),
        )


def _point(setting: str, milliseconds: np.ndarray, errors_px: np.ndarray, default: bool) -> Point:
    cost, cost_interval = mean_interval(milliseconds)
    error, error_interval = median_interval(errors_px)
    return Point(setting, cost, error, cost_interval, error_interval, default)


def corners_mm() -> dict[int, np.ndarray]:
    """The frame's markers: corners and middles of the piece's sides."""
    near, middle, far = 2.0, (PIECE_MM - MARKER_MM) / 2, PIECE_MM - 2.0 - MARKER_MM
    places = [(x, y) for y in (near, middle, far) for x in (near, middle, far) if (x, y) != (middle, middle)]
    return {100 + i: rect_corners([x, y, MARKER_MM, MARKER_MM]) for i, (x, y) in enumerate(places)}


def shoot(size_px: tuple[int, int], seed: int) -> Shot:
    """One photograph from a fixed seed: the piece fills a third of its height or so, over soft clutter."""
    rng = np.random.default_rng(seed)
    camera_from_piece, matrix = drawn_view(rng, size_px)
    px_from_mm = plane_homography(matrix, camera_from_piece, np.eye(4))
    clutter = drawn_clutter(rng, size_px)
    fine = tuple(SAMPLES * side for side in size_px)
    # index i of the fine grid lies at (i + 0.5) / SAMPLES px, texel j of the raster at (j + 0.5) / RASTER_PX_PER_MM mm
    fine_from_px = np.array([[SAMPLES, 0, -0.5], [0, SAMPLES, -0.5], [0, 0, 1.0]])
    mm_from_texel = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, RASTER_PX_PER_MM]]) / RASTER_PX_PER_MM
    matrix = fine_from_px @ px_from_mm @ mm_from_texel
    raster = piece_raster(rng)
    warp = lambda part: cv2.resize(  # noqa: E731
        cv2.warpPerspective(part, matrix, fine, flags=cv2.INTER_NEAREST), size_px, interpolation=cv2.INTER_AREA
    )
    light = clutter * (1 - warp(np.full(raster.shape, 1, np.float32))) + warp(raster)
    return Shot(developed(light, rng), px_from_mm)


def drawn_view(rng, size_px: tuple[int, int], most_azimuth_deg: float = 50.0) -> tuple[np.ndarray, np.ndarray]:
    """`camera_from_piece` 4×4 (mm, z into the paper) and the pinhole matrix 3×3."""
    azimuth, elevation = np.radians(rng.uniform([-most_azimuth_deg, -30], [most_azimuth_deg, 30]))
    toward = [np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)]
    world_from_piece = np.diag([1.0, -1.0, -1.0, 1.0])
    world_from_piece[:2, 3] = [-PIECE_MM / 2, PIECE_MM / 2]
    camera_from_world = look_at(rng.uniform(350, 700) * np.array(toward), [0, 0, 0], rng.uniform(-20, 20))
    return camera_from_world @ world_from_piece, intrinsics(50.0, size_px)


def drawn_clutter(rng, size_px: tuple[int, int]) -> np.ndarray:
    """H×W light of something soft behind the piece."""
    return cv2.resize(rng.uniform(0.05, 0.6, (24, 32)).astype(np.float32), size_px, interpolation=cv2.INTER_CUBIC)


def developed(light: np.ndarray, rng) -> np.ndarray:
    """uint8 H×W×3: the light H×W with drawn exposure, blur, noise and JPEG."""
    light = cv2.GaussianBlur(rng.uniform(0.3, 0.9) * light, (0, 0), rng.uniform(0.3, 1.2))
    light += rng.normal(0, rng.uniform(0, 0.01), light.shape).astype(np.float32)
    codes = photo_codes_of(srgb_from_linear(light.clip(0, 1)))
    jpeg = cv2.imencode(".jpg", codes, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(60, 96))])[1]
    gray = cv2.imdecode(jpeg, cv2.IMREAD_GRAYSCALE)
    return np.repeat(gray[..., None], 3, 2)


def piece_raster(rng) -> np.ndarray:
    """Light of the piece at RASTER_PX_PER_MM: markers, and a soft design."""
    side = round(PIECE_MM * RASTER_PX_PER_MM)
    raster = np.full((side, side), 0.95, np.float32)
    x, y, width, height = (round(v * RASTER_PX_PER_MM) for v in DESIGN_MM)
    design = rng.uniform(0.05, 0.9, (12, 12)).astype(np.float32)
    raster[y : y + height, x : x + width] = cv2.resize(design, (width, height), interpolation=cv2.INTER_LINEAR)
    printed, marker_px = printed_markers(DICTIONARY), round(MARKER_MM * RASTER_PX_PER_MM)
    for marker_id, corners in corners_mm().items():
        column, row = np.round(corners[0] * RASTER_PX_PER_MM).astype(int)
        code = cv2.aruco.generateImageMarker(printed, marker_id, marker_px) / 255
        raster[row : row + marker_px, column : column + marker_px] = 0.03 + 0.92 * code
    return raster


def find_fitted(srgb: np.ndarray, coarsest_px: int) -> dict[int, np.ndarray]:
    """Corners as patchproof takes them."""
    return find_sheet(srgb, frozenset(corners_mm()), corners_mm(), DICTIONARY, coarsest_px).corners_px


def find_plain(srgb: np.ndarray, coarsest_px: int) -> dict[int, np.ndarray]:
    """Corners as OpenCV refines them on the level that first shows each marker."""
    seen: dict[int, list[np.ndarray]] = {}
    for level in levels(srgb, whole(srgb), coarsest_px):
        look(srgb, whole(srgb), level, printed_markers(DICTIONARY), seen)
        if corners_mm().keys() <= seen.keys():
            break
    return {i: quads[0] for i, quads in seen.items() if i in corners_mm()}


def tried(shots: list[Shot], find, coarsest_px: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Seconds per photograph, all errors of the design's corners in px (infinite without a fit), share of markers."""
    seconds, errors, found = [], [], 0
    for shot in shots:
        begin = time.process_time()  # of the processor: other work on the machine does not count
        corners = find(shot.srgb, coarsest_px)
        seconds.append(time.process_time() - begin)
        found += len(corners)
        errors.append(_errors(corners, shot))
    return np.array(seconds), np.concatenate(errors), found / (len(shots) * len(corners_mm()))


def _errors(corners: dict[int, np.ndarray], shot: Shot) -> np.ndarray:
    design = rect_corners(DESIGN_MM)
    try:
        fit = fit_page(corners, corners_mm())
    except (CannotJudge, np.linalg.LinAlgError):
        return np.full(4, np.inf)
    off = apply_homography(fit.px_from_mm, design) - apply_homography(shot.px_from_mm, design)
    return np.linalg.norm(off, axis=1)
