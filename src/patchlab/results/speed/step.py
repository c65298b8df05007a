"""A step of the optimizer beside its network's own work: the share that is ours.

In: `suv.toml` and `effects.toml`, the same with every effect on. Out: `step.csv`, in milliseconds: a step of four
views, selections apart, where poses are seen for the first time and where they come round again, both as often as in a
run of default length (a fifth and four), and the network's forward and backward pass of four such pictures in the
same rounds; so many processes share the views, so many threads the pass. Means of each round's medians; of steps with
new poses means, as a process sees the views of several in one of them. Freed memory is kept as the command line keeps
it, by the pass, too. Run in this folder, idle: python step.py
"""

import statistics
from dataclasses import replace
from functools import partial
from time import perf_counter

import torch
from torch import nn

import patchproof as pp
from patchlab.results.rows import write_rows
from patchlab.study.measure import call_in_turn, time_call
from patchproof.base.workers import keep_freed_memory
from patchproof.optimizer import expectation, loop
from patchproof.optimizer.problem import set_problem

ROUNDS, STEPS = 15, 8  # the first is to warm up; each of the new ones renders views of as many steps ahead
NEW = ROUNDS // expectation.VIEWS_PER_POSE
NAMES = [f"label {i}" for i in range(999)] + ["jeep"]


class Block(nn.Module):
    """A bottleneck of He et al. (CVPR 2016)."""

    def __init__(self, into: int, width: int, stride: int):
        super().__init__()
        sizes = ((into, width, 1, 1), (width, width, 3, stride), (width, 4 * width, 1, 1))
        layers = [(nn.Conv2d(a, b, k, s, k // 2, bias=False), nn.BatchNorm2d(b), nn.ReLU()) for a, b, k, s in sizes]
        self.path = nn.Sequential(*[layer for three in layers for layer in three][:-1])
        skip = nn.Sequential(nn.Conv2d(into, 4 * width, 1, stride, bias=False), nn.BatchNorm2d(4 * width))
        self.skip = nn.Identity() if into == 4 * width and stride == 1 else skip

    def forward(self, x):
        """N×C×H×W in, out with four times the width's channels."""
        return torch.relu(self.path(x) + self.skip(x))


def resnet50() -> pp.Classifier:
    """One of the shape of ResNet-50 with random weights."""
    torch.manual_seed(0)
    blocks, into = [], 64
    for width, count, stride in ((64, 3, 1), (128, 4, 2), (256, 6, 2), (512, 3, 2)):
        for number in range(count):
            blocks.append(Block(into, width, stride if number == 0 else 1))
            into = 4 * width
    stem = [nn.Conv2d(3, 64, 7, 2, 3, bias=False), nn.BatchNorm2d(64), nn.ReLU(), nn.MaxPool2d(3, 2, 1)]
    net = nn.Sequential(*stem, *blocks, nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(into, 1000))
    return pp.classifier_of(net.to(memory_format=torch.channels_last), 224, NAMES, "python:resnet50")


def pass_ms(problem, pictures, indices) -> float:
    """Milliseconds of a forward and backward pass of the network, each picture's loss to its pixels."""
    leaf, (classifier,) = pictures.clone().requires_grad_(), problem.classifiers

    def work():
        loss = problem.losses(classifier, classifier.logits(leaf), indices).mean()
        torch.autograd.grad(loss, leaf)

    return time_call(work, perf_counter)[1]


def measured(name: str, scene: str, processes: int) -> dict:
    """A line of the table."""
    models = [resnet50()] if name == "resnet50" else [f"file:${{PATCHPROOF_DATA}}/models/{name}.onnx"]
    asked = pp.load_scene(f"{scene}.toml").settings.changed(optimize={"steps": ROUNDS * STEPS})
    scene = pp.make_scene(asked)
    problem = replace(set_problem(scene, models=models), jobs=processes)
    expectation.MIN_POSES = 0  # a fifth of the views
    pictures = torch.rand(4, 3, problem.training_px, problem.training_px)
    problem.see(None, scene.draw("train", 256), 16)  # makes the places that training knows, once
    running = loop.steps(problem)

    def passes() -> float:
        torch.set_num_threads(processes)  # which sharing views takes away
        return statistics.median(pass_ms(problem, pictures, problem.indices[0]) for _ in range(STEPS))

    def steps() -> float:
        torch.set_num_threads(1)
        timed = [time_call(partial(next, running), perf_counter) for _ in range(STEPS)]
        selects = [loop.ends_interval(asked.optimize, step.state.number, loop.SELECT_AFTER) for step, _ in timed]
        middle = statistics.mean if timed[0][0].state.number <= NEW * STEPS else statistics.median
        return middle(ms for (_, ms), select in zip(timed, selects, strict=True) if not select)

    rounds = call_in_turn({"pass": passes, "step": steps}, ROUNDS - 1)
    running.close()
    parts = {name: (statistics.mean(ms[: NEW - 1]), statistics.mean(ms[NEW - 1 :])) for name, ms in rounds.items()}
    own_ms, step_ms = (statistics.fmean(ms, (1, expectation.VIEWS_PER_POSE - 1)) for ms in parts.values())
    times = dict(zip(("new_ms", "again_ms"), parts["step"], strict=True)) | {"step_ms": step_ms, "pass_ms": own_ms}
    return {name: round(value, 1) for name, value in times.items()} | {"ratio": round(step_ms / own_ms, 3)}


if __name__ == "__main__":
    keep_freed_memory()
    kinds = [(n, "suv") for n in ("mobilenet_v2_1.0_224", "squeezenet1.1_224", "resnet50")]
    asked = [(*kind, n) for kind in (*kinds, ("mobilenet_v2_1.0_224", "effects")) for n in (1, 2)]
    write_rows("step.csv", ({"network": a, "scene": b, "processes": n} | measured(a, b, n) for a, b, n in asked))
