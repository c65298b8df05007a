"""Benchmark detection: the size at which the search starts, corner refinement, and the size of photographs.

In: photographs of flat paper. Out: a chart per photo size, of milliseconds per photograph against the error of the
design's corners.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from patchlab.bench.chart import Chart, ChartPoint, Check
from patchlab.bench.measure import time_call
from patchlab.bench.paper_photos import DESIGN_MM, MarkerCorners, Sheet, corners_mm, draw_sheet, photograph_paper
from patchlab.study.estimates import median
from patchproof.base.geometry import apply_homography, rect_corners
from patchproof.base.progress import Progress
from patchproof.photo.detect import COARSEST_PX, full_region, pyramid_levels, search_level
from patchproof.photo.known_page import find_sheet
from patchproof.photo.rectify import fit_page
from patchproof.photo.rejection import PhotoRejected
from patchproof.report.tables import Table
from patchproof.sheets.markers import DICTIONARY, aruco_dictionary

SIZES_PX = ((1600, 1200), (2400, 1800), (4000, 3000))
START_SIDES_PX = (500, COARSEST_PX, 2000)
WIDE_AZIMUTH_DEG = 50.0
MAX_MILLISECONDS = 333.0  # 12 megapixels, three a second

CornerFinder = Callable[[np.ndarray, int], MarkerCorners]
KnownPhoto = tuple[np.ndarray, Sheet]  # a photograph, and the sheet that it shows


@dataclass(frozen=True)
class DetectionTrial:
    """Milliseconds per photograph, all errors of the design's corners in px (infinite without a fit), and the share of
    markers found.
    """

    milliseconds: list[float]
    errors_px: np.ndarray
    share: float


def charts(quick: bool, progress: Progress) -> Iterator[Chart]:
    """Chart start size and refinement, one chart per photo size."""
    count = 3 if quick else 12
    for number, size_px in enumerate(SIZES_PX):
        yield _levels_chart([photograph_sheet(size_px, seed) for seed in range(count)], size_px)
        progress("detect", number + 1, len(SIZES_PX))


def _levels_chart(shots: list[KnownPhoto], size_px: tuple[int, int]) -> Chart:
    megapixels, points, shares = round(size_px[0] * size_px[1] / 1e6), [], []
    for coarsest_px in START_SIDES_PX:
        for name, find in (("fitted", find_fitted_corners), ("OpenCV's", find_opencv_corners)):
            trial, setting = try_finder(shots, find, coarsest_px), f"{coarsest_px} px, {name}"
            cost, error = median(trial.milliseconds), median(trial.errors_px)
            points.append(ChartPoint(setting, cost, error, coarsest_px == COARSEST_PX and find is find_fitted_corners))
            shares.append((setting, trial.share))
    default = next(point for point in points if point.default)
    checks = [Check("px of corner error by default", default.center[1], 0.1)]
    if size_px == SIZES_PX[-1]:
        checks.append(Check("milliseconds by default", default.center[0], MAX_MILLISECONDS))
    return Chart(
        name=f"levels_{megapixels}mp",
        title=f"Detection in photographs of {megapixels} MP: start size and refinement",
        cost="milliseconds of processor time per photograph (median)",
        error="error of the design's corners, px (median)",
        series={f"{megapixels} MP": points},
        about="The search starts at so many px; corners are fitted or OpenCV's. "
        f"{len(shots)} photographs, tilt to 60°, blur to 1.2 px, JPEG 60 to 95; decoding is not counted.",
        checks=tuple(checks),
        tables=(Table(f"found_{megapixels}mp", "Markers found", ("setting", "share"), tuple(shares)),),
    )


def photograph_sheet(size_px: tuple[int, int], seed: int) -> KnownPhoto:
    """A photograph of flat paper, drawn from the seed, with its sheet."""
    sheet, rng = draw_sheet("flat", seed, size_px, WIDE_AZIMUTH_DEG)
    return photograph_paper(sheet, rng), sheet


def find_fitted_corners(srgb: np.ndarray, coarsest_px: int) -> MarkerCorners:
    """Find corners as patchproof does."""
    return find_sheet(srgb, frozenset(corners_mm()), corners_mm(), DICTIONARY, coarsest_px).corners_px


def find_opencv_corners(srgb: np.ndarray, coarsest_px: int) -> MarkerCorners:
    """Find corners as OpenCV refines them on the pyramid level that first shows each marker."""
    quads: dict[int, list[np.ndarray]] = {}
    for level in pyramid_levels(srgb, full_region(srgb), coarsest_px):
        search_level(srgb, full_region(srgb), level, aruco_dictionary(DICTIONARY), quads)
        if corners_mm().keys() <= quads.keys():
            break
    return {i: quads[i][0] for i in quads if i in corners_mm()}


def try_finder(shots: list[KnownPhoto], find: CornerFinder, coarsest_px: int) -> DetectionTrial:
    """Try a corner finder on all photographs."""
    milliseconds, errors, markers = [], [], 0
    for photo, sheet in shots:
        corners, ms = time_call(partial(find, photo, coarsest_px))
        milliseconds.append(ms)
        markers += len(corners)
        errors.append(_corner_errors_px(corners, sheet))
    return DetectionTrial(milliseconds, np.concatenate(errors), markers / (len(shots) * len(corners_mm())))


def _corner_errors_px(corners: MarkerCorners, sheet: Sheet) -> np.ndarray:
    design = rect_corners(DESIGN_MM)
    try:
        fit = fit_page(corners, corners_mm())
    except (PhotoRejected, np.linalg.LinAlgError):
        return np.full(4, np.inf)
    return np.linalg.norm(apply_homography(fit.px_from_mm, design) - sheet.px(design), axis=1)
