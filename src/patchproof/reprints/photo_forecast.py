"""Forecast a photograph: render the run's object and print at the photograph's measured view, over its surroundings.

In: a run, its sheet's manifest and a `PhotoSquare` of a photograph. Out: the chance that such a photograph is
recognized, from renderings alone: pixels of the photographed piece and object are not used. Pose and blur are measured
from the markers; brightness and color of the light are those on the photograph's paper; direction of the light, gloss
and variation of the print are drawn from the scene's ranges.

Left out on purpose: bent pieces and scenes made of pictures, whose camera does not follow from a homography; anything
in front of the object; light that falls on the object, but not on the paper.
"""

import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from patchproof.base import geometry
from patchproof.base.color import linear_from_srgb, photo_codes_from_srgb, srgb_from_linear
from patchproof.base.errors import Refused
from patchproof.evidence.reproject import PhotoSquare
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.optimizer.promise import pictures_with_controls
from patchproof.optimizer.responses import ask_networks
from patchproof.optimizer.run import Run, load_run
from patchproof.render.photograph import expose
from patchproof.render.pixels import Appearance
from patchproof.render.views import Views, render_views
from patchproof.scene.backgrounds import Backgrounds
from patchproof.scene.conditions import Conditions, with_values
from patchproof.scene.patch_scene import PatchScene
from patchproof.sheets.manifest import Manifest

DRAWS = 8  # of the conditions that are not measured
_DRAW_BLOCKS = 256  # of conditions; a photograph's name decides which it gets


@dataclass(frozen=True, eq=False, kw_only=True)
class PhotoBackground(Backgrounds):
    """The photograph itself (uint8 H×W×3) as the background."""

    srgb: np.ndarray

    def picture(self, choice: np.ndarray, photo_px: tuple[int, int], size_px: tuple[int, int]) -> np.ndarray:
        """The photograph at that size."""
        return cv2.resize(self.srgb, size_px, interpolation=cv2.INTER_AREA)


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredCameraScene(PatchScene):
    """A scene seen by one measured camera: its pose (4×4 from the world), and its matrix for a picture of side 1."""

    pose: np.ndarray
    unit_matrix: np.ndarray

    def camera_from_world(self, conditions: Conditions) -> np.ndarray:
        """The measured pose for each of N conditions, N×4×4."""
        return np.broadcast_to(self.pose, (len(conditions), 4, 4)).copy()

    def matrix_px(self, size_px: tuple[int, int]) -> np.ndarray:
        """The measured camera matrix (3×3) for a square picture."""
        return np.diag([size_px[0], size_px[0], 1.0]) @ self.unit_matrix


def photo_forecaster(
    run: str | Path | Run, manifest: Manifest, trust: bool = False, named: Iterable[str] = ()
) -> Callable[[PhotoSquare], float | None]:
    """Make the function that forecasts photographs of a sheet, by its run or that run's folder; it returns None for a
    photograph that cannot be rendered. Refused is a run that the sheet is not of; for `trust` and `named` see
    `load_run`.
    """
    run = run if isinstance(run, Run) else load_run(run, trust, named)
    if manifest.sheet_id != run.scene.sheet_id:
        expected, got = f"the run of sheet {manifest.sheet_id}", f"the run of sheet {run.scene.sheet_id}"
        raise Refused(expected, got, "name the run that the sheet was made from")
    problem = set_problem(run.scene)
    piece = pictures_with_controls(problem, run.design, ())["design"]
    # counts as one more draw, so that the chance is never 0 or 1
    prior = (run.promise.rate * run.promise.n + 0.5) / (run.promise.n + 1)

    def chance(shot: PhotoSquare) -> float | None:
        scene = run.scene
        if not isinstance(scene, PatchScene) or not scene.is_flat or shot.matrix_px is None:
            return None
        views = render_measured_view(problem, scene, piece, shot, manifest)
        with torch.no_grad():
            pictures = expose(views, piece)
        hits = ask_networks(problem, pictures, views.stage.scene.boxes(views.conditions)).recognized[0]
        return float((hits.sum() + prior) / (len(hits) + 1))

    return chance


def render_measured_view(
    problem: Problem, scene: PatchScene, piece: Appearance, shot: PhotoSquare, manifest: Manifest
) -> Views:
    """Render `DRAWS` views of the scene with `piece` on it, as the camera of the photograph's square sees them."""
    side, (left, top, *_) = len(shot.square), manifest.cut_mm
    px_from_piece = shot.px_from_mm @ np.array([[1, 0, left], [0, 1, top], [0, 0, 1.0]])
    pose = geometry.plane_pose(px_from_piece, shot.matrix_px) @ np.linalg.inv(scene.placement.world_from_piece)
    paper = shot.light.paper.clip(1e-3)
    tint = paper / paper[1]
    light = linear_from_srgb(shot.square / 255.0) / tint  # before white balance, which the camera model applies again
    background = PhotoBackground(pictures=(), srgb=photo_codes_from_srgb(srgb_from_linear(light.clip(0, 1))))
    values: dict[str, Any] = {field.name: getattr(scene, field.name) for field in fields(scene)}
    values["backgrounds"] = background
    values |= {"pose": pose, "unit_matrix": np.diag([1 / side, 1 / side, 1.0]) @ shot.matrix_px}
    measured_scene = MeasuredCameraScene(**values)
    conditions = _conditions(scene, shot, float(paper[1]), tint)
    size_px = problem.figure_px, problem.figure_px
    return render_views(replace(problem.stage, scene=measured_scene), piece, conditions, size_px)


def _conditions(scene: PatchScene, shot: PhotoSquare, white: float, tint: np.ndarray) -> Conditions:
    """Draw `DRAWS` conditions with that light on white paper and that tint, without noise, which the background has."""
    number = zlib.crc32(shot.file.encode()) % _DRAW_BLOCKS  # so that draws do not depend on other photographs
    draws = scene.draw("evaluate", DRAWS, start=DRAWS * number)
    factor = white / np.maximum(scene.white_light(draws), 1e-3)
    return with_values(
        draws,
        ambient=draws.light.ambient * factor,
        directional=draws.light.directional * factor,
        exposure_ev=0.0,
        white_balance=tint,
        blur_px=shot.blur_px / len(shot.square) * min(scene.photo_px),
        printed_scale=1.0,
        **dict.fromkeys(("motion_px", "noise", "jpeg"), 0),
    )
