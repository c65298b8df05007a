"""Compare pictures, gradients and answers of a GPU with those of a CPU, and their speed.

In: scene files. Out: `cuda.csv`, by scene and quantity a value for each device: of 8 training views the largest
difference of a pixel and the relative difference of the gradient at one design; of a run of 60 steps its seconds, its
median step and its last loss on the selection set; of 96 views of one design the seconds, the answers that are alike
and the largest difference of a confidence; training views a second by how many are rendered together, new and relit.
The CPU's runs are shared by as many processes as it has cores. Run in this folder: python cuda.py suv truck
"""

import csv
import os
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import torch

import patchproof as pp
from patchproof.base.workers import available_cores, keep_freed_memory
from patchproof.optimizer import loop
from patchproof.optimizer.expectation import gradient_in_views, training_views
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.optimizer.responses import responses
from patchproof.optimizer.subject import as_pixels, from_pixels
from patchproof.render.photograph import expose

GPU = os.environ.get("GPU", "cuda")
STEPS, VIEWS, BATCHES, ROUNDS = 60, 96, (4, 16, 64, 256), 5


def seconds(work: Callable[[], object]) -> float:
    """How long it takes until the device is done."""
    start = time.perf_counter()
    work()
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter() - start


def run(problem: Problem) -> tuple[list[float], loop.TrainingStep]:
    """A run's seconds by step, and its last step."""
    running, done = loop.steps(problem), []
    times = [seconds(lambda: done.append(next(running))) for _ in range(STEPS)]
    return times, done[-1]


def measured(name: str) -> Iterator[dict]:
    """The lines of one scene."""
    scene = pp.load_scene(f"{name}.toml")
    scene = replace(scene, settings=scene.settings.changed(optimize={"steps": STEPS}))
    cpu, gpu = (set_problem(scene, device, jobs=available_cores()) for device in ("cpu", GPU))

    def line(quantity: str, on_cpu: float | None, on_gpu: float) -> dict:
        shown = ["" if value is None else f"{value:.6g}" for value in (on_cpu, on_gpu)]
        return {"scene": name, "quantity": quantity, "cpu": shown[0], "gpu": shown[1]}

    drawn, answers, pictures = scene.draw("train", 8), [], []
    for problem in (cpu, gpu):
        views, design = training_views(problem, drawn), problem.subject.start()
        design = design + 0.2 * torch.arange(design.numel()).sin().reshape(design.shape).to(design)
        answers.append(gradient_in_views(problem, design, [views]))
        pictures.append(expose(views, problem.subject.appearance(design)).detach().cpu())
    yield line("largest difference of a pixel", None, float((pictures[0] - pictures[1]).abs().max()))
    one, other = (answer.gradient.cpu() for answer in answers)
    yield line("relative difference of the gradient", None, float((one - other).norm() / one.norm()))
    yield line("loss", *(answer.loss for answer in answers))

    runs = [run(problem) for problem in (cpu, gpu)]
    yield line(f"seconds of {STEPS} steps", *(sum(times) for times, _ in runs))
    yield line("median step, ms", *(1000 * statistics.median(times) for times, _ in runs))
    yield line("last loss on the selection set", *(step.select_loss or 0.0 for _, step in runs))

    pixels, unseen, told = as_pixels(runs[0][1].state.design), scene.draw("evaluate", VIEWS), []
    times = []
    for problem in (cpu, gpu):
        shown = {"design": problem.subject.appearance(from_pixels(pixels, problem.device))}
        times.append(seconds(lambda p=problem, s=shown: told.append(responses(p, s, unseen)["design"])))
    yield line(f"seconds of {VIEWS} views", *times)
    yield line(f"answers alike of {VIEWS}", None, int((told[0].recognized == told[1].recognized).sum()))
    yield line("largest difference of a confidence", None, float(np.abs(told[0].confidence - told[1].confidence).max()))

    for count in BATCHES:
        drawn = scene.draw("train", count)
        views, start = training_views(gpu, drawn), gpu.subject.start()
        new = [seconds(lambda d=drawn: training_views(gpu, d)) for _ in range(ROUNDS)]
        again = [seconds(lambda v=views, s=start: gradient_in_views(gpu, s, [v])) for _ in range(ROUNDS)]
        new_s, again_s = (statistics.median(times[1:]) for times in (new, again))
        yield line(f"new views a second, {count} together", None, count / (new_s + again_s))
        yield line(f"views a second relit, {count} together", None, count / again_s)


if __name__ == "__main__":
    keep_freed_memory()
    with open("cuda.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, ("scene", "quantity", "cpu", "gpu"))
        writer.writeheader()
        for scene_name in sys.argv[1:]:
            for row in measured(scene_name):
                print(row, flush=True)
                writer.writerow(row)
