"""Benchmark the size of training views: a step's time against the error of confidences.

In: the demo's scene and a design for it. Out: one chart.
"""

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from patchlab.bench.chart import Chart, ChartPoint
from patchlab.bench.measure import time_calls, time_ratio
from patchlab.bench.train import optimize_demo_design
from patchproof.base.intervals import student_mean
from patchproof.base.output import image_pixels
from patchproof.base.progress import Progress
from patchproof.optimizer.pixels import from_pixels
from patchproof.optimizer.problem import Problem
from patchproof.optimizer.responses import ask_networks
from patchproof.render.photograph import expose
from patchproof.render.pixels import PiecePicture
from patchproof.report.tables import Table
from patchproof.reprints.mounted_sheet import take_photo
from patchproof.scene.conditions import Conditions

SIDES_PX = (96, 128, 192, 224, 384)  # besides the default's


def charts(quick: bool, progress: Progress) -> Iterator[Chart]:
    """Chart the sides of training views."""
    problem, design = optimize_demo_design(80 if quick else 160, progress)
    yield resolution_chart(problem, design, 6 if quick else 40, 2 if quick else 15, progress)


def resolution_chart(problem: Problem, trained: Tensor, views: int, rounds: int, progress: Progress) -> Chart:
    """Compare views rendered at several sides with full photographs, JPEG files, of the same conditions."""
    shown = problem.patch.appearance(trained)
    conditions, (classifier,), (indices,) = problem.scene.draw("select", views), problem.classifiers, problem.indices

    def pictures(side: int, picture: PiecePicture, part: Conditions) -> Tensor:
        return expose(problem.see(picture, part, side), picture)

    def confidence(photos: Tensor) -> np.ndarray:
        return ask_networks(problem, photos, None).confidence[0]

    def step(side: int) -> None:
        design = trained.clone().requires_grad_()
        logits = classifier.logits(pictures(side, problem.patch.appearance(design), conditions[:8]))
        torch.autograd.grad(problem.losses(classifier, logits, indices).mean(), design)

    sides, truth = sorted({*SIDES_PX, problem.training_px}), []
    with torch.no_grad():
        for i in range(views):
            photo = image_pixels(take_photo(problem.stage, shown, conditions[i : i + 1]))
            truth.append(confidence(from_pixels(photo)[None])[0])
            progress("photographs", i + 1, views)
    times, points, rows = time_calls({side: lambda side=side: step(side) for side in sides}, rounds), [], []
    for side in sides:
        with torch.no_grad():
            errors = confidence(pictures(side, shown, conditions)) - truth
        cost, is_default = time_ratio(times, side, problem.training_px), side == problem.training_px
        points.append(ChartPoint(f"{side} px", cost, student_mean(np.abs(errors)), is_default))
        rows.append((f"{side} px", student_mean(errors)))
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
