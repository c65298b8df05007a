"""Train designs on each network and on ensembles, and test them on every network beside the original object.

In: scenes, ways (full texture, masked, many or few signed steps, patches, ...), networks and seeds. Out: the matrix of
rates and confidences with intervals, each beside the original object's on the same conditions; gains of networks that a
design was not trained on; three fixed views in changed light; heat maps and contact sheets; each design as a GLB.
Where no gain is shown, its interval stands in the table. If networks have families, ensembles leave out whole families,
and another table has the gains from family to family.

Source: Pestana et al., algorithm "Full Texture" and table "Transferability". Their ε may be the signed step, here
`optimize.step_size`, or a ball around the start, `patch.epsilon`. Intervals are over conditions, for the designs that
were trained: another seed's design may do better or worse. Only intervals over objects take one figure per object and
seed.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field, model_validator

from patchlab.study import trained_designs
from patchlab.study.estimates import mean
from patchlab.study.figures import number_grid, picture_sheet
from patchlab.study.grid import Names, PositiveInt, by_values, group_by, short_name
from patchlab.study.record import Record, to_record
from patchlab.study.study import Cell, Result, Study
from patchlab.study.trained_designs import ORIGINAL, NamePart, gain_word, views_from_sides, views_in_drawn_light
from patchproof.base.intervals import rate
from patchproof.optimizer.promise import pictures_with_controls
from patchproof.optimizer.responses import responses
from patchproof.render.photograph import Appearance
from patchproof.report.tables import Drawing, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_ALL_ROW, _WITHOUT_PREFIX = "all", "without_"
_SHEET_PX = 224


class TransferSettings(trained_designs.TrainedSettings):
    """Settings of a study of trained designs with ensembles and families of networks."""

    ensembles: bool = True  # also train on all networks but one, each in turn, and on all
    # By name: networks of a family; each of `networks` is in one. Ensembles leave out whole families. {}: every network
    # is a family.
    families: dict[NamePart, Names] = Field({})
    lights: PositiveInt = 20  # lights in each of three fixed views
    vertex_colors: tuple[NamePart, ...] = ()  # ways whose design is the colors of vertices; faces mask the vertices

    @model_validator(mode="after")
    def _know_every_family(self):
        members = [name for family in self.families.values() for name in family]
        if self.families and sorted(members) != sorted(self.networks):
            raise ValueError("takes families in which each of networks is once, and no other network")
        if unknown := set(self.vertex_colors) - set(self.ways):
            raise ValueError(f"takes vertex_colors among ways; {', '.join(sorted(unknown))} is none")
        return self

    def family_of(self, network: str) -> str:
        """The family of a network."""
        return next((name for name, family in self.families.items() if network in family), short_name(network))


def cells(settings: TransferSettings, base: Path) -> list[Cell]:
    """A cell per scene, way and seed for the original and for every training set."""

    def rows(networks: Sequence[str]) -> dict[str, Sequence[str]]:
        ensembles: dict[str, Sequence[str]] = {}
        if settings.ensembles and len(networks) > 1:
            for family in dict.fromkeys(map(settings.family_of, networks)):
                rest = [name for name in networks if settings.family_of(name) != family]
                if len(rest) > 1:  # a single network is a row already
                    ensembles[_WITHOUT_PREFIX + family] = rest
            ensembles[_ALL_ROW] = networks
        return {ORIGINAL: (), **trained_designs.single_network_rows(networks), **ensembles}

    return trained_designs.trained_cells(settings, base, rows)


def run(settings: TransferSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Train if the cell names training networks, then test on all."""
    problem = trained_designs.trained_problem(settings, base, cell)
    if cell.values["way"] in settings.vertex_colors:
        from patchlab.paper.vertex_colors import vertex_problem

        problem = vertex_problem(problem)
    things: dict[str, Appearance] = {"design": None}
    design = None
    if cell.values["trained"]:
        design = trained_designs.best_design(trained_designs.with_trainers(problem, cell))
        things = pictures_with_controls(problem, design, ())
    sheet = views_from_sides(problem, 3), _SHEET_PX
    answers = trained_designs.answers_and_files(problem, cell.name, things, settings.n, sheet, design)
    if problem.scene.HAS_OBJECT:
        fixed = views_in_drawn_light(problem, settings.lights)
        answers["views"] = to_record(responses(problem, things, fixed))
        answers["azimuths"] = fixed.pose.azimuth_deg[:: settings.lights].tolist()
    return answers


def tables(settings: TransferSettings, results: Sequence[Result]) -> list[Table]:
    """Tables: the matrix, gains over objects, networks left out, and fixed views."""
    rows = _rows(results)
    left_out = _left_out_tables(settings, results, rows)
    return [_matrix(settings, rows), *_object_tables(settings, results), *left_out, *_view_tables(settings, rows)]


ResultsByRow = Mapping[tuple, Mapping[str, Sequence[Result]]]  # results by (scene, way), then by row


def _rows(results: Sequence[Result]) -> ResultsByRow:
    groups = group_by(results, by_values("name", "way"))
    return {key: group_by(group, lambda result: result.cell.values["row"]) for key, group in groups.items()}


def _matrix(settings: TransferSettings, groups: ResultsByRow) -> Table:
    rows = []
    for key, by_row in groups.items():
        original = Record(by_row.get(ORIGINAL, ()), "design")
        for row, of_row in by_row.items():
            record = Record(of_row, "design")
            for network in trained_designs.tested_networks(of_row):
                (level, sure), (gain, surer) = record.level(network), record.gain(original, network)
                trained = network in of_row[0].cell.values["trained"]
                start = (*key, row, short_name(network))
                if row == ORIGINAL:
                    rows.append((*start, "", level, None, "", sure, None))
                else:
                    rows.append((*start, "yes" if trained else "no", level, gain, gain_word(gain), sure, surer))
    head = ("scene", "way", "trained on", "tested on", "seen", "rate", "gain in rate", "shows")
    about = (
        f"Rates and mean confidences of the target over {settings.n} unseen conditions per seed"
        f" ({len(settings.seeds)} of them); gains are over the original on the same conditions, paired."
    )
    head = (*head, "confidence", "gain in confidence")
    return Table("matrix", "Trained on one, tested on another", head, tuple(rows), about)


def _object_tables(settings: TransferSettings, results: Sequence[Result]) -> list[Table]:

    def family_of_row(result: Result) -> str:
        trained = result.cell.values["trained"]
        return settings.family_of(trained[0]) if len(trained) == 1 else result.cell.values["row"]

    title = "Gains over objects"
    if len({(result.cell.values["name"], result.cell.values["seed"]) for result in results}) < 2:
        return []
    tables = [_gain_table(results, "objects", title, lambda result: result.cell.values["row"], short_name)]
    if settings.families:
        tables.append(_gain_table(results, "families", f"{title}, by family", family_of_row, settings.family_of))
    return tables


def _gain_table(
    results: Sequence[Result], name: str, title: str, trainer: Callable[[Result], str], tester: Callable[[str], str]
) -> Table:
    """A table of gains from one figure per object and seed, the mean over rows and networks of one name."""
    group_of = by_values("way", "name", "seed")
    untrained = (result for result in results if not result.cell.values["trained"])
    originals = {group_of(result): Record([result], "design") for result in untrained}
    figures: dict[tuple, dict[tuple, list[tuple[float, float]]]] = {}
    for result, network in product(results, trained_designs.tested_networks(results)):
        trained, group = result.cell.values["trained"], group_of(result)
        if trained and group in originals:
            start = (group[0], trainer(result), tester(network), "yes" if network in trained else "no")
            before, after = (np.mean(of.hits(network)) for of in (originals[group], Record([result], "design")))
            figures.setdefault(start, {}).setdefault(group, []).append((float(before), float(after)))
    rows = []
    for start, by_group in figures.items():
        before, after = np.array([np.mean(rates, 0) for rates in by_group.values()]).T
        gain = mean((after - before).tolist())
        rows.append((*start, float(before.mean()), float(after.mean()), gain, gain_word(gain)))
    head = ("way", "trained on", "tested on", "seen", "original", "rate", "gain in rate", "shows")
    about = "Means of one figure per object and seed, with Student's interval over these."
    return Table(name, title, head, tuple(rows), about)


def _left_out_tables(settings: TransferSettings, results: Sequence[Result], groups: ResultsByRow) -> list[Table]:
    rows = []
    for key, by_row in groups.items():
        original = Record(by_row.get(ORIGINAL, ()), "design")
        for network in trained_designs.tested_networks(results):
            if (without := by_row.get(_WITHOUT_PREFIX + settings.family_of(network))) is None:
                continue
            record = Record(without, "design")
            gain, confidence = record.gain(original, network)
            before, after = original.level(network)[0], record.level(network)[0]
            single = _rate_from_others(settings, by_row, network)
            rows.append((*key, short_name(network), before, after, gain, confidence, single, gain_word(gain)))
    head = ("scene", "way", "left out", "original", "ensemble of the others", "gain", "gain in confidence")
    head = (*head, "mean rate of one other", "shows")
    about = (
        "Each network judges a design that was trained on all others together, but for those of its family; beside it,"
        " those trained on one of these."
    )
    return [Table("left_out", "Networks left out", head, tuple(rows), about)] if rows else []


def _rate_from_others(settings: TransferSettings, by_row: Mapping[str, Sequence[Result]], network: str) -> float | None:
    family = settings.family_of(network)
    rates = [
        np.mean(Record(results, "design").hits(network))
        for results in by_row.values()
        if len(trained := results[0].cell.values["trained"]) == 1 and settings.family_of(trained[0]) != family
    ]
    return float(np.mean(rates)) if rates else None


def _view_tables(settings: TransferSettings, groups: ResultsByRow) -> list[Table]:
    rows = []
    for key, by_row in groups.items():
        for row, of_row in by_row.items():
            trained = of_row[0].cell.values["trained"]
            for network in trained_designs.tested_networks(of_row) if trained and "views" in of_row[0].answers else ():
                records = (Record(some, "design", "views") for some in (by_row.get(ORIGINAL, ()), of_row))
                before, after = (np.reshape(record.hits(network), (-1, 3, settings.lights)) for record in records)
                for i, azimuth in enumerate(of_row[0].answers["azimuths"]):
                    rates = (rate(hits[:, i].ravel().tolist()) for hits in (before, after))
                    rows.append((*key, row, short_name(network), ("no", "yes")[network in trained], azimuth, *rates))
    head = ("scene", "way", "trained on", "tested on", "seen", "azimuth (deg)", "original", "design")
    about = f"Three fixed views, {settings.lights} drawn lights, backgrounds and cameras each."
    return [Table("views", "Three views in changed light", head, tuple(rows), about)] if rows else []


def figures(settings: TransferSettings, results: Sequence[Result]) -> list[Drawing]:
    """A heat map and a contact sheet of designs per scene and way."""
    networks, drawings = trained_designs.tested_networks(results), []
    for (scene, way), by_row in _rows(results).items():
        drawings += [
            Drawing(
                f"heat_{scene}_{way}",
                f"Transfer: {scene}, {way}",
                lambda figure, by_row=by_row: _heat_map(figure, by_row, networks),
                (3.0 + 1.9 * len(networks), 2.1 + 0.33 * len(by_row)),
                "Rows: trained on. Columns: tested on. Below each rate, its gain over the original.",
            ),
            picture_sheet(
                f"sheet_{scene}_{way}",
                f"Designs: {scene}, {way}",
                [(row, of_row[0].file(f"{of_row[0].cell.name}.sheet.png")) for row, of_row in by_row.items()],
                (6.5, 1.75 * len(by_row)),
                "Three views in even light; the first seed.",
            ),
        ]
    return drawings


def _heat_map(figure: "Figure", by_row: Mapping[str, Sequence[Result]], networks: Sequence[str]) -> None:
    original = Record(by_row.get(ORIGINAL, ()), "design")
    records = {row: Record(of_row, "design") for row, of_row in by_row.items()}
    panels = figure.subplots(1, 2, sharey=True)
    for which, (axes, title) in enumerate(zip(panels, ("rate", "mean confidence"), strict=True)):
        values, texts = np.full((len(records), len(networks)), np.nan), []
        for y, (row, record) in enumerate(records.items()):
            texts.append([])
            for x, network in enumerate(networks):
                level, gain = record.level(network)[which], record.gain(original, network)[which]
                values[y, x] = np.nan if level is None else level.value
                below = "" if row == ORIGINAL or gain is None else f"\n{gain.value:+.2f}"
                texts[y].append(f"{values[y, x]:.2f}{below}")
        number_grid(axes, values, texts, fontsize=6)
        axes.set_xticks(range(len(networks)), [short_name(name) for name in networks], rotation=25, ha="right")
        axes.set_yticks(range(len(records)), list(records))
        axes.set_title(title)
    panels[0].set_ylabel("trained on")


STUDY = Study("transfer", TransferSettings, cells, run, tables, figures)
