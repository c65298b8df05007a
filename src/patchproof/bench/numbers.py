"""How a network's numbers are stored: float32 or bfloat16, in which order pictures lie in memory, how many at a time.

In: views of the demo's scene; the built-in network and, where the environment names a folder of real networks
(PATCHPROOF_DATA), MobileNet v2. Out: a chart: time of a forward and backward pass to the pictures against the error of
the confidence, by the same network in float64.
"""

from __future__ import annotations

import copy
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from patchproof.bench.chart import Chart, OnStage, Point
from patchproof.bench.measure import ratio, timed
from patchproof.bench.world import demo_problem
from patchproof.claims import student_mean
from patchproof.classifier.batches import MAX_BATCH, InBatches, few_on_cpu
from patchproof.classifier.load import load_classifier
from patchproof.classifier.network import Classifier, center_square
from patchproof.optimizer.problem import Problem
from patchproof.render.photograph import expose
from patchproof.report.tables import Table

VIEWS = 12
REAL = "models/mobilenet_v2_1.0_224.pt2"


@dataclass(frozen=True)
class Way:
    """A type to compute in, an order of memory, and whether as few pictures at a time as `batches.py` takes."""

    bfloat16: bool
    order: torch.memory_format
    few: bool

    @property
    def name(self) -> str:
        """As it stands in a chart."""
        order = "channels last" if self.order is torch.channels_last else "rows"
        return f"{'bfloat16' if self.bfloat16 else 'float32'} {order}{', few at a time' if self.few else ''}"


USUAL = Way(False, torch.channels_last, True)  # as `load_classifier` gives it
WAYS = (
    Way(False, torch.contiguous_format, False),
    Way(False, torch.contiguous_format, True),
    Way(False, torch.channels_last, False),
    USUAL,
    Way(True, torch.contiguous_format, False),
    Way(True, torch.channels_last, False),
    Way(True, torch.channels_last, True),
)


@dataclass(frozen=True)
class Answer:
    """Logits N×K and the gradient N×3×S×S of the confidence's logarithm in each picture."""

    logits: Tensor
    gradient: Tensor


def charts(quick: bool, on_stage: OnStage) -> Iterator[Chart]:
    """The one chart."""
    problem = demo_problem()
    classifiers, path = [problem.classifiers[0]], Path(os.environ.get("PATCHPROOF_DATA", "-")) / REAL
    if path.is_file() and not quick:
        classifiers.append(load_classifier(f"file:{path}", Path()))
    yield types_chart(problem, classifiers, 5 if quick else 15, on_stage)


def types_chart(problem: Problem, classifiers: list[Classifier], rounds: int, on_stage: OnStage) -> Chart:
    """Types and orders of memory, one series for each network."""
    photos, series, rows = _photos(problem), {}, []
    for number, classifier in enumerate(classifiers):
        pictures, name = center_square(photos, classifier.input_px), classifier.name.rpartition("/")[2]
        assert isinstance(classifier.network, InBatches)
        network = classifier.network.network
        assert isinstance(network, torch.nn.Module)
        with torch.no_grad():
            label = network(pictures).argmax(1)
        truth = answer(_copy(network).double(), pictures.double(), label)
        calls = {way: _work(network, way, pictures, label) for way in WAYS}
        answers, seconds = {way: call() for way, call in calls.items()}, timed(calls, rounds)
        series[name] = [
            Point(way.name, ratio(seconds, way, USUAL), student_mean(_off(answers[way], truth, label)), way is USUAL)
            for way in WAYS
        ]
        rows += [(name, way.name, *_figures(answers[way], truth)) for way in WAYS]
        on_stage("numbers", number + 1, len(classifiers))
    head = ("network", "way", "mean |logit - float64's|", "largest", "cosine of the gradient")
    return Chart(
        name="types",
        title="Types of numbers and orders of memory",
        cost="forward and backward pass to the pictures, relative to the default",
        error=f"mean |confidence - float64's| of the top label ({VIEWS} views)",
        series=series,
        about=f"{VIEWS} views of the demo's scene; bfloat16 by torch.autocast, gradients in float32 at the pictures. "
        "Rows: N×3×H×W in that order; channels last: the colors of a pixel side by side; few at a time: at most 4 "
        "pictures of 224 px, 12 of 128 px; all of 64 px at once.",
        tables=(Table("types_logits", "Logits and gradients", head, tuple(rows)),),
    )


def answer(network: Callable[[Tensor], Tensor], pictures: Tensor, label: Tensor) -> Answer:
    """What a network says, and in which direction each picture would have to change."""
    pictures = pictures.detach().requires_grad_()
    logits = network(pictures)
    loss = torch.nn.functional.cross_entropy(logits.double(), label, reduction="sum")
    (gradient,) = torch.autograd.grad(loss, pictures)
    return Answer(logits.detach(), gradient)


def _copy(network: torch.nn.Module) -> torch.nn.Module:
    """Another one of the same weights; torch warns of its own ways as it copies an exported program."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        return copy.deepcopy(network)


def _work(network, way: Way, pictures: Tensor, label: Tensor) -> Callable[[], Answer]:
    own = InBatches(_copy(network))
    own.order, own.high = way.order, few_on_cpu(pictures.shape[-1]) if way.few else MAX_BATCH

    def work() -> Answer:
        with torch.autocast("cpu", dtype=torch.bfloat16) if way.bfloat16 else nullcontext():
            return answer(own, pictures, label)

    return work


def _photos(problem: Problem) -> Tensor:
    conditions, shown = problem.scene.draw("select", VIEWS), problem.subject.shown(problem.subject.start())
    with torch.no_grad():
        return expose(problem.see(shown, conditions, problem.figure_px), shown)


def _off(given: Answer, truth: Answer, label: Tensor) -> np.ndarray:
    own, true = (torch.softmax(a.logits.double(), 1).gather(1, label[:, None])[:, 0] for a in (given, truth))
    return (own - true).abs().numpy()


def _figures(given: Answer, truth: Answer) -> tuple[float, float, float]:
    off = (given.logits.double() - truth.logits).abs()
    cosine = torch.nn.functional.cosine_similarity(given.gradient.double().flatten(1), truth.gradient.flatten(1))
    return float(off.mean()), float(off.max()), float(cosine.mean())
