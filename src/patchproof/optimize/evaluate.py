"""Evaluate a run again: fresh conditions, its controls, and networks it was not optimized with.

In: a run. Out: RUN/evaluate.json with, per network, rate, confidence and paired differences to each control. Conditions
come from the evaluate stream, which neither training nor the promise has seen.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from patchproof.claims import wilson
from patchproof.optimize.problem import set_problem
from patchproof.optimize.promise import PROMISE_VIEWS, control_claims, try_out
from patchproof.optimize.run import load_run
from patchproof.output import write_whole


def evaluate_run(
    run_folder: str | Path,
    *,
    models: tuple[str, ...] | None = None,
    n: int = PROMISE_VIEWS,
    seed: int | None = None,
    device: str = "cpu",
    on_view: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Any]:
    """Rates of the run's design and its controls on n fresh conditions; written to RUN/evaluate.json and returned."""
    run = load_run(run_folder)
    problem = set_problem(run.scene, device, models)
    done = 0

    def progress(count: int) -> None:
        nonlocal done
        done += count
        on_view(done, n)

    outcomes = try_out(problem, run.design, run.scene.draw("evaluate", n, seed), progress)
    result = {"n": n, "seed": run.scene.seed if seed is None else seed, "models": {}}
    for i, classifier in enumerate(problem.classifiers):
        recognized = outcomes.recognized["design"][i]
        result["models"][classifier.name] = {
            "sha256": classifier.sha256,
            "rate": float(recognized.mean()),
            "interval": wilson(int(recognized.sum()), n),
            "confidence": float(outcomes.confidence["design"][i].mean()),
            "controls": {kind: claim.model_dump() for kind, claim in control_claims(outcomes, i).items()},
        }
    write_whole(
        run.folder / "evaluate.json", lambda path: path.write_text(json.dumps(result, indent=1) + "\n", "utf-8")
    )
    return result
