"""What networks answer when things are shown to them under the same conditions.

In: a `Problem`, things to show (None: the bare object), conditions. Out: per thing its `Answers`: whether each network
recognized the target, how sure it was of it, and the loss. Views are seen once for all things, a few at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from patchproof.optimizer.problem import Problem
from patchproof.render.photograph import Shown, expose
from patchproof.scene.conditions import Conditions

AT_A_TIME = 4  # views: before a small network 16 took 1.4 times as long, out of the cache
Thing = TypeVar("Thing", bound=Hashable)


@dataclass(frozen=True)
class Answers:
    """M×N of M networks and N conditions; `loss` is what the problem descends on."""

    recognized: np.ndarray
    confidence: np.ndarray
    loss: np.ndarray

    def at(self, rows: np.ndarray) -> Answers:
        """The answers to conditions at an index array."""
        return Answers(self.recognized[:, rows], self.confidence[:, rows], self.loss[:, rows])


def responses(
    problem: Problem,
    shown: Mapping[Thing, Shown],
    conditions: Conditions,
    side_px: int | None = None,
    on_views: Callable[[int], None] = lambda n: None,
) -> dict[Thing, Answers]:
    """Show each thing under every condition to every network, in square views of `side_px` (by default the size of
    figures that people will read); `on_views` gets how many views have been done since its last call.
    """
    laid_out = next((thing for thing in shown.values() if thing is not None), None)
    parts: list[dict[Thing, Answers]] = []
    with torch.no_grad():
        for part in in_parts(conditions):
            views, boxes = problem.see(laid_out, part, side_px or problem.figure_px), problem.boxes(part)
            parts.append({name: ask(problem, expose(views, thing), boxes) for name, thing in shown.items()})
            on_views(len(part))
    return joined(parts)


def in_parts(conditions: Conditions) -> Iterator[Conditions]:
    """Conditions, as many at a time as suit a CPU."""
    for first in range(0, len(conditions), AT_A_TIME):
        yield conditions[first : first + AT_A_TIME]


def ask(problem: Problem, pictures: Tensor, boxes: np.ndarray | None) -> Answers:
    """Every network's answers to pictures N×3×H×W with the object in `boxes` (`Problem.boxes`). One that stands in the
    problem twice, with other labels, is asked once.
    """
    rows = []
    with torch.no_grad():
        logits = {classifier: classifier.logits(pictures, boxes) for classifier in dict.fromkeys(problem.classifiers)}
        for classifier, indices in zip(problem.classifiers, problem.indices, strict=True):
            own = logits[classifier]
            recognized, confidence = classifier.recognized(own, indices), classifier.confidence(own, indices)
            rows.append(torch.stack([recognized.double(), confidence, problem.losses(classifier, own, indices)]))
    recognized, confidence, loss = torch.stack(rows, 1).cpu().numpy()
    return Answers(recognized > 0.5, confidence, loss)


def joined(parts: Sequence[Mapping[Thing, Answers]]) -> dict[Thing, Answers]:
    """The answers to parts of the conditions as those to all of them."""
    names = ("recognized", "confidence", "loss")
    return {
        thing: Answers(*(np.concatenate([getattr(part[thing], name) for part in parts], -1) for name in names))
        for thing in parts[0]
    }
