"""The promise of a finished run, made later or of more views: a draft's design may deserve a full one.

In: a run's folder. Out: the same run with another promise in its run.json, to the byte the one that `optimize` would
have made of so many views. Left out on purpose: sheets. One that was written before keeps its promise until it is
written again, with the same markers and sheet id.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from patchproof.base.output import write_whole
from patchproof.optimizer.problem import set_problem
from patchproof.optimizer.run import RUN_FILE, Run, check_promise, load_run, promise_of


def promise_run(
    run_folder: str | Path,
    *,
    views: int | None = None,
    device: str = "cpu",
    jobs: int = 1,
    on_promise: Callable[[int, int], None] = lambda done, total: None,
) -> Run:
    """Promise a run's design anew, from so many views (by default as many as `optimize` takes), with its controls."""
    check_promise(views)
    run = load_run(run_folder)
    problem = set_problem(run.scene, device, jobs=jobs)
    promise = promise_of(problem, run.design, tuple(run.promise.controls), views, on_promise)
    details = run.details | {"promise": promise.model_dump(mode="json")}
    write_whole(run.folder / RUN_FILE, (json.dumps(details, indent=1) + "\n").encode())
    return replace(run, promise=promise, details=details)
