"""Evaluate a run on fresh conditions, with its controls, also with networks it was not optimized for.

In: a run. Out: RUN/evaluate.json with, per network, rate, confidence and paired differences to each control. Conditions
come from the evaluate stream, which neither training nor the promise uses.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

from patchproof.base.errors import Refused
from patchproof.base.folder_lock import lock_folder
from patchproof.base.goal import Goal
from patchproof.base.input import is_file
from patchproof.base.output import require_finished_run, write_atomically
from patchproof.base.progress import Advance, Compute, Progress, no_progress
from patchproof.base.validation import StrictModel
from patchproof.classifier.network import Classifier
from patchproof.optimizer import promise as promises
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.optimizer.promise import PROMISE_VIEWS, PromiseOptions
from patchproof.optimizer.responses import Responses, responses
from patchproof.optimizer.run import Run, load_run, promise_of, write_run
from patchproof.scene.conditions import Conditions
from patchproof.sheets.manifest import ControlClaim, ModelClaim


class ModelEvaluation(ModelClaim):
    """One network's rate and confidence for the design, and its controls by kind."""

    controls: dict[str, ControlClaim]


class Evaluation(StrictModel):
    """A run evaluated under `n` fresh conditions of a seed, by network name."""

    n: int
    seed: int
    goal: Goal
    models: dict[str, ModelEvaluation]

    def _repr_html_(self) -> str:
        from patchproof.base.notebook import notebook_html

        rates = {}
        for name, each in self.models.items():
            claims = {name: each} | {f"{name}, {kind}": claim for kind, claim in each.controls.items()}
            rates |= {key: (claim.rate, claim.interval) for key, claim in claims.items()}
        return notebook_html(f"recognized in {self.n} fresh conditions", {}, rates)


def evaluate(
    run_folder: str | Path | Run,
    *,
    models: Sequence[str | Classifier] | None = None,
    n: int = PROMISE_VIEWS,
    seed: int | None = None,
    trust: bool = False,
    compute: Compute = Compute(),
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> Evaluation:
    """Evaluate a run's design and controls under fresh conditions, and write the result to RUN/evaluate.json.

    Args:
        run_folder: a finished run, or its folder.
        models: networks in place of the run's: names, or classifiers in memory.
        n: conditions, 1 or more.
        seed: of the conditions, in place of the scene's.
        trust: as in `load_run`.
        compute: device and processes; refuses a cluster.
        overwrite: replace an earlier evaluate.json.
        progress: called with the stage "evaluate" (views).

    Raises:
        Refused: for a folder without a finished run, or one that was evaluated before.
    """
    folder, compute = Path(run_folder), compute.without("evaluate", cluster=True)
    with _locked_run(folder):
        if is_file(folder / "evaluate.json") and not overwrite:
            do = "add --overwrite, or rename it to keep it"
            raise Refused("a run that was not evaluated yet", f"{folder / 'evaluate.json'}, which exists", do)
        run = load_run(folder, trust)
        conditions, advance = run.scene.draw("evaluate", n, seed), partial(progress, "evaluate")
        problem, by_kind = run_responses(run, conditions, models, compute, advance)
        evaluations = {
            claim.name: ModelEvaluation(**claim.model_dump(), controls=promises.control_claims(by_kind, i))
            for i, claim in enumerate(promises.model_claims(problem, by_kind["design"]))
        }
        seed = run.scene.seed if seed is None else seed
        result = Evaluation(n=n, seed=seed, goal=run.promise.target.goal, models=evaluations)
        text = result.model_dump_json(indent=1, exclude={"models": {"__all__": {"name"}}}) + "\n"
        write_atomically(folder / "evaluate.json", text)
    return result


@contextmanager
def _locked_run(folder: Path) -> Iterator[None]:
    """Lock a run's folder; refused before anything is computed if it cannot be written to."""
    require_finished_run(folder)
    if not os.access(folder, os.W_OK):
        raise Refused("a run's folder that can be written to", f"{folder}", "allow that, or use a copy of the run")
    with lock_folder(folder):
        yield


def run_responses(
    run: Run, conditions: Conditions, models: Sequence[str | Classifier] | None, compute: Compute, advance: Advance
) -> tuple[Problem, dict[str, Responses]]:
    """A run's problem, with `models` in place of its networks, and the responses to its design and to each control."""
    problem = set_problem(run.scene, compute.device, models, jobs=compute.jobs)
    appearances = promises.pictures_with_controls(problem, run.design, promises.CONTROLS)
    return problem, responses(problem, appearances, conditions, advance=advance)


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
    again. Fewer views than the run's promise has are refused. For `trust` see `load_run`.
    """
    compute, options = compute.without("promise", cluster=True), PromiseOptions(views)
    with _locked_run(Path(run_folder)):
        run = load_run(run_folder, trust)
        if (n := views or PROMISE_VIEWS) < (present := run.promise.n):
            raise Refused(f"{present} views or more, as the promise has now", f"{n}", f"ask for {present} or more")
        options = replace(options, controls=tuple(run.promise.controls))
        problem = set_problem(run.scene, compute.device, jobs=compute.jobs)
        promise = promise_of(problem, run.design, options, partial(progress, "promise"))
        details = run.details | {"promise": promise.model_dump(mode="json")}
        return write_run(replace(run, promise=promise, details=details))
