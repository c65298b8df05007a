"""Simulate the photographs of an operating envelope, ask a network about them, and measure them.

In: a run and points (values of axes). Out: hits per point and condition of the design, of the bare object and of a gray
piece in its place; codes and corner errors of full photographs. Pieces come from the PDFs of their sheets, as in
`reprint`, and a point changes the gray piece as it changes the design. Recognition is judged at the promise's
resolution, except where JPEG is varied, which needs full size. Photographs that are only measured are rendered only in
the window around the piece (`piece_window`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from patchlab.study.record import corner_error_mm
from patchlab.validation.envelope.axes import GEOMETRY_AXES, SweepPoint, conditions_at, scene_at
from patchlab.validation.envelope.fit import CONTROLS
from patchlab.validation.envelope.window import RenderedWindow, paste_on_plain, piece_window
from patchlab.validation.mounted_sheets import mount_run_sheet
from patchproof.base import geometry
from patchproof.base.output import image_pixels
from patchproof.channel.printer import Printer, load_printer
from patchproof.evidence.camera import PinholePhoto
from patchproof.evidence.measure import measure
from patchproof.evidence.ranges import PromisedRanges
from patchproof.evidence.surface import Surface, surface_of
from patchproof.optimizer.pixels import from_pixels
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.optimizer.responses import CHUNK_VIEWS, ask_networks
from patchproof.optimizer.run import Run, load_run
from patchproof.render.photograph import expose
from patchproof.render.pixels import PiecePicture
from patchproof.render.stage import Stage, set_stage
from patchproof.render.views import Views, relight, render_views
from patchproof.reprints.mounted_sheet import MountedSheet, jpeg_of
from patchproof.scene.conditions import Conditions
from patchproof.scene.interface import Scene, require_piece
from patchproof.scene.mesh_scene import require_mesh

_TAPE_SRGB = 0.45  # color of the tape that hides a corner


@dataclass(frozen=True, eq=False)
class Simulation:
    """A run with its mounted sheet and the gray control's, the sheet's surface, and another printer."""

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
    sheet, printer = mount_run_sheet(run), load_printer(other, run.scene.base)
    gray, surface = mount_run_sheet(run, "gray"), surface_of(sheet.manifest)
    return Simulation(run, set_problem(run.scene), sheet, gray, surface, printer)


def piece_at(world: Simulation, point: SweepPoint, first_corner: int, gray: bool = False) -> PiecePicture:
    """The piece by the point's printer, with its hidden quarters counted from `first_corner`."""
    whole = _printed_piece(world, gray, float(point.get("mismatch", 0.0)))
    if not point.get("hidden"):
        return whole
    srgb, hidden = whole.srgb.clone(), float(point["hidden"])
    height, width = srgb.shape[:2]
    for corner in range(4):
        side = min(max(hidden - corner, 0.0), 1.0) ** 0.5  # a part of a corner is a smaller square
        high, wide = round(side * height / 2), round(side * width / 2)
        index = (first_corner + corner) % 4
        rows = slice(0, high) if index in (0, 1) else slice(height - high, height)
        columns = slice(0, wide) if index in (0, 3) else slice(width - wide, width)
        srgb[rows, columns] = _TAPE_SRGB
    return PiecePicture.of(srgb)


@lru_cache(maxsize=12)  # both pieces at a sweep's six points
def _printed_piece(world: Simulation, gray: bool, mismatch: float) -> PiecePicture:
    """The printed piece with `mismatch` times the difference between the two printers added."""
    sheet = world.gray if gray else world.sheet

    def seen(sent: Tensor) -> Tensor:
        promised = sheet.printer.apply(sent)
        return (promised + mismatch * (world.other.apply(sent) - promised)).clamp(0, 1) if mismatch else promised

    return sheet.printed(seen)


def recognize_target(world: Simulation, points: Sequence[SweepPoint], conditions: Conditions) -> dict[str, np.ndarray]:
    """By the design and `CONTROLS` P×N bool: the run's first network recognizes the target."""
    out = {kind: np.zeros((len(points), len(conditions)), bool) for kind in ("design", *CONTROLS)}
    as_file = any("jpeg" in point for point in points)
    side = min(world.scene.settings.camera.photo_px) if as_file else world.problem.figure_px
    stages, problem = _StageCache(world), world.problem
    first_network = replace(problem, classifiers=problem.classifiers[:1], indices=problem.indices[:1])
    with torch.inference_mode():
        for first in range(4):  # the corner that is hidden first; each goes with a quarter of the conditions
            every = np.arange(first, len(conditions), 4)
            size = 1 if as_file else CHUNK_VIEWS
            for rows in (every[i : i + size] for i in range(0, len(every), size)):
                boxes = first_network.boxes(conditions[rows])
                frame_of = lambda point, _: RenderedWindow(stages.at(point), (side, side))  # noqa: E731
                views = _ViewCache(world, conditions[rows], first, frame_of)
                for i, kind in product(_by_cost(points), out):
                    file = views.file(points[i], kind)[0] if as_file else None
                    pictures = views.at(points[i], kind) if file is None else from_pixels(file)[None]
                    out[kind][i, rows] = ask_networks(first_network, pictures, boxes).recognized
    return out


def measure_photos(world: Simulation, points: Sequence[SweepPoint], conditions: Conditions) -> list[list[Measurement]]:
    """P×N measurements of photographs, as `verify` makes them."""
    out: list[list[Measurement]] = [[] for _ in points]
    stages = _StageCache(world)
    with torch.inference_mode():
        for n in range(len(conditions)):
            frame_of = lambda point, drawn: piece_window(stages.at(point), drawn)  # noqa: E731
            views = _ViewCache(world, conditions[[n]], n % 4, frame_of)
            for i in _by_cost(points):
                srgb, origin_px = views.file(points[i])
                if "curl" in points[i]:  # measuring rolled paper needs the picture's middle
                    srgb, origin_px = paste_on_plain(srgb, origin_px, world.scene.settings.camera.photo_px), (0, 0)
                drawn = conditions_at(world.scene, conditions[[n]], points[i])
                out[i].append(_measure_window(world, stages.at(points[i]).scene, drawn, srgb, origin_px))
    return out


class _StageCache:
    def __init__(self, world: Simulation):
        self._world, self._kept = world, {}

    def at(self, point: SweepPoint) -> Stage:
        key = tuple((name, point[name]) for name in ("curl", "gap", "size") if name in point)
        if key not in self._kept:
            self._kept[key] = set_stage(scene_at(self._world.scene, point))
        return self._kept[key]


class _ViewCache:
    """Views of some conditions at successive points; parts that consecutive points share are computed once."""

    def __init__(
        self,
        world: Simulation,
        drawn: Conditions,
        first: int,
        frame_of: Callable[[SweepPoint, Conditions], RenderedWindow],
    ):
        self._world, self._drawn, self._first, self._frame_of = world, drawn, first, frame_of
        self._kept: tuple[SweepPoint, Views] | None = None
        self._pictures: dict[str, tuple[SweepPoint, Tensor]] = {}
        self._origin_px = (0, 0)

    def at(self, point: SweepPoint, kind: str = "design", jpeg: bool = True) -> Tensor:
        """N×3×H×W pictures of the design or a control at the point."""
        shown = None if kind == "bare" else piece_at(self._world, point, self._first, kind == "gray")
        return expose(self._views(point), shown, jpeg)

    def file(self, point: SweepPoint, kind: str = "design") -> tuple[np.ndarray, tuple[int, int]]:
        """The single picture as uint8 H×W×3, read back from a JPEG file, and its corner in the photograph."""
        rest = {name: value for name, value in point.items() if name != "jpeg"}
        if kind not in self._pictures or self._pictures[kind][0] != rest:
            self._pictures[kind] = rest, self.at(rest, kind, jpeg=False)
        drawn = conditions_at(self._world.scene, self._drawn, point)
        return image_pixels(jpeg_of(self._pictures[kind][1], drawn)), self._origin_px

    def _views(self, point: SweepPoint) -> Views:
        """Views at the point that can show any piece of the sheet's size."""
        if self._kept is None or self._kept[0] != point:
            conditions = conditions_at(self._world.scene, self._drawn, point)
            if self._kept is None or _geometry_values(self._kept[0]) != _geometry_values(point):
                frame = self._frame_of(point, conditions)
                self._origin_px = frame.origin_px
                views = render_views(frame.stage, piece_at(self._world, {}, 0), conditions, frame.size_px)
            else:
                views = relight(self._kept[1], conditions)
            self._kept = point, views
        return self._kept[1]


def _measure_window(
    world: Simulation, scene: Scene, conditions: Conditions, srgb: np.ndarray, origin_px
) -> Measurement:
    whole_px = world.scene.settings.camera.photo_px
    matrix_px = None
    if scene.HAS_OBJECT:  # a flat picture has no focal length
        matrix_px = require_mesh(scene).matrix_px(whole_px).copy()
        matrix_px[:2, 2] -= origin_px
    view = PinholePhoto(srgb, matrix_px, calibrated=False)
    entry = measure(view, "photo", world.surface, None, PromisedRanges({})).entry
    error_mm = None
    if entry.status == "measured" and entry.geometry:
        corners = geometry.rect_corners(world.surface.rect_mm)
        true_px = require_piece(scene).piece_px(conditions, corners - world.sheet.manifest.cut_mm[:2]) - origin_px
        error_mm = corner_error_mm(entry.geometry, corners, true_px)
    return Measurement(entry.status, entry.code, error_mm)


def _geometry_values(point: SweepPoint) -> tuple:
    return tuple((name, point[name]) for name in GEOMETRY_AXES if name in point)


def _by_cost(points: Sequence[SweepPoint]) -> list[int]:
    """Indices of points sorted so that equal geometries, and points that differ in JPEG only, are adjacent."""
    key = lambda i: (_geometry_values(points[i]), sorted((k, v) for k, v in points[i].items() if k != "jpeg"))  # noqa: E731
    return sorted(range(len(points)), key=key)
