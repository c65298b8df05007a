"""Compare our designs with those of other tools and recipes: same piece, as many passes, same views.

In: scene files with meshes, networks, seeds; for the benchmark, the demo's scene. A cell is one of each: every method
makes a design for the scene's piece (`bench.methods`), and all are shown under conditions of the evaluate stream,
beside the bare object and gray. Out: rates, gains over the best control, ours minus each, passes, seconds, pictures.

A gain counts in the direction of the goal: with `deceive`, a falling rate. Unlike other studies, this one has tables
with times, which differ from run to run: seconds of one core, without loading the network.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field

from patchlab.bench.chart import Chart, ChartPoint
from patchlab.bench.measure import time_call
from patchlab.bench.methods import METHODS, load_art
from patchlab.paper.patch3d import patch_cells
from patchlab.study import grid
from patchlab.study.estimates import cluster_mean, median, paired_means
from patchlab.study.figures import contact_sheet, enlarge_design, photographs, picture_sheet
from patchlab.study.record import gain_of, hardest_control, rate_of, to_record
from patchlab.study.study import Cell, Result, Study
from patchproof.app.demo import demo_scene
from patchproof.base.errors import Refused
from patchproof.base.progress import Progress
from patchproof.base.workers import use_threads
from patchproof.optimizer.pixels import from_pixels
from patchproof.optimizer.promise import pictures_with_controls
from patchproof.optimizer.responses import responses
from patchproof.report.images import png
from patchproof.report.tables import Drawing, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Peer = Literal["sign", "flat", "art"]
PEERS: tuple[Peer, ...] = ("sign", "flat", "art")
PEERS_WITHOUT_EXTRA: tuple[Peer, ...] = ("sign", "flat")  # those that need no extra
CONTROLS = ("bare", "gray")
_TILE_PX = 192
QUICK_STEPS, QUICK_VIEWS = 30, 40


class PeersSettings(grid.GridSettings):
    """Scenes, networks, seeds and peers; each scene's [optimize] sets the passes of every method."""

    seeds: grid.Seeds = (0, 1, 2)  # of the scenes' draws
    # Compared with ours: signed steps; a patch pasted flat; that of ART (`pip install "patchproof[lab]"`).
    peers: Annotated[tuple[Peer, ...], Field(min_length=1)] = PEERS
    n: grid.PositiveInt = 400  # conditions per cell, of the evaluate stream

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of our method and its peers."""
        return ("ours", *self.peers)


def cells(settings: PeersSettings, base: Path) -> list[Cell]:
    """A cell per scene, network and seed."""
    if "art" in settings.peers:
        load_art()  # a refusal comes before hours of other methods
    return patch_cells(settings, base)


def run(settings: PeersSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Make every method's design for one object, network and seed, and show them in the same views."""
    problem = grid.problem_of(base, cell.values)
    made = {name: time_call(partial(METHODS[name], problem)) for name in settings.methods}
    pixels = {name: design.pixels for name, (design, _) in made.items()}
    controls = pictures_with_controls(problem, pixels["ours"], CONTROLS)
    things = {name: controls[name] for name in CONTROLS}
    things |= {name: problem.subject.appearance(from_pixels(each, problem.device)) for name, each in pixels.items()}
    conditions = problem.scene.draw("evaluate", settings.n)
    view = conditions[problem.scene.facing(conditions)][:1]
    on_object = [photographs(problem, things[name], view, _TILE_PX)[0] for name in pixels]
    return {
        **to_record(responses(problem, things, conditions)),
        "passes": {name: design.passes for name, (design, _) in made.items()},
        "seconds": {name: milliseconds / 1000 for name, (_, milliseconds) in made.items()},
        f"{cell.name}.png": contact_sheet([[enlarge_design(each, _TILE_PX) for each in pixels.values()], on_object]),
        **{f"{cell.name}-{name}.png": png(each) for name, each in pixels.items()},
    }


def tables(settings: PeersSettings, results: Sequence[Result]) -> list[Table]:
    """Tables of pooled results, and of every cell."""
    return [_pooled(settings, results), _by_cell(settings, results)]


def _pooled(settings: PeersSettings, results: Sequence[Result]) -> Table:
    rows = []
    for name in settings.methods:
        leads = [gain_of(result, "ours", name) for result in results]
        by_pair = [
            float(np.mean([gain_of(result, "ours", name) for result in group]))
            for group in grid.group_by(results, grid.by_values("name", "network")).values()
        ]
        rows.append(
            (
                name,
                float(np.mean([rate_of(result, name) for result in results])),
                cluster_mean([gain_of(result, name, hardest_control(result, CONTROLS)) for result in results]),
                *((None, None) if name == "ours" else (cluster_mean(leads), cluster_mean(by_pair))),
                round(float(np.mean([result.answers["passes"][name] for result in results]))),
                float(np.mean([result.answers["seconds"][name] for result in results])),
            )
        )
    about = (
        f"Rates in {settings.n} unseen views per cell, the same for all; differences are paired and count in the "
        "direction of the goal. Intervals are bootstraps over cells (object, network and seed) and, in the column by "
        "pair, over objects before networks with all their seeds: seeds of a pair are alike. n counts them; fewer "
        "than 5 get none. A pass is a picture that the network sees in training or selection; seconds are of one core."
    )
    head = ("method", "rate", "gain over best control", "ours minus it", "by pair", "passes", "seconds")
    return Table("pooled", "Ours and its peers, for as many passes", head, tuple(rows), about)


def _by_cell(settings: PeersSettings, results: Sequence[Result]) -> Table:
    names = (*CONTROLS, *settings.methods)
    rows = tuple((*grid.cell_key(result), *(rate_of(result, name) for name in names)) for result in results)
    return Table("cells", "Rates, cell by cell", ("object", "network", "seed", *names), rows)


def figures(settings: PeersSettings, results: Sequence[Result]) -> list[Drawing]:
    """A scatter plot of ours against each peer, and pictures of designs (first seeds)."""
    firsts = [group[0] for group in grid.group_by(results, grid.by_values("name", "network")).values()]
    scatter = partial(_scatter, settings, results)
    return [
        Drawing("scatter", "Ours against each peer, a point per cell", scatter, (4.4, 4.2)),
        picture_sheet(
            "designs",
            "Designs and how they look on the object: first seed of each object and network",
            [(first.cell.name, first.file(f"{first.cell.name}.png")) for first in firsts],
            (1.7 * len(settings.methods), 3.6 * len(firsts) + 0.3),
            "Above the design's pixels, below the piece in one unseen view.",
            columns=settings.methods,
        ),
    ]


def _scatter(settings: PeersSettings, results: Sequence[Result], figure: "Figure") -> None:
    axes = figure.add_subplot()
    for peer in settings.peers:
        theirs, ours = ([rate_of(result, name) for result in results] for name in (peer, "ours"))
        axes.plot(theirs, ours, "o", label=peer, alpha=0.7)
    axes.plot([0, 1], [0, 1], color="#8a8f98", linewidth=0.8)
    axes.set_xlabel("rate of the peer")
    axes.set_ylabel("rate of ours")
    axes.legend()


STUDY = Study("peers", PeersSettings, cells, run, tables, figures)


# The benchmark: this study on the demo's scene


def charts(quick: bool, progress: Progress) -> Iterator[Chart]:
    """Chart every method's time against its error on the demo's scene; ART only where it is installed."""
    with TemporaryDirectory() as folder:
        base, peers = Path(folder), PEERS if _has_art() else PEERS_WITHOUT_EXTRA
        seeds, n = (range(2), QUICK_VIEWS) if quick else (range(5), 400)
        settings = PeersSettings(scenes=(demo_scene(base).name,), seeds=tuple(seeds), peers=peers, n=n)
        results = []
        for cell in cells(settings, base):
            if quick:
                cell = replace(cell, values=grid.with_changes(dict(cell.values), {"optimize": {"steps": QUICK_STEPS}}))
            with use_threads(1):
                results.append(Result(cell, run(settings, base, cell), base))
            progress("cells", len(results), len(settings.seeds))
        yield peers_chart(settings, results)


def peers_chart(settings: PeersSettings, results: Sequence[Result]) -> Chart:
    """Seconds of each method over ours, against the share of unseen views in which its design fails."""
    losses = np.array([[1 - rate_of(result, name) for name in settings.methods] for result in results])
    points = []
    for name, loss in zip(settings.methods, paired_means(losses), strict=True):
        seconds = [result.answers["seconds"] for result in results]
        cost = median([each[name] / each["ours"] for each in seconds])
        points.append(ChartPoint(name, cost, loss, name == "ours"))
    missing = "" if "art" in settings.peers else ' ART is not installed (`pip install "patchproof[lab]"`): left out.'
    return Chart(
        name="demo",
        title="Ours and its peers on the demo's scene, for as many passes",
        cost="time of one core, ÷ that of ours",
        error=f"share of {settings.n} unseen views that are not recognized",
        series={"methods": points},
        about=f"{len(results)} seeds. Intervals are for comparing methods: what all share of a seed is taken out. More "
        f"objects and networks: `patchlab study peers --config FILE.toml`.{missing}",
        tables=tuple(tables(settings, results)),
    )


def _has_art() -> bool:
    try:
        load_art()
    except Refused:
        return False
    return True
