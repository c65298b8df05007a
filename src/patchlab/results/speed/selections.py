"""Try designs on the selection set twice as often as a run does, and compare the designs kept.

In: three objects of `bench effort`, to be recognized, and two of them not to be, and by signed steps. Out:
`selections.csv`: by run the loss on the selection set after every 120 of 960 views, after how many the best of these
and of every second one stood, and, where they differ, both designs' mean loss and rate in the same 300 fresh views. Run
in this folder: python selections.py
"""

import numpy as np

import patchproof as pp
from patchlab.bench.effort import object_scene
from patchlab.results.rows import write_rows
from patchproof.base.workers import keep_freed_memory
from patchproof.optimizer import loop
from patchproof.optimizer.pixels import as_pixels, from_pixels
from patchproof.optimizer.problem import set_problem
from patchproof.optimizer.responses import responses

JUDGED = 300
RUNS = [("assist", "adam", label, seed) for label in ("box truck", "chair", "mailbox") for seed in range(6)]
RUNS += [
    (goal, optimizer, label, seed)
    for label in ("box truck", "chair")
    for seed in range(3)
    for goal, optimizer in (("deceive", "adam"), ("assist", "sign"))
]


def measured(goal: str, optimizer: str, label: str, seed: int) -> dict:
    """A line of the table."""
    changed = {"optimize": {"seed": seed, "optimizer": optimizer}, "target": {"goal": goal}}
    scene = pp.make_scene(object_scene(label, 240).settings.changed(**changed))
    problem = set_problem(scene, jobs=2)
    tried = [step for step in loop.steps(problem) if step.select_loss is not None]
    losses = [step.select_loss for step in tried]
    best = {"all": int(np.argmin(losses)), "half": 2 * int(np.argmin(losses[1::2])) + 1}
    row = {"goal": goal, "optimizer": optimizer, "object": label, "seed": seed}
    row |= {f"loss_{120 * (i + 1)}": round(loss, 3) for i, loss in enumerate(losses)}
    row |= {f"{name}_best": 120 * (at + 1) for name, at in best.items()}
    row |= dict.fromkeys(("all_loss", "all_rate", "half_loss", "half_rate"), "")
    if best["all"] != best["half"]:
        designs = {name: from_pixels(as_pixels(tried[at].state.design), problem.device) for name, at in best.items()}
        shown = {name: problem.subject.appearance(design) for name, design in designs.items()}
        for name, answer in responses(problem, shown, scene.draw("evaluate", JUDGED)).items():
            row |= {f"{name}_loss": round(float(answer.loss.mean()), 4)}
            row |= {f"{name}_rate": round(float(answer.recognized.mean()), 4)}
    return row


if __name__ == "__main__":
    keep_freed_memory()
    loop.SELECT_AFTER = 120
    write_rows("selections.csv", (measured(*run) for run in RUNS))
