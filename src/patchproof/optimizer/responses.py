"""What networks make of things that are shown to them under the same conditions.

In: a `Problem`, things to show (None: the bare object), conditions. Out: `Responses`: whether each network recognized
the target, how sure it was of it, and the goal's loss. Views are seen once for all things, a few at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
import torch
from torch import Tensor

from patchproof.optimizer.goals import target_loss
from patchproof.optimizer.problem import Problem
from patchproof.render.photograph import Shown, expose
from patchproof.scene.conditions import Conditions

AT_A_TIME = 4  # views: before a small network 16 took 1.4 times as long, out of the cache
Thing = TypeVar("Thing", bound=Hashable)


@dataclass(frozen=True)
class Responses(Generic[Thing]):
    """By what was shown, M×N of M networks and N conditions; `loss` is what the scene's goal descends on."""

    recognized: dict[Thing, np.ndarray]
    confidence: dict[Thing, np.ndarray]
    loss: dict[Thing, np.ndarray]


def responses(
    problem: Problem,
    shown: Mapping[Thing, Shown],
    conditions: Conditions,
    side_px: int | None = None,
    on_views: Callable[[int], None] = lambda n: None,
) -> Responses[Thing]:
    """Show each thing under every condition to every network, in square views of `side_px` (by default the size of
    figures that people will read); `on_views` gets how many views have been done since the last call.
    """
    laid_out = next((thing for thing in shown.values() if thing is not None), None)
    parts: dict[Thing, list[np.ndarray]] = {name: [] for name in shown}
    with torch.no_grad():
        for part in in_parts(conditions):
            views = problem.see(laid_out, part, side_px or problem.figure_px)
            for name, thing in shown.items():
                parts[name].append(ask(problem, expose(views, thing)))
            on_views(len(part))
    return gathered(parts)


def in_parts(conditions: Conditions) -> Iterator[Conditions]:
    """Conditions, as many at a time as suit a CPU."""
    for first in range(0, len(conditions), AT_A_TIME):
        yield conditions[first : first + AT_A_TIME]


def ask(problem: Problem, pictures: Tensor) -> np.ndarray:
    """3×M×N: recognized (0 or 1), confidence and loss of pictures N×3×H×W by every network. One that stands in the
    problem more than once, with other labels, is asked once.
    """
    goal, rows = problem.scene.settings.target.goal, []
    with torch.no_grad():
        logits = {classifier: classifier.logits(pictures) for classifier in dict.fromkeys(problem.classifiers)}
        for classifier, indices in zip(problem.classifiers, problem.indices, strict=True):
            answer = logits[classifier]
            recognized, confidence = classifier.recognized(answer, indices), classifier.confidence(answer, indices)
            rows.append(torch.stack([recognized.double(), confidence, target_loss(answer, indices, goal)]))
    return torch.stack(rows, 1).cpu().numpy()


def gathered(parts: Mapping[Thing, Sequence[np.ndarray]]) -> Responses[Thing]:
    """What `ask` gave for parts of the conditions, one after the other."""
    joined = {name: np.concatenate(part, -1) for name, part in parts.items()}
    return Responses(
        {name: all_three[0] > 0.5 for name, all_three in joined.items()},
        {name: all_three[1] for name, all_three in joined.items()},
        {name: all_three[2] for name, all_three in joined.items()},
    )
