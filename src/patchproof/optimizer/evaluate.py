"""Evaluate a run on fresh conditions, with its controls, also with networks it was not optimized for.

In: a run. Out: RUN/evaluate.json with, per network, rate, confidence and paired differences to each control, for a
detector also its average precision. Conditions come from the evaluate stream, which neither training nor the promise
uses. They are evaluated a few at a time, by this process or by others, each of which opens the run for itself.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

import torch
from pydantic import Field

from patchproof.base.compute import Compute
from patchproof.base.errors import Refused
from patchproof.base.folder_lock import lock_folder
from patchproof.base.goal import Goal
from patchproof.base.input import is_file
from patchproof.base.output import write_atomically
from patchproof.base.progress import Advance, Progress, no_advance, no_progress
from patchproof.base.validation import StrictModel
from patchproof.base.workers import Workers, open_workers
from patchproof.classifier.average_precision import Detection, average_precision, find_detections
from patchproof.classifier.network import Classifier, center_square
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.optimizer.promise import (
    CONTROLS,
    PROMISE_VIEWS,
    PromiseOptions,
    control_claims,
    model_claims,
    pictures_with_controls,
)
from patchproof.optimizer.responses import CHUNK_VIEWS, Responses, in_chunks, merge_responses, responses
from patchproof.optimizer.run import Run, load_run, promise_of, write_run
from patchproof.render.photograph import Appearance, expose
from patchproof.scene.conditions import Conditions
from patchproof.sheets.manifest import ControlClaim, ModelClaim

NetworkChoice = tuple[str | Classifier, ...] | None
DetectionsByKind = dict[str, dict[str, list[Detection]]]  # by detector, and by "design" or control


class ModelEvaluation(ModelClaim):
    """One network's rate and confidence for the design, its controls by kind, and a detector's average precision (at an
    overlap of 0.5) for "design" and each control.
    """

    controls: dict[str, ControlClaim]
    ap50: dict[str, float] | None = None


class Evaluation(StrictModel):
    """A run evaluated under `n` fresh conditions of a seed, by network name."""

    n: int
    seed: int
    goal: Goal
    models: dict[str, ModelEvaluation]
    not_measured: dict[str, str] = Field(default_factory=dict)  # reasons by figure

    def _repr_html_(self) -> str:
        from patchproof.base.notebook import notebook_html

        rates = {}
        for name, each in self.models.items():
            claims = {name: each} | {f"{name}, {kind}": claim for kind, claim in each.controls.items()}
            rates |= {key: (claim.rate, claim.interval) for key, claim in claims.items()}
        return notebook_html(f"recognized in {self.n} fresh conditions", {}, rates)

    def to_json(self) -> str:
        """Return the text of evaluate.json."""
        models = {name: each.model_dump(exclude={"name"}) for name, each in self.models.items()}
        for each in models.values():
            if each["ap50"] is None:  # of classifiers
                del each["ap50"]
        values = self.model_dump(mode="json", exclude={"models", "not_measured"})
        values |= {"models": models, "not_measured": self.not_measured}
        return json.dumps(values, indent=1) + "\n"


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
        models: networks in place of the run's: names, or classifiers in memory, which other processes cannot load.
        n: conditions, 1 or more.
        seed: of the conditions, in place of the scene's.
        trust: as in `load_run`.
        compute: device, and processes or cluster.
        overwrite: replace an earlier evaluate.json.
        progress: called with the stage "evaluate" (views).

    Raises:
        Refused: for a folder without a finished run, or one that was evaluated before.
    """
    folder, networks = Path(run_folder).resolve(), None if models is None else tuple(models)
    refuse_networks_in_memory(networks, compute)
    if is_file(folder / "evaluate.json") and not overwrite:
        do = "add --overwrite, or rename it to keep it"
        raise Refused("a run that was not evaluated yet", f"{folder / 'evaluate.json'}, which exists", do)
    with open_workers(compute.jobs, compute.cluster) as workers:
        run, problem = _open_run(folder, networks, compute.device, trust)
        conditions, advance = run.scene.draw("evaluate", n, seed), partial(progress, "evaluate")
        options = networks, compute.device, trust, advance
        responses_by_kind, detections = run_responses(folder, conditions, workers, *options)
    close_run()
    evaluations = {}
    for i, claim in enumerate(model_claims(problem, responses_by_kind["design"])):
        ap50 = None
        if parts := [part[claim.name] for part in detections if claim.name in part]:
            ap50 = {kind: average_precision([f for part in parts for f in part[kind]], n) for kind in parts[0]}
        controls = control_claims(responses_by_kind, i)
        evaluations[claim.name] = ModelEvaluation(**claim.model_dump(), controls=controls, ap50=ap50)
    seed, why = run.scene.seed if seed is None else seed, "the object's box in these views is not known"
    boxless = (net.name for net in problem.classifiers if net.LOOKS_AT_BOXES and evaluations[net.name].ap50 is None)
    reasons = {f"AP50 of {name}": why for name in boxless}
    result = Evaluation(n=n, seed=seed, goal=run.promise.target.goal, models=evaluations, not_measured=reasons)
    with lock_folder(run.folder):
        write_atomically(run.folder / "evaluate.json", result.to_json())
    return result


def refuse_networks_in_memory(networks: NetworkChoice, compute: Compute) -> None:
    """Refuse networks in memory where other processes do the work."""
    in_memory = [network.name for network in networks or () if isinstance(network, Classifier)]
    if in_memory and (compute.jobs > 1 or compute.cluster is not None):
        got = f"{in_memory[0]}, a network in memory"
        raise Refused("networks that other processes load by name", got, "leave jobs and cluster out of Compute")


def run_responses(
    folder: Path,
    conditions: Conditions,
    workers: Workers,
    networks: NetworkChoice = None,
    device: str = "cpu",
    trust: bool = False,
    advance: Advance = no_advance,
) -> tuple[dict[str, Responses], list[DetectionsByKind]]:
    """The networks' responses to the design of the run in an absolute folder, and to its controls, under the
    conditions; and the detections of detectors, one dictionary per chunk of conditions.
    """
    respond, n = partial(_chunk_responses, folder, networks, device, trust), len(conditions)
    chunks = workers.map(respond, in_chunks(conditions), lambda done, _: advance(min(done * CHUNK_VIEWS, n), n))
    return merge_responses([by_kind for by_kind, _ in chunks]), [detections for _, detections in chunks]


def close_run() -> None:
    """Drop the run that `run_responses` keeps open in this process."""
    _open_run.cache_clear()


@lru_cache(maxsize=1)
def _open_run(folder: Path, models: NetworkChoice, device: str, trust: bool) -> tuple[Run, Problem]:
    """The run and its problem, loaded once in each process."""
    run = load_run(folder, trust)
    return run, set_problem(run.scene, device, models)


def _chunk_responses(
    folder: Path, models: NetworkChoice, device: str, trust: bool, conditions: Conditions
) -> tuple[dict[str, Responses], DetectionsByKind]:
    run, problem = _open_run(folder, models, device, trust)
    appearances = pictures_with_controls(problem, run.design, CONTROLS)
    return responses(problem, appearances, conditions), _detections(problem, appearances, conditions)


def _detections(problem: Problem, appearances: Mapping[str, Appearance], conditions: Conditions) -> DetectionsByKind:
    """All detections under the target's labels; empty where the object's box is not known."""
    boxes = problem.boxes(conditions)
    if boxes is None:
        return {}
    detections: DetectionsByKind = {}
    with torch.no_grad():
        views = problem.see(appearances["design"], conditions, problem.figure_px)
        pictures = {kind: expose(views, appearance) for kind, appearance in appearances.items()}
        for network, indices in zip(problem.classifiers, problem.indices, strict=True):
            if not network.LOOKS_AT_BOXES:
                continue
            boxes_px, shows = torch.as_tensor(boxes * network.input_px), [True] * len(boxes)
            squares = ((kind, center_square(photos, network.input_px)) for kind, photos in pictures.items())
            candidates = ((kind, network.network(square)) for kind, square in squares)
            detections[network.name] = {k: find_detections(c, indices, boxes_px, shows) for k, c in candidates}
    return detections


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
