"""Detectors of a sheet's markers: ours, and those that a user has.

In: photographs of flat paper. Out: milliseconds per photograph and the errors of the design's corners, with the same
fit of the page for all. A detector that knows other markers gets paper with those, as large.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib import import_module

import cv2
import numpy as np

from patchlab.charts.paper_photos import DESIGN_MM, MarkerCorners, Sheet, corners_mm, draw_sheet, photograph_paper
from patchlab.study.measure import time_call
from patchproof.base.geometry import apply_homography, rect_corners
from patchproof.photo.known_page import find_sheet
from patchproof.photo.rectify import fit_page
from patchproof.photo.rejection import PhotoRejected
from patchproof.sheets.markers import DICTIONARY, aruco_dictionary

APRILTAG = "DICT_APRILTAG_36h11"


@dataclass(frozen=True)
class DetectionTrial:
    """Milliseconds per photograph, and all errors of the design's four corners in px (infinite without a fit)."""

    milliseconds: list[float]
    errors_px: np.ndarray


def find_fitted_corners(srgb: np.ndarray) -> MarkerCorners:
    """Find corners as patchproof does."""
    return find_sheet(srgb, frozenset(corners_mm()), corners_mm(), DICTIONARY).corners_px


def find_opencv_corners(srgb: np.ndarray, refinement: int) -> dict[int, np.ndarray]:
    """Find corners by OpenCV's detector as it is, with one of its refinements."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = refinement
    detector = cv2.aruco.ArucoDetector(aruco_dictionary(DICTIONARY), parameters)
    quads, ids, _ = detector.detectMarkers(cv2.cvtColor(srgb, cv2.COLOR_RGB2GRAY))
    found = [] if ids is None else zip(ids.ravel(), quads, strict=True)
    return {int(i): quad.reshape(4, 2) + 0.5 for i, quad in found if i in corners_mm()}


def find_tag_corners(srgb: np.ndarray) -> MarkerCorners:
    """Find corners by AprilTag's own library, which counts them from another corner than OpenCV."""
    tags = [tag for tag in _tag_detector().detect(cv2.cvtColor(srgb, cv2.COLOR_RGB2GRAY)) if tag.tag_id in corners_mm()]
    turns = [{t.tag_id: np.roll(t.corners[::-1], turn, 0) for t in tags} for turn in range(4)]
    return min(turns, key=_residual_px)


@lru_cache(maxsize=1)
def _tag_detector():
    return import_module("pupil_apriltags").Detector(families="tag36h11", nthreads=1)


def _residual_px(corners: MarkerCorners) -> float:
    if not corners:
        return np.inf
    homography, ids = fit_page(corners, corners_mm()).px_from_mm, list(corners)
    seen = apply_homography(homography, np.concatenate([corners_mm()[i] for i in ids]))
    return float(np.linalg.norm(seen - np.concatenate([corners[i] for i in ids]), axis=1).mean())


# By name: the detector, and the markers of its paper.
FINDERS: dict[str, tuple[Callable[[np.ndarray], MarkerCorners], str]] = {
    "ours": (find_fitted_corners, DICTIONARY),
    "ArUco": (partial(find_opencv_corners, refinement=cv2.aruco.CORNER_REFINE_NONE), DICTIONARY),
    "ArUco subpixel": (partial(find_opencv_corners, refinement=cv2.aruco.CORNER_REFINE_SUBPIX), DICTIONARY),
    "AprilTag": (find_tag_corners, APRILTAG),
}


def try_finder(name: str, count: int, size_px: tuple[int, int]) -> DetectionTrial:
    """Try a detector of `FINDERS` on so many photographs, after one that warms it up."""
    find, dictionary = FINDERS[name]
    milliseconds, errors = [], []
    for seed in range(count):
        sheet, rng = draw_sheet(seed, size_px)
        photo = photograph_paper(sheet, rng, dictionary)
        if not seed:
            find(photo)
        corners, ms = time_call(partial(find, photo))
        milliseconds.append(ms)
        errors.append(_corner_errors_px(corners, sheet))
    return DetectionTrial(milliseconds, np.concatenate(errors))


def _corner_errors_px(corners: MarkerCorners, sheet: Sheet) -> np.ndarray:
    design = rect_corners(DESIGN_MM)
    try:
        fit = fit_page(corners, corners_mm())
    except (PhotoRejected, np.linalg.LinAlgError):
        return np.full(4, np.inf)
    return np.linalg.norm(apply_homography(fit.px_from_mm, design) - sheet.px(design), axis=1)
