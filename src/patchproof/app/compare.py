"""Compare the designs of several runs of one scene under the same conditions, and the best two under fresh ones.

In: finished runs, optimized here or imported, whose scenes differ in [patch], [optimize] and [sheet] at most. Out:
DIR/designs.html with each design's picture, rate, gain over its best control and difference to the best design, paired
on the same views; DIR/designs.json, and a CSV of each table.

The best of several rates is biased upward on the views that selected it (the winner's curse), and so is its lead. The
two best are therefore evaluated under as many fresh conditions: those figures are to be quoted. Left out on purpose:
corrections of the other rows for the number of designs; they only serve the selection.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from patchproof.base.errors import Refused
from patchproof.base.goal import Goal
from patchproof.base.intervals import estimate_difference, rate
from patchproof.base.notebook import draw_rates
from patchproof.base.output import new_folder
from patchproof.base.progress import Compute, Progress, no_progress
from patchproof.base.validation import expand_path, summarize_names
from patchproof.classifier.network import Classifier
from patchproof.optimizer.evaluate import run_responses
from patchproof.optimizer.promise import CONTROLS, PROMISE_VIEWS
from patchproof.optimizer.responses import Responses
from patchproof.optimizer.run import Run, load_run
from patchproof.report.tables import Drawing, Results, Table, Value, write_results
from patchproof.scene.interface import Scene, require_piece
from patchproof.scene.mesh_scene import MeshScene

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COMPARISON_FILES = ("designs.html", "designs.json", "designs_*.csv", "designs_*.png")
_HEAD = ("design", "network", "rate", "best control", "minus it", "minus the best design")
AnswersByKind = Mapping[str, Responses]  # to a design and each of its controls


def compare(
    runs: Sequence[str | Path | Run],
    out: str | Path,
    *,
    models: Sequence[str | Classifier] | None = None,
    n: int = PROMISE_VIEWS,
    seed: int | None = None,
    trust: bool = False,
    compute: Compute = Compute(),
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> Results:
    """Compare the designs of several runs under the same conditions, and the two best of them under as many fresh ones.

    Args:
        runs: finished runs of one scene, or their folders, two or more.
        out: folder for designs.html, designs.json and the tables.
        models, trust, compute, overwrite: as in `evaluate`.
        n: conditions for each comparison.
        seed: of the conditions, in place of the first run's.
        progress: called with a design's name as the stage (conditions), for the two best once more.

    Raises:
        Refused: for runs of different scenes.
    """
    compute, loaded = compute.without("compare", cluster=True), _load_runs(runs, models is None, trust)
    scene = next(iter(loaded.values())).scene
    target = scene.settings.target
    names = tuple(each.name if isinstance(each, Classifier) else each for each in models or target.models)
    seed = scene.seed if seed is None else seed
    with new_folder(out, COMPARISON_FILES, overwrite, runs) as folder:

        def ask(name: str, start: int) -> AnswersByKind:
            run, advance = loaded[name], partial(progress, name)
            return run_responses(run, run.scene.draw("evaluate", n, seed, start), models, compute, advance)[1]

        by_design = {name: ask(name, 0) for name in loaded}
        ours = ((name, each["design"]) for name, each in by_design.items())
        means = {name: (each.recognized[0].mean(), each.confidence[0].mean()) for name, each in ours}
        order = sorted(loaded, key=means.__getitem__)[:: -target.goal.sign]
        by_design = {name: by_design[name] for name in order}
        fresh = {name: ask(name, n) for name in order[:2]}
        results = Results(
            kind="comparison",
            name="designs",
            about=f'{len(loaded)} designs for {target.goal} "{target.label}", under the same conditions.',
            extent=f"{len(loaded)} designs, {n} conditions, and {n} more for the best two; seed {seed}",
            settings=scene.settings.model_dump(mode="json"),
            tables=_tables(target.goal, names, by_design, fresh),
            figures=[_drawing({name: loaded[name] for name in order}, by_design)],
            failed={},
        )
        write_results(folder, results)
    return results


def _load_runs(runs: Sequence[str | Path | Run], with_networks: bool, trust: bool) -> dict[str, Run]:
    """Load runs by their folders' names, or by full paths if two names are equal; refused if their views differ."""
    paths = [Path(run).resolve() for run in runs]
    if len(set(paths)) < max(len(paths), 2):
        got = summarize_names([str(run) for run in runs]) or "none"
        raise Refused("two runs or more to compare, each once", got, "name them")
    ambiguous = len({path.name for path in paths}) < len(paths)
    loaded = {str(path) if ambiguous else path.name: load_run(path, trust) for path in paths}
    first, *others = loaded
    for name in others:
        if _views_of(loaded[name].scene, with_networks) != _views_of(loaded[first].scene, with_networks):
            do = "compare runs whose scenes differ in [patch], [optimize] and [sheet] at most"
            raise Refused(f"runs with the same views as {first}", f"{name} with other settings of its views", do)
    return loaded


def _views_of(scene: Scene, with_networks: bool) -> tuple[Any, ...]:
    """Everything except the piece that views of the scene and the networks' answers depend on; files by content."""
    require_piece(scene)
    settings = scene.settings.model_dump(mode="json", exclude={"patch", "optimize", "sheet"})
    names = settings["target"].pop("models")
    networks = [expand_path(name, scene.base.resolve()) for name in names] if with_networks else []
    files = {key: sha256 for key, sha256 in scene.inputs.items() if not key.startswith("patch.")}
    if isinstance(scene, MeshScene):  # a side and the patch in its middle are one front
        settings["view"]["front"] = np.round([scene.frame.normal, scene.frame.up], 6).tolist()
    return settings, networks, files, scene.mesh_glb


def _tables(
    goal: Goal, networks: Sequence[str], by_design: Mapping[str, AnswersByKind], fresh: Mapping[str, AnswersByKind]
) -> list[Table]:
    """The best two under fresh conditions, and all designs; the first is the best."""

    def rows(answers: Mapping[str, AnswersByKind], names: Sequence[str]) -> tuple[tuple[Value, ...], ...]:
        return tuple(_row(goal, answers, name, network, i) for name in answers for i, network in enumerate(names))

    title = "The best two, under conditions that had no say in choosing them: the figures to quote"
    about = "Differences are paired. That the best by the first network was chosen here flatters its rate and its lead."
    return [
        Table("fresh", title, _HEAD, rows(fresh, networks[:1])),
        Table("designs", "All designs, under the same conditions", _HEAD, rows(by_design, networks), about),
    ]


def _row(goal: Goal, answers: Mapping[str, AnswersByKind], name: str, network: str, i: int) -> tuple[Value, ...]:
    hits = {kind: answer.recognized[i].tolist() for kind, answer in answers[name].items()}
    control, best = max(CONTROLS, key=lambda kind: goal.sign * sum(hits[kind])), next(iter(answers))
    lead = None if name == best else estimate_difference(hits["design"], answers[best]["design"].recognized[i].tolist())
    return name, network, rate(hits["design"]), control, estimate_difference(hits["design"], hits[control]), lead


def _drawing(runs: Mapping[str, Run], answers: Mapping[str, AnswersByKind]) -> Drawing:
    """Draw each design's picture beside its rate and its controls' rates."""

    def draw(figure: "Figure") -> None:
        grid = figure.subplots(len(runs), 2, squeeze=False, width_ratios=(1, 3), sharex="col")
        for axes, (name, run) in zip(grid, runs.items(), strict=True):
            estimates = {kind: rate(answer.recognized[0].tolist()) for kind, answer in answers[name].items()}
            draw_rates(axes, {kind: (e.value, (e.low, e.high)) for kind, e in estimates.items() if e}, run.design)
            axes[1].set_title(name, fontsize=9, loc="left")

    about = "By the first network, under the conditions that all designs share."
    return Drawing("designs", "The designs, best first", draw, (4.8, 1.3 * len(runs) + 0.4), about)
