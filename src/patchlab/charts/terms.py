"""Chart the worth of each term of the model: its share of a step's time, and what a promise without it is off by.

In: scenes with one network each. A cell is one pair of object and network: a design is trained in the whole world and
shown, in sessions as a promise has them, in the world and in the world without each term that is on. Out: by term, over
pairs, points of rate that a promise without it is off by, and processor time of a step with and without it, in turn.
Terms that went come from the stored study of their best scenes. Left out on purpose: designs that were trained without
a term, which differ by chance more than by the term (`patchlab study ablation`).
"""

import csv
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from patchlab.charts.drawing import label_points, rows_of, value_and_ends
from patchlab.study import grid
from patchlab.study.estimates import cluster_mean, mean, median
from patchlab.study.measure import call_in_turn, time_call
from patchlab.study.record import hits_text, parse_hits
from patchlab.study.study import Cell, Result, Study
from patchlab.study.trained_designs import best_design
from patchlab.validation.ablation import simplify_problem
from patchproof.app.plan.errors import Setup, scene_terms
from patchproof.base.sessions import count_by_session, rate_posterior
from patchproof.optimizer.problem import Problem
from patchproof.optimizer.promise import VIEWS_PER_SESSION
from patchproof.optimizer.responses import responses
from patchproof.optimizer.subject import from_pixels
from patchproof.render.photograph import expose
from patchproof.report.tables import Drawing, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_GONE = Path(__file__).parents[1] / "results/ablation/chances/chances_missed.csv"
_STAYED = ("motion blur",)  # of the terms there


class TermsSettings(grid.GridSettings):
    """Pairs, and the size of everything that is tried on them."""

    steps: grid.PositiveInt = 240  # of each design
    n: grid.PositiveInt = 400  # views of a promise
    rounds: grid.PositiveInt = 24  # of a step with and without each term


def cells(settings: TermsSettings, base: Path) -> list[Cell]:
    """A cell per pair of scene and network."""
    changes = {"optimize": {"steps": settings.steps}}
    return grid.grid_cells(settings, base, lambda values: ((grid.with_changes(values, changes), ()),))


def run(settings: TermsSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Hits in the whole world and without each term, and ratios of a step's time without it to one with it."""
    problem = grid.problem_of(base, cell.values)
    design = from_pixels(best_design(problem), problem.device)
    conditions = problem.scene.draw("promise", settings.n, per_session=VIEWS_PER_SESSION)
    setup = Setup(problem.stage, problem.subject.appearance(design), problem.scene.draw("train", 64))
    worlds = {"": problem}
    for term in scene_terms(problem, design, None):
        if term.modeled and term.key and (not term.needs_whole_photo or term.name != "JPEG"):
            if term.change(setup) is not None:
                worlds[term.name] = simplify_problem(problem, term.name)
    hits = {name: _hits(world, design, conditions) for name, world in worlds.items()}
    views = problem.scene.draw("train", 4)
    steps = {name: partial(time_call, partial(_step, world, design, views)) for name, world in worlds.items()}
    timed = call_in_turn(steps, settings.rounds)
    whole = timed.pop("")
    ratios = {name: [w[1] / a[1] for w, a in zip(each, whole, strict=True)] for name, each in timed.items()}
    return {"hits": hits, "ratios": ratios}


def _hits(world: Problem, design: torch.Tensor, conditions) -> str:
    shown = world.subject.appearance(design)
    return hits_text(responses(world, {"design": shown}, conditions)["design"].recognized[0])


def _step(world: Problem, design: torch.Tensor, views) -> None:
    leaf, (network,), (indices,) = design.clone().requires_grad_(), world.classifiers, world.indices
    shown = world.subject.appearance(leaf)
    logits = network.logits(expose(world.see(shown, views, world.training_px), shown))
    torch.autograd.grad(world.losses(network, logits, indices).mean(), leaf)


def tables(settings: TermsSettings, results: Sequence[Result]) -> tuple[Table, ...]:
    """A table of terms, of those that went, and of every pair."""
    every = []
    for result in results:
        whole = np.mean(parse_hits(result.answers["hits"][""]))
        for name, ratios in result.answers["ratios"].items():
            off = float(whole - np.mean(parse_hits(result.answers["hits"][name])))
            every.append(
                (name, *(result.cell.values[key] for key in ("name", "network")), off, 1 - median(ratios).value)
            )
    rows = []
    for name in dict.fromkeys(row[0] for row in every):
        some = [row for row in every if row[0] == name]
        off, cost = ([row[i] for row in some] for i in (3, 4))
        rows.append(
            (name, len(some), cluster_mean(np.abs(off).tolist()), mean(off), max(off, key=abs), cluster_mean(cost))
        )
    rows.sort(key=lambda row: -value_and_ends(row[2])[0])
    half = [_half_width(result) for result in results]
    about = (
        f"{len(results)} pairs of object and network, {settings.n} views in sessions of {VIEWS_PER_SESSION}, the same "
        f"design; a promise's own interval reaches {100 * float(np.mean(half)):.1f} points to either side in the mean"
    )
    head = ("term", "pairs", "off by", "with sign", "most", "share of a step")
    pairs = Table("pairs", "Every pair", ("term", "scene", "network", "off by", "share of a step"), tuple(every))
    gone = Table("gone", "Terms that went, in their best scenes", ("term", "off by", "most"), tuple(_gone_terms()))
    return Table("terms", "What a promise is off by without a term", head, tuple(rows), about), gone, pairs


def _half_width(result: Result) -> float:
    hits = parse_hits(result.answers["hits"][""])
    low, high = rate_posterior(*count_by_session(hits, VIEWS_PER_SESSION)).rate_interval
    return (high - low) / 2


def _gone_terms() -> list[tuple[str, float, float]]:
    with _GONE.open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if " + " not in row["left out"] and row["left out"] not in _STAYED]
    return [(row["left out"], float(row["rate"]), float(row["largest"])) for row in rows]


def figures(settings: TermsSettings, results: Sequence[Result]) -> tuple[Drawing, ...]:
    """The chart: a dot a term, and a line at what a promise's own interval cannot tell."""
    terms, gone, _ = tables(settings, results)
    line = 100 * float(np.mean([_half_width(result) for result in results]))
    return (Drawing("chart", "What each term is worth", partial(_draw, terms, gone, line), (8.3, 4.6), terms.about),)


def _draw(terms: Table, gone: Table, line: float, figure: "Figure") -> None:
    from matplotlib.ticker import FixedLocator, FuncFormatter

    axes, points = figure.add_subplot(), []
    for name, _, off, _, most, cost in rows_of(terms):
        x, (y, low, high) = 100 * value_and_ends(cost)[0], (100 * v for v in value_and_ends(off))
        color = "#0072b2" if 100 * abs(most) > line else "#d55e00"
        axes.errorbar(x, y, [[y - low], [high - y]], fmt="o", color=color, ms=6, elinewidth=1, capsize=2)
        axes.plot(x, 100 * abs(most), "_", color=color, ms=11)
        points.append((x, y, name, color))
    axes.set_yscale("symlog", linthresh=1)
    axes.yaxis.set_major_locator(FixedLocator([0, 0.5, 1, 2, 5, 10, 20, 50]))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, position: f"{value:g}"))
    axes.axhline(line, color="0.25", lw=1.2, ls=":")
    axes.annotate(
        "a promise's own interval", (1, line), xycoords=("axes fraction", "data"), ha="right", va="bottom", fontsize=9
    )
    went = "; ".join(f"{name} {100 * abs(rate):.1f}" for name, rate, _ in rows_of(gone))
    axes.set(xlabel="share of a step's time, %", ylabel="a promise without it is off by, points")
    title = "Dot: mean over pairs; dash: the largest. Blue: beyond a promise's own interval in some pair.\n"
    axes.set_title(f"{title}Gone (points in their best scenes): {went}", fontsize=9, loc="left")
    label_points(figure, axes, points)


STUDY = Study("terms", TermsSettings, cells, run, tables, figures)
