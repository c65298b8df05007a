"""Find and measure the sheet in rendered photographs, and compare with the renderer's truth.

The stated uncertainty is checked, too.
In: a scene with wide ranges of view, light and camera. Out: by photograph its status, its code and
the error of the design's corners; over all photographs shares with Wilson intervals by tilt, distance, blur, noise,
light, hiding and JPEG. The sheet has noise in place of a design, since only markers are read. In a share of the
photographs a card of drawn size, position and color hides a part of the piece.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import torch
from pydantic import Field

from patchlab.study.estimates import clustered_median
from patchlab.study.record import corner_error_mm
from patchlab.study.study import Cell, Result, Study
from patchlab.validation.mounted_sheets import mount_content
from patchproof.base.errors import Refused
from patchproof.base.geometry import apply_homography, local_scale, rect_corners
from patchproof.base.intervals import Estimate, rate
from patchproof.base.output import image_pixels
from patchproof.base.resample import to_sixteenths
from patchproof.base.validation import Share, StrictModel
from patchproof.evidence.camera import pinhole_photo
from patchproof.evidence.measure import measure
from patchproof.evidence.ranges import promised_ranges
from patchproof.evidence.surface import surface_of
from patchproof.photo.read import Photo
from patchproof.render.photograph import photograph
from patchproof.render.stage import set_stage
from patchproof.report.tables import Table
from patchproof.reprints.mounted_sheet import MountedSheet, jpeg_of
from patchproof.scene.conditions import Conditions
from patchproof.scene.patch_scene import PatchScene, require_patch
from patchproof.scene.scene import load_scene
from patchproof.sheets.content import SheetContent
from patchproof.sheets.piece import control_design

MEASURABLE_TILT_DEG, MEASURABLE_BLUR_PX = 70.0, 1.5  # bounds on errors are claimed up to these
SHARP_MODULE_PX = 4.0  # pixels per marker module from which corners should be right to a tenth of a pixel
_BIN_EDGES = {
    "tilt_deg": (0, 20, 40, 50, 60, 70, 90),
    "module_px": (0, 1.5, 2, 3, 4, 6, 30),
    "blur_px": (0, 0.5, 1, 1.5, 2, 9),
    "noise": (0, 0.01, 0.02, 0.03, 1),
    "light": (0, 0.06, 0.12, 0.25, 0.5, 9),
    "hidden": (0, 1e-9, 0.1, 0.25, 0.5, 1.01),
    "jpeg": (40, 55, 70, 85, 101),
}
_LABELS = {
    "tilt_deg": "tilt in degrees",
    "module_px": "pixels per marker module",
    "blur_px": "blur, Gaussian sigma in pixels",
    "noise": "noise at white",
    "light": "light of white paper",
    "hidden": "share of the piece hidden",
    "jpeg": "JPEG quality",
}


class DetectionSettings(StrictModel):
    """The scene, and the number of photographs."""

    scene: str  # a scene file of one object with a patch
    photos: Annotated[int, Field(ge=1, le=100_000)] = 200  # number of photographs
    hidden: Share = 0.4  # share of them in which a card hides a part of the piece
    seed: int = 0  # seed of all draws


def cells(settings: DetectionSettings, base: Path) -> list[Cell]:
    """A cell per photograph."""
    return [Cell(f"photo_{i:05d}", {"number": i}) for i in range(settings.photos)]


def run(settings: DetectionSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Take one photograph and measure it; corner errors are None without a homography."""
    (sheet, scene), number = mount_noise_sheet(str(base / settings.scene), settings.seed), cell.values["number"]
    surface = surface_of(sheet.manifest)
    conditions = scene.draw("reprint", 1, settings.seed, number)
    rng = np.random.default_rng([settings.seed, number])
    truth = sheet.px_from_page(conditions)
    srgb, hidden = _photograph_sheet(sheet, conditions, truth, rng, rng.random() < settings.hidden)
    photo = Photo(srgb, float(scene.matrix_px(scene.settings.camera.photo_px)[0, 0]))
    entry = measure(pinhole_photo(photo, None), "photo.jpg", surface, None, promised_ranges(())).entry
    geometry = entry.geometry
    px_per_mm, tilt_deg = local_scale(truth, surface.center_mm)
    answers = {
        "tilt_deg": tilt_deg,
        "module_px": px_per_mm * scene.piece.module_mm,
        "blur_px": float(conditions.sensor.blur_px[0]),
        "noise": float(conditions.sensor.noise[0]),
        "jpeg": int(conditions.sensor.jpeg[0]),
        "hidden": hidden,
        "status": entry.status,
        "code": entry.code,
        "markers": entry.markers_found,
        "light": geometry and geometry.contrast,
        "error_mm": None,
        "error_px": None,
        "uncertainty_mm": geometry and geometry.corner_uncertainty_mm,
    }
    if geometry is None or geometry.homography_px_from_mm is None:
        return answers
    homography, corners = np.array(geometry.homography_px_from_mm), rect_corners(surface.rect_mm)
    true_px = apply_homography(truth, corners)
    errors_px = np.linalg.norm(apply_homography(homography, corners) - true_px, axis=1).tolist()
    return answers | {"error_mm": corner_error_mm(geometry, corners, true_px), "error_px": errors_px}


def _photograph_sheet(sheet: MountedSheet, conditions: Conditions, truth, rng, hide: bool) -> tuple[np.ndarray, float]:
    """uint8 pixels as read back from the JPEG, and the share of the piece that a card hides (0 without `hide`)."""
    photo_px, share = sheet.scene.settings.camera.photo_px, 0.0
    with torch.no_grad():
        picture = photograph(sheet.stage, sheet.piece, conditions, photo_px, jpeg=False)
    if hide:
        piece_px = apply_homography(truth, rect_corners(sheet.manifest.cut_mm))
        cover, piece = (_fill_quad(quad, photo_px) for quad in (_draw_card(rng, piece_px), piece_px))
        share = float((cover * piece).sum() / max(piece.sum(), 1))
        card = torch.from_numpy(rng.uniform(0.05, 0.8, 3).astype(np.float32))[:, None, None]
        picture = picture + torch.from_numpy(cover) * (card - picture)
    return image_pixels(jpeg_of(picture, conditions)), share


@lru_cache(maxsize=1)
def mount_noise_sheet(scene_path: str, seed: int) -> tuple[MountedSheet, PatchScene]:
    """Mount a sheet whose design is noise; returns its scene, too."""
    scene = require_patch(load_scene(scene_path, seed), "a scene of an object with a flat patch")
    if not scene.is_flat:
        raise Refused("a scene of an object with a flat patch", "a bent patch", "leave bend out")
    piece = scene.piece
    blank = np.zeros((240, round(240 * piece.size_mm[0] / piece.size_mm[1]), 3), np.uint8)
    noise = control_design("noise", blank, scene.sheet_id, piece)
    return mount_content(set_stage(scene), SheetContent(piece, scene.sheet_id, "design", noise)), scene


def _draw_card(rng: np.random.Generator, piece_px: np.ndarray) -> np.ndarray:
    """Draw corners of a card, a fifth to two thirds of the piece long, with its middle on the piece."""
    u, v = rng.random(2)
    top, bottom = piece_px[0] + u * (piece_px[1] - piece_px[0]), piece_px[3] + u * (piece_px[2] - piece_px[3])
    length = rng.uniform(0.2, 0.67) * np.linalg.norm(piece_px[2] - piece_px[0]) / np.sqrt(2)
    half, angle = length / 2 * np.array([1, rng.uniform(0.3, 1)]), rng.uniform(0, np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return top + v * (bottom - top) + (np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half) @ turn.T


def _fill_quad(quad: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """H×W float32 in [0, 1]: about the share of each pixel that lies in the quad."""
    mask = np.zeros((size_px[1], size_px[0]), np.uint8)
    cv2.fillConvexPoly(mask, to_sixteenths(quad), 255, cv2.LINE_AA, 4)
    return mask.astype(np.float32) / 255


def tables(settings: DetectionSettings, results: Sequence[Result]) -> Sequence[Table]:
    """Tables of bounds over all photographs, of shares by quantity, and of codes."""
    shots = [result.answers for result in results]
    return (_bounds(shots), _by_quantity(shots), _codes(shots))


def _is_usual(shot: Mapping) -> bool:
    return shot["tilt_deg"] <= MEASURABLE_TILT_DEG and shot["blur_px"] <= MEASURABLE_BLUR_PX


def _measured(shots: Sequence[Mapping]) -> list[Mapping]:
    return [shot for shot in shots if shot["status"] == "measured" and shot["error_mm"] is not None]


def _bounds(shots: Sequence[Mapping]) -> Table:
    usual, measured = [shot for shot in shots if _is_usual(shot)], _measured(shots)
    claimed = _measured(usual)
    sharp = [shot for shot in claimed if shot["module_px"] >= SHARP_MODULE_PX]
    rows = (
        ("sheet identified", rate([shot["status"] != "rejected" for shot in usual])),
        ("measured", rate([shot["status"] == "measured" for shot in usual])),
        (f"corner error at {SHARP_MODULE_PX:g} px per module or more, median, px", _median(sharp, "error_px")),
        ("corner error, median, px", _median(claimed, "error_px")),
        ("largest corner error, median, mm", _median(claimed, "error_mm")),
        ("largest corner error of all, mm", max((shot["error_mm"] for shot in claimed), default=None)),
        ("the same at any tilt and blur, mm", max((shot["error_mm"] for shot in measured), default=None)),
        ("stated 95 % uncertainty covers the largest corner error", _coverage(claimed)),
        ("the same at any tilt and blur", _coverage(measured)),
    )
    about = f"{len(usual)} of {len(shots)} photographs have tilt ≤ 70° and blur ≤ 1.5 px; corners are the design's four"
    return Table("bounds", "Errors against the truth", ("figure", "value"), rows, about)


def _coverage(measured: Sequence[Mapping]) -> Estimate | None:
    return rate([shot["error_mm"] <= shot["uncertainty_mm"] for shot in measured])


def _median(shots: Sequence[Mapping], name: str) -> Estimate | None:
    return clustered_median(np.array([shot[name] for shot in shots])) if shots else None


def _by_quantity(shots: Sequence[Mapping]) -> Table:
    rows = []
    for name, edges in _BIN_EDGES.items():
        for low, high in pairwise(edges):
            here = [shot for shot in shots if shot[name] is not None and low <= shot[name] < high]
            if here:
                identified = rate([shot["status"] != "rejected" for shot in here])
                measured = rate([shot["status"] == "measured" for shot in here])
                rows.append((_LABELS[name], f"{low:g} to {high:g}", identified, measured, _coverage(_measured(here))))
    head = ("quantity", "range", "identified", "measured", "covered")
    about = "each with all other quantities over their whole ranges; light is known where markers were found"
    return Table("by_quantity", "By what a photograph was taken under", head, tuple(rows), about)


def _codes(shots: Sequence[Mapping]) -> Table:
    counts = Counter((shot["status"], shot["code"] or "–") for shot in shots)
    rows = tuple((status, code, count) for (status, code), count in sorted(counts.items()))
    return Table("codes", "Status and code", ("status", "code", "photographs"), rows)


STUDY = Study("detection", DetectionSettings, cells, run, tables)
