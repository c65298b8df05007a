"""The renderer's knobs: texture taps, supersampled edges, and resolution of training views.

In: the benchmarks' world. Out: one chart per knob; `speed` adds how the rasterizer's time grows and what share of a
step it takes, `texture` what the taps buy.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from patchproof.bench.chart import Chart, OnStage, Point, Series, Table
from patchproof.bench.measure import mean_interval, psnr, ratio, timed
from patchproof.bench.speed import growth_chart, step_chart
from patchproof.bench.texture import QUICK_WIDTHS_PX, SUBSAMPLES, WIDTHS_PX, texture_chart
from patchproof.bench.world import World, set_world
from patchproof.channel.camera import encoded
from patchproof.goal import Goal
from patchproof.optimizer.goals import target_loss
from patchproof.optimizer.pixels import from_pixels
from patchproof.output import image_pixels
from patchproof.render.photograph import expose, shade
from patchproof.render.pixels import PiecePicture
from patchproof.render.views import see
from patchproof.reprints.hung_sheet import take_photo
from patchproof.scene.backgrounds import Backgrounds
from patchproof.scene.conditions import Conditions

SUPERSAMPLES, EDGES_PX = (1, 2, 3), 192
SIDES_PX = (96, 128, 192, 224, 384)


def render_charts(quick: bool, on_stage: OnStage) -> Iterator[Chart]:
    """Every chart of the renderer, one after the other."""
    world, rounds = set_world(80 if quick else 160, on_stage), 2 if quick else 15
    yield texture_chart(world, QUICK_WIDTHS_PX if quick else WIDTHS_PX, rounds, on_stage)
    yield edges_chart(world, 2 if quick else 8, rounds, on_stage)
    yield resolution_chart(world, 6 if quick else 40, rounds, on_stage)
    yield growth_chart(quick, on_stage)
    yield step_chart(world.problem, rounds, on_stage)


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
    with torch.no_grad():
        for i in range(views):
            photo = image_pixels(take_photo(problem.stage, shown, conditions[i : i + 1]))
            truth.append(photographed(from_pixels(photo)[None])[0])
            on_stage("photographs", i + 1, views)

    def pictures(side: int, picture: PiecePicture, part: Conditions) -> Tensor:
        return expose(see(problem.stage, picture, part, (side, side)), picture)

    def work(side: int) -> None:
        design = world.design.clone().requires_grad_()
        logits = classifier.logits(pictures(side, problem.subject.shown(design), conditions[:8]))
        torch.autograd.grad(target_loss(logits, indices, Goal.assist).mean(), design)

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
