"""The photographs behind an operating envelope, what a network makes of them, and what the tool measures in them.

In: a run and points (values of axes). Out: per point and condition whether the target was recognized, and the codes and
corner errors of full photographs. The piece comes from the sheet's PDF, as in `reprint`. Recognition is judged at the
promise's resolution, except where JPEG is varied: that is met at full size or not at all. Of a photograph that is to be
measured only the window around the piece is rendered, at full resolution: the rest costs most and shows no markers.
Left out on purpose: what else in a photograph might look like a marker.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from patchproof import geometry
from patchproof.channel import lens
from patchproof.channel.printer import Printer, load_printer
from patchproof.evidence.camera import View
from patchproof.evidence.measure import measure
from patchproof.evidence.ranges import PromisedRanges
from patchproof.evidence.surface import Surface, surface_of
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.optimizer.responses import AT_A_TIME
from patchproof.optimizer.run import Run, load_run
from patchproof.photo.read import Photo
from patchproof.printing.sheet import sheet_of
from patchproof.render.photograph import expose
from patchproof.render.pixels import PiecePicture
from patchproof.render.stage import Stage, set_stage
from patchproof.render.views import relit, see
from patchproof.reprints.reprint import DPI_RANGE, OVERSAMPLING
from patchproof.scene.conditions import Conditions, fields_of
from patchproof.scene.mesh_scene import MeshScene
from patchproof.scene.scene import Scene
from patchproof.sheets.manifest import Manifest
from patchproof.sheets.raster import piece_pixels
from patchproof.strict import Refused
from patchproof.validation.envelope.axes import GEOMETRY, Point, conditions_at, placed_at

_MARGIN_SHARE, _MARGIN_PX, _BLOCK = 0.25, 32, 16  # of a window round the piece; blocks of JPEG stay where they are
_TAPE_SRGB = 0.45  # what hides a corner


@dataclass(frozen=True, eq=False)
class World:
    """A run with what is printed of it: the sheet's piece as pixels 1×3×H×W, two printers, and its surface."""

    run: Run
    problem: Problem
    manifest: Manifest
    surface: Surface
    sent: Tensor
    printer: Printer
    other: Printer

    @property
    def scene(self) -> Scene:
        """The run's scene."""
        return self.run.scene


@dataclass(frozen=True)
class Measurement:
    """A photograph's status and code, and the largest error of the design's corners in mm where it was measured."""

    status: str
    code: str | None
    error_mm: float | None


@lru_cache(maxsize=1)
def open_world(folder: Path, other_printer: str | None) -> World:
    """A run's world; `other_printer` None stands for uncoated paper, or coated where the run has uncoated."""
    run = load_run(folder)
    if run.scene.piece is None:
        raise Refused("a run of a patch", "one of the object's own texture", "name the run of a printed patch")
    profile = run.scene.settings.printer.profile
    other = other_printer or ("coated" if profile == "uncoated" else "uncoated")
    with TemporaryDirectory() as temporary:
        pdf = Path(temporary) / "sheet.pdf"
        manifest = sheet_of(run, pdf)
        finest = run.scene.closest_px_per_mm(run.scene.settings.camera.photo_px)
        dpi = float(np.clip(OVERSAMPLING * finest * 25.4, *DPI_RANGE))
        sent = torch.tensor(piece_pixels(pdf, manifest, dpi)).permute(2, 0, 1)[None] / 255
    printers = (load_printer(profile, run.scene.base), load_printer(other, run.scene.base))
    return World(run, set_problem(run.scene), manifest, surface_of(manifest), sent, *printers)


def piece_at(world: World, point: Point, first_corner: int) -> PiecePicture:
    """The piece as this point's printer shows it, with quarters hidden beginning at one of its corners."""
    srgb = _printed(world, float(point.get("mismatch", 0.0)))
    height, width = srgb.shape[:2]
    if point.get("hidden"):
        srgb, left = srgb.clone(), float(point["hidden"])
        for corner in range(4):
            side = min(max(left - corner, 0.0), 1.0) ** 0.5  # a part of a corner is a smaller square
            high, wide = round(side * height / 2), round(side * width / 2)
            at = (first_corner + corner) % 4
            rows = slice(0, high) if at in (0, 1) else slice(height - high, height)
            columns = slice(0, wide) if at in (0, 3) else slice(width - wide, width)
            srgb[rows, columns] = _TAPE_SRGB
    return PiecePicture(srgb, (0, 0, width, height), (0, 0, width, height))


@lru_cache(maxsize=8)
def _printed(world: World, mismatch: float) -> Tensor:
    """The printed piece H×W×3 with `mismatch` times the difference between the two printers added."""
    seen = world.printer.apply(world.sent)
    if mismatch:
        seen = (seen + mismatch * (world.other.apply(world.sent) - seen)).clamp(0, 1)
    return seen[0].permute(1, 2, 0).contiguous()


def recognized(world: World, points: Sequence[Point], conditions: Conditions) -> np.ndarray:
    """P×N bool: whether the run's first network sees the target."""
    out = np.zeros((len(points), len(conditions)), bool)
    as_file = any("jpeg" in point for point in points)
    side = min(world.scene.settings.camera.photo_px) if as_file else world.problem.figure_px
    stages = _Stages(world)
    with torch.inference_mode():
        for first in range(4):  # the corner that is hidden first; each goes with a quarter of the conditions
            every = np.arange(first, len(conditions), 4)
            size = 1 if as_file else AT_A_TIME
            for rows in (every[i : i + size] for i in range(0, len(every), size)):
                views = _Views(world, conditions[rows], first, lambda point, _: _Frame(stages.at(point), (side, side)))
                for i in _by_cost(points):
                    out[i, rows] = _judge(world.problem, views.files(points[i]) if as_file else views.at(points[i]))
    return out


def measured(world: World, points: Sequence[Point], conditions: Conditions) -> list[list[Measurement]]:
    """P×N measurements of photographs as verify would make them."""
    out = [[None] * len(conditions) for _ in points]
    stages = _Stages(world)
    with torch.inference_mode():
        for n in range(len(conditions)):
            frame = lambda point, drawn: _window(world, stages.at(point), drawn)  # noqa: E731
            views = _Views(world, conditions[[n]], n % 4, frame)
            for i in _by_cost(points):
                srgb = (views.files(points[i])[0].permute(1, 2, 0).numpy() * 255 + 0.5).astype(np.uint8)
                origin_px = views.frame.origin_px
                if "curl" in points[i]:  # the middle of the picture says how rolled paper is seen
                    srgb, origin_px = _on_plain_ground(srgb, origin_px, world.scene.settings.camera.photo_px), (0, 0)
                drawn = conditions_at(world.scene, conditions[[n]], points[i])
                out[i][n] = _measurement(world, stages.at(points[i]).scene, drawn, srgb, origin_px)
    return out


class _Stages:
    """The stage of each geometry, the last few kept."""

    def __init__(self, world: World):
        self._world, self._kept = world, {}

    def at(self, point: Point) -> Stage:
        key = tuple((name, point[name]) for name in ("curl", "gap", "size") if name in point)
        if key not in self._kept:
            self._kept[key] = set_stage(placed_at(self._world.scene, point))
        return self._kept[key]


@dataclass(frozen=True)
class _Frame:
    """What is rendered: pictures of `size_px`, whose corner lies at `origin_px` of the photograph."""

    stage: Stage
    size_px: tuple[int, int]
    origin_px: tuple[int, int] = (0, 0)


class _Views:
    """Views of some conditions at one point after another; what consecutive points share is computed once."""

    def __init__(self, world: World, drawn: Conditions, first: int, frame_of: Callable[[Point, Conditions], _Frame]):
        self._world, self._drawn, self._first, self._frame_of = world, drawn, first, frame_of
        self._key, self._seen, self._file = None, None, (None, None)
        self.frame = None

    def at(self, point: Point, jpeg: bool = True) -> Tensor:
        """N×3×H×W pictures."""
        shown = piece_at(self._world, point, self._first)
        conditions = conditions_at(self._world.scene, self._drawn, point)
        if self._key != (key := _geometry(point)):
            self._key, self.frame = key, self._frame_of(point, conditions)
            self._seen = see(self.frame.stage, shown, conditions, self.frame.size_px)
        elif not _same(conditions, self._seen.conditions):
            self._seen = relit(self._seen, conditions)
        return expose(self._seen, shown, jpeg)

    def files(self, point: Point) -> Tensor:
        """1×3×H×W: the only picture, read back from a JPEG file of its quality."""
        rest = {name: value for name, value in point.items() if name != "jpeg"}
        if self._file[0] != rest:
            self._file = rest, self.at(rest, jpeg=False)[0].permute(1, 2, 0).cpu().numpy()
        srgb = (self._file[1].clip(0, 1) * 255 + 0.5).astype(np.uint8)
        quality = int(conditions_at(self._world.scene, self._drawn, point).sensor.jpeg[0])
        return torch.tensor(_through_file(srgb, quality)).permute(2, 0, 1)[None] / 255


@dataclass(frozen=True)
class WindowScene(MeshScene):
    """A scene whose camera sees a part of the picture, at the same scale; its `photo_px` is the part's size."""

    whole_px: tuple[int, int] = (0, 0)
    origin_px: tuple[int, int] = (0, 0)

    def matrix_px(self, size_px: tuple[int, int]) -> np.ndarray:
        """The whole picture's matrix, counted from the window's corner."""
        matrix = super().matrix_px(self.whole_px).copy()
        matrix[:2, 2] -= self.origin_px
        return matrix


@dataclass(frozen=True)
class _WindowBackgrounds:
    """The window's part of the whole picture's background."""

    whole: object
    whole_px: tuple[int, int]
    origin_px: tuple[int, int]

    def picture(self, choice: np.ndarray, photo_px, size_px) -> np.ndarray:
        x, y = self.origin_px
        return self.whole.picture(choice, self.whole_px, self.whole_px)[y : y + size_px[1], x : x + size_px[0]]


def window_stage(stage: Stage, origin_px: tuple[int, int], size_px: tuple[int, int]) -> Stage:
    """The stage as a camera sees it that shows a window of the photograph only."""
    scene = stage.scene
    whole_px, camera = scene.settings.camera.photo_px, scene.settings.camera.model_copy(update={"photo_px": size_px})
    parts = {field.name: getattr(scene, field.name) for field in fields(MeshScene)}
    parts["settings"] = scene.settings.model_copy(update={"camera": camera})
    parts["backgrounds"] = _WindowBackgrounds(scene.backgrounds, whole_px, origin_px)
    return replace(stage, scene=WindowScene(**parts, whole_px=whole_px, origin_px=origin_px))


def _window(world: World, stage: Stage, conditions: Conditions) -> _Frame:
    """The part of the photograph that shows the piece; all of it where the lens bends or a part would not do."""
    scene, whole_px = stage.scene, world.scene.settings.camera.photo_px
    everything = _Frame(stage, whole_px)
    if not isinstance(scene, MeshScene) or stage.camera is not None or conditions.sensor.vignetting.any():
        return everything
    edge = np.linspace(0, 1, 9)
    grid = np.stack(np.meshgrid(edge, edge), -1).reshape(-1, 2) * scene.placement.size_mm
    points = _seen_at(scene, conditions, grid, whole_px)
    if not np.isfinite(points).all():
        return everything
    margin = _MARGIN_SHARE * np.ptp(points, axis=0).max() + _MARGIN_PX
    low = np.clip(np.floor((points.min(0) - margin) / _BLOCK) * _BLOCK, 0, None).astype(int)
    high = np.minimum(np.ceil((points.max(0) + margin) / _BLOCK).astype(int) * _BLOCK, whole_px)
    if (high - low < 64).any():  # outside of the picture, almost
        return everything
    size, origin = tuple((high - low).tolist()), tuple(low.tolist())
    return _Frame(window_stage(stage, origin, size), size, origin)


def _on_plain_ground(part: np.ndarray, origin_px, whole_px: tuple[int, int]) -> np.ndarray:
    """A photograph that shows `part` at `origin_px` and nothing else."""
    srgb, (x, y) = np.full((whole_px[1], whole_px[0], 3), np.median(part, (0, 1)).astype(np.uint8)), origin_px
    srgb[y : y + part.shape[0], x : x + part.shape[1]] = part
    return srgb


def _measurement(world: World, scene: Scene, conditions: Conditions, srgb: np.ndarray, origin_px) -> Measurement:
    """What the tool says of a part of a photograph whose corner lies at `origin_px`."""
    whole_px = world.scene.settings.camera.photo_px
    matrix_px = None
    if isinstance(scene, MeshScene):  # of pictures nobody knows the focal length
        matrix_px = scene.matrix_px(whole_px).copy()
        matrix_px[:2, 2] -= origin_px
    photo = Photo(srgb, None if matrix_px is None else float(matrix_px[0, 0]), Path("photo"))
    view = View(photo, matrix_px, calibrated=False)
    entry = measure(view, "photo", world.surface, None, PromisedRanges({})).entry
    error_mm = None
    if entry.status == "measured" and entry.geometry and entry.geometry.homography_px_from_mm is not None:
        corners = geometry.rect_corners(world.surface.rect_mm)
        true_px = _seen_at(scene, conditions, corners - world.manifest.cut_mm[:2], whole_px) - origin_px
        back = geometry.apply_homography(np.linalg.inv(np.array(entry.geometry.homography_px_from_mm)), true_px)
        error_mm = float(np.linalg.norm(back - corners, axis=1).max())
    return Measurement(entry.status, entry.code, error_mm)


def _seen_at(scene: Scene, conditions: Conditions, piece_mm: np.ndarray, photo_px: tuple[int, int]) -> np.ndarray:
    """Pixels N×2 of points of the piece in one photograph; NaN behind the camera."""
    if not isinstance(scene, MeshScene):
        return geometry.apply_homography(scene.piece_homographies(conditions, photo_px)[0], piece_mm)
    pose = scene.camera_from_print(conditions)[0]
    points = geometry.project(scene.matrix_px(photo_px), pose, scene.placement.world(piece_mm))
    return points if scene.camera is None else lens.distort_points(points, scene.camera, photo_px)


def _judge(problem: Problem, pictures: Tensor) -> np.ndarray:
    classifier, indices = problem.classifiers[0], problem.indices[0]
    return classifier.recognized(classifier.logits(pictures), indices).cpu().numpy()


def _geometry(point: Point) -> tuple:
    return tuple((name, point[name]) for name in GEOMETRY if name in point)


def _by_cost(points: Sequence[Point]) -> list[int]:
    """Points of one geometry together, and among them those that differ in their JPEG alone."""
    key = lambda i: (_geometry(points[i]), sorted((k, v) for k, v in points[i].items() if k != "jpeg"))  # noqa: E731
    return sorted(range(len(points)), key=key)


def _same(a: Conditions, b: Conditions) -> bool:
    others = fields_of(b)
    return all(np.array_equal(values, others[name]) for name, values in fields_of(a).items())


def _through_file(srgb: np.ndarray, quality: int) -> np.ndarray:
    buffer = io.BytesIO()
    Image.fromarray(srgb).save(buffer, "JPEG", quality=quality)
    with Image.open(buffer) as image:
        return np.asarray(image)
