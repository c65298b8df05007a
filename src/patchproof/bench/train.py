"""The knobs of training: views per step, optimizer and step size, how conditions are drawn.

In: the demo's scene. Out: a chart per knob. Designs are compared on conditions of the evaluate stream, which neither
trains nor selects. The cost of training is counted in views that the network sees, those of the selection set
included; what one of them takes is `render`'s business.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from patchproof.bench.chart import Chart, OnStage, Point
from patchproof.bench.world import demo_problem, set_world, with_optimize
from patchproof.claims import Estimate, paired_means, standard_deviation, student_mean
from patchproof.optimizer.loop import SELECT_AFTER, SELECT_VIEWS, State, selects, steps, views_seen
from patchproof.optimizer.patch import Patch
from patchproof.optimizer.pixels import as_pixels, from_pixels
from patchproof.optimizer.problem import Problem
from patchproof.optimizer.responses import responses
from patchproof.report.tables import Table
from patchproof.scene.conditions import Stream
from patchproof.settings import OptimizeSettings

VIEWS, QUICK_VIEWS = (2, 4, 8, 12, 24), (2, 4, 12)
ADAM, QUICK_ADAM = (0.01, 0.025, 0.05, 0.1, 0.2), (0.025, 0.05, 0.1)  # step sizes
SIGN, QUICK_SIGN = (0.01, 0.03, 0.1), (0.03,)
SAMPLES, QUICK_SAMPLES = (8, 16, 32, 64, 128, 256), (8, 16, 32, 64)


USUAL = OptimizeSettings(step_size=Patch.STEP_SIZE)
Losses = Mapping[tuple[OptimizeSettings, int], Sequence[float]]  # by settings and training views, one per seed


@dataclass(frozen=True)
class Effort:
    """Training views of a whole run, of which half is charted, too; seeds; views that designs are compared on."""

    views: int
    seeds: int
    judged: int


def charts(quick: bool, on_stage: OnStage) -> Iterator[Chart]:
    """Every chart of training, one after the other."""
    effort = Effort(120, 3, 64) if quick else Effort(960, 4, 256)
    views = {f"{n}": USUAL.changed(views=n) for n in (QUICK_VIEWS if quick else VIEWS)}
    moves = {f"adam {size:g}": USUAL.changed(step_size=size) for size in (QUICK_ADAM if quick else ADAM)}
    for size in QUICK_SIGN if quick else SIGN:
        moves[f"sign {size:g}"] = USUAL.changed(optimizer="sign", step_size=size)
    losses = trained_losses(demo_problem(), list(dict.fromkeys([*views.values(), *moves.values()])), effort, on_stage)
    yield runs_chart("views", "Views per step, for as many views in all", views, losses, effort)
    yield runs_chart("optimizer", "Optimizer and step size", moves, losses, effort)
    yield draws_chart(quick, on_stage)


# Views per step, and how the design moves: quality after as many views


def runs_chart(name: str, title: str, runs: Mapping[str, OptimizeSettings], losses: Losses, effort: Effort) -> Chart:
    """Settings by name, after half of the views and after all, against the loss of what has been trained."""
    columns = [(setting, run, end) for setting, run in runs.items() for end in ends_of(run, effort)]
    series: dict[int, list[Point]] = {end: [] for end in sorted({end for _, _, end in columns})}
    table = np.array([losses[run, end] for _, run, end in columns]).T
    for (setting, run, end), loss in zip(columns, paired_means(table), strict=True):
        cost = views_seen(run.changed(steps=end // run.views))
        series[end].append(Point(setting, cost, loss, run == USUAL and end == effort.views))
    return Chart(
        name=name,
        title=title,
        cost="views that the network sees, selection included",
        error=f"loss of the kept design on {effort.judged} new conditions",
        series={f"trained on {end} views": points for end, points in series.items()},
        about=f"{effort.seeds} seeds. Intervals are for comparing settings: what all settings of a seed share is taken "
        f"out. A selection set of {SELECT_VIEWS} views is seen every {SELECT_AFTER} training views.",
        one_front=True,
    )


def ends_of(run: OptimizeSettings, effort: Effort) -> list[int]:
    """Training views after which a run is charted: there the design was tried on the selection set."""
    return [end for end in (effort.views // 2, effort.views) if selects(run, end // run.views)]


def trained_losses(
    problem: Problem, runs: Collection[OptimizeSettings], effort: Effort, on_stage: OnStage
) -> dict[tuple[OptimizeSettings, int], list[float]]:
    """Losses on new conditions, the same for every design."""
    shown = {}
    for seed in range(effort.seeds):
        for i, run in enumerate(runs):
            ends = ends_of(run, effort)
            numbers = [end // run.views for end in ends]
            designs = trained(with_optimize(problem, run.changed(steps=numbers[-1]), seed), numbers)
            shown |= {(run, end, seed): problem.subject.shown(d) for end, d in zip(ends, designs, strict=True)}
            on_stage("training", seed * len(runs) + i + 1, effort.seeds * len(runs))
    answers = responses(problem, shown, problem.scene.draw("evaluate", effort.judged), problem.training_px)
    return {
        (run, end): [float(answers[run, end, seed].loss.mean()) for seed in range(effort.seeds)]
        for run, end, _ in shown
    }


def trained(problem: Problem, numbers: Sequence[int]) -> list[Tensor]:
    """The best design, as printed, after each of these numbers of steps (rising)."""
    states: dict[int, State] = {step.state.number: step.state for step in steps(problem)}
    return [from_pixels(as_pixels(states[number].best)) for number in numbers]


# Sobol points against independent draws


def draws_chart(quick: bool, on_stage: OnStage) -> Chart:
    """How far the loss of n views lies from that of all views, by how their conditions were drawn."""
    counts, scrambles, single = (QUICK_SAMPLES, 10, 256) if quick else (SAMPLES, 40, 2048)
    world = set_world(40 if quick else 160, lambda stage, done, total: None)

    def losses(stream: Stream, count: int, seed: int) -> np.ndarray:
        conditions = world.problem.scene.draw(stream, count, seed)
        return responses(world.problem, {0: world.shown()}, conditions, world.problem.training_px)[0].loss[0]

    sobol = []
    for seed in range(scrambles):
        sobol.append(losses("select", counts[-1], seed))
        on_stage("Sobol", seed + 1, scrambles)
    alone = losses("evaluate", single, 0)
    square = student_mean((alone - alone.mean()) ** 2)  # losses are far from normal: no χ² interval
    spread, low, high = (math.sqrt(max(x, 0)) for x in (square.value, square.low, square.high))
    by_chance = [Estimate(spread / n**0.5, low / n**0.5, high / n**0.5, single) for n in counts]
    by_sobol = [standard_deviation(np.stack(sobol)[:, :n].mean(1)) for n in counts]
    pairs = list(zip(counts, by_sobol, by_chance, strict=True))
    worth = tuple((n, n * (chance.value / sobol.value) ** 2) for n, sobol, chance in pairs)
    return Chart(
        name="draws",
        title="How conditions are drawn",
        cost="views that the loss is estimated from",
        error="standard deviation of the mean loss over draws",
        series={
            "Sobol points": [Point(f"{n}", n, sobol, n == SELECT_VIEWS) for n, sobol, _ in pairs],
            "independent": [Point(f"{n}", n, chance) for n, _, chance in pairs],
        },
        about=f"Sobol: {scrambles} scrambles; independent: spread of {single} single views, over √n. Default: the "
        "selection set, which as training is drawn by Sobol points.",
        tables=(Table("draws_worth", "As many independent views do the same", ("Sobol views", "independent"), worth),),
        one_front=True,
    )
