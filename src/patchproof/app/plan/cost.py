"""Measure the time of one optimization step on this machine, by parts.

In: a problem and a design. Out: `Cost`: median milliseconds of each part over a few steps' views, after a warm-up. The
parts are those of the loop, in which views of one pose share its rasterization; a part inside of `render_views` is the
difference of two calls of it.
"""

import statistics
import time

import numpy as np
import torch
from torch import Tensor

from patchproof.base.progress import Advance, no_advance
from patchproof.base.validation import StrictModel
from patchproof.optimizer.expectation import new_pose_share
from patchproof.optimizer.problem import Problem
from patchproof.render.photograph import affected_windows, expose
from patchproof.render.pixels import Appearance
from patchproof.render.raster import rasterize
from patchproof.render.views import Views, cameras, near_mm
from patchproof.scene.conditions import Conditions
from patchproof.scene.mesh_scene import require_mesh

REPEATS = 5


class StepPart(StrictModel):
    """Milliseconds of a part of a step and their share of it."""

    name: str
    ms: float
    share: float


class Cost(StrictModel):
    """One step of `views` views of `side_px`."""

    views: int
    side_px: int
    threads: int
    ms: float
    parts: tuple[StepPart, ...]


def measure_cost(problem: Problem, design: Tensor, advance: Advance = no_advance) -> Cost:
    """Time steps that show `design`, with all classifiers of the problem."""
    views, threads, rows = problem.scene.settings.optimize.views, torch.get_num_threads(), []
    for number in range(REPEATS + 1):  # the first one warms up
        rows.append(_step_ms(problem, design, problem.scene.draw("train", views, start=number * views)))
        advance(number + 1, REPEATS + 1)
    median = {name: statistics.median(row[name] for row in rows[1:]) for name in rows[0]}
    total = sum(median.values())
    parts = tuple(StepPart(name=name, ms=ms, share=ms / total) for name, ms in median.items())
    return Cost(views=views, side_px=problem.training_px, threads=threads, ms=total, parts=parts)


def _step_ms(problem: Problem, design: Tensor, conditions: Conditions) -> dict[str, float]:
    """Time each part of one step in milliseconds, in the order of the loop."""
    design = design.clone().requires_grad_()
    parts, views = _see_ms(problem, problem.subject.appearance(design.detach()), conditions)
    share = new_pose_share(problem.scene)
    parts = {name: ms * share for name, ms in parts.items()}
    clock = _Clock(problem.device)
    appearance = problem.subject.appearance(design)
    parts[problem.subject.STAGE_NAME] = clock.lap()
    pictures = expose(views, appearance)
    parts["light, piece and camera"] = clock.lap()
    leaf, boxes, windows = pictures.detach().requires_grad_(), problem.boxes(conditions), affected_windows(views)
    losses = [
        problem.losses(classifier, classifier.logits(leaf, boxes, windows), indices).mean()
        for classifier, indices in zip(problem.classifiers, problem.indices, strict=True)
    ]
    loss = torch.stack(losses).mean()
    parts["classifier forward"] = clock.lap()
    (gradient,) = torch.autograd.grad(loss, leaf)
    parts["classifier backward"] = clock.lap()
    cost = (pictures * gradient).sum() + problem.subject.penalty(design)
    torch.autograd.grad(cost, design)
    parts["design backward"] = clock.lap()
    return parts


def _see_ms(problem: Problem, appearance: Appearance, conditions: Conditions) -> tuple[dict[str, float], Views]:
    """Time the parts of `render_views` in milliseconds; also returns the views."""
    side_px = problem.training_px
    problem.see(None, conditions, 16)  # loads the background pictures, which a run does once
    clock = _Clock(problem.device)
    views = problem.see(appearance, conditions, side_px)
    total = clock.lap()
    problem.see(None, conditions, side_px)
    parts = {"see: background": clock.lap()}
    if problem.scene.HAS_OBJECT:
        scene = require_mesh(problem.scene)
        poses, surface = scene.camera_from_world(conditions), problem.stage.object_surface
        matrices = np.broadcast_to(scene.matrix_px((side_px, side_px)), (len(poses), 3, 3))
        view_cameras = cameras(poses, matrices, (side_px, side_px), problem.stage)
        rasterize(surface.vertices, surface.faces, view_cameras, near_mm(scene))
        rasterizing = min(clock.lap(), parts["see: background"])
        rest = parts.pop("see: background") - rasterizing
        parts |= {"see: rasterize object": rasterizing, "see: object's texels, outlines, background": rest}
    if views.piece is not None:
        parts["see: piece's footprints"] = max(0.0, total - sum(parts.values()))
    return parts, views


class _Clock:
    """A stopwatch in milliseconds that waits for the device."""

    def __init__(self, device: torch.device):
        self._device, self._last = device, 0.0
        self.lap()

    def lap(self) -> float:
        """Return the milliseconds since the last call, and restart."""
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        start, self._last = self._last, time.perf_counter()
        return 1000 * (self._last - start)
