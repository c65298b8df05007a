"""Evaluate a run again: fresh conditions, its controls, and networks it was not optimized with.

In: a run. Out: RUN/evaluate.json with, per network, rate, confidence and paired differences to each control. Conditions
come from the evaluate stream, which neither training nor the promise has seen. They are seen in parts of `CHUNK`, by
this process or by others, each of which opens the run for itself.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from patchproof.claims import wilson
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.optimizer.promise import CHUNK, PROMISE_VIEWS, Outcomes, control_claims, try_out
from patchproof.optimizer.run import Run, load_run
from patchproof.output import write_whole
from patchproof.scene.conditions import Conditions
from patchproof.workers import open_workers


def evaluate_run(
    run_folder: str | Path,
    *,
    models: tuple[str, ...] | None = None,
    n: int = PROMISE_VIEWS,
    seed: int | None = None,
    device: str = "cpu",
    jobs: int = 1,
    cluster: str | None = None,
    on_view: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Any]:
    """Rates of the run's design and its controls on n fresh conditions; written to RUN/evaluate.json and returned."""
    folder = Path(run_folder).resolve()
    with open_workers(jobs, cluster) as workers:
        run, problem = _opened(folder, models, device)
        conditions = run.scene.draw("evaluate", n, seed)
        parts = [conditions[first : first + CHUNK] for first in range(0, n, CHUNK)]
        try_part = partial(_try_part, folder, models, device)
        tried = workers.map(try_part, parts, lambda done, _: on_view(min(done * CHUNK, n), n))
    _opened.cache_clear()
    outcomes = Outcomes(*(_joined(part) for part in zip(*tried, strict=True)), conditions)
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


@lru_cache(maxsize=1)
def _opened(folder: Path, models: tuple[str, ...] | None, device: str) -> tuple[Run, Problem]:
    """A run and its problem, once in each process."""
    run = load_run(folder)
    return run, set_problem(run.scene, device, models)


def _try_part(folder: Path, models, device: str, conditions: Conditions) -> tuple[dict, dict]:
    run, problem = _opened(folder, models, device)
    outcomes = try_out(problem, run.design, conditions)
    return outcomes.recognized, outcomes.confidence


def _joined(parts: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {kind: np.concatenate([part[kind] for part in parts], -1) for kind in parts[0]}
