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
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from patchproof.bench.chart import Chart, OnStage, Point, Series, Table
from patchproof.bench.measure import mean_interval, ratio, timed
from patchproof.bench.world import demo_problem
from patchproof.classifier.batches import MAX_BATCH, InBatches, few_on_cpu
from patchproof.classifier.load import load_classifier
from patchproof.classifier.network import Classifier
from patchproof.classifier.view import center_square
from patchproof.optimizer.problem import Problem
from patchproof.render.photograph import expose

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


def numbers_charts(quick: bool, on_stage: OnStage) -> Iterator[Chart]:
    """The one chart."""
    problem, rounds, left_out = demo_problem(), 5 if quick else 15, ()
    classifiers = [problem.classifiers[0]]
    path = Path(os.environ.get("PATCHPROOF_DATA", "-")) / REAL
    if quick or not path.is_file():
        why = "with --quick" if quick else "PATCHPROOF_DATA names no folder with it"
        left_out = (f"{REAL} was left out: {why}",)
    else:
        classifiers.append(load_classifier(f"file:{path}", Path()))
    chart = types_chart(problem, classifiers, rounds, on_stage)
    yield replace(chart, notes=(*chart.notes, *left_out))


def types_chart(problem: Problem, classifiers: list[Classifier], rounds: int, on_stage: OnStage) -> Chart:
    """Types and orders of memory, one series for each network."""
    photos, series, rows = _photos(problem), [], []
    for number, classifier in enumerate(classifiers):
        pictures = center_square(photos, classifier.input_px)
        network = classifier.network.network  # without the batches that it is loaded in
        with torch.no_grad():
            label = network(pictures).argmax(1)
        truth = answer(_copy(network).double(), pictures.double(), label)
        answers, calls = {}, {}
        for way in WAYS:
            work = _work(network, way, pictures, label)
            answers[way], calls[way] = work(), work
        seconds, points = timed(calls, rounds), []
        for way in WAYS:
            off = _off(answers[way].logits, truth.logits, label)
            (cost, span), (error, interval) = ratio(seconds, way, USUAL), mean_interval(off)
            points.append(Point(way.name, cost, error, span, interval, way is USUAL))
            rows.append((f"{classifier.name.rpartition('/')[2]}: {way.name}", *_figures(answers[way], truth)))
        series.append(Series(classifier.name.rpartition("/")[2], tuple(points)))
        on_stage("numbers", number + 1, len(classifiers))
    return Chart(
        "types",
        "Types of numbers and orders of memory",
        "forward and backward pass to the pictures, relative to the default",
        f"mean |confidence - float64's| of the top label ({VIEWS} views, 95 %)",
        tuple(series),
        (
            f"{VIEWS} views of the demo's scene; bfloat16 by torch.autocast, gradients in float32 at the pictures",
            "rows: N×3×H×W in that order; channels last: the colors of a pixel side by side",
            "few at a time: at most 4 pictures of 224 px, 12 of 128 px; all of 64 px at once",
        ),
        tables=(Table(("", "mean |logit - float64's|", "largest", "cosine of the gradient"), tuple(rows)),),
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


def _off(logits: Tensor, truth: Tensor, label: Tensor) -> np.ndarray:
    both = (torch.softmax(one.double(), 1).gather(1, label[:, None])[:, 0] for one in (logits, truth))
    found, true = both
    return (found - true).abs().numpy()


def _figures(found: Answer, truth: Answer) -> tuple[str, str, str]:
    off = (found.logits.double() - truth.logits).abs()
    cosine = torch.nn.functional.cosine_similarity(found.gradient.double().flatten(1), truth.gradient.flatten(1))
    return f"{float(off.mean()):.2g}", f"{float(off.max()):.2g}", f"{float(cosine.mean()):.5f}"
