"""The loop: draw conditions, photograph the piece, descend.

In: a `Problem` and, to go on, a `State`. Out: a generator of `Step`s; saving, progress and plots are its caller's
business. The design starts at mid-gray. Adam on every level of the gradient's pyramid, or signed steps as in FGSM and
PGD (Goodfellow et al. 2015, Madry et al. 2018), always clipped to [0, 1]. Every 240 views the design is tried on a
fixed selection set, and the best one is kept: a design that suited its last views only is not what gets printed. The
promise set is never touched here.

Where there is an object, a run's poses come round several times, each time before another background, under other
light, with another print and camera: what was seen is kept, as far as memory allows, and only lit anew. A step depends
on the state and its own number alone, so that a run that was stopped goes on to the same bytes. Its views are seen two
at a time by as many processes as the problem has, and gradients are added in the views' order, so that their number
changes no byte either.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial

import numpy as np
import torch
from torch import Tensor

from patchproof.base.settings import OptimizeSettings
from patchproof.base.strict import Refused
from patchproof.base.workers import sharing
from patchproof.optimizer.pixels import as_pixels, from_pixels
from patchproof.optimizer.problem import Problem
from patchproof.render.photograph import expose, windows_of
from patchproof.render.views import Views, apart, seen_again
from patchproof.scene.conditions import Conditions
from patchproof.scene.scene import Scene

# Training views. Tried twice as often, 28 of 30 runs kept their last design all the same, and two one that was better
# by 0.00 and 0.02 of loss; steps four times as large as the default's lost 0.01.
SELECT_AFTER = 240
SAVE_AFTER = 120  # training views that a kill may lose
SELECT_VIEWS = 64
SELECT_CHUNK = 4
TOGETHER = 2  # views of a step that one process sees: one at a time, seeing took 1.4 times as long
AHEAD = 4  # steps whose views a process sees together: alone, seeing took 1.4 times as long
# A run has this many poses, or a quarter as many as views if that is more. Over 18 pairs of object and seed the loss
# was 0.7 % [-0.2, 1.5] higher than with a pose to each view, and as many views were recognized. With a background to
# each pose, too, it was 2 %; with one pose for four steps in a row, 25 to 33 %.
POSES, LOOKS = 240, 4
KEPT_PX = 240 * 224**2  # of the views that a process keeps, with 20 to 60 bytes to a pixel
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
    """What some of a step's views say: means over them, and the gradient of their mean loss at what is printed."""

    views: int
    loss: float
    confidence: float
    rate: float
    gradient: np.ndarray
    pictures: np.ndarray | None


Asked = Callable[[Tensor], Sequence[_Part]]  # what views say of what is printed


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
    return _ends(settings, number, SELECT_AFTER)


def saves(settings: OptimizeSettings, number: int) -> bool:
    """Whether the state after step `number` is worth keeping."""
    return _ends(settings, number, SAVE_AFTER)


def _ends(settings: OptimizeSettings, number: int, views: int) -> bool:
    done, before = (n * settings.views // views for n in (number, number - 1))
    return done > before or number == settings.steps


def views_seen(settings: OptimizeSettings) -> int:
    """Views that each network sees in training and selection."""
    selections = sum(selects(settings, number) for number in range(1, settings.steps + 1))
    return settings.steps * settings.views + selections * SELECT_VIEWS


def steps(problem: Problem, state: State | None = None) -> Iterator[Step]:
    """The steps from `state` (or from the start) to the last one that the scene's settings ask for."""
    state = start(problem) if state is None else state
    settings = problem.scene.settings.optimize
    conditions, poses = trained_on(problem.scene), _poses(problem.scene)
    selection = problem.scene.draw("select", SELECT_VIEWS)
    kept = _Kept(problem, conditions)  # by each process what it has seen
    for_selection = lru_cache(lambda first: seen(problem, selection[first : first + SELECT_CHUNK]))

    def answer(task: tuple[np.ndarray, int, Conditions | None, bool]) -> tuple[float, float] | _Part:
        printed, first, drawn, pictures = task
        printed = torch.as_tensor(printed, device=problem.device)
        if drawn is None:
            return _tried(problem, for_selection(first), printed)
        return part_of(problem, printed, kept.lit(first, drawn), pictures)

    with sharing(answer, problem.jobs, in_turn=True) as (workers, share):

        def asked(printed: Tensor, tasks: Sequence[tuple[int, Conditions | None, bool]]) -> list:
            sent = printed.cpu().numpy()
            return workers.map(share, [(sent, *task) for task in tasks])

        while state.number < settings.steps:
            first, last = state.number * settings.views, state.number + 1 == settings.steps
            drawn = _together(conditions[first : first + settings.views])
            tasks = [((first + at) % poses, rows, last) for at, rows in drawn]
            step = _step(problem, state, partial(asked, tasks=tasks))
            if selects(settings, step.state.number):
                printed = problem.subject.printed(from_pixels(as_pixels(step.state.design), problem.device))
                step = _select(step, asked(printed, [(at, None, False) for at in range(0, SELECT_VIEWS, SELECT_CHUNK)]))
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
    views = [seen(problem, rows) for _, rows in _together(drawn)]
    return _step(problem, state, lambda printed: [part_of(problem, printed, part) for part in views])


def trained_on(scene: Scene) -> Conditions:
    """A run's training conditions, whose poses come round again; what lies behind an object does not."""
    settings = scene.settings.optimize
    conditions = scene.draw("train", settings.steps * settings.views)
    pose = conditions.pose[np.arange(len(conditions)) % _poses(scene)]
    if scene.HAS_OBJECT:
        pose = replace(pose, background=conditions.pose.background)
    return replace(conditions, pose=pose)


def new_share(scene: Scene) -> float:
    """The share of a run's views that show a pose for the first time, from 0 to 1."""
    settings = scene.settings.optimize
    return min(1.0, _poses(scene) / (settings.steps * settings.views))


def _poses(scene: Scene) -> int:
    """How many poses a run has: those of whole steps; of pictures, which are all of a view, all."""
    settings = scene.settings.optimize
    views = settings.steps * settings.views
    return math.ceil(max(POSES, views / LOOKS) / settings.views) * settings.views if scene.HAS_OBJECT else views


def _together(drawn: Conditions) -> list[tuple[int, Conditions]]:
    """A step's conditions, as many at a time as are seen together, and where they begin."""
    return [(first, drawn[first : first + TOGETHER]) for first in range(0, len(drawn), TOGETHER)]


def seen(problem: Problem, drawn: Conditions) -> Views:
    """Views of these conditions for training, in which any design can be shown."""
    return problem.see(problem.laid_out, drawn, problem.training_px)


class _Kept:
    """Views that a process has seen, the first that fit, and those of its next steps, which it sees together."""

    def __init__(self, problem: Problem, conditions: Conditions):
        self._problem, self._conditions = problem, conditions
        self._poses = min(_poses(problem.scene), len(conditions))
        self._views, self._ahead = dict[int, Views](), dict[int, Views]()
        comes_round = new_share(problem.scene) < 1
        self._most = KEPT_PX // (TOGETHER * problem.training_px**2) if comes_round else 0

    def lit(self, pose: int, drawn: Conditions) -> Views:
        """The views of these conditions, whose poses begin with that number."""
        if pose not in self._views and pose not in self._ahead:
            self._look_ahead(pose, len(drawn))
        views = self._views.get(pose) or self._ahead.pop(pose)
        if len(self._views) < self._most:
            self._views[pose] = views
        return seen_again(views, drawn)

    def _look_ahead(self, pose: int, count: int) -> None:
        views = self._problem.scene.settings.optimize.views
        poses = range(pose, self._poses, views)[:AHEAD]
        rows = np.concatenate([np.arange(first, first + count) for first in poses])
        together = seen(self._problem, self._conditions[rows])
        self._ahead |= zip(poses, apart(together, [count] * len(poses)), strict=True)


def part_of(problem: Problem, printed: Tensor, views: Views, pictures: bool = False) -> _Part:
    """Photograph what is printed in these views and ask which way it goes down."""
    printed = printed.detach().requires_grad_()
    photos = expose(views, problem.subject.showing(printed))
    loss, confidence, rate = score(problem, photos, views.conditions, windows_of(views))
    (gradient,) = torch.autograd.grad(loss, printed)
    kept = photos.detach().cpu().numpy() if pictures else None
    return _Part(len(photos), float(loss.detach()), confidence, rate, gradient.cpu().numpy(), kept)


def gradient_of(problem: Problem, design: Tensor, asked: Asked) -> tuple[Tensor, Sequence[_Part], list[float]]:
    """The gradient of the views' mean loss at a design, printed once for all of them; what they say, and the share of
    each part in a mean.
    """
    design = design.detach().requires_grad_()
    printed = problem.subject.printed(design)
    parts = asked(printed.detach())
    share = [part.views / sum(p.views for p in parts) for part in parts]
    gradient = sum(weight * part.gradient for weight, part in zip(share, parts, strict=True))
    told = (printed * torch.as_tensor(gradient, device=problem.device)).sum()  # see classifier/windows.py
    (gradient,) = torch.autograd.grad(told, design)
    return gradient, parts, share


def _step(problem: Problem, state: State, asked: Asked) -> Step:
    gradient, parts, share = gradient_of(problem, state.design, asked)

    def mean(values):
        return sum(weight * value for weight, value in zip(share, values, strict=True))

    design = state.design.detach().requires_grad_()
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


def score(
    problem: Problem, pictures: Tensor, conditions: Conditions, windows: np.ndarray | None = None
) -> tuple[Tensor, float, float]:
    """Mean loss over classifiers and pictures of these conditions; mean confidence and rate of the same. Outside of
    `windows` N×4 the pictures' gradient is not asked for.
    """
    losses, confidence, rate, boxes = [], 0.0, 0.0, problem.boxes(conditions)
    for classifier, indices in zip(problem.classifiers, problem.indices, strict=True):
        logits = classifier.logits(pictures, boxes, windows)
        losses.append(problem.losses(classifier, logits, indices).mean())
        confidence += float(classifier.confidence(logits.detach(), indices).mean())
        rate += float(classifier.recognized(logits.detach(), indices).double().mean())
    count = len(losses)
    return torch.stack(losses).mean(), confidence / count, rate / count


@torch.no_grad()
def _tried(problem: Problem, seen: Views, printed: Tensor) -> tuple[float, float]:
    """Loss and rate of what is printed, in selection views."""
    loss, _, rate = score(problem, expose(seen, problem.subject.showing(printed)), seen.conditions)
    return float(loss), rate


def _select(step: Step, tried: Sequence[tuple[float, float]]) -> Step:
    """Keep the design if it is the best so far, as it would be printed, on the selection set."""
    state = step.state
    loss, rate = (sum(values) / len(values) for values in zip(*tried, strict=True))
    if loss < state.best_loss:
        state = replace(state, best=state.design, best_loss=loss)
    return replace(step, state=state, select_loss=loss, select_rate=rate)
