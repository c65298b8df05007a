"""A photograph taken again: the run's own object and print, rendered at its measured view before its own surroundings.

In: a run, its sheet's manifest and a `PhotoSquare` of a photograph. Out: the chance that such a photograph is recognized, as
far as rendering knows; the photographed piece and object themselves have no say. Pose and blur are those measured from
the markers, the light on paper is as bright and of the same color; where the light comes from, gloss and what the
print has of its own are drawn from the scene's ranges.

Left out on purpose: bent pieces and scenes made of pictures, whose camera no homography tells; what stands in front of
the object; light on the object other than on paper.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
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

DRAWS = 8  # of what is not measured
_FILES = 256


@dataclass(frozen=True, eq=False, kw_only=True)
class Surroundings(Backgrounds):
    """The photograph itself behind everything, H×W×3 uint8."""

    srgb: np.ndarray

    def picture(self, choice: np.ndarray, photo_px: tuple[int, int], size_px: tuple[int, int]) -> np.ndarray:
        """It, at that size."""
        return cv2.resize(self.srgb, size_px, interpolation=cv2.INTER_AREA)


@dataclass(frozen=True, eq=False, kw_only=True)
class Retaken(PatchScene):
    """The scene as one measured camera has it: 4×4 from the world, and its matrix for a picture of side 1."""

    pose: np.ndarray
    unit_matrix: np.ndarray

    def camera_from_world(self, conditions: Conditions) -> np.ndarray:
        """N×4×4, all of them the measured one."""
        return np.broadcast_to(self.pose, (len(conditions), 4, 4)).copy()

    def matrix_px(self, size_px: tuple[int, int]) -> np.ndarray:
        """3×3 of a square picture."""
        return np.diag([size_px[0], size_px[0], 1.0]) @ self.unit_matrix


def photo_forecaster(run: str | Path | Run, manifest: Manifest) -> Callable[[PhotoSquare], float | None]:
    """What forecasts photographs of this sheet, by its run or that one's folder; refused where it is another run's.
    None of a photograph that cannot be taken again.
    """
    run = run if isinstance(run, Run) else load_run(run)
    if manifest.sheet_id != run.scene.sheet_id:
        raise Refused(f"the run of sheet {manifest.sheet_id}", f"that of {run.scene.sheet_id}", "name the run it is of")
    problem = set_problem(run.scene)
    shown = pictures_with_controls(problem, run.design, ())["design"]
    # as if one more had been drawn at the promised rate, of which no finite number of conditions makes a certainty
    usual = (run.promise.rate * run.promise.n + 0.5) / (run.promise.n + 1)

    def chance(shot: PhotoSquare) -> float | None:
        scene = run.scene
        if not isinstance(scene, PatchScene) or not scene.is_flat or shot.matrix_px is None:
            return None
        views = retake(problem, scene, shown, shot, manifest)
        with torch.no_grad():
            pictures = expose(views, shown)
        hits = ask_networks(problem, pictures, views.stage.scene.boxes(views.conditions)).recognized[0]
        return float((hits.sum() + usual) / (len(hits) + 1))

    return chance


def retake(problem: Problem, scene: PatchScene, shown: Appearance, shot: PhotoSquare, manifest: Manifest) -> Views:
    """`DRAWS` views: the photograph's square as rendering has it, for what is `shown`."""
    side, (left, top, *_) = len(shot.square), manifest.cut_mm
    piece = shot.px_from_mm @ np.array([[1, 0, left], [0, 1, top], [0, 0, 1.0]])
    pose = geometry.plane_pose(piece, shot.matrix_px) @ np.linalg.inv(scene.placement.world_from_piece)
    paper = shot.light.paper.clip(1e-3)
    tint = paper / paper[1]
    light = linear_from_srgb(shot.square / 255.0) / tint  # as it is before the white balance, which tints all again
    behind = Surroundings(pictures=(), srgb=photo_codes_from_srgb(srgb_from_linear(light.clip(0, 1))))
    own: dict[str, Any] = {field.name: getattr(scene, field.name) for field in fields(scene)}
    own["backgrounds"] = behind
    retaken = Retaken(**own, pose=pose, unit_matrix=np.diag([1 / side, 1 / side, 1.0]) @ shot.matrix_px)
    conditions = _conditions(scene, shot, float(paper[1]), tint)
    size_px = problem.figure_px, problem.figure_px
    return render_views(replace(problem.stage, scene=retaken), shown, conditions, size_px)


def _conditions(scene: PatchScene, shot: PhotoSquare, white: float, tint: np.ndarray) -> Conditions:
    """`DRAWS` conditions of that light on white paper and that tint. Surroundings have their blur and grain already."""
    number = zlib.crc32(shot.file.encode()) % _FILES  # a photograph's draws depend on no other
    drawn = scene.draw("evaluate", DRAWS, start=DRAWS * number)
    factor = white / np.maximum(scene.white_light(drawn), 1e-3)
    return with_values(
        drawn,
        ambient=drawn.light.ambient * factor,
        directional=drawn.light.directional * factor,
        exposure_ev=0.0,
        white_balance=tint,
        blur_px=shot.blur_px / len(shot.square) * min(scene.photo_px),
        printed_scale=1.0,
        **dict.fromkeys(("motion_px", "noise", "jpeg"), 0),
    )
