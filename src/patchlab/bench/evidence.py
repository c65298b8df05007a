"""Benchmark models of the sheet's shape: plane, lens, cylinder.

In: photographs of paper. Out: a chart. Errors are in millimeters on the paper, over the whole design.
"""

from collections.abc import Callable, Iterator
from functools import lru_cache, partial

import numpy as np

from patchlab.bench import paper_photos
from patchlab.bench.chart import Chart, ChartPoint
from patchlab.bench.measure import time_call
from patchlab.study.estimates import median
from patchproof.base.geometry import apply_homography, fit_homography
from patchproof.base.progress import Progress
from patchproof.photo.known_page import find_sheet
from patchproof.photo.rectify import fit_page
from patchproof.photo.shapes import fit_cylinder, fit_radial_lens
from patchproof.photo.unroll import fit_shape
from patchproof.sheets.markers import DICTIONARY

MARKER_SHIFT_PX = 4.0  # shift of one marker, as if it had been glued on again

PixelModel = Callable[[np.ndarray], np.ndarray]


def charts(quick: bool, progress: Progress) -> Iterator[Chart]:
    """Chart the models."""
    yield models_chart(4 if quick else 24, progress)


def error_mm(model: PixelModel, sheet: paper_photos.Sheet) -> float:
    """The largest error of a model on paper, over a 5×5 grid on the design."""
    x, y, width, height = paper_photos.DESIGN_MM
    across, down = np.meshgrid(np.linspace(x, x + width, 5), np.linspace(y, y + height, 5))
    grid = np.column_stack([across.ravel(), down.ravel()])
    by_mm = [(sheet.px(grid + step) - sheet.px(grid - step)) / 0.1 for step in 0.05 * np.eye(2)]
    off = np.linalg.solve(np.stack(by_mm, -1), (model(grid) - sheet.px(grid))[..., None])
    return float(np.linalg.norm(off[..., 0], axis=1).max())


def fit_robust_plane(corners_px: paper_photos.MarkerCorners) -> PixelModel:
    """The page's homography as the tool fits it, robust to single markers."""
    homography = fit_page(corners_px, paper_photos.corners_mm()).px_from_mm
    return lambda mm: apply_homography(homography, mm)


def _all_corners(corners_px: paper_photos.MarkerCorners) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    ids = sorted(corners_px)
    px, mm = (np.concatenate([corners[i] for i in ids]) for corners in (corners_px, paper_photos.corners_mm()))
    return fit_homography(mm, px), mm, px


def _fit_plain_plane(corners_px: paper_photos.MarkerCorners) -> PixelModel:
    homography, *_ = _all_corners(corners_px)
    return lambda mm: apply_homography(homography, mm)


def _fit_lens(corners_px: paper_photos.MarkerCorners) -> PixelModel:
    return fit_radial_lens(*_all_corners(corners_px), paper_photos.SIZE_PX).px


def _fit_cylinder(corners_px: paper_photos.MarkerCorners) -> PixelModel:
    shape = fit_cylinder(*_all_corners(corners_px), paper_photos.SIZE_PX, None)
    return fit_robust_plane(corners_px) if shape is None else shape.px


def choose_model(corners_px: paper_photos.MarkerCorners) -> PixelModel:
    """The model that the tool measures with: a plane, unless a cylinder or a lens fits the corners far better."""
    explained = fit_shape(corners_px, paper_photos.corners_mm(), paper_photos.SIZE_PX)
    return fit_robust_plane(corners_px) if explained is None else explained.shape.px


MODELS: dict[str, Callable[[paper_photos.MarkerCorners], PixelModel]] = {
    "plain plane": _fit_plain_plane,
    "robust plane": fit_robust_plane,
    "lens": _fit_lens,
    "cylinder": _fit_cylinder,
    "what pays": choose_model,
}
DEFAULT_MODEL = "what pays"  # as in `evidence.measure`


@lru_cache(maxsize=512)
def find_sheet_corners(kind: paper_photos.Kind, seed: int) -> dict[int, np.ndarray]:
    """Corners found in a photograph of the sheet, by marker."""
    photo = paper_photos.photograph_paper(*paper_photos.draw_sheet(kind, seed))
    return find_sheet(photo, frozenset(paper_photos.corners_mm()), paper_photos.corners_mm(), DICTIONARY).corners_px


def models_chart(count: int, progress: Progress) -> Chart:
    """Milliseconds of each model against its error, on flat, misprinted, distorted and rolled sheets."""
    kinds: dict[str, tuple[paper_photos.Kind, float]] = {
        "flat": ("flat", 0.0),
        f"flat, a marker {MARKER_SHIFT_PX:g} px off": ("flat", MARKER_SHIFT_PX),
        "lens": ("lens", 0.0),
        "rolled": ("rolled", 0.0),
    }
    series, (near, far) = {}, paper_photos.RADII_MM
    for number, (label, (kind, wrong_px)) in enumerate(kinds.items()):
        errors: dict[str, list[float]] = {name: [] for name in MODELS}
        milliseconds: dict[str, list[float]] = {name: [] for name in MODELS}
        for seed in range(count):
            sheet, ids = paper_photos.draw_sheet(kind, seed)[0], sorted(paper_photos.corners_mm())
            shifted = ids[seed % len(ids)]
            corners = {
                i: px + np.array([wrong_px * (i == shifted), 0]) for i, px in find_sheet_corners(kind, seed).items()
            }
            for name, model in MODELS.items():
                fitted, ms = time_call(partial(model, corners))
                milliseconds[name].append(ms)
                errors[name].append(error_mm(fitted, sheet))
        series[label] = [
            ChartPoint(name, median(milliseconds[name]), median(errors[name]), name == DEFAULT_MODEL) for name in MODELS
        ]
        progress("models of sheets", number + 1, len(kinds))
    return Chart(
        name="models",
        title="What makes a sheet flat",
        cost="milliseconds to fit (median); finding the markers is not counted",
        error="largest error on the design, mm (median)",
        series=series,
        about=f"{count} photographs with eight markers; rolled: radius {near:g} to {far:g} mm, either "
        f"way; lens: k1 {paper_photos.LENS_TERMS[0]:g}. What pays: the robust plane, unless its residual is halved by "
        "a lens or a cylinder; no focal length known.",
    )
