"""The responses of networks to several things (designs, controls) under the same conditions.

In: a `Problem`, appearances to show (None: the bare object), conditions. Out: `Responses` for each: whether each
network recognized the target, its confidence, and the loss. Views are rendered once for all things, a few at a time, by
as many processes as the problem has; the responses do not depend on how many.
"""

from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, zip_longest
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from patchproof.base.progress import Advance, no_advance
from patchproof.base.workers import fork_workers
from patchproof.optimizer.problem import Problem
from patchproof.render.photograph import Appearance, affected_windows, expose
from patchproof.render.views import split_views
from patchproof.scene.conditions import Conditions

CHUNK_VIEWS = 4  # with a small network, 16 views took 1.4 times as long each, out of the CPU's cache
Thing = TypeVar("Thing", bound=Hashable)
Chunked = TypeVar("Chunked", Conditions, np.ndarray)


@dataclass(frozen=True)
class Responses:
    """Arrays M×N for M networks and N conditions; `loss` is what the problem descends on."""

    recognized: np.ndarray
    confidence: np.ndarray
    loss: np.ndarray

    def select(self, rows: np.ndarray) -> "Responses":
        """The responses under the conditions with these indices."""
        return Responses(self.recognized[:, rows], self.confidence[:, rows], self.loss[:, rows])


def responses(
    problem: Problem,
    appearances: Mapping[Thing, Appearance],
    conditions: Conditions,
    side_px: int | None = None,
    control_mask: np.ndarray | None = None,
    advance: Advance = no_advance,
) -> dict[Thing, Responses]:
    """Show each thing under every condition to every network, in squares of `side_px` (default: `figure_px`). A
    `control_mask` selects the conditions for things after the first. `advance` gets the views done and their total.
    """
    things, first_appearance = list(appearances), next((a for a in appearances.values() if a is not None), None)
    mask = np.ones(len(conditions), bool) if control_mask is None else control_mask
    # chunks of one session go to one process, which draws their background once
    pairs = zip_longest(in_chunks(np.flatnonzero(mask)), in_chunks(np.flatnonzero(~mask)))
    tasks = [[part for part in zip(pair, (things, things[:1]), strict=True) if part[0] is not None] for pair in pairs]

    @torch.no_grad()
    def respond(task: Sequence[tuple[np.ndarray, Sequence[Thing]]]) -> list[dict[Thing, Responses]]:
        answers, drawn_conditions = [], conditions[np.concatenate([rows for rows, _ in task])]
        together = problem.see(first_appearance, drawn_conditions, side_px or problem.figure_px)
        for (_, shown), views in zip(task, split_views(together, [len(rows) for rows, _ in task]), strict=True):
            boxes, cache = problem.boxes(views.conditions), {}
            windows = affected_windows(views) if len(shown) > 1 else None
            pictures = ((thing, expose(views, appearances[thing])) for thing in shown)
            answers.append({thing: ask_networks(problem, photos, boxes, windows, cache) for thing, photos in pictures})
        return answers

    views_done = np.cumsum([sum(len(rows) for rows, _ in task) for task in tasks])
    with fork_workers(respond, min(problem.jobs, len(tasks))) as (workers, share):
        answers = workers.map(share, tasks, lambda done, _: advance(int(views_done[done - 1]), len(conditions)))
    merged = merge_responses(list(chain(*answers)))  # the first chunk has all things
    rows = np.concatenate([rows for rows, _ in chain(*tasks)])
    return merged | {things[0]: merged[things[0]].select(np.argsort(rows))}


def in_chunks(conditions: Chunked) -> Iterator[Chunked]:
    """Conditions, or their indices, `CHUNK_VIEWS` at a time."""
    for first in range(0, len(conditions), CHUNK_VIEWS):
        yield conditions[first : first + CHUNK_VIEWS]


def ask_networks(
    problem: Problem,
    pictures: Tensor,
    boxes: np.ndarray | None,
    windows: np.ndarray | None = None,
    cache: dict[Any, Any] | None = None,
) -> Responses:
    """Return networks' responses to pictures N×3×H×W with the object in `boxes`. A network that is in the problem
    twice, with other labels, runs once. Pictures that differ only in `windows` share the `cache`.
    """
    rows = []
    with torch.no_grad():
        networks = dict.fromkeys(problem.classifiers)
        logits = {network: network.logits(pictures, boxes, windows, cache) for network in networks}
        for classifier, indices in zip(problem.classifiers, problem.indices, strict=True):
            k_logits = logits[classifier]
            recognized, confidence = classifier.recognized(k_logits, indices), classifier.confidence(k_logits, indices)
            rows.append(torch.stack([recognized.double(), confidence, problem.losses(classifier, k_logits, indices)]))
    recognized, confidence, loss = torch.stack(rows, 1).cpu().numpy()
    return Responses(recognized > 0.5, confidence, loss)


def merge_responses(parts: Sequence[Mapping[Thing, Responses]]) -> dict[Thing, Responses]:
    """Join the responses to chunks of the conditions into those to all conditions."""
    names = ("recognized", "confidence", "loss")
    joined = lambda thing, name: np.concatenate([getattr(p[thing], name) for p in parts if thing in p], -1)  # noqa: E731
    return {thing: Responses(*(joined(thing, name) for name in names)) for thing in parts[0]}
