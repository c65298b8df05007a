"""The loop: draw conditions, compute the gradient, descend, select.

In: a `Problem` and, to resume, a `State`. Out: a generator of `TrainingStep`s, and the checkpoint, which holds a state
and is replaced as a whole; when to save it, progress and plots are left to the caller. The design starts at mid-gray.
Adam on every level of the gradient's pyramid, or signed steps as in FGSM and PGD (Goodfellow et al. 2015, Madry et al.
2018), always clipped to [0, 1]. Every 240 views the design is tried on a fixed selection set, and the best one is kept,
so that a design that suited only its last views is not printed. The promise set is never used here.

A step depends only on the state and its own number, so that a resumed run gives the same bytes.
"""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from patchproof.base.errors import Refused
from patchproof.base.fingerprint import refuse_other_inputs
from patchproof.base.input import is_file
from patchproof.base.output import CHECKPOINT_FILE, write_atomically
from patchproof.base.settings import OptimizeSettings
from patchproof.base.validation import StrictModel
from patchproof.optimizer.expectation import Answer, expectation, gradient_in_views, in_batches, training_views
from patchproof.optimizer.problem import Problem
from patchproof.scene.conditions import Conditions

# Training views. When designs were tried twice as often, 28 of 30 runs still kept their last design, and two kept one
# with 0.00 and 0.02 less loss; at four times the default's step size, 0.01 was lost.
SELECT_AFTER = 240
SAVE_AFTER = 120  # training views that a kill can lose
SELECT_VIEWS = 64
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
class TrainingStep:
    """One step's results over its training views; `select_*` only where the design was tried on the selection set."""

    state: State
    loss: float
    confidence: float
    rate: float
    gradient: float  # the classifiers' largest, without penalties; 0 means that they no longer distinguish designs
    select_loss: float | None = None
    select_rate: float | None = None


def steps(problem: Problem, state: State | None = None) -> Iterator[TrainingStep]:
    """The steps from `state` (or from the start) to the last one that the scene's settings ask for."""
    state = start(problem) if state is None else state
    settings = problem.scene.settings.optimize
    with expectation(problem, problem.scene.draw("select", SELECT_VIEWS)) as expected:
        while state.number < settings.steps:
            step = _descend(problem, state, expected.gradient(state.design, state.number))
            if ends_interval(settings, step.state.number, SELECT_AFTER):
                loss, rate = expected.selection(step.state.design)
                if loss < step.state.best_loss:
                    step = replace(step, state=replace(step.state, best=step.state.design, best_loss=loss))
                step = replace(step, select_loss=loss, select_rate=rate)
            state = step.state
            yield step


def start(problem: Problem) -> State:
    """The state before the first step."""
    design = problem.subject.start()
    zeros = tuple(torch.zeros_like(level) for level in problem.subject.gradient_levels(design))
    return State(0, design, zeros, zeros, design)


def take_step(problem: Problem, state: State, conditions: Conditions) -> TrainingStep:
    """One step on these conditions, in this process."""
    views = [training_views(problem, rows) for _, rows in in_batches(problem, conditions)]
    return _descend(problem, state, gradient_in_views(problem, state.design, views))


def draft(problem: Problem, conditions: Conditions, views: int) -> Tensor:
    """The design after a step on every `views` rows of the conditions, not tried on the selection set."""
    state = start(problem)
    for first in range(0, len(conditions), views):
        state = take_step(problem, state, conditions[first : first + views]).state
    return state.design


def ends_interval(settings: OptimizeSettings, number: int, views: int) -> bool:
    """True if step `number`, counted from 1, is the last one or the first after another `views` training views."""
    done, before = (n * settings.views // views for n in (number, number - 1))
    return done > before or number == settings.steps


def _descend(problem: Problem, state: State, answer: Answer) -> TrainingStep:
    """One step down the gradient of the answer's loss and of the subject's penalty."""
    largest, gradient = float(answer.gradient.abs().max()), answer.gradient
    if not math.isfinite(largest):  # a step with it would make the design NaN
        do = "check its number format: some pictures lead it to infinity"
        raise Refused("finite gradients", f"{largest} in step {state.number + 1} from the networks", do)
    design = state.design.detach().requires_grad_()
    penalty = problem.subject.penalty(design)
    if isinstance(penalty, Tensor):
        gradient = gradient + torch.autograd.grad(penalty, design)[0]
        penalty = float(penalty.detach())
    updated = _update(problem, state, gradient)
    return TrainingStep(updated, answer.loss + penalty, answer.confidence, answer.rate, largest)


def _update(problem: Problem, state: State, gradient: Tensor) -> State:
    """One update of the design, clipped to the allowed designs."""
    clipped, settings = problem.subject.clip, problem.scene.settings.optimize
    number, step_size = state.number + 1, settings.step_size
    if settings.optimizer == "sign":
        return replace(state, number=number, design=clipped(state.design - step_size * gradient.sign()))
    levels = problem.subject.gradient_levels(gradient)
    mean = tuple(torch.lerp(level, moment, _BETAS[0]) for level, moment in zip(levels, state.mean, strict=True))
    square = tuple(torch.lerp(level**2, moment, _BETAS[1]) for level, moment in zip(levels, state.square, strict=True))
    updates = [
        (m / (1 - _BETAS[0] ** number)) / ((v / (1 - _BETAS[1] ** number)).sqrt() + _EPSILON)
        for m, v in zip(mean, square, strict=True)
    ]
    design = clipped(state.design - step_size * problem.subject.combine_levels(updates))
    return replace(state, number=number, design=design, mean=mean, square=square)


def save_checkpoint(state: State, problem: Problem, out: Path) -> None:
    """Replace the checkpoint of the run in `out`."""
    from safetensors.torch import save_file

    tensors = {"design": state.design, "best": state.best}
    tensors |= {f"mean{level}": one for level, one in enumerate(state.mean)}
    tensors |= {f"square{level}": one for level, one in enumerate(state.square)}
    tensors = {name: tensor.cpu().contiguous().clone() for name, tensor in tensors.items()}
    # text keeps every bit of the loss; the sheet id identifies scene and seed
    note = {"number": state.number, "best_loss": state.best_loss.hex(), "sheet_id": problem.scene.sheet_id}
    note |= {"inputs": problem.inputs}
    # a single key, since safetensors writes several in undefined order
    metadata = {"state": json.dumps(note)}
    write_atomically(out / CHECKPOINT_FILE, lambda path: save_file(tensors, path, metadata=metadata))


def load_checkpoint(out: Path, problem: Problem) -> State:
    """The checkpoint's state, or the start where there is no checkpoint; refused where scene or seed differ."""
    path, start_state = out / CHECKPOINT_FILE, start(problem)
    if not is_file(path):
        return start_state
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt", device=str(problem.device)) as file:
            note = _Note.model_validate_json((file.metadata() or {})["state"])
            if note.sheet_id != problem.scene.sheet_id:
                do = "resume with the scene, seed, --steps and --draft that it was begun with, or use another folder"
                got = f"a checkpoint of sheet {note.sheet_id} in {out}, not {problem.scene.sheet_id}"
                raise Refused("a checkpoint of the same run", got, do)
            refuse_other_inputs(note.inputs, problem.inputs, out, problem.scene.settings.model_dump())
            design, best = _tensor(file, "design", start_state.design), _tensor(file, "best", start_state.design)
            mean = tuple(_tensor(file, f"mean{n}", level) for n, level in enumerate(start_state.mean))
            square = tuple(_tensor(file, f"square{n}", level) for n, level in enumerate(start_state.square))
        return State(note.number, design, mean, square, best, float.fromhex(note.best_loss))
    except Refused:
        raise
    except (SafetensorError, OSError, LookupError, ValueError, ArithmeticError) as error:
        got = f"{path} that cannot be read ({str(error)[:100]})"
        raise Refused("a checkpoint", got, "start in another folder") from error


class _Note(StrictModel):
    number: Annotated[int, Field(ge=0)]
    best_loss: str
    sheet_id: str
    inputs: dict[str, str]


def _tensor(file: Any, name: str, start: torch.Tensor) -> torch.Tensor:
    """The tensor of that name; refused unless it has the size and type of `start` and is finite."""
    if file.get_slice(name).get_shape() != list(start.shape):
        raise ValueError(f"{name} of another size than the scene's design")
    tensor = file.get_tensor(name)
    if tensor.dtype != start.dtype or not bool(torch.isfinite(tensor).all()):
        raise ValueError(f"{name} of type {tensor.dtype} or with infinite values")
    return tensor.clone()  # the file's memory is mapped, and Windows does not replace mapped files
