"""Compare promises by networks in half precision with those in float32: time and answers.

In: scene files. Out: `half.csv`, by scene and thing shown (a design, and the bare object in half of its views): answers
in bfloat16 (`torch.autocast`) beside those in float32 under the same conditions, as mean and root mean square of the
difference in confidence, views that change sides, and rates; and the share of the processor time that all views took,
the median of rounds in turn on one thread. One design each. Run in this folder: python half.py SCENE [SCENE ...]
"""

import statistics
import sys
from functools import partial
from pathlib import Path

import numpy as np
import torch

import patchproof as pp
from patchlab.results.rows import write_rows
from patchlab.study.measure import call_in_turn, time_call
from patchproof.base.workers import keep_freed_memory
from patchproof.classifier.network import Classifier
from patchproof.optimizer import promise
from patchproof.optimizer.loop import best_design
from patchproof.optimizer.problem import set_problem
from patchproof.optimizer.responses import responses

ROUNDS = 3
asked = Classifier._call_network


def rounded(self, squares, windows):
    """A network's answers in half precision."""
    with torch.autocast("cpu", dtype=torch.bfloat16):
        return asked(self, squares, windows).float()


def measured(path: str) -> list[dict]:
    """The lines of one scene."""
    problem = set_problem(pp.load_scene(path))
    shown = promise.pictures_with_controls(problem, best_design(problem), promise.CONTROLS)
    conditions = problem.scene.draw("promise", promise.PROMISE_VIEWS, per_session=promise.VIEWS_PER_SESSION)
    control_mask = promise._control_mask(promise.PROMISE_VIEWS, promise.VIEWS_PER_SESSION)

    def told(way):
        Classifier._call_network = way
        return time_call(lambda: responses(problem, shown, conditions, control_mask=control_mask))

    rounds, rows = call_in_turn({way: partial(told, way) for way in (asked, rounded)}, ROUNDS), []
    Classifier._call_network, (wholes, halves) = asked, rounds.values()
    share = statistics.median(half_ms / ms for (_, ms), (_, half_ms) in zip(wholes, halves, strict=True))
    for thing in ("design", "bare"):
        whole, half = wholes[-1][0][thing], halves[-1][0][thing]
        off, other = (half.confidence - whole.confidence)[0], (half.recognized != whole.recognized)[0]
        row = {"scene": Path(path).stem, "thing": thing, "n": len(off), "share": f"{share:.3f}"}
        row |= {"mean": f"{off.mean():.5f}", "rms": f"{np.sqrt((off**2).mean()):.5f}", "other": int(other.sum())}
        rows.append(row | {"rate": f"{whole.recognized.mean():.4f}", "half_rate": f"{half.recognized.mean():.4f}"})
    return rows


if __name__ == "__main__":
    keep_freed_memory()
    torch.set_num_threads(1)
    write_rows("half.csv", (row for path in sys.argv[1:] for row in measured(path)))
