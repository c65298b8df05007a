"""What a training step asks of a device: operations to launch, and answers to wait for.

A GPU runs behind the program; whatever the program has to know (how many pixels are covered, whether a number is
finite) makes it wait. Counted on a CPU, where every operation passes the same dispatcher.
"""

from __future__ import annotations

import traceback
from collections import Counter

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from patchproof.optimizer import loop
from patchproof.optimizer.problem import set_problem
from test_optimize import scene_with

# Of one step of four views, in the two parts that a CPU sees them in, on a carton before a network of one layer: where
# poses are seen for the first time, as in one step of four, and where they are seen again. Measured: 6,239 and 101, of
# which 24 are footprints of a texture, dealt out by their number of taps, and 18 outlines; 1,211 and 17.
OPERATIONS, WAITS = (6_500, 1_300), (105, 20)


class Counted(TorchDispatchMode):
    """Counts the operations that reach the device, and those whose answer the program waits for, by where."""

    def __init__(self):
        super().__init__()
        self.operations, self.waits = 0, Counter()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.operations += 1
        masked = "aten.index" in str(func) and any(
            isinstance(i, torch.Tensor) and i.dtype == torch.bool
            for i in (args[1] if isinstance(args[1], list) else ())
        )
        if masked or any(name in str(func) for name in ("nonzero", "_local_scalar_dense", "bincount", "unique")):
            ours = [frame for frame in traceback.extract_stack() if "/patchproof/" in frame.filename]
            self.waits[f"{ours[-1].filename.rsplit('/', 1)[-1]}:{ours[-1].name}" if ours else "torch"] += 1
        return func(*args, **(kwargs or {}))


def test_a_step_keeps_within_its_budget_of_operations_and_waits(tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "POSES", 8)
    problem = set_problem(scene_with(tmp_path))
    state, drawn = loop.start(problem), problem.scene.draw("train", 8)
    kept = loop._Kept(problem, drawn)

    def step(first: int) -> None:
        parts = loop._together(drawn[first : first + 4])
        views = [kept.lit(first + at, rows) for at, rows in parts]
        loop._step(problem, state, lambda printed: [loop.part_of(problem, printed, part) for part in views])

    step(0)  # what is made once
    for operations, waits in zip(OPERATIONS, WAITS, strict=True):
        with Counted() as counted:
            step(4)
        assert counted.operations <= operations
        assert sum(counted.waits.values()) <= waits, counted.waits.most_common()
        assert counted.waits, "the count itself works: a step asks whether its gradient is finite"
