"""Simulate the photographs of an operating envelope, ask a network about them, and measure them.

In: a run, an axis and its values. Out: hits per value and condition of the design, of the bare object and of a gray
piece in its place; codes and corner errors of full photographs. Pieces come from the PDFs of their sheets, as in
`reprint`, and a value changes the gray piece as it changes the design. Recognition is judged at the promise's
resolution, except where JPEG is varied, which needs full size.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from patchlab.study.record import corner_error_mm
from patchlab.validation.envelope.axes import PAPER_AXES, conditions_at, scene_at
from patchlab.validation.mounted_sheets import mount_content
from patchproof.base import geometry
from patchproof.base.output import image_pixels
from patchproof.channel.printer import Printer, load_printer
from patchproof.evidence.locate import PinholePhoto
from patchproof.evidence.measure import measure
from patchproof.evidence.surface import Surface, surface_of
from patchproof.evidence.task import PromisedRanges
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.optimizer.responses import Responses, ask_networks, merge_responses, responses
from patchproof.optimizer.run import Run, load_run
from patchproof.optimizer.subject import from_pixels
from patchproof.render.photograph import Appearance, photograph
from patchproof.render.pixels import PiecePicture
from patchproof.render.stage import Stage, set_stage
from patchproof.reprints.reprint import MountedSheet, jpeg_of
from patchproof.reprints.run_sheet import content_of
from patchproof.scene.conditions import Conditions
from patchproof.scene.interface import Scene, require_piece
from patchproof.scene.mesh_scene import require_mesh

CONTROLS = ("bare", "gray")  # of a promise's controls; a noise design would need a draw
_TAPE_SRGB = 0.45  # color of the tape that hides a corner


@dataclass(frozen=True, eq=False)
class Simulation:
    """A run before its first network, its mounted sheet and the gray control's, the surface, and another printer."""

    run: Run
    problem: Problem
    sheet: MountedSheet
    gray: MountedSheet
    surface: Surface
    other: Printer

    @property
    def scene(self) -> Scene:
        """The run's scene."""
        return self.run.scene


@dataclass(frozen=True)
class Measurement:
    """A photograph's status and code, and the design's largest corner error in mm if it was measured."""

    status: str
    code: str | None
    error_mm: float | None


@lru_cache(maxsize=1)
def open_simulation(folder: Path, other_printer: str | None) -> Simulation:
    """Open a run's simulation; `other_printer` None stands for uncoated paper, or coated if the run has uncoated."""
    run = load_run(folder, trust=True)
    require_piece(run.scene, "name the run of a printed patch")
    profile = run.scene.settings.printer.profile
    other = other_printer or ("coated" if profile == "uncoated" else "uncoated")
    contents = (content_of(run, None, control, folder)[0] for control in (None, "gray"))
    sheet, gray = (mount_content(set_stage(run.scene), content) for content in contents)
    problem = set_problem(run.scene)
    problem = replace(problem, classifiers=problem.classifiers[:1], indices=problem.indices[:1])
    return Simulation(run, problem, sheet, gray, surface_of(sheet.manifest), load_printer(other, run.scene.base))


def piece_at(world: Simulation, axis: str, value: float, first_corner: int, gray: bool = False) -> PiecePicture:
    """The piece by the value's printer, with its hidden quarters counted from `first_corner`."""
    whole = _printed_piece(world, gray, value if axis == "mismatch" else 0.0)
    if axis != "hidden":
        return whole
    srgb = whole.srgb.clone()
    height, width = srgb.shape[:2]
    for corner in range(4):
        side = min(max(value - corner, 0.0), 1.0) ** 0.5  # a part of a corner is a smaller square
        high, wide = round(side * height / 2), round(side * width / 2)
        index = (first_corner + corner) % 4
        rows = slice(0, high) if index in (0, 1) else slice(height - high, height)
        columns = slice(0, wide) if index in (0, 3) else slice(width - wide, width)
        srgb[rows, columns] = _TAPE_SRGB
    return PiecePicture.of(srgb)


@lru_cache(maxsize=12)  # both pieces at a sweep's six values
def _printed_piece(world: Simulation, gray: bool, mismatch: float) -> PiecePicture:
    """The printed piece with `mismatch` times the difference between the two printers added."""
    sheet = world.gray if gray else world.sheet

    def seen(sent: Tensor) -> Tensor:
        promised = sheet.printer.apply(sent)
        return (promised + mismatch * (world.other.apply(sent) - promised)).clamp(0, 1) if mismatch else promised

    return sheet.printed(seen)


def recognize_target(
    world: Simulation, axis: str, values: Sequence[float], conditions: Conditions
) -> dict[str, np.ndarray]:
    """By the design and `CONTROLS` P×N bool: the run's first network recognizes the target."""
    out = {kind: np.zeros((len(values), len(conditions)), bool) for kind in ("design", *CONTROLS)}
    for i, value in enumerate(values):
        problem = replace(world.problem, stage=_stage_at(world, axis, value))
        # the corner that is hidden first; each goes with a quarter of the conditions
        for first in range(min(4, len(conditions))):
            rows = np.arange(first, len(conditions), 4)
            design, gray = (piece_at(world, axis, value, first, is_gray) for is_gray in (False, True))
            drawn, shown = conditions_at(conditions[rows], {axis: value}), (design, None, gray)
            respond = _respond_to_files if axis == "jpeg" else responses
            for kind, answer in respond(problem, dict(zip(out, shown, strict=True)), drawn).items():
                out[kind][i, rows] = answer.recognized[0]
    return out


def _respond_to_files(
    problem: Problem, shown: Mapping[str, Appearance], conditions: Conditions
) -> dict[str, Responses]:
    """Responses to squares of whole photographs that were read back from JPEG files."""
    side, parts = min(problem.scene.settings.camera.photo_px), []
    for one in (conditions[[i]] for i in range(len(conditions))):
        boxes = problem.boxes(one)
        files = {kind: _file_pixels(problem.stage, each, one, (side, side)) for kind, each in shown.items()}
        parts.append({kind: ask_networks(problem, from_pixels(srgb)[None], boxes) for kind, srgb in files.items()})
    return merge_responses(parts)


def measure_photos(
    world: Simulation, axis: str, values: Sequence[float], conditions: Conditions
) -> list[list[Measurement]]:
    """P×N measurements of photographs, as `verify` makes them."""
    out: list[list[Measurement]] = []
    for value in values:
        stage, drawn = _stage_at(world, axis, value), conditions_at(conditions, {axis: value})
        out.append([])
        for i in range(len(drawn)):
            piece, one = piece_at(world, axis, value, i % 4), drawn[[i]]
            out[-1].append(_measure(world, stage.scene, one, _file_pixels(stage, piece, one, stage.scene.photo_px)))
    return out


def _stage_at(world: Simulation, axis: str, value: float) -> Stage:
    return set_stage(scene_at(world.scene, {axis: value})) if axis in PAPER_AXES else world.problem.stage


def _file_pixels(stage: Stage, shown: Appearance, one: Conditions, size_px: tuple[int, int]) -> np.ndarray:
    """uint8 H×W×3 of a single photograph, read back from a JPEG file."""
    with torch.inference_mode():
        return image_pixels(jpeg_of(photograph(stage, shown, one, size_px, jpeg=False), one))


def _measure(world: Simulation, scene: Scene, one: Conditions, srgb: np.ndarray) -> Measurement:
    # a flat picture has no focal length
    matrix_px = require_mesh(scene).matrix_px(scene.photo_px) if scene.HAS_OBJECT else None
    view = PinholePhoto(srgb, matrix_px, calibrated=False)
    entry = measure(view, "photo", world.surface, None, PromisedRanges({})).entry
    error_mm = None
    if entry.status == "measured" and entry.geometry:
        corners = geometry.rect_corners(world.surface.rect_mm)
        true_px = require_piece(scene).piece_px(one, corners - world.sheet.manifest.cut_mm[:2])
        error_mm = corner_error_mm(entry.geometry, corners, true_px)
    return Measurement(entry.status, entry.code, error_mm)
