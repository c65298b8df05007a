"""Benchmark whole runs: time and quality of a draft, the default, and three times its effort.

In: five of the package's objects, the built-in classifier, and the demo's hard conditions. Out: one chart, and
a table of seconds and promises. A run is timed from its scene to the promise with controls, in one process on one
thread, so that efforts compare. All designs of an object are judged in the same fresh conditions.
"""

import tomllib
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

from patchlab.bench.chart import Chart, ChartPoint
from patchlab.bench.measure import time_call
from patchproof.app.demo import SCENE
from patchproof.base.intervals import Estimate, rate
from patchproof.base.progress import Progress
from patchproof.base.settings import OptimizeSettings, SceneSettings
from patchproof.base.validation import validate_model
from patchproof.base.workers import use_threads
from patchproof.optimizer.pixels import from_pixels
from patchproof.optimizer.problem import set_problem
from patchproof.optimizer.promise import PromiseOptions
from patchproof.optimizer.responses import responses
from patchproof.optimizer.run import DRAFT_EFFORT, THOROUGH_EFFORT, Run
from patchproof.optimizer.run import optimize as optimize_scene
from patchproof.report.tables import Table
from patchproof.scene.interface import Scene
from patchproof.scene.scene import build_scene

# By label: the primitive, its length, the piece's offset from its middle, and the piece's size, in mm.
OBJECTS_BY_LABEL = {
    "box truck": ("box_truck", 400, 45, 147),
    "carton": ("carton", 300, 0, 140),
    "chair": ("chair", 450, 0, 140),
    "mailbox": ("mailbox", 400, 0, 90),
    "table lamp": ("table_lamp", 450, 0, 90),
}
DEFAULT = "default"
# By name: steps, and views of the promise (None: as many as the scene's half width needs).
EFFORTS = {"draft": DRAFT_EFFORT, DEFAULT: (OptimizeSettings().steps, None), "thorough": THOROUGH_EFFORT}
QUICK_EFFORTS = {"draft": DRAFT_EFFORT, DEFAULT: (2 * DRAFT_EFFORT[0], 2 * DRAFT_EFFORT[1])}


def charts(quick: bool, progress: Progress) -> Iterator[Chart]:
    """Chart the efforts on five objects, quick: two efforts on one."""
    labels = list(OBJECTS_BY_LABEL)[:1] if quick else list(OBJECTS_BY_LABEL)
    yield effort_chart(labels, QUICK_EFFORTS if quick else EFFORTS, 100 if quick else 400, progress)


def effort_chart(
    labels: list[str], efforts: Mapping[str, tuple[int, int | None]], judged: int, progress: Progress
) -> Chart:
    """Seconds of each effort over the default's, against the share of fresh views in which its design fails."""
    series, rows = {}, []
    for label in labels:
        runs = {}
        for name, (steps, views) in efforts.items():
            runs[name] = _timed_run(object_scene(label, steps), views)
            progress("runs", len(series) * len(efforts) + len(runs), len(labels) * len(efforts))
        missed = _missed_shares({name: run for name, (run, _) in runs.items()}, judged)
        seconds = {name: taken for name, (_, taken) in runs.items()}
        costs = {name: taken / seconds[DEFAULT] for name, taken in seconds.items()}
        series[label] = [ChartPoint(name, costs[name], missed[name], name == DEFAULT) for name in efforts]
        for name, (run, taken) in runs.items():
            low, high = run.promise.interval
            best = max(claim.rate for claim in run.promise.controls.values())
            rows.append((label, name, taken, run.promise.rate, (high - low) / 2, best, 1 - missed[name].value))
    head = ("object", "effort", "seconds", "promised", "half width", "best control", "rate of fresh views")
    return Chart(
        name="effort",
        title="A draft, the default, and three times the steps with four times the promise",
        cost="seconds from the scene to its promise, relative to the default",
        error=f"share of {judged} fresh views in which the design is not recognized",
        series=series,
        about="One run of each, in one process on one thread; intervals are over the views.",
        tables=(Table("effort_runs", "Runs", head, tuple(rows), "seconds on this machine"),),
    )


def object_scene(label: str, steps: int) -> Scene:
    """The demo's scene with one of `OBJECTS_BY_LABEL` and this number of optimizer steps."""
    primitive, length_mm, off_mm, size_mm = OBJECTS_BY_LABEL[label]
    settings: dict[str, Any] = tomllib.loads(SCENE)
    settings["object"] |= {"mesh": f"primitive:{primitive}", "length_mm": length_mm}
    settings["patch"] |= {"offset_mm": [0, off_mm], "width_mm": size_mm, "height_mm": size_mm}
    settings["target"]["label"] = label
    settings["optimize"]["steps"] = steps
    return build_scene(validate_model(SceneSettings, settings, label), Path())


def _timed_run(scene: Scene, views: int | None) -> tuple[Run, float]:
    with TemporaryDirectory() as folder, use_threads(1):
        work = partial(optimize_scene, scene, Path(folder) / "run", promise=PromiseOptions(views))
        run, ms = time_call(work, perf_counter)
        return run, ms / 1000


def _missed_shares(runs: dict[str, Run], judged: int) -> dict[str, Estimate]:
    problem = set_problem(next(iter(runs.values())).scene)
    shown = {name: problem.subject.appearance(from_pixels(run.design), "design") for name, run in runs.items()}
    answers = responses(problem, shown, problem.scene.draw("evaluate", judged))
    missed = {name: rate([not hit for hit in answer.recognized[0]]) for name, answer in answers.items()}
    return {name: estimate for name, estimate in missed.items() if estimate is not None}
