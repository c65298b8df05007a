"""What networks answer when things are shown to them under the same conditions.

In: a `Problem`, things to show (None: the bare object), conditions. Out: per thing its `Responses`: whether each network
recognized the target, how sure it was of it, and the loss. Views are seen once for all things, a few at a time, by as
many processes as the problem has; the answers do not depend on how many.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain, zip_longest
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from patchproof.base.progress import Advance, no_advance
from patchproof.base.workers import fork_workers
from patchproof.optimizer.problem import Problem
from patchproof.render.photograph import Appearance, affected_windows, expose
from patchproof.render.views import split_views
from patchproof.scene.conditions import Conditions

CHUNK_VIEWS = 4  # views: before a small network 16 took 1.4 times as long, out of the cache
Thing = TypeVar("Thing", bound=Hashable)
Some = TypeVar("Some", Conditions, np.ndarray)


@dataclass(frozen=True)
class Responses:
    """M×N of M networks and N conditions; `loss` is what the problem descends on."""

    recognized: np.ndarray
    confidence: np.ndarray
    loss: np.ndarray

    def at(self, rows: np.ndarray) -> Responses:
        """The answers to conditions at an index array."""
        return Responses(self.recognized[:, rows], self.confidence[:, rows], self.loss[:, rows])


def responses(
    problem: Problem,
    shown: Mapping[Thing, Appearance],
    conditions: Conditions,
    side_px: int | None = None,
    beside: np.ndarray | None = None,
    advance: Advance = no_advance,
) -> dict[Thing, Responses]:
    """Show each thing under every condition to every network, in square views of `side_px` (by default the size of
    figures that people will read); all but the first only under those that the mask `beside` names. `advance` gets how
    many views are done, and how many there are.
    """
    with open_responses(problem, shown, conditions, side_px) as asked:
        return asked(list(shown), np.arange(len(conditions)), beside, advance)


@contextmanager
def open_responses(
    problem: Problem, shown: Mapping[Thing, Appearance], conditions: Conditions, side_px: int | None = None
) -> Iterator[Callable[..., dict[Thing, Responses]]]:
    """`responses` of some of the things under some of the conditions, by index array, as often as wanted by the same
    processes.
    """
    laid_out = next((thing for thing in shown.values() if thing is not None), None)

    @torch.no_grad()
    def answers(task: Sequence[_Chunk[Thing]]) -> list[dict[Thing, Responses]]:
        told, drawn = [], conditions[np.concatenate([part.rows for part in task])]
        together = problem.see(laid_out, drawn, side_px or problem.figure_px)
        for part, views in zip(task, split_views(together, [len(part.rows) for part in task]), strict=True):
            boxes, windows, kept = problem.boxes(views.conditions), None, {}
            if len(part.things) > 1:
                windows = affected_windows(views)
            pictures = ((thing, expose(views, shown[thing])) for thing in part.things)
            told.append({thing: ask(problem, photos, boxes, windows, kept) for thing, photos in pictures})
        return told

    def asked(
        things: Sequence[Thing],
        rows: np.ndarray,
        beside: np.ndarray | None = None,
        advance: Advance = no_advance,
    ) -> dict[Thing, Responses]:
        compared = np.ones(len(rows), bool) if beside is None else beside
        of_all = [_Chunk(part, things) for part in in_chunks(rows[compared])]
        of_first = [_Chunk(part, things[:1]) for part in in_chunks(rows[~compared])]
        # those of the same session go to the same process, which draws the place behind them once; the last ones go
        # apart, the shortest last, so that no process waits long for another
        tasks = [[part for part in pair if part is not None] for pair in zip_longest(of_all, of_first)]
        last = sorted(chain(*tasks[-problem.jobs :]), key=lambda part: -len(part.things))
        tasks[-problem.jobs :] = [[part] for part in last]
        seen = np.cumsum([sum(len(part.rows) for part in task) for task in tasks])
        told = workers.map(share, tasks, lambda done, _: advance(int(seen[done - 1]), len(rows)))
        parts = list(zip(chain(*tasks), chain(*told), strict=True))  # the first of them has all things
        whole = joined([answered for _, answered in parts])
        whole[things[0]] = whole[things[0]].at(np.argsort(np.concatenate([part.rows for part, _ in parts])))
        return whole

    with fork_workers(answers, min(problem.jobs, math.ceil(len(conditions) / CHUNK_VIEWS))) as (workers, share):
        yield asked


class _Chunk(NamedTuple, Generic[Thing]):
    """Some conditions, by row, and what is shown under them."""

    rows: np.ndarray
    things: Sequence[Thing]


def in_chunks(conditions: Some) -> Iterator[Some]:
    """Conditions or their numbers, as many at a time as suit a CPU."""
    for first in range(0, len(conditions), CHUNK_VIEWS):
        yield conditions[first : first + CHUNK_VIEWS]


def ask(
    problem: Problem,
    pictures: Tensor,
    boxes: np.ndarray | None,
    windows: np.ndarray | None = None,
    kept: dict[Any, Any] | None = None,
) -> Responses:
    """Every network's answers to pictures N×3×H×W with the object in `boxes` (`Problem.boxes`). One that stands in the
    problem twice, with other labels, is asked once. Pictures that differ only in `windows` share what is `kept`.
    """
    rows = []
    with torch.no_grad():
        networks = dict.fromkeys(problem.classifiers)
        logits = {network: network.logits(pictures, boxes, windows, kept) for network in networks}
        for classifier, indices in zip(problem.classifiers, problem.indices, strict=True):
            own = logits[classifier]
            recognized, confidence = classifier.recognized(own, indices), classifier.confidence(own, indices)
            rows.append(torch.stack([recognized.double(), confidence, problem.losses(classifier, own, indices)]))
    recognized, confidence, loss = torch.stack(rows, 1).cpu().numpy()
    return Responses(recognized > 0.5, confidence, loss)


def joined(parts: Sequence[Mapping[Thing, Responses]]) -> dict[Thing, Responses]:
    """The answers to parts of the conditions as those to all of them."""
    return {thing: concatenate_responses([part[thing] for part in parts if thing in part]) for thing in parts[0]}


def concatenate_responses(parts: Sequence[Responses]) -> Responses:
    """The answers to one part of the conditions after those to another."""
    names = ("recognized", "confidence", "loss")
    return Responses(*(np.concatenate([getattr(part, name) for part in parts], -1) for name in names))
