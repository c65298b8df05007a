"""Expectation over transformations: the mean loss of a design over drawn conditions, and its gradient.

In: a `Problem` and its conditions. Out: `Expectation`, one interface to any number of processes. The design is printed
once for all views of a step; each process photographs some of the views, runs the networks, and sends back the gradient
at the print. These gradients are added in the views' order, so that the number of processes changes no byte, and are
propagated back through the printer here. A run's poses occur several times, each time with another background, light,
print and camera: `ViewCache` renders them once and only relights them later, as far as memory allows.

Source: Athalye et al. 2018, "Synthesizing robust adversarial examples", eq. 2 and 3.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from patchproof.base.workers import fork_workers
from patchproof.optimizer.problem import Problem
from patchproof.optimizer.subject import as_pixels, from_pixels
from patchproof.render.photograph import affected_windows, expose
from patchproof.render.views import Views, split_views
from patchproof.scene.conditions import Conditions
from patchproof.scene.interface import Scene

# Of the views of the next steps that a process renders together: 16 at 224 px, of which 2 at a time took 1.7 times as
# long, 8 at a time 1.1 times.
AHEAD_PX = 16 * 224**2
# A run has this many poses, or a fifth as many as views if that is more. Over 18 pairs of object and seed, the loss was
# 0.3 % [-1.1, 0.5] lower than with a quarter, and with a quarter 0.7 % [-0.2, 1.5] higher than with one pose for each
# view; as many views were recognized. With one background for each pose, too, it was 2 % higher; with one pose for four
# steps in a row, 25 to 33 %.
MIN_POSES, VIEWS_PER_POSE = 192, 5
CACHE_PX = 480 * 224**2  # of the views that all processes keep, at 20 to 70 bytes a pixel
SELECT_CHUNK = 4  # selection views that a process renders together


def training_conditions(scene: Scene) -> Conditions:
    """The conditions of all of a run's views. Poses repeat, backgrounds do not."""
    settings = scene.settings.optimize
    conditions = scene.draw("train", settings.steps * settings.views)
    pose = conditions.pose[np.arange(len(conditions)) % pose_count(scene)]
    if scene.HAS_OBJECT:
        pose = replace(pose, background=conditions.pose.background)
    return replace(conditions, pose=pose)


def pose_count(scene: Scene) -> int:
    """The number of poses in a run, a multiple of a step's views; scenes of pictures have one pose per view."""
    settings = scene.settings.optimize
    views = settings.steps * settings.views
    steps = math.ceil(max(MIN_POSES, views / VIEWS_PER_POSE) / settings.views)
    return steps * settings.views if scene.HAS_OBJECT else views


def new_pose_share(scene: Scene) -> float:
    """The share of a run's views that show a pose for the first time, from 0 to 1."""
    settings = scene.settings.optimize
    return min(1.0, pose_count(scene) / (settings.steps * settings.views))


def in_batches(problem: Problem, conditions: Conditions) -> list[tuple[int, Conditions]]:
    """A step's conditions in batches that one process renders, each with the row that it begins at."""
    size = problem.scene.settings.optimize.views_per_batch
    return [(row, conditions[row : row + size]) for row in range(0, len(conditions), size)]


def training_views(problem: Problem, conditions: Conditions) -> Views:
    """Views of these conditions at the training's size, in which any design can be shown."""
    return problem.see(problem.start_appearance, conditions, problem.training_px)


class ViewCache:
    """One process's rendered training views: as many as fit are kept, and the next steps' are rendered together."""

    def __init__(self, problem: Problem, conditions: Conditions):
        self._problem, self._conditions = problem, conditions
        self._poses = min(pose_count(problem.scene), len(conditions))
        self._stored, self._ahead = dict[int, Views](), dict[int, Views]()
        settings, repeats = problem.scene.settings.optimize, new_pose_share(problem.scene) < 1
        processes = min(problem.jobs, math.ceil(settings.views / settings.views_per_batch))
        self._capacity = CACHE_PX // (processes * settings.views_per_batch * problem.training_px**2) if repeats else 0

    def views(self, pose: int, conditions: Conditions) -> Views:
        """The views of a task's conditions, whose poses begin with the run's pose number `pose`."""
        if pose not in self._stored and pose not in self._ahead:
            self._render_ahead(pose, len(conditions))
        views = self._stored.get(pose) or self._ahead.pop(pose)
        if len(self._stored) < self._capacity:
            self._stored[pose] = views
        return self._problem.see_again(views, conditions)

    def _render_ahead(self, pose: int, count: int) -> None:
        step = self._problem.scene.settings.optimize.views
        tasks = AHEAD_PX // (count * self._problem.training_px**2)
        poses = range(pose, self._poses, step)[: max(1, tasks)]
        rows = np.concatenate([np.arange(first, first + count) for first in poses])
        together = training_views(self._problem, self._conditions[rows])
        self._ahead |= zip(poses, split_views(together, [count] * len(poses)), strict=True)


class Answer(NamedTuple):
    """Means over some views, and the gradient of their mean loss, without the penalty: a tensor at the design 3×h×w, or
    at the printed texels as processes exchange it (`_to_send`).
    """

    views: int
    loss: float
    confidence: float
    rate: float
    gradient: Any


class _Job(NamedTuple):
    """Printed texels, and training views: their first pose, and conditions; else selection views from `first` on."""

    printed: np.ndarray | Tensor
    first: int
    conditions: Conditions | None = None


class Expectation:
    """Evaluates designs in the views of a run's steps and in the fixed views of its selection set."""

    def __init__(self, problem: Problem, conditions: Conditions, selection_views: int, ask: Callable[[list], list]):
        self._problem, self._conditions, self._selection_views = problem, conditions, selection_views
        self._ask, self._poses = ask, pose_count(problem.scene)

    def gradient(self, design: Tensor, step: int) -> Answer:
        """The mean loss and its gradient at a design 3×h×w, in the views of step number `step`, counted from 0."""
        views = self._problem.scene.settings.optimize.views
        tasks = in_batches(self._problem, self._conditions[step * views : (step + 1) * views])

        def ask(printed: Tensor) -> list[Answer]:
            texels = _to_send(printed)
            return self._ask([_Job(texels, (step * views + row) % self._poses, rows) for row, rows in tasks])

        return _mean_answer(self._problem, design, ask)

    def selection(self, design: Tensor) -> tuple[float, float]:
        """Mean loss and rate of a design in the selection views, rounded to the 8-bit pixels that go to the printer."""
        texels = _to_send(self._problem.subject.print_design(from_pixels(as_pixels(design), self._problem.device)))
        answers = self._ask([_Job(texels, first) for first in range(0, self._selection_views, SELECT_CHUNK)])
        loss, rate = (sum(values) / len(values) for values in zip(*answers, strict=True))
        return loss, rate


@contextmanager
def expectation(problem: Problem, selection: Conditions) -> Iterator[Expectation]:
    """The expectation over a run's training conditions and the `selection` set's, by the problem's processes."""
    conditions = training_conditions(problem.scene)
    cache = ViewCache(problem, conditions)  # each process keeps the views it has rendered
    selection_views = lru_cache(lambda first: training_views(problem, selection[first : first + SELECT_CHUNK]))

    def answer(task: _Job) -> Answer | tuple[float, float]:
        printed = torch.as_tensor(task.printed, device=problem.device)
        if task.conditions is not None:
            return _views_answer(problem, printed, cache.views(task.first, task.conditions))
        views = selection_views(task.first)
        with torch.no_grad():
            photos = expose(views, problem.subject.appearance_of_print(printed))
            loss, _, rate = score(problem, photos, views.conditions)[1].tolist()
        return loss, rate

    with fork_workers(answer, problem.jobs, in_turn=True) as (workers, share):
        yield Expectation(problem, conditions, len(selection), lambda tasks: workers.map(share, tasks))


def last_pictures(problem: Problem, design: Tensor) -> Tensor:
    """Pictures N×3×H×W of a design in the views of a run's last step."""
    conditions = training_conditions(problem.scene)[-problem.scene.settings.optimize.views :]
    with torch.no_grad():
        return expose(training_views(problem, conditions), problem.subject.appearance(design))


def gradient_in_views(problem: Problem, design: Tensor, views: Sequence[Views]) -> Answer:
    """The mean loss and its gradient at a design 3×h×w in these views, all in this process."""
    return _mean_answer(problem, design, lambda printed: [_views_answer(problem, printed, each) for each in views])


def score(
    problem: Problem, pictures: Tensor, conditions: Conditions, windows: np.ndarray | None = None
) -> tuple[Tensor, Tensor]:
    """The mean loss, differentiable, and (loss, confidence, rate) in float64, all means over classifiers and pictures
    N×3×H×W. Outside of `windows`, N×4 pixels (left, top, right, bottom), the pictures' gradient is not needed.
    """
    losses, figures, boxes = [], [], problem.boxes(conditions)
    for classifier, indices in zip(problem.classifiers, problem.indices, strict=True):
        logits = classifier.logits(pictures, boxes, windows)
        losses.append(problem.losses(classifier, logits, indices).mean())
        told = classifier.confidence(logits.detach(), indices), classifier.recognized(logits.detach(), indices)
        figures.append(torch.stack([each.double().mean() for each in told]))
    loss = torch.stack(losses).mean()
    return loss, torch.cat([loss.detach().double()[None], torch.stack(figures).mean(0)])


def _mean_answer(problem: Problem, design: Tensor, ask: Callable[[Tensor], Sequence[Answer]]) -> Answer:
    """Print the design once, get the answers of views, and propagate their mean gradient back through the printer."""
    design = design.detach().requires_grad_()
    printed = problem.subject.print_design(design)
    answers = ask(printed.detach())
    views = sum(answer.views for answer in answers)
    shares = [answer.views / views for answer in answers]

    def mean(values):
        return sum(share * value for share, value in zip(shares, values, strict=True))

    print_gradient = torch.as_tensor(mean(answer.gradient for answer in answers), device=problem.device)
    # differentiating a product, since torch imports SymPy for grad_outputs (networks/cuts.py)
    (gradient,) = torch.autograd.grad((printed * print_gradient).sum(), design)
    loss, confidence, rate = (mean(getattr(a, name) for a in answers) for name in ("loss", "confidence", "rate"))
    return Answer(views, loss, confidence, rate, gradient)


def _views_answer(problem: Problem, printed: Tensor, views: Views) -> Answer:
    """Photograph the print in these views, run the networks, and differentiate their mean loss."""
    printed = printed.detach().requires_grad_()
    photos = expose(views, problem.subject.appearance_of_print(printed))
    loss, figures = score(problem, photos, views.conditions, affected_windows(views))
    (gradient,) = torch.autograd.grad(loss, printed)
    mean_loss, confidence, rate = figures.tolist()
    return Answer(len(photos), mean_loss, confidence, rate, _to_send(gradient))


def _to_send(tensor: Tensor) -> np.ndarray | Tensor:
    """Return a tensor as processes exchange it: an array on a CPU; a GPU has one process and exchanges nothing."""
    return tensor.numpy() if tensor.device.type == "cpu" else tensor
