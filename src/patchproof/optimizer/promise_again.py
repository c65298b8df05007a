"""Promise the rate of a finished run again."""

from dataclasses import replace
from functools import partial
from pathlib import Path

from patchproof.base.compute import Compute
from patchproof.base.folder_lock import lock_folder
from patchproof.base.progress import Progress, no_progress
from patchproof.optimizer.problem import set_problem
from patchproof.optimizer.promise import PromiseOptions
from patchproof.optimizer.run import Run, load_run, promise_of, write_run


def promise_run(
    run_folder: str | Path,
    *,
    views: int | None = None,
    trust: bool = False,
    compute: Compute = Compute(),
    progress: Progress = no_progress,
) -> Run:
    """Promise the rate of a finished run's design again, from `views` views and with the run's own controls; the run is
    the same to the byte as if `optimize` had been given these views. A sheet keeps its promise until it is written
    again. For `trust` see `load_run`.
    """
    compute, options = compute.without("promise", cluster=True), PromiseOptions(views)
    with lock_folder(run_folder):
        run = load_run(run_folder, trust)
        options = replace(options, controls=tuple(run.promise.controls))
        problem = set_problem(run.scene, compute.device, jobs=compute.jobs)
        promise = promise_of(problem, run.design, options, partial(progress, "promise"))
        details = run.details | {"promise": promise.model_dump(mode="json")}
        return write_run(replace(run, promise=promise, details=details))
