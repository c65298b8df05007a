"""What evidence costs: which model makes a piece's photograph flat.

In: photographs of paper. Out: a chart. Errors are in millimeters of the paper, over the whole design.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache, partial

import numpy as np

from patchlab.bench.chart import Chart, Point, Progress
from patchlab.bench.measure import clocked
from patchlab.bench.paper import (
    DESIGN_MM,
    LENS,
    RADII_MM,
    SIZE_PX,
    Kind,
    Sheet,
    corners_mm,
    drawn_sheet,
    photographed,
)
from patchlab.study.claims import median
from patchproof.base.geometry import apply_homography, fit_homography
from patchproof.photo.known_page import find_sheet
from patchproof.photo.rectify import fit_page
from patchproof.photo.shapes import fit_cylinder, fit_radial_lens
from patchproof.photo.unroll import fit_shape
from patchproof.sheets.markers import DICTIONARY

WRONG_PX = 4.0  # by which a marker is moved that was glued on again

Corners = Mapping[int, np.ndarray]
ToPx = Callable[[np.ndarray], np.ndarray]


def charts(quick: bool, progress: Progress) -> Iterator[Chart]:
    """Models."""
    yield models_chart(4 if quick else 24, progress)


def error_mm(model: ToPx, sheet: Sheet) -> float:
    """The largest distance on paper, over a net on the design, between where a model sees a point and where it is."""
    x, y, width, height = DESIGN_MM
    across, down = np.meshgrid(np.linspace(x, x + width, 5), np.linspace(y, y + height, 5))
    net = np.column_stack([across.ravel(), down.ravel()])
    by_mm = [(sheet.px(net + step) - sheet.px(net - step)) / 0.1 for step in 0.05 * np.eye(2)]
    off = np.linalg.solve(np.stack(by_mm, -1), (model(net) - sheet.px(net))[..., None])
    return float(np.linalg.norm(off[..., 0], axis=1).max())


def plane(corners_px: Corners) -> ToPx:
    """The page's homography as the tool fits it."""
    homography = fit_page(corners_px, corners_mm()).px_from_mm
    return lambda mm: apply_homography(homography, mm)


def _all_corners(corners_px: Corners) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    ids = sorted(corners_px)
    px, mm = (np.concatenate([corners[i] for i in ids]) for corners in (corners_px, corners_mm()))
    return fit_homography(mm, px), mm, px


def _plain(corners_px: Corners) -> ToPx:
    homography, *_ = _all_corners(corners_px)
    return lambda mm: apply_homography(homography, mm)


def _lens(corners_px: Corners) -> ToPx:
    return fit_radial_lens(*_all_corners(corners_px), SIZE_PX).px


def _cylinder(corners_px: Corners) -> ToPx:
    shape = fit_cylinder(*_all_corners(corners_px), SIZE_PX, None)
    return plane(corners_px) if shape is None else shape.px


def what_pays(corners_px: Corners) -> ToPx:
    """As photographs are measured: a plane, unless a cylinder or a lens explains the corners far better."""
    explained = fit_shape(corners_px, corners_mm(), SIZE_PX)
    return plane(corners_px) if explained is None else explained.shape.px


MODELS: dict[str, Callable[[Corners], ToPx]] = {
    "plain plane": _plain,
    "robust plane": plane,
    "lens": _lens,
    "cylinder": _cylinder,
    "what pays": what_pays,
}
DEFAULT_MODEL = "what pays"  # as in `evidence.measure`


@lru_cache(maxsize=512)
def corners_found(kind: Kind, seed: int) -> dict[int, np.ndarray]:
    """The corners that are found in a sheet's photograph, by marker."""
    photo = photographed(*drawn_sheet(kind, seed))
    return find_sheet(photo, frozenset(corners_mm()), corners_mm(), DICTIONARY).corners_px


def models_chart(count: int, progress: Progress) -> Chart:
    """Models of the sheet against the error of the design, on flat, misprinted, bent and rolled sheets."""
    kinds: dict[str, tuple[Kind, float]] = {
        "flat": ("flat", 0.0),
        f"flat, a marker {WRONG_PX:g} px off": ("flat", WRONG_PX),
        "lens": ("lens", 0.0),
        "rolled": ("rolled", 0.0),
    }
    series = {}
    for number, (label, (kind, wrong_px)) in enumerate(kinds.items()):
        errors: dict[str, list[float]] = {name: [] for name in MODELS}
        milliseconds: dict[str, list[float]] = {name: [] for name in MODELS}
        for seed in range(count):
            sheet, wrong = drawn_sheet(kind, seed)[0], sorted(corners_mm())[seed % len(corners_mm())]
            corners = {i: px + np.array([wrong_px * (i == wrong), 0]) for i, px in corners_found(kind, seed).items()}
            for name, model in MODELS.items():
                fitted, taken = clocked(partial(model, corners))
                milliseconds[name].append(taken)
                errors[name].append(error_mm(fitted, sheet))
        series[label] = [
            Point(name, median(milliseconds[name]), median(errors[name]), name == DEFAULT_MODEL) for name in MODELS
        ]
        progress("models of sheets", number + 1, len(kinds))
    return Chart(
        name="models",
        title="What makes a sheet flat",
        cost="milliseconds to fit (median); finding the markers is not counted",
        error="largest error on the design, mm (median)",
        series=series,
        about=f"{count} photographs with eight markers; rolled: radius {RADII_MM[0]:g} to {RADII_MM[1]:g} mm, either "
        f"way; lens: k1 {LENS[0]:g}. What pays: the robust plane, unless its residual is halved by a lens or a "
        "cylinder; no focal length known.",
    )
