"""How many markers a piece needs, and which model makes its photograph flat.

In: nothing. Photographs are those of `detect`, on flat paper, through a lens that bends, and of rolled paper: every
pixel is traced back to the paper by OpenCV's lens and a ray through a cylinder, so that nothing of the tool's own
models is used. Out: two charts. Errors are in millimetres of the paper, over the whole design.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import cv2
import numpy as np

from patchproof.bench.chart import Chart, OnStage, Point, Series, Table
from patchproof.bench.detect import (
    DESIGN_MM,
    MARKER_MM,
    PIECE_MM,
    RASTER_PX_PER_MM,
    SAMPLES,
    corners_mm,
    developed,
    drawn_clutter,
    drawn_view,
    piece_raster,
)
from patchproof.bench.measure import median_interval
from patchproof.geometry import apply_homography, fit_homography
from patchproof.photo.complete import find_sheet
from patchproof.photo.detect import DICTIONARY
from patchproof.photo.rectify import fit_page
from patchproof.photo.unroll import explain, rolled, through_lens
from patchproof.sheets.piece import MODULES, lay_out_piece

SIZE_PX = (1600, 1200)
LENS = np.array([-0.12, 0.03, 5e-4, -5e-4, 0.0])  # k1 k2 p1 p2 k3: a wide phone camera
RADII_MM = (100.0, 400.0)
ASIDE_DEG = 35.0  # rolled paper hides a part of itself beyond
WRONG_PX = 4.0  # by which a marker is moved that was glued on again
MARKERS = {1: (100,), 2: (100, 107), 4: (100, 102, 105, 107), 8: tuple(range(100, 108))}
COVERED = 100  # the marker of the corner that something covers

_AROUND = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]])  # the piece's corners, as shares of it

Corners = Mapping[int, np.ndarray]
ToPx = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Sheet:
    """Paper before a camera: flat where `curvature` (1/mm) is 0, else rolled about its upright middle."""

    camera_from_piece: np.ndarray
    matrix_px: np.ndarray
    terms: np.ndarray
    curvature: float

    def px(self, mm: np.ndarray) -> np.ndarray:
        """Where points N×2 of the paper are seen, N×2."""
        x, y = np.asarray(mm, float).T
        along, k = x - PIECE_MM / 2, self.curvature
        away = (1 - np.cos(k * along)) / k if k else 0 * x
        points = np.column_stack([PIECE_MM / 2 + (np.sin(k * along) / k if k else along), y, away])
        turn, move = cv2.Rodrigues(self.camera_from_piece[:3, :3])[0], self.camera_from_piece[:3, 3]
        return cv2.projectPoints(points, turn, move, self.matrix_px, self.terms)[0].reshape(-1, 2)

    def mm(self, px: np.ndarray) -> np.ndarray:
        """Which point N×2 of the paper is seen at pixels N×2; NaN where none is."""
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-9)
        ray = cv2.undistortPoints(px.reshape(-1, 1, 2), self.matrix_px, self.terms, criteria=stop).reshape(-1, 2)
        rotation, k = self.camera_from_piece[:3, :3], self.curvature
        ray = np.column_stack([ray, np.ones(len(ray))]) @ rotation
        eye = -rotation.T @ self.camera_from_piece[:3, 3] - [PIECE_MM / 2, 0, 0]
        if not k:
            points = eye - ray * (eye[2] / ray[:, 2])[:, None]
            return points[:, :2] + [PIECE_MM / 2, 0]
        radius = 1 / k
        a, b = (ray[:, [0, 2]] ** 2).sum(1), ray[:, 0] * eye[0] + ray[:, 2] * (eye[2] - radius)
        rest = b * b - a * (eye[0] ** 2 + (eye[2] - radius) ** 2 - radius**2)
        far = (-b - np.sign(radius) * np.sqrt(np.where(rest > 0, rest, np.nan))) / a
        x, y, z = (eye[i] + far * ray[:, i] for i in range(3))
        return np.column_stack([radius * np.arctan2(x * k, 1 - z * k) + PIECE_MM / 2, y])


def drawn_sheet(kind: str, seed: int) -> tuple[Sheet, np.random.Generator]:
    """A sheet that is "flat", seen through a "lens", or "rolled"."""
    rng = np.random.default_rng([seed, 1])
    pose, matrix = drawn_view(rng, SIZE_PX, ASIDE_DEG)
    curvature = rng.choice([-1, 1]) / rng.uniform(*RADII_MM) if kind == "rolled" else 0.0
    return Sheet(pose, matrix, LENS if kind == "lens" else np.zeros(5), float(curvature)), rng


def photographed(sheet: Sheet, rng) -> np.ndarray:
    """uint8 H×W×3 photograph of the sheet over soft clutter."""
    picture, raster = drawn_clutter(rng, SIZE_PX), piece_raster(rng)
    border = sheet.px(np.concatenate([PIECE_MM * np.linspace(a, b, 50) for a, b in pairwise(_AROUND)]))
    left, top = np.clip(np.floor(border.min(0)).astype(int) - 2, 0, SIZE_PX)
    right, bottom = np.clip(np.ceil(border.max(0)).astype(int) + 2, 0, SIZE_PX)
    y, x = np.mgrid[top:bottom, left:right] + 0.5
    mm = sheet.mm(np.column_stack([x.ravel(), y.ravel()])).reshape(*x.shape, 2)
    # the map from pixels to paper is smooth: between pixels it is straight to a thousandth of one
    fine = SAMPLES * (right - left), SAMPLES * (bottom - top)
    at = cv2.resize(np.nan_to_num(mm, nan=-1e3).astype(np.float32), fine, interpolation=cv2.INTER_LINEAR)
    inside = ((at > 0) & (at < PIECE_MM)).all(2).astype(np.float32)
    seen = inside * cv2.remap(raster, at * RASTER_PX_PER_MM - 0.5, None, cv2.INTER_NEAREST)
    light, cover = (cv2.resize(part, x.shape[::-1], interpolation=cv2.INTER_AREA) for part in (seen, inside))
    part = picture[top:bottom, left:right]
    picture[top:bottom, left:right] = part * (1 - cover) + light
    return developed(picture, rng)


@lru_cache(maxsize=512)
def corners_found(kind: str, seed: int) -> dict[int, np.ndarray]:
    """The corners that are found in that photograph, by marker."""
    sheet, rng = drawn_sheet(kind, seed)
    return find_sheet(photographed(sheet, rng), frozenset(corners_mm()), corners_mm(), DICTIONARY).corners_px


def error_mm(found: ToPx, sheet: Sheet) -> float:
    """The largest distance on paper, over a net on the design, between where a model sees a point and where it is."""
    x, y, width, height = DESIGN_MM
    across, down = np.meshgrid(np.linspace(x, x + width, 5), np.linspace(y, y + height, 5))
    net = np.column_stack([across.ravel(), down.ravel()])
    by_mm = [(sheet.px(net + step) - sheet.px(net - step)) / 0.1 for step in 0.05 * np.eye(2)]
    off = np.linalg.solve(np.stack(by_mm, -1), (found(net) - sheet.px(net))[..., None])
    return float(np.linalg.norm(off[..., 0], axis=1).max())


# How many markers


def markers_chart(count: int, on_stage: OnStage) -> Chart:
    """Markers in the frame against the error of the design, with all of them in view and with a corner covered."""
    ways = {"all in view": (), "a corner covered": (COVERED,)}
    errors = {(way, n): [] for way in ways for n in MARKERS}
    seconds = {n: [] for n in MARKERS}
    for seed in range(count):
        sheet, rng = drawn_sheet("flat", seed)
        photo = photographed(sheet, rng)
        for n, ids in MARKERS.items():
            places = {i: corners_mm()[i] for i in ids}
            begin = time.perf_counter()
            found = find_sheet(photo, frozenset(ids), places, DICTIONARY).corners_px
            seconds[n].append(1000 * (time.perf_counter() - begin))
            for way, covered in ways.items():
                seen = {i: px for i, px in found.items() if i not in covered}
                errors[way, n].append(error_mm(plane(seen), sheet) if seen else np.inf)
        on_stage("markers", seed + 1, count)
    rows = tuple((f"{n}", f"{np.median(values):.0f}") for n, values in seconds.items())
    return Chart(
        "markers",
        "Markers in the frame",
        "% of the piece's area that markers and their quiet zones take",
        f"largest error on the design, mm (median of {count} photographs, 95 %)",
        tuple(Series(way, tuple(_marker_points(errors, way))) for way in ways),
        (
            f"a piece of {PIECE_MM:g} mm with markers of {MARKER_MM:g} mm, tilt to 45°, {SIZE_PX[0]} × {SIZE_PX[1]} px",
            "1: a corner, 2: two opposite corners, 4: all corners, 8: and the sides' middles, which the frame has "
            "room for",
            "with its only marker covered a sheet is not found: no point",
        ),
        tables=(Table(("markers", "ms to find them"), rows),),
    )


def _marker_points(errors: Mapping[tuple[str, int], list[float]], way: str) -> list[Point]:
    side = MARKER_MM * (MODULES + 2) / MODULES
    default, points = len(lay_out_piece(DESIGN_MM[2:], MARKER_MM, "", "design").markers), []
    for n in MARKERS:
        middle, interval = median_interval(np.array(errors[way, n]))
        if np.isfinite([middle, *interval]).all():
            area = 100 * n * side**2 / PIECE_MM**2
            points.append(Point(f"{n}", area, middle, (area, area), interval, n == default))
    return points


# Which model


def plane(corners_px: Corners) -> ToPx:
    """The page's homography as the tool fits it."""
    homography = fit_page(corners_px, corners_mm()).px_from_mm
    return lambda mm: apply_homography(homography, mm)


def _all_corners(corners_px: Corners) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    ids = sorted(corners_px)
    px, mm = (np.concatenate([one[i] for i in ids]) for one in (corners_px, corners_mm()))
    return fit_homography(mm, px), mm, px


def _plain(corners_px: Corners) -> ToPx:
    homography, *_ = _all_corners(corners_px)
    return lambda mm: apply_homography(homography, mm)


def _lens(corners_px: Corners) -> ToPx:
    return through_lens(*_all_corners(corners_px), SIZE_PX).px


def _cylinder(corners_px: Corners) -> ToPx:
    found = rolled(*_all_corners(corners_px), SIZE_PX, None)
    return plane(corners_px) if found is None else found.px


def what_pays(corners_px: Corners) -> ToPx:
    """As photographs are measured: a plane, unless a cylinder or a lens explains the corners far better."""
    flat, found = plane(corners_px), explain(corners_px, corners_mm(), SIZE_PX)
    return flat if found is None else found.shape.px


MODELS: dict[str, Callable[[Corners], ToPx]] = {
    "plain plane": _plain,
    "robust plane": plane,
    "lens": _lens,
    "cylinder": _cylinder,
    "what pays": what_pays,
}
DEFAULT_MODEL = what_pays  # as in `verify.measure`


def models_chart(count: int, on_stage: OnStage) -> Chart:
    """Models of the sheet against the error of the design, on flat, misprinted, bent and rolled sheets."""
    kinds = {"flat": 0.0, f"flat, a marker {WRONG_PX:g} px off": WRONG_PX, "lens": 0.0, "rolled": 0.0}
    series = []
    for number, (label, wrong_px) in enumerate(kinds.items()):
        errors, seconds = {name: [] for name in MODELS}, {name: [] for name in MODELS}
        for seed in range(count):
            sheet, _ = drawn_sheet(kind := label.partition(",")[0], seed)
            wrong = COVERED + seed % len(corners_mm())
            found = {i: px + np.array([wrong_px * (i == wrong), 0]) for i, px in corners_found(kind, seed).items()}
            for name, model in MODELS.items():
                begin = time.perf_counter()
                fitted = model(found)
                seconds[name].append(1000 * (time.perf_counter() - begin))
                errors[name].append(error_mm(fitted, sheet))
        points = []
        for name, model in MODELS.items():
            cost, error = median_interval(np.array(seconds[name])), median_interval(np.array(errors[name]))
            points.append(Point(name, cost[0], error[0], cost[1], error[1], model is DEFAULT_MODEL))
        series.append(Series(label, tuple(points)))
        on_stage("models of sheets", number + 1, len(kinds))
    return Chart(
        "models",
        "What makes a sheet flat",
        "milliseconds to fit (median); finding the markers is not counted",
        f"largest error on the design, mm (median of {count} photographs, 95 %)",
        tuple(series),
        (
            f"eight markers; rolled: radius {RADII_MM[0]:g} to {RADII_MM[1]:g} mm, either way; lens: k1 {LENS[0]:g}",
            "what pays: the robust plane, unless its residual is halved by a lens or a cylinder; no focal length known",
        ),
    )
