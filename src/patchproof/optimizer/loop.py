"""The loop: draw conditions, photograph the piece, descend.

In: a `Problem` and, to go on, a `State`. Out: a generator of `Step`s; saving, progress and plots are its caller's
business. The design starts at mid-gray. Adam on every level of the gradient's pyramid, or signed steps as in FGSM and
PGD (Goodfellow et al. 2015, Madry et al. 2018), always clipped to [0, 1]. Every so many views the design is tried on a
fixed selection set, and the best one is kept: a design that suited its last views only is not what gets printed. The
promise set is never touched here.

A step depends on the state and its own number alone, so that a run that was stopped goes on to the same bytes. Its
views are seen two at a time by as many processes as the problem has, and gradients are added in the views' order, so
that their number changes no byte either.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial

import numpy as np
import torch
from torch import Tensor

from patchproof.optimizer.pixels import as_pixels, from_pixels
from patchproof.optimizer.problem import Problem
from patchproof.render.photograph import expose
from patchproof.render.views import Views
from patchproof.scene.conditions import Conditions
from patchproof.settings import OptimizeSettings
from patchproof.strict import Refused
from patchproof.workers import sharing

SELECT_AFTER = 120  # training views
SELECT_VIEWS = 64
SELECT_CHUNK = 4
TOGETHER = 2  # views of a step that one process sees: one at a time, seeing took 1.4 times as long
_BETAS, _EPSILON = (0.9, 0.999), 1e-8  # Adam's own defaults


@dataclass(frozen=True)
class State:
    """Everything that the next step depends on; designs 3×h×w, Adam's moments by level."""

    number: int
    design: Tensor
    mean: tuple[Tensor, ...]
    square: tuple[Tensor, ...]
    best: Tensor
    best_loss: float = float("inf")


@dataclass(frozen=True)
class _Part:
    """What some of a step's views say: means over them, and the gradient of their mean loss as float32 3×h×w."""

    views: int
    loss: float
    confidence: float
    rate: float
    gradient: np.ndarray
    pictures: np.ndarray | None


@dataclass(frozen=True)
class Step:
    """What one step did. Rates and confidence are over this step's training views; `select_*` where the design was
    tried.
    """

    state: State
    loss: float
    confidence: float
    rate: float
    gradient: float  # the classifiers' largest, penalties apart; 0 means that they no longer tell designs apart
    select_loss: float | None = None
    select_rate: float | None = None
    pictures: Tensor | None = field(default=None, repr=False)


def start(problem: Problem) -> State:
    """The state before the first step."""
    design = problem.subject.start()
    zeros = tuple(torch.zeros_like(level) for level in problem.subject.levels(design))
    return State(0, design, zeros, zeros, design)


def selects(settings: OptimizeSettings, number: int) -> bool:
    """Whether the design is tried on the selection set after step `number`, counted from 1."""
    done, before = (n * settings.views // SELECT_AFTER for n in (number, number - 1))
    return done > before or number == settings.steps


def views_seen(settings: OptimizeSettings) -> int:
    """Views that each network sees in training and selection."""
    selections = sum(selects(settings, number) for number in range(1, settings.steps + 1))
    return settings.steps * settings.views + selections * SELECT_VIEWS


def steps(problem: Problem, state: State | None = None) -> Iterator[Step]:
    """The steps from `state` (or from the start) to the last one that the scene's settings ask for."""
    state = start(problem) if state is None else state
    settings = problem.scene.settings.optimize
    conditions = problem.scene.draw("train", settings.steps * settings.views)
    selection = problem.scene.draw("select", SELECT_VIEWS)
    seen = lru_cache(partial(_seen_for_selection, problem, selection))  # once by each process

    def answer(task: tuple[np.ndarray, Conditions | int, bool]) -> _Part | tuple[float, float]:
        pixels, of, pictures = task
        design = torch.as_tensor(pixels, device=problem.device)
        return _tried(problem, seen(of), design) if isinstance(of, int) else part_of(problem, design, of, pictures)

    with sharing(answer, problem.jobs) as (workers, share):
        while state.number < settings.steps:
            first = state.number * settings.views
            drawn, last = conditions[first : first + settings.views], state.number + 1 == settings.steps
            pixels = state.design.cpu().numpy()
            step = _step(problem, state, workers.map(share, [(pixels, part, last) for part in _together(drawn)]))
            if selects(settings, step.state.number):
                printed = from_pixels(as_pixels(step.state.design), torch.device("cpu")).numpy()
                parts = [(printed, at, False) for at in range(0, SELECT_VIEWS, SELECT_CHUNK)]
                step = _select(step, workers.map(share, parts))
            state = step.state
            yield step


def best_design(problem: Problem) -> np.ndarray:
    """Run the whole loop; the pixels of the design that the selection set liked best."""
    state = start(problem)
    for step in steps(problem, state):
        state = step.state
    return problem.subject.pixels(state.best)


def draft(problem: Problem, conditions: Conditions, views: int) -> Tensor:
    """The design after a step on every `views` rows of the conditions, untried on the selection set."""
    state = start(problem)
    for first in range(0, len(conditions), views):
        state = step_on(problem, state, conditions[first : first + views]).state
    return state.design


def step_on(problem: Problem, state: State, drawn: Conditions) -> Step:
    """One step on these conditions, in this process."""
    return _step(problem, state, [part_of(problem, state.design, part, False) for part in _together(drawn)])


def _together(drawn: Conditions) -> list[Conditions]:
    """A step's conditions, as many at a time as are seen together."""
    return [drawn[first : first + TOGETHER] for first in range(0, len(drawn), TOGETHER)]


def part_of(problem: Problem, design: Tensor, drawn: Conditions, pictures: bool) -> _Part:
    """Photograph the design under these conditions and ask which way it goes down."""
    design = design.clone().requires_grad_()
    shown = problem.subject.shown(design)
    seen = expose(problem.see(shown, drawn, problem.training_px), shown)
    loss, confidence, rate = score(problem, seen, drawn)
    (gradient,) = torch.autograd.grad(loss, design)
    photos = seen.detach().cpu().numpy() if pictures else None
    return _Part(len(drawn), float(loss.detach()), confidence, rate, gradient.cpu().numpy(), photos)


def _step(problem: Problem, state: State, parts: Sequence[_Part]) -> Step:
    design, share = state.design.clone().requires_grad_(), [part.views / sum(p.views for p in parts) for part in parts]

    def mean(values):
        return sum(weight * value for weight, value in zip(share, values, strict=True))

    gradient = torch.as_tensor(mean(part.gradient for part in parts), device=problem.device)
    largest, penalty = float(gradient.abs().max()), problem.subject.penalty(design)
    if not math.isfinite(largest):  # one such step would turn the design into nothing for good
        do = "check its number format: some pictures lead it to infinity"
        raise Refused("finite gradients", f"{largest} in step {state.number + 1} from the networks", do)
    if isinstance(penalty, Tensor):
        gradient = gradient + torch.autograd.grad(penalty, design)[0]
        penalty = float(penalty.detach())
    photos = [torch.as_tensor(part.pictures) for part in parts if part.pictures is not None]
    return Step(
        _descend(state, gradient, problem),
        mean(part.loss for part in parts) + penalty,
        mean(part.confidence for part in parts),
        mean(part.rate for part in parts),
        largest,
        pictures=torch.cat(photos) if photos else None,
    )


def _descend(state: State, gradient: Tensor, problem: Problem) -> State:
    """One update of the design, clipped to what it may become."""
    clipped, settings = problem.subject.clipped, problem.scene.settings.optimize
    number, step_size = state.number + 1, settings.step_size
    if settings.optimizer == "sign":
        design = clipped(state.design - step_size * gradient.sign())
        return replace(state, number=number, design=design)
    levels = problem.subject.levels(gradient)
    mean = tuple(torch.lerp(now, old, _BETAS[0]) for now, old in zip(levels, state.mean, strict=True))
    square = tuple(torch.lerp(now**2, old, _BETAS[1]) for now, old in zip(levels, state.square, strict=True))
    updates = [
        (m / (1 - _BETAS[0] ** number)) / ((v / (1 - _BETAS[1] ** number)).sqrt() + _EPSILON)
        for m, v in zip(mean, square, strict=True)
    ]
    design = clipped(state.design - step_size * problem.subject.joined(updates))
    return replace(state, number=number, design=design, mean=mean, square=square)


def score(problem: Problem, pictures: Tensor, conditions: Conditions) -> tuple[Tensor, float, float]:
    """Mean loss over classifiers and pictures of these conditions; mean confidence and rate of the same."""
    losses, confidence, rate, boxes = [], 0.0, 0.0, problem.boxes(conditions)
    for classifier, indices in zip(problem.classifiers, problem.indices, strict=True):
        logits = classifier.logits(pictures, boxes)
        losses.append(problem.losses(classifier, logits, indices).mean())
        confidence += float(classifier.confidence(logits.detach(), indices).mean())
        rate += float(classifier.recognized(logits.detach(), indices).double().mean())
    count = len(losses)
    return torch.stack(losses).mean(), confidence / count, rate / count


def _seen_for_selection(problem: Problem, selection: Conditions, first: int) -> Views:
    """Some of the selection views, to be shaded anew for each design."""
    shown = problem.subject.shown(start(problem).design)
    return problem.see(shown, selection[first : first + SELECT_CHUNK], problem.training_px)


@torch.no_grad()
def _tried(problem: Problem, seen: Views, design: Tensor) -> tuple[float, float]:
    """Loss and rate of a design in selection views."""
    loss, _, rate = score(problem, expose(seen, problem.subject.shown(design)), seen.conditions)
    return float(loss), rate


def _select(step: Step, tried: Sequence[tuple[float, float]]) -> Step:
    """Keep the design if it is the best so far, as it would be printed, on the selection set."""
    state = step.state
    loss, rate = (sum(values) / len(values) for values in zip(*tried, strict=True))
    if loss < state.best_loss:
        state = replace(state, best=state.design, best_loss=loss)
    return replace(step, state=state, select_loss=loss, select_rate=rate)
