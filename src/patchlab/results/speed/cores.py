"""Predict a training step's time on more cores than this machine has, from its parts as measured here.

In: the demo's scene, and `suv.toml` before MobileNetV2. Out: `cores.csv`: by network, views of a step, views of a batch
and cores the predicted milliseconds of a step whose poses have been seen, and how many times as fast that is as one
core with the same settings. A step is what one process does alone (print, update, send and receive each batch) and the
batches of the core that has most of them. Assumed: cores are alike, share neither clock nor memory, and nobody waits
for a sleeping process. Medians of processor time in turn. Run in this folder: python cores.py
"""

import math
import pickle
import statistics
import tomllib
from functools import partial
from itertools import product

import torch

import patchproof as pp
from patchlab.results.rows import write_rows
from patchlab.study.measure import call_in_turn, time_call
from patchproof.app.demo import SCENE
from patchproof.base.workers import keep_freed_memory
from patchproof.optimizer import expectation, loop
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.render.views import split_views

BATCHES, STEP_VIEWS, CORES, ROUNDS = (1, 2, 4), (4, 8, 16), (1, 2, 4, 8, 16), 12


def parts_ms(problem: Problem) -> dict[int | str, float]:
    """Milliseconds of a batch by its views, of what is done once in a step, and of sending a batch and its answer."""
    state, whole = loop.start(problem), expectation.training_views(problem, problem.scene.draw("train", sum(BATCHES)))
    parts = dict(zip(BATCHES, split_views(whole, BATCHES), strict=True))
    printed = problem.subject.print_design(state.design).detach()

    def batch(size):
        return expectation._views_answer(problem, printed, problem.see_again(parts[size], parts[size].conditions))

    def step():
        loop._descend(problem, state, expectation._mean_answer(problem, state.design, lambda _: [answer]))

    def send():
        pickle.loads(pickle.dumps((printed.numpy(), parts[2].conditions, answer)))

    answer, calls = batch(2), {size: partial(batch, size) for size in BATCHES} | {"step": step, "send": send}
    rounds = call_in_turn({name: partial(time_call, call) for name, call in calls.items()}, ROUNDS)
    return {name: statistics.median(ms for _, ms in timed) for name, timed in rounds.items()}


if __name__ == "__main__":
    keep_freed_memory()
    torch.set_num_threads(1)
    problems, rows = map(set_problem, (pp.make_scene(tomllib.loads(SCENE)), pp.load_scene("suv.toml"))), []
    every = {p.classifiers[0].name.rsplit("/")[-1].removesuffix(".onnx"): parts_ms(p) for p in problems}
    for (network, ms), views, size, cores in product(every.items(), STEP_VIEWS, BATCHES, CORES):
        alone, busiest = ms["step"] + views // size * ms[size], math.ceil(views // size / cores) * ms[size]
        step = alone if cores == 1 else ms["step"] + views // size * ms["send"] + busiest
        row = {"network": network, "views": views, "batch": size, "cores": cores, "batch_ms": round(ms[size], 2)}
        rows.append(row | {"step_ms": round(step, 2), "times_as_fast": round(alone / step, 2)})
    write_rows("cores.csv", rows)
