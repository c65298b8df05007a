"""The renderer's knobs: texture taps, supersampled edges, resolution of training views, and pool refresh.

In: nothing but the package's own object and classifier (the demo's truck, dim and over clutter), so that it runs
anywhere. Out: one chart per knob; `bench_speed` adds how the rasterizer's time grows and what share of a step it takes.
The design that is looked at comes from a short optimization of that scene, since a real design has more contrast and
finer detail than a picture one would make up.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn import functional as F

from patchproof import geometry
from patchproof.bench.chart import Chart, Check, OnStage, Point, Series, Table
from patchproof.bench.measure import mean_interval, psnr, ratio, timed
from patchproof.bench.speed import growth_chart, step_chart
from patchproof.channel.camera import encoded
from patchproof.optimize.goals import target_loss
from patchproof.optimize.loop import steps
from patchproof.optimize.pixels import as_pixels, from_pixels
from patchproof.optimize.problem import Problem, set_problem
from patchproof.render.fragments import Cameras
from patchproof.render.photograph import expose, shade
from patchproof.render.pixels import DESIGN_TAPS, PiecePicture
from patchproof.render.raster import rasterize
from patchproof.render.texture import Layout, footprint, layout, look_up, texel_table
from patchproof.render.views import relit, see
from patchproof.scene.backgrounds import Backgrounds
from patchproof.scene.conditions import Conditions
from patchproof.scene.scene import build_scene
from patchproof.settings import OptimizeSettings, SceneSettings, read_toml
from patchproof.sheet.piece import Piece
from patchproof.study import demo
from patchproof.study.patterns import background
from patchproof.study.reprint import take_photo

TAPS = tuple(sorted({1, 2, 4, 6, 8, 12, DESIGN_TAPS}))
WIDTHS_PX, QUICK_WIDTHS_PX, TILTS_DEG = (20, 45, 70, 110, 200), (20, 70, 200), (0, 60)
PICTURE_PX = 224
SUBSAMPLES = 16  # along each side of a pixel, in the references
LEAST_PSNR = 38.0  # dB over the design's own pixels
SUPERSAMPLES, EDGES_PX = (1, 2, 3), 192
SIDES_PX = (96, 128, 192, 224, 384)
REFRESHES = (1, 2, 4, 8)


@dataclass(frozen=True)
class World:
    """The demo's problem with a design that was optimized a little for it (3×h×w)."""

    problem: Problem
    design: Tensor

    def shown(self, kind: str = "design", tiled: int = 1) -> PiecePicture:
        """The printed piece with the design, side by side with itself where it is `tiled`, or with one of its
        controls.
        """
        subject = self.problem.subject
        if kind == "design":
            return subject.shown(self.design.repeat(1, tiled, tiled))
        return subject.shown(from_pixels(subject.control(kind, subject.pixels(self.design))), kind)


def render_charts(quick: bool, on_stage: OnStage) -> Iterator[Chart]:
    """Every chart of the renderer, one after the other."""
    world, rounds = set_world(20 if quick else 40, on_stage), 2 if quick else 15
    yield texture_chart(world, QUICK_WIDTHS_PX if quick else WIDTHS_PX, rounds, on_stage)
    yield edges_chart(world, 2 if quick else 8, rounds, on_stage)
    yield resolution_chart(world, 6 if quick else 40, rounds, on_stage)
    yield refresh_chart(world.problem, *((10, 6, 2) if quick else (40, 12, 3)), on_stage)
    yield growth_chart(quick, on_stage)
    yield step_chart(world.problem, rounds, on_stage)


def set_world(count: int, on_stage: OnStage) -> World:
    """The demo's problem, and the best design of `count` steps of its optimization."""
    problem = demo_problem()
    for step in steps(with_settings(problem, steps=count)):
        on_stage("design", step.state.number, count)
    return World(problem, from_pixels(as_pixels(step.state.best)))


def demo_problem() -> Problem:
    """The demo's scene before made-up clutter."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "scene.toml"
        path.write_text(demo.SCENE, encoding="utf-8")
        tables = read_toml(path)
    del tables["background"]
    scene = build_scene(SceneSettings.model_validate(tables), Path())
    clutter = (background(np.random.default_rng([demo.SEED, i]), demo.BACKGROUND_PX) for i in range(demo.BACKGROUNDS))
    return set_problem(replace(scene, backgrounds=Backgrounds(tuple(clutter))))


def with_settings(problem: Problem, seed: int | None = None, **optimize: int | float | str) -> Problem:
    """The problem with other settings of the loop, and another seed of its draws."""
    scene = problem.scene
    changed = scene.settings.optimize.model_copy(update=optimize)
    settings = scene.settings.model_copy(update={"optimize": changed})
    return replace(problem, scene=replace(scene, settings=settings, seed=scene.seed if seed is None else seed))


# How many taps a pixel's footprint needs


@dataclass(frozen=True)
class Look:
    """A view of a piece: the uv (and its change per pixel) of P pixels that lie within the design, and the mean P×3 of
    16×16 samples in each.
    """

    uv: tuple[Tensor, Tensor, Tensor]
    truth: Tensor


@dataclass(frozen=True)
class Texels:
    """A piece's picture as the renderer looks it up."""

    where: Layout
    table: Tensor

    def seen(self, look: Look, taps: int) -> Tensor:
        """The P×3 that a view's pixels see."""
        first = torch.zeros(len(look.truth), dtype=torch.long)
        return look_up(footprint(self.where, first, *look.uv, taps, blocks=True), self.table)


def texels(picture: PiecePicture) -> Texels:
    """The mip levels of a picture of the piece, which gradients reach."""
    height, width, _ = picture.srgb.shape
    table = texel_table([picture.srgb.detach()], wrap=False).requires_grad_()
    return Texels(layout([(width, height)], wrap=False), table)


def texture_chart(world: World, widths_px: Sequence[int], rounds: int, on_stage: OnStage) -> Chart:
    """Taps along a footprint's shorter side against the error to 16×16 samples per pixel."""
    kinds = {"optimized design": world.shown(tiled=3), "noise control": world.shown("noise")}
    views = [(width, tilt) for width in widths_px for tilt in TILTS_DEG]
    quality, seconds = {}, {}
    for kind, picture in kinds.items():
        looks, content = [], texels(picture)
        for view in views:
            looks.append(look(world.problem.scene.piece, picture, *view))
            on_stage("texture", len(quality) // len(TAPS) * len(views) + len(looks), len(kinds) * len(views))
        for taps in TAPS:
            with torch.no_grad():
                quality[kind, taps] = np.array([psnr(content.seen(one, taps), one.truth) for one in looks])

        def work(taps: int, looks=looks, content=content) -> None:
            for one in looks:
                torch.autograd.grad(content.seen(one, taps).sum(), content.table)

        seconds[kind] = timed({taps: lambda taps=taps, work=work: work(taps) for taps in TAPS}, rounds)
    rows = tuple((f"{kind}, {taps}", *(f"{q:.1f}" for q in values)) for (kind, taps), values in quality.items())
    milliseconds = 1e3 * np.median(seconds["optimized design"][DESIGN_TAPS]) / len(views)
    return Chart(
        "texture",
        "Texture: taps along the shorter side of a pixel's footprint",
        "footprint + look-up + backward, relative to the default",
        f"PSNR of the design's pixels, dB (median and range of {len(views)} views)",
        tuple(
            Series(kind, tuple(_over_views(taps, seconds[kind], quality[kind, taps]) for taps in TAPS))
            for kind in kinds
        ),
        (
            "truth: 16 × 16 samples per pixel of printed blocks, averaged as code values; pixels wholly on the design",
            "design: the optimized one three by three, as fine as one for a classifier with three times the pixels",
            f"the default takes {milliseconds:.2f} ms per view",
        ),
        tuple(
            Check(
                f"worst PSNR of the {kind} at the default, dB",
                float(quality[kind, DESIGN_TAPS].min()),
                LEAST_PSNR,
                at_least=True,
            )
            for kind in kinds
        ),
        (Table(("PSNR in dB, by taps", *(f"{width} px {tilt}°" for width, tilt in views)), rows),),
        higher_is_better=True,
        target=LEAST_PSNR,
    )


def _over_views(taps: int, seconds: dict, quality: np.ndarray) -> Point:
    cost, interval = ratio(seconds, taps, DESIGN_TAPS)
    spread = (float(quality.min()), float(quality.max()))
    return Point(f"{taps}", cost, float(np.median(quality)), interval, spread, taps == DESIGN_TAPS)


def look(piece: Piece, picture: PiecePicture, width_px: float, tilt_deg: float) -> Look:
    """A piece whose design is seen `width_px` wide in the middle of a picture."""
    pose, matrix = _pose(piece, width_px, tilt_deg), np.diag([PICTURE_PX, PICTURE_PX, 1.0])
    matrix[:2, 2] = PICTURE_PX / 2
    plane = np.pad(geometry.rect_corners([0, 0, *piece.size_mm]), ((0, 0), (0, 1)))
    faces = torch.tensor([[0, 3, 2], [0, 2, 1]])
    cameras = Cameras(torch.tensor(pose)[None], torch.tensor(matrix)[None], (PICTURE_PX, PICTURE_PX))
    fragments = rasterize(torch.tensor(plane), faces, cameras, 1.0)
    homography = geometry.plane_homography(matrix, pose, np.eye(4))
    truth, inside = reference(homography, piece, picture, fragments.pixel)
    fragments = fragments.where(inside)
    corner_uv = torch.tensor(_uv(picture, piece, plane[:, :2]), dtype=torch.float32)[faces][fragments.face]
    weights = (fragments.barycentric, fragments.barycentric_dx, fragments.barycentric_dy)
    uv = tuple((weight[..., None] * corner_uv).sum(1) for weight in weights)
    return Look(uv, truth[inside])


def _pose(piece: Piece, width_px: float, tilt_deg: float) -> np.ndarray:
    """4×4 from piece to camera: tilted about x, turned and shifted a little, so that nothing lies along the pixels."""
    distance = PICTURE_PX * piece.design_rect_mm[2] / width_px  # the focal length is the picture's side
    (cos_x, cos_z), (sin_x, sin_z) = (f(np.radians([tilt_deg, 11.5])) for f in (np.cos, np.sin))
    tilt = np.array([[1, 0, 0], [0, cos_x, -sin_x], [0, sin_x, cos_x]])
    turn = np.array([[cos_z, -sin_z, 0], [sin_z, cos_z, 0], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, :3] = turn @ tilt
    middle = np.array([*np.array(piece.size_mm) / 2, 0])
    shift = np.array([0.37, 0.11, PICTURE_PX]) * distance / PICTURE_PX
    pose[:3, 3] = shift - pose[:3, :3] @ middle
    return pose


def reference(homography: np.ndarray, piece: Piece, picture: PiecePicture, pixel: Tensor) -> tuple[Tensor, Tensor]:
    """Means P×3 of 16×16 samples in each of P pixels, and whether all of them lie within the design."""
    texture = picture.srgb.detach().permute(2, 0, 1)[None]
    x, y, width, height = piece.design_rect_mm
    corner = np.stack([pixel % PICTURE_PX, pixel // PICTURE_PX], 1)[:, None]  # P×1×2
    along = (np.arange(SUBSAMPLES) + 0.5) / SUBSAMPLES
    total, inside = torch.zeros(len(pixel), 3), np.ones(len(pixel), bool)
    for down in along:
        at = corner + np.stack([along, np.full(SUBSAMPLES, down)], 1)
        mm = geometry.apply_homography(np.linalg.inv(homography), at.reshape(-1, 2))
        within = (mm >= [x, y]).all(1) & (mm <= [x + width, y + height]).all(1)
        inside &= within.reshape(-1, SUBSAMPLES).all(1)
        grid = torch.tensor(2 * _uv(picture, piece, mm) - 1, dtype=torch.float32).view(1, 1, -1, 2)
        # texels are blocks of one color, as printed
        values = F.grid_sample(texture, grid, mode="nearest", padding_mode="border", align_corners=False)[0, :, 0]
        total += values.view(3, len(pixel), SUBSAMPLES).sum(2).T
    return total / SUBSAMPLES**2, torch.tensor(inside)


def _uv(picture: PiecePicture, piece: Piece, mm: np.ndarray) -> np.ndarray:
    """Where the piece's millimetres lie on its picture, from 0 to 1."""
    height, width, _ = picture.srgb.shape
    box = np.array(picture.box_px, float)
    return (box[:2] + mm / np.array(piece.size_mm) * (box[2:] - box[:2])) / [width, height]


# What samples at the object's edges buy


def edges_chart(world: World, views: int, rounds: int, on_stage: OnStage) -> Chart:
    """Samples per pixel of the object against a picture rendered 16 times as large and averaged in linear light."""
    problem, size_px = world.problem, (EDGES_PX, EDGES_PX)
    camera = problem.scene.settings.camera.model_copy(update={"photo_px": size_px})
    settings = problem.scene.settings.model_copy(update={"camera": camera})
    plain = Backgrounds((np.full((1, 1, 3), 128, np.uint8),))  # the object's own edges are what is looked at
    stage = replace(problem.stage, scene=replace(problem.scene, settings=settings, backgrounds=plain))
    shown, conditions = world.shown(), problem.scene.draw("select", views)
    quality = {n: [] for n in SUPERSAMPLES}
    with torch.no_grad():
        for i in range(views):
            one = conditions[i : i + 1]
            large = shade(see(stage, shown, one, (EDGES_PX * SUBSAMPLES,) * 2), shown)
            truth = encoded(F.avg_pool2d(large, SUBSAMPLES))
            for n, values in quality.items():
                values.append(psnr(encoded(shade(see(stage, shown, one, size_px, n), shown)), truth))
            on_stage("edges", i + 1, views)

    def work(n: int) -> None:
        expose(see(stage, shown, conditions, size_px, n), shown)

    seconds = timed({n: lambda n=n: work(n) for n in SUPERSAMPLES}, rounds)
    points = []
    for n, values in quality.items():
        middle, interval = mean_interval(np.array(values))
        cost, span = ratio(seconds, n, 1)
        points.append(Point(f"{n} × {n}", cost, middle, span, interval, n == 1))
    return Chart(
        "edges",
        "Samples per pixel of the object",
        "see + expose, relative to one sample per pixel",
        f"PSNR of the whole picture, dB (mean of {views} views, 95 %)",
        (Series("object with its patch", tuple(points)),),
        (f"truth: {SUBSAMPLES} × {SUBSAMPLES} samples per pixel, averaged in linear light; views of {EDGES_PX} px",),
        higher_is_better=True,
    )


# How large training views have to be


def resolution_chart(world: World, views: int, rounds: int, on_stage: OnStage) -> Chart:
    """Sides at which views are rendered against whole photographs of the same conditions, JPEG files and all."""
    problem, shown = world.problem, world.shown()
    conditions, (classifier,), (indices,) = problem.scene.draw("select", views), problem.classifiers, problem.indices

    def photographed(picture: Tensor) -> np.ndarray:
        return classifier.confidence(classifier.logits(picture), indices).numpy()

    truth = []
    with torch.no_grad(), TemporaryDirectory() as folder:
        for i in range(views):
            path = Path(folder) / f"{i}.jpg"
            take_photo(problem.stage, shown, conditions[i : i + 1], path)
            with Image.open(path) as image:
                truth.append(photographed(from_pixels(np.asarray(image))[None])[0])
            on_stage("photographs", i + 1, views)

    def pictures(side: int, picture: PiecePicture, part: Conditions) -> Tensor:
        return expose(see(problem.stage, picture, part, (side, side)), picture)

    def work(side: int) -> None:
        design = world.design.clone().requires_grad_()
        logits = classifier.logits(pictures(side, problem.subject.shown(design), conditions[:8]))
        torch.autograd.grad(target_loss(logits, indices, "assist").mean(), design)

    seconds, points, rows = timed({side: lambda side=side: work(side) for side in SIDES_PX}, rounds), [], []
    with torch.no_grad():
        for side in SIDES_PX:
            off = photographed(pictures(side, shown, conditions)) - np.array(truth)
            error, interval = mean_interval(np.abs(off))
            bias, between = mean_interval(off)
            cost, span = ratio(seconds, side, problem.training_px)
            points.append(Point(f"{side} px", cost, error, span, interval, side == problem.training_px))
            rows.append((f"{side} px", f"{bias:+.3f}", f"{between[0]:+.3f} to {between[1]:+.3f}"))
    photo_px = problem.scene.settings.camera.photo_px
    return Chart(
        "resolution",
        "Side of training views",
        "a whole step (render, classify, gradient), relative to the default",
        f"mean |confidence - photograph's| ({views} views, 95 %)",
        (Series(f"{classifier.name}, input {classifier.input_px} px", tuple(points)),),
        (f"truth: photographs of {photo_px[0]} × {photo_px[1]} px as JPEG files, reduced as the classifier does it",),
        tables=(Table(("", "confidence - photograph's", "95 %"), tuple(rows)),),
    )


# How long a pool of views may be kept


def refresh_chart(problem: Problem, count: int, views: int, seeds: int, on_stage: OnStage) -> Chart:
    """Steps for which views keep their poses against the selection loss after as many steps, and after as much time."""
    seconds = _refresh_seconds(with_settings(problem, views=views))
    cost = {n: seconds["see"] / n + seconds["rest"] for n in REFRESHES}
    ratios = {n: cost[n] / cost[1] for n in REFRESHES}  # of rounds, in turn
    ends = {n: max(count, round(count / np.median(ratios[n]))) for n in REFRESHES}
    losses = {key: [] for key in [(n, when) for n in REFRESHES for when in ("steps", "time")]}
    for seed in range(seeds):
        for i, n in enumerate(REFRESHES):
            loop = steps(with_settings(problem, seed, steps=ends[n], views=views, refresh=n))
            best = {step.state.number: step.state.best_loss for step in loop}
            losses[n, "steps"].append(best[count])
            losses[n, "time"].append(best[ends[n]])
            on_stage("refresh", seed * len(REFRESHES) + i + 1, seeds * len(REFRESHES))
    table = np.array(list(losses.values()))  # settings × seeds
    own = dict(zip(losses, table - table.mean(0) + table.mean(), strict=True))  # without what a seed's runs share
    points = []
    for when in ("steps", "time"):
        for n in REFRESHES[when == "time" :]:
            scale = ends[n] / count if when == "time" else 1.0
            span = tuple(float(scale * bound) for bound in (ratios[n].min(), ratios[n].max()))
            left = own[n, when]
            error, between = float(left.mean()), (float(left.min()), float(left.max()))
            middle = float(scale * np.median(ratios[n]))
            default = when == "steps" and n == OptimizeSettings().refresh
            done = count if when == "steps" else ends[n]
            points.append(Point(f"refresh {n}, {done} steps", middle, error, span, between, default))
    share = float(np.median(seconds["see"] / (seconds["see"] + seconds["rest"])))
    return Chart(
        "refresh",
        "Steps for which views keep their poses",
        f"time of the run, relative to {count} steps of refresh 1",
        f"selection loss (mean and range of {seeds} seeds, without what a seed's runs share)",
        (Series(f"{views} views a step", tuple(points)),),
        (f"seeing views anew is {100 * share:.0f} % of a step with the built-in classifier, less with a larger one",),
    )


def _refresh_seconds(problem: Problem) -> dict[str, np.ndarray]:
    """Times in turn of what a refresh costs and of the rest of a step."""
    conditions = problem.scene.draw("train", problem.scene.settings.optimize.views)
    (classifier,), (indices,) = problem.classifiers, problem.indices
    start = problem.subject.start()
    pool = problem.see(problem.subject.shown(start), conditions, problem.training_px)

    def rest() -> None:
        design = start.clone().requires_grad_()
        logits = classifier.logits(expose(relit(pool, conditions), problem.subject.shown(design)))
        torch.autograd.grad(target_loss(logits, indices, "assist").mean(), design)

    anew = lambda: problem.see(problem.subject.shown(start), conditions, problem.training_px)  # noqa: E731
    return timed({"see": anew, "rest": rest}, 9)
