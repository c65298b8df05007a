"""What networks answer when things are shown to them under the same conditions.

In: a `Problem`, things to show (None: the bare object), conditions. Out: per thing its `Answers`: whether each network
recognized the target, how sure it was of it, and the loss. Views are seen once for all things, a few at a time, by as
many processes as the problem has; the answers do not depend on how many.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, zip_longest
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from patchproof.optimizer.problem import Problem
from patchproof.render.photograph import Shown, expose
from patchproof.scene.conditions import Conditions
from patchproof.workers import sharing

AT_A_TIME = 4  # views: before a small network 16 took 1.4 times as long, out of the cache
Thing = TypeVar("Thing", bound=Hashable)
Some = TypeVar("Some", Conditions, np.ndarray)


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
    beside: np.ndarray | None = None,
    on_views: Callable[[int, int], None] = lambda done, total: None,
) -> dict[Thing, Answers]:
    """Show each thing under every condition to every network, in square views of `side_px` (by default the size of
    figures that people will read); all but the first only under those that the mask `beside` names. `on_views` gets how
    many views are done, and how many there are.
    """
    laid_out = next((thing for thing in shown.values() if thing is not None), None)
    first, n = next(iter(shown)), len(conditions)
    compared = np.ones(n, bool) if beside is None else beside

    @torch.no_grad()
    def answers(parts: Sequence[np.ndarray]) -> list[dict[Thing, Answers]]:
        told = []
        for rows in parts:
            drawn, names = conditions[rows], list(shown) if compared[rows[0]] else [first]
            views, boxes = problem.see(laid_out, drawn, side_px or problem.figure_px), problem.boxes(drawn)
            told.append({name: ask(problem, expose(views, shown[name]), boxes) for name in names})
        return told

    of_all, of_first = (in_parts(np.flatnonzero(rows)) for rows in (compared, ~compared))
    # those of the same session go to the same process, which draws the place behind them once; the last ones go apart,
    # so that no process waits long for another
    tasks = [[rows for rows in pair if rows is not None] for pair in zip_longest(of_all, of_first)]
    tasks[-problem.jobs :] = [[rows] for task in tasks[-problem.jobs :] for rows in task]
    seen = np.cumsum([sum(map(len, task)) for task in tasks])
    with sharing(answers, min(problem.jobs, len(tasks))) as (workers, share):
        told = workers.map(share, tasks, lambda done, _: on_views(int(seen[done - 1]), n))
    parts = sorted(zip(chain(*tasks), chain(*told), strict=True), key=lambda part: not compared[part[0][0]])
    whole = joined([answered for _, answered in parts])
    whole[first] = whole[first].at(np.argsort(np.concatenate([rows for rows, _ in parts])))
    return whole


def in_parts(conditions: Some) -> Iterator[Some]:
    """Conditions or their numbers, as many at a time as suit a CPU."""
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
    return {thing: in_a_row([part[thing] for part in parts if thing in part]) for thing in parts[0]}


def in_a_row(parts: Sequence[Answers]) -> Answers:
    """The answers to one part of the conditions after those to another."""
    names = ("recognized", "confidence", "loss")
    return Answers(*(np.concatenate([getattr(part, name) for part in parts], -1) for name in names))
