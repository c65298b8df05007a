"""Compare designs trained on poses that repeat, each time in other light: no pose twice, the run's own
240 poses before other backgrounds each time, and 240 poses each of which keeps its background.

In: three objects of `bench effort`. Out: `poses.csv`: by object and seed the mean loss and the rate of each design,
trained on 960 views and kept as it was in the end, in the same 300 fresh views. Run in this folder: python poses.py
"""

from dataclasses import replace

import numpy as np
import torch

import patchproof as pp
from patchlab.bench.effort import object_scene
from patchlab.results.rows import write_rows
from patchproof.base.workers import keep_freed_memory
from patchproof.optimizer.expectation import training_conditions
from patchproof.optimizer.loop import start, take_step
from patchproof.optimizer.pixels import as_pixels, from_pixels
from patchproof.optimizer.problem import set_problem
from patchproof.optimizer.responses import responses

LABELS, SEEDS, JUDGED = ("box truck", "chair", "mailbox"), range(6), 300


def measured(label: str, seed: int) -> dict:
    """A line of the table."""
    scene = pp.make_scene(object_scene(label, 240).settings.changed(optimize={"seed": seed}))
    problem, drawn, again = set_problem(scene), scene.draw("train", 960), training_conditions(scene)
    kept = replace(again, pose=replace(again.pose, background=drawn.pose.background[np.arange(960) % 240]))
    shown = {}
    for name, conditions in (("each", drawn), ("again", again), ("kept", kept)):
        state = start(problem)
        for first in range(0, 960, 4):
            state = take_step(problem, state, conditions[first : first + 4]).state
        shown[name] = problem.subject.appearance(from_pixels(as_pixels(state.design), problem.device))
    row = {"object": label, "seed": seed}
    for name, answer in responses(problem, shown, scene.draw("evaluate", JUDGED)).items():
        row |= {f"{name}_loss": round(float(answer.loss.mean()), 4), f"{name}_rate": round(answer.recognized.mean(), 4)}
    return row


if __name__ == "__main__":
    keep_freed_memory()
    torch.set_num_threads(1)
    write_rows("poses.csv", (measured(label, seed) for label in LABELS for seed in SEEDS))
