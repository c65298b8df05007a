"""The knobs of training: views per step, how conditions are drawn, optimizer and step size, how many networks.

In: the demo's scene; where the environment names a folder of real networks and meshes (PATCHPROOF_DATA), an ensemble is
tried on those, since one network alone comes with the package. Out: a chart per knob. Designs are compared on
conditions of the evaluate stream, which neither trains nor selects. The cost of training is counted in views that the
network sees, those of the selection set included; what one of them takes is `bench_render`'s business.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from patchproof.bench.chart import Chart, Interval, OnStage, Point, Series, Table
from patchproof.bench.measure import checked_pick, mean_interval, median_interval, paired_means, timed
from patchproof.bench.world import demo_problem, set_world, with_settings
from patchproof.claims import CONFIDENCE
from patchproof.goal import Goal
from patchproof.optimizer.goals import target_loss
from patchproof.optimizer.loop import SELECT_AFTER, SELECT_VIEWS, State, selections, selects, start, steps
from patchproof.optimizer.patch import Patch
from patchproof.optimizer.pixels import as_pixels, from_pixels
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.render.photograph import Shown, expose
from patchproof.render.views import Views
from patchproof.scene.conditions import draw
from patchproof.scene.scene import build_scene
from patchproof.settings import OptimizeSettings, SceneSettings

CHUNK = 16
VIEWS, QUICK_VIEWS = (2, 4, 8, 12, 24), (2, 4, 12)
STEP_SIZES = {"adam": (0.01, 0.025, 0.05, 0.1, 0.2), "sign": (0.01, 0.03, 0.1)}
QUICK_STEP_SIZES = {"adam": (0.025, 0.05, 0.1), "sign": (0.03,)}
ENSEMBLE_STEPS, ENSEMBLE_SEEDS = 60, 3
SAMPLES, QUICK_SAMPLES = (8, 16, 32, 64, 128, 256), (8, 16, 32, 64)
NETWORKS = ("mobilenet_v1_0.25_128", "mobilenet_v1_0.75_192", "squeezenet1.1_224")
ENSEMBLE_MESH, ENSEMBLE_LABEL = "gz_suv.glb", "jeep"


@dataclass(frozen=True)
class Effort:
    """Training views of a whole run, of which half is charted, too; seeds; views that designs are compared on."""

    views: int
    seeds: int
    judged: int


def train_charts(quick: bool, on_stage: OnStage) -> Iterator[Chart]:
    """Every chart of training, one after the other."""
    effort = Effort(120, 3, 64) if quick else Effort(960, 4, 256)
    problem = demo_problem()
    yield views_chart(problem, QUICK_VIEWS if quick else VIEWS, effort, on_stage)
    chart = optimizer_chart(problem, QUICK_STEP_SIZES if quick else STEP_SIZES, effort, on_stage)
    if quick or not _networks():
        why = "with --quick" if quick else "PATCHPROOF_DATA names no folder with real networks"
        chart = replace(chart, notes=(*chart.notes, f"ensembles of networks were left out: {why}"))
    yield chart
    yield draws_chart(quick, on_stage)
    if not quick and _networks():
        yield ensemble_chart(ENSEMBLE_STEPS, ENSEMBLE_SEEDS, on_stage)


# Views per step, and how the design moves: quality after as many views


def views_chart(problem: Problem, views: Sequence[int], effort: Effort, on_stage: OnStage) -> Chart:
    """Views per step against the loss of what has been trained on as many views in all."""
    runs = {f"{n}": {"views": n} for n in views}
    chart = _training_chart(problem, runs, f"{OptimizeSettings().views}", effort, on_stage)
    return replace(chart, name="views", title="Views per step, for as many views in all")


def optimizer_chart(problem: Problem, sizes: Mapping[str, Sequence[float]], effort: Effort, on_stage: OnStage) -> Chart:
    """Optimizer and step size against the loss of what has been trained on as many views."""
    runs = {f"{kind} {size:g}": {"optimizer": kind, "step_size": size} for kind in sizes for size in sizes[kind]}
    usual = OptimizeSettings()
    chart = _training_chart(problem, runs, f"{usual.optimizer} {Patch.STEP_SIZE:g}", effort, on_stage)
    return replace(chart, name="optimizer", title="Optimizer and step size")


def _training_chart(
    problem: Problem, runs: Mapping[str, Mapping], usual: str, effort: Effort, on_stage: OnStage
) -> Chart:
    """Each run's settings, after half of the views and after all; `usual` is the default among them."""
    settings = {name: OptimizeSettings().model_copy(update=dict(run)) for name, run in runs.items()}
    # the last steps of other numbers would not have been selected from
    ends = {
        name: [n for n in (effort.views // 2, effort.views) if selects(one, n // one.views)]
        for name, one in settings.items()
    }
    losses: list[list[float]] = []
    for seed in range(effort.seeds):
        losses.append([])
        for i, (name, one) in enumerate(settings.items()):
            numbers = tuple(end // one.views for end in ends[name])
            how = one.views, one.optimizer, one.step_size or Patch.STEP_SIZE
            losses[seed] += trained_losses(problem, effort.judged, seed, *how, numbers)
            on_stage("training", seed * len(runs) + i + 1, effort.seeds * len(runs))
    points: dict[int, list[Point]] = {}
    columns = [(name, end) for name in runs for end in ends[name]]
    costs = [float(seen(settings[name].views, end // settings[name].views)) for name, end in columns]
    default = columns.index((usual, effort.views))
    for i, (middle, interval) in enumerate(paired_means(np.array(losses))):
        (name, end), x = columns[i], costs[i]
        points.setdefault(end, []).append(Point(name, x, middle, (x, x), interval, i == default))
    pick, excess = checked_pick(np.array(losses), costs, default)
    series = [Series(f"trained on {end} views", tuple(some)) for end, some in sorted(points.items())]
    before = judge_of(problem, effort.judged).loss(start(problem).design)
    return Chart(
        "training",
        "",
        "views that the network sees, selection included",
        f"loss of the kept design on {effort.judged} new conditions ({effort.seeds} seeds, 95 %)",
        tuple(series),
        (
            f"the gray design before the first step: {before:.3f}",
            "intervals are for comparing settings: what all settings of a seed share is taken out",
            f"a selection set of {SELECT_VIEWS} views is seen every {SELECT_AFTER} training views",
            f"picked on seeds 0, 2, …: {columns[pick][0]}; the default's error on the others: {excess:+.1%}",
        ),
        one_front=True,
    )


def seen(views: int, steps_done: int) -> int:
    """Views that a network sees in so many steps, selection included."""
    settings = OptimizeSettings(views=views, steps=steps_done)
    return views * steps_done + SELECT_VIEWS * selections(settings)


@lru_cache(maxsize=512)
def trained_losses(
    problem: Problem, judged: int, seed: int, views: int, optimizer: str, step_size: float, numbers: tuple[int, ...]
) -> list[float]:
    """Losses on new conditions of what was trained for these numbers of steps; two charts share some of them."""
    settings = {"views": views, "optimizer": optimizer, "step_size": step_size, "steps": numbers[-1]}
    designs = trained(with_settings(problem, seed, **settings), numbers)
    return [judge_of(problem, judged).loss(design) for design in designs]


def trained(problem: Problem, numbers: Sequence[int]) -> list[Tensor]:
    """The best design, as printed, after each of these numbers of steps (rising)."""
    states: dict[int, State] = {step.state.number: step.state for step in steps(problem)}
    return [from_pixels(as_pixels(states[number].best)) for number in numbers]


class Judge:
    """Conditions of the evaluate stream, seen once and shaded anew for each design."""

    def __init__(self, problem: Problem, count: int):
        conditions = problem.scene.draw("evaluate", count)
        shown = problem.subject.shown(start(problem).design)
        self.problem = problem
        with torch.no_grad():
            self.pools: list[Views] = [
                problem.see(shown, conditions[i : i + CHUNK], problem.training_px) for i in range(0, count, CHUNK)
            ]

    def logits(self, design: Tensor) -> list[Tensor]:
        """N×K logits of each of the problem's networks."""
        with torch.no_grad():
            shown = self.problem.subject.shown(design)
            pictures = [expose(pool, shown) for pool in self.pools]
            return [torch.cat([one.logits(part) for part in pictures]) for one in self.problem.classifiers]

    def loss(self, design: Tensor) -> float:
        """Mean loss over networks and conditions."""
        goal = self.problem.scene.settings.target.goal
        pairs = zip(self.logits(design), self.problem.indices, strict=True)
        return float(np.mean([float(target_loss(logits, indices, goal).mean()) for logits, indices in pairs]))


@lru_cache(maxsize=4)
def judge_of(problem: Problem, count: int) -> Judge:
    """The same conditions for every design of a chart."""
    return Judge(problem, count)


# Sobol points against independent draws


def draws_chart(quick: bool, on_stage: OnStage) -> Chart:
    """How far the loss of n views lies from that of all views, by how their conditions were drawn."""
    counts, scrambles, single = (QUICK_SAMPLES, 10, 256) if quick else (SAMPLES, 40, 2048)
    world = set_world(40 if quick else 160, lambda stage, done, total: None)
    problem, shown = world.problem, world.shown()
    sobol = np.zeros((3, scrambles, counts[-1]))
    for seed in range(scrambles):
        sobol[:, seed] = outcomes(problem, shown, "select", counts[-1], seed)
        on_stage("Sobol", seed + 1, scrambles)
    alone = outcomes(problem, shown, "evaluate", single, 0)
    means = np.stack([sobol[:, :, :n].mean(2) for n in counts])  # C×3×S
    spread = means.std(2, ddof=1)
    by_chance = np.stack([alone.std(1, ddof=1) / np.sqrt(n) for n in counts])
    kinds = ("loss", "confidence", "rate")
    rows = tuple(
        (f"{n} views", *(f"{(by_chance[i, k] / spread[i, k]) ** 2:.1f}" for k in range(3)))
        for i, n in enumerate(counts)
    )
    sobol_points = [
        Point(f"{n}", n, spread[i, 0], (n, n), _spread_interval(spread[i, 0], scrambles), n == SELECT_VIEWS)
        for i, n in enumerate(counts)
    ]
    independent = [
        Point(f"{n}", n, by_chance[i, 0], (n, n), tuple(bound / np.sqrt(n) for bound in _bootstrapped(alone[0])))
        for i, n in enumerate(counts)
    ]
    return Chart(
        "draws",
        "How conditions are drawn",
        "views that the loss is estimated from",
        "standard deviation of the mean loss over draws (95 %)",
        (Series("Sobol points", tuple(sobol_points)), Series("independent", tuple(independent))),
        (
            f"Sobol: {scrambles} scrambles; independent: spread of {single} single views, over √n",
            "ringed: the selection set, which as training is drawn by Sobol points",
        ),
        tables=(Table(("as many independent views do the same", *kinds), rows),),
        one_front=True,
    )


def outcomes(problem: Problem, shown: Shown, stream: str, count: int, seed: int) -> np.ndarray:
    """3×N: loss, confidence and whether recognized, in views of these conditions."""
    (classifier,), (indices,), parts = problem.classifiers, problem.indices, []
    conditions = draw(problem.scene.settings, stream, count, seed)
    with torch.no_grad():
        for first in range(0, count, CHUNK):
            pictures = expose(problem.see(shown, conditions[first : first + CHUNK], problem.training_px), shown)
            logits = classifier.logits(pictures)
            loss = target_loss(logits, indices, problem.scene.settings.target.goal)
            found = (loss, classifier.confidence(logits, indices), classifier.recognized(logits, indices))
            parts.append(np.stack([part.double().numpy() for part in found]))
    return np.concatenate(parts, 1)


def _spread_interval(deviation: float, n: int) -> Interval:
    """χ² interval of a standard deviation of n values."""
    from scipy.stats import chi2

    low, high = chi2.ppf([(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], n - 1)
    return float(deviation * np.sqrt((n - 1) / high)), float(deviation * np.sqrt((n - 1) / low))


def _bootstrapped(values: np.ndarray) -> Interval:
    """Interval of a standard deviation of any values: losses are far from normal."""
    _, (low, high) = mean_interval((values - values.mean()) ** 2)
    return float(np.sqrt(low)), float(np.sqrt(high))


# Networks that a design is trained on, judged by one that it is not


def ensemble_chart(count: int, seeds: int, on_stage: OnStage) -> Chart:
    """One or two networks, judged by the third: time of training against its loss."""
    problem = _real_problem(NETWORKS)
    judge = Judge(problem, 64)
    teams = [team for size in (1, 2) for team in combinations(range(len(NETWORKS)), size)]
    seconds = timed({team: _one_step(problem, team) for team in teams}, 3)
    held_out = {team: np.zeros((seeds, len(NETWORKS) - len(team), 2)) for team in teams}
    for seed in range(seeds):
        for i, team in enumerate(teams):
            (design,) = trained(with_settings(_only(problem, team), seed, steps=count), [count])
            logits = judge.logits(design)
            for j, other in enumerate(k for k in range(len(NETWORKS)) if k not in team):
                indices = problem.indices[other]
                loss = target_loss(logits[other], indices, Goal.assist).mean()
                rate = problem.classifiers[other].recognized(logits[other], indices).double().mean()
                held_out[team][seed, j] = float(loss), float(rate)
            on_stage("ensembles", seed * len(teams) + i + 1, seeds * len(teams))
    return _ensemble_chart(teams, seconds, held_out, count, judge.logits(start(problem).design), problem)


def _ensemble_chart(teams, seconds, held_out, count: int, before: list[Tensor], problem: Problem) -> Chart:
    others = {o: [team for team in teams if o not in team] for o in range(len(NETWORKS))}
    cheapest = min(float(np.median(values)) for values in seconds.values())
    series, rows = [], []
    for other, able in others.items():
        at = [sorted(set(range(len(NETWORKS))) - set(team)).index(other) for team in able]
        losses = np.stack([held_out[team][:, j, 0] for team, j in zip(able, at, strict=True)], 1)
        points = []
        for team, j, (loss, interval) in zip(able, at, paired_means(losses), strict=True):
            middle, span = median_interval(seconds[team] / cheapest)
            name = " + ".join(NETWORKS[k].split("_")[-2] if "v1" in NETWORKS[k] else "squeeze" for k in team)
            points.append(Point(name, middle, loss, span, interval))
            rows.append((f"{NETWORKS[other]} after {name}", f"{held_out[team][:, j, 1].mean():.2f}"))
        rate = problem.classifiers[other].recognized(before[other], problem.indices[other]).double().mean()
        rows.append((f"{NETWORKS[other]}, gray design", f"{float(rate):.2f}"))
        series.append(Series(f"judged by {NETWORKS[other]}", tuple(points)))
    return Chart(
        "ensemble",
        "Networks that a design is trained on",
        "time of a step, relative to the smallest network alone",
        f"loss of a network that it was not trained on (64 conditions, {count} steps, 95 % over seeds)",
        tuple(series),
        (
            f"{ENSEMBLE_MESH}, target {ENSEMBLE_LABEL}; 0.25 and 0.75 are MobileNet v1 of 128 and 192 px",
            "no ring: a scene names its networks, there is no default",
        ),
        tables=(Table(("recognized by", "rate"), tuple(rows)),),
    )


def _networks() -> Path | None:
    """The folder of real networks, if they are all there."""
    folder = Path(os.environ.get("PATCHPROOF_DATA", "-"))
    files = [folder / "meshes" / ENSEMBLE_MESH, *(folder / "models" / f"{name}.pt2" for name in NETWORKS)]
    return folder if all(path.is_file() for path in files) else None


def _real_problem(names: Sequence[str]) -> Problem:
    folder = _networks()
    tables = {
        "object": {"mesh": str(folder / "meshes" / ENSEMBLE_MESH), "length_mm": 480},
        "patch": {"width_mm": 110, "height_mm": 110},
        "target": {"label": ENSEMBLE_LABEL, "models": [f"file:{folder / 'models' / name}.pt2" for name in names]},
    }
    return set_problem(build_scene(SceneSettings.model_validate(tables), Path()))


def _only(problem: Problem, team: Sequence[int]) -> Problem:
    """The problem before some of its networks; views and design keep the size that all of them need."""
    classifiers, indices = (tuple(some[i] for i in team) for some in (problem.classifiers, problem.indices))
    return replace(problem, classifiers=classifiers, indices=indices)


def _one_step(problem: Problem, team: Sequence[int]):
    """A call that takes one step without selection's."""
    loop = steps(with_settings(_only(problem, team), steps=SELECT_AFTER))
    return lambda: next(loop)
