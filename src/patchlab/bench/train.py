"""Benchmark training: views per step, optimizer and step size.

In: the demo's scene. Out: two charts. Designs are compared on conditions of the evaluate stream, which neither
trains nor selects. Cost is the number of views that the network sees, selection included; `bench.render`
measures the time of a view.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from torch import Tensor

from patchlab.bench.chart import Chart, ChartPoint
from patchlab.study.estimates import paired_means
from patchproof.app.demo import demo_scene
from patchproof.base.progress import Progress
from patchproof.base.settings import OptimizeSettings
from patchproof.optimizer import loop
from patchproof.optimizer.pixels import as_pixels, from_pixels
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.optimizer.responses import responses
from patchproof.scene.scene import load_scene

STEP_VIEWS, QUICK_STEP_VIEWS = (2, 4, 8, 12, 24), (2, 4, 12)
ADAM_STEP_SIZES, QUICK_ADAM_STEP_SIZES = (0.0075, 0.015, 0.03, 0.06, 0.12), (0.0075, 0.015, 0.03)  # step sizes
SIGN_STEP_SIZES, QUICK_SIGN_STEP_SIZES = (0.01, 0.03, 0.1), (0.03,)

DEFAULT_SETTINGS = OptimizeSettings()
Losses = Mapping[tuple[OptimizeSettings, int], Sequence[float]]  # by settings and training views, one per seed


@dataclass(frozen=True)
class TrainingEffort:
    """Training views of a whole run (half of them is charted, too), seeds, and views that designs are judged on."""

    views: int
    seeds: int
    judged: int


def charts(quick: bool, progress: Progress) -> Iterator[Chart]:
    """Chart views per step, then optimizer and step size."""
    effort = TrainingEffort(120, 3, 64) if quick else TrainingEffort(960, 4, 256)
    views = {f"{n}": DEFAULT_SETTINGS.changed(views=n) for n in (QUICK_STEP_VIEWS if quick else STEP_VIEWS)}
    moves = {
        f"adam {size:g}": DEFAULT_SETTINGS.changed(step_size=size)
        for size in (QUICK_ADAM_STEP_SIZES if quick else ADAM_STEP_SIZES)
    }
    for size in QUICK_SIGN_STEP_SIZES if quick else SIGN_STEP_SIZES:
        moves[f"sign {size:g}"] = DEFAULT_SETTINGS.changed(optimizer="sign", step_size=size)
    losses = train_and_judge(demo_problem(), list(dict.fromkeys([*views.values(), *moves.values()])), effort, progress)
    yield runs_chart("views", "Views per step, for as many views in all", views, losses, effort)
    yield runs_chart("optimizer", "Optimizer and step size", moves, losses, effort)


def runs_chart(
    name: str, title: str, runs: Mapping[str, OptimizeSettings], losses: Losses, effort: TrainingEffort
) -> Chart:
    """Chart the loss of designs by setting, after half of the training views and after all."""
    columns = [(setting, run, end) for setting, run in runs.items() for end in charted_ends(run, effort)]
    series: dict[int, list[ChartPoint]] = {end: [] for end in sorted({end for _, _, end in columns})}
    table = np.array([losses[run, end] for _, run, end in columns]).T
    for (setting, run, end), loss in zip(columns, paired_means(table), strict=True):
        cost = loop.views_per_network(run.changed(steps=end // run.views))
        series[end].append(ChartPoint(setting, cost, loss, run == DEFAULT_SETTINGS and end == effort.views))
    return Chart(
        name=name,
        title=title,
        cost="views that the network sees, selection included",
        error=f"loss of the kept design on {effort.judged} new conditions",
        series={f"trained on {end} views": points for end, points in series.items()},
        about=f"{effort.seeds} seeds. Intervals are for comparing settings: what all settings of a seed share is taken "
        f"out. A selection set of {loop.SELECT_VIEWS} views is seen every {loop.SELECT_AFTER} training views.",
        one_front=True,
    )


def charted_ends(run: OptimizeSettings, effort: TrainingEffort) -> list[int]:
    """Training views after which a run is charted, where the selection set has just been seen."""
    whole = run.changed(steps=effort.views // run.views)
    return [end for end in (effort.views // 2, effort.views) if loop.is_selection_step(whole, end // run.views)]


def train_and_judge(
    problem: Problem, runs: Collection[OptimizeSettings], effort: TrainingEffort, progress: Progress
) -> dict[tuple[OptimizeSettings, int], list[float]]:
    """Train every run with every seed; losses on new conditions, the same for all designs."""
    shown = {}
    for seed in range(effort.seeds):
        for i, run in enumerate(runs):
            ends = charted_ends(run, effort)
            numbers = [end // run.views for end in ends]
            designs = designs_after(problem.with_training(run.changed(steps=numbers[-1]), seed), numbers)
            shown |= {(run, end, seed): problem.subject.appearance(d) for end, d in zip(ends, designs, strict=True)}
            progress("training", seed * len(runs) + i + 1, effort.seeds * len(runs))
    answers = responses(problem, shown, problem.scene.draw("evaluate", effort.judged), problem.training_px)
    return {
        (run, end): [float(answers[run, end, seed].loss.mean()) for seed in range(effort.seeds)]
        for run, end, _ in shown
    }


def designs_after(problem: Problem, numbers: Sequence[int]) -> list[Tensor]:
    """The best designs, as printed, after these numbers of steps (rising)."""
    states: dict[int, loop.State] = {step.state.number: step.state for step in loop.steps(problem)}
    return [from_pixels(as_pixels(states[number].best)) for number in numbers]


def optimize_demo_design(count: int, progress: Progress) -> tuple[Problem, Tensor]:
    """The demo's problem, and the best design 3×h×w of `count` optimizer steps."""
    problem = demo_problem().with_training(OptimizeSettings(steps=count))
    state = loop.start(problem)
    for step in loop.steps(problem, state):
        state = step.state
        progress("design", state.number, count)
    return problem, from_pixels(as_pixels(state.best))


def demo_problem() -> Problem:
    """Build the demo's scene and set its problem."""
    with TemporaryDirectory() as folder:
        return set_problem(load_scene(demo_scene(Path(folder))))
