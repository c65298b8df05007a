"""The renderer's knobs: texture taps (see `texture`), supersampled edges, and resolution of training views.

In: the benchmarks' world. Out: one chart per knob.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn import functional as F

from patchproof.bench.chart import Chart, OnStage, Point
from patchproof.bench.measure import psnr, ratio, timed
from patchproof.bench.texture import QUICK_WIDTHS_PX, SUBSAMPLES, WIDTHS_PX, texture_chart
from patchproof.bench.world import World, set_world
from patchproof.channel.camera import encoded
from patchproof.claims import student_mean
from patchproof.optimizer.goals import target_loss
from patchproof.optimizer.pixels import from_pixels
from patchproof.optimizer.responses import ask
from patchproof.render.photograph import expose, shade
from patchproof.render.pixels import PiecePicture
from patchproof.render.views import see
from patchproof.report.tables import Table
from patchproof.reprints.reprint import take_photo
from patchproof.scene.backgrounds import Backgrounds
from patchproof.scene.conditions import Conditions

SUPERSAMPLES, EDGES_PX = (1, 2, 3), 192
SIDES_PX = (96, 128, 192, 224, 384)


def charts(quick: bool, on_stage: OnStage) -> Iterator[Chart]:
    """Every chart of the renderer, one after the other."""
    world, rounds = set_world(80 if quick else 160, on_stage), 2 if quick else 15
    yield texture_chart(world, QUICK_WIDTHS_PX if quick else WIDTHS_PX, rounds, on_stage)
    yield edges_chart(world, 2 if quick else 8, rounds, on_stage)
    yield resolution_chart(world, 6 if quick else 40, rounds, on_stage)


# What samples at the object's edges buy


def edges_chart(world: World, views: int, rounds: int, on_stage: OnStage) -> Chart:
    """Samples per pixel of the object against a picture rendered 16 times as large and averaged in linear light."""
    problem, size_px = world.problem, (EDGES_PX, EDGES_PX)
    large_px = (EDGES_PX * SUBSAMPLES, EDGES_PX * SUBSAMPLES)
    settings = problem.scene.settings.changed(camera={"photo_px": size_px})
    plain = Backgrounds((np.full((1, 1, 3), 128, np.uint8),))  # the object's own edges are what is looked at
    stage = replace(problem.stage, scene=replace(problem.scene, settings=settings, backgrounds=plain))
    shown, conditions = world.shown(), problem.scene.draw("select", views)
    quality: dict[int, list[float]] = {n: [] for n in SUPERSAMPLES}
    with torch.no_grad():
        for i in range(views):
            view = conditions[i : i + 1]
            large = shade(see(stage, shown, view, large_px), shown)
            truth = encoded(F.avg_pool2d(large, SUBSAMPLES))
            for n, values in quality.items():
                values.append(psnr(encoded(shade(see(stage, shown, view, size_px, n), shown)), truth))
            on_stage("edges", i + 1, views)
    seconds = timed(
        {n: lambda n=n: expose(see(stage, shown, conditions, size_px, n), shown) for n in SUPERSAMPLES}, rounds
    )
    return Chart(
        name="edges",
        title="Samples per pixel of the object",
        cost="see + expose, relative to one sample per pixel",
        error=f"PSNR of the whole picture, dB (mean of {views} views)",
        series={
            "object with its patch": [
                Point(f"{n} × {n}", ratio(seconds, n, 1), student_mean(quality[n]), n == 1) for n in SUPERSAMPLES
            ]
        },
        about=f"Truth: {SUBSAMPLES} × {SUBSAMPLES} samples per pixel, averaged in linear light; {EDGES_PX} px.",
        higher_is_better=True,
    )


# How large training views have to be


def resolution_chart(world: World, views: int, rounds: int, on_stage: OnStage) -> Chart:
    """Sides at which views are rendered against whole photographs of the same conditions, JPEG files and all."""
    problem, shown = world.problem, world.shown()
    conditions, (classifier,), (indices,) = problem.scene.draw("select", views), problem.classifiers, problem.indices

    def pictures(side: int, picture: PiecePicture, part: Conditions) -> Tensor:
        return expose(problem.see(picture, part, side), picture)

    def confidence(photos: Tensor) -> np.ndarray:
        return ask(problem, photos).confidence[0]

    def step(side: int) -> None:
        design = world.design.clone().requires_grad_()
        logits = classifier.logits(pictures(side, world.patch.shown(design), conditions[:8]))
        torch.autograd.grad(target_loss(logits, indices, problem.scene.settings.target.goal).mean(), design)

    truth = np.zeros(views)
    with TemporaryDirectory() as folder:
        for i in range(views):
            path = Path(folder) / f"{i}.jpg"
            take_photo(problem.stage, shown, conditions[i : i + 1], path)
            with Image.open(path) as image:
                truth[i] = confidence(from_pixels(np.asarray(image))[None])[0]
            on_stage("photographs", i + 1, views)
    seconds, points, rows = timed({side: lambda side=side: step(side) for side in SIDES_PX}, rounds), [], []
    for side in SIDES_PX:
        with torch.no_grad():
            off = confidence(pictures(side, shown, conditions)) - truth
        cost, is_default = ratio(seconds, side, problem.training_px), side == problem.training_px
        points.append(Point(f"{side} px", cost, student_mean(np.abs(off)), is_default))
        rows.append((f"{side} px", student_mean(off)))
    photo_px = problem.scene.settings.camera.photo_px
    return Chart(
        name="resolution",
        title="Side of training views",
        cost="a whole step (render, classify, gradient), relative to the default",
        error=f"mean |confidence - photograph's| ({views} views)",
        series={f"{classifier.name}, input {classifier.input_px} px": points},
        about=f"Truth: photographs of {photo_px[0]} × {photo_px[1]} px as JPEG files, reduced by the classifier.",
        tables=(Table("resolution_bias", "Confidence minus photograph's", ("side", "mean difference"), tuple(rows)),),
    )
