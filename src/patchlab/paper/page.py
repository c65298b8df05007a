"""The paper's tables and claims on one page, each beside our figure from the stored tables of studies.

In: `results/paper_page/paper.toml`, a row for each figure and claim of the paper; a folder with a folder per part
(`PARTS`), each with the CSV tables of its finished study. Out: tables of rows: the paper's figure, ours with its
interval, and "agrees", "does not", "cannot be told" or "not run yet" with the reason. A figure agrees where our 95 %
interval overlaps the paper's range; a claim "in sign" where the interval lies on that side of 0, and it does not where
it lies on the other. Our networks are not the paper's, but for MobileNet v2: what can agree is the pattern.
"""

import csv
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from statistics import fmean
from typing import Literal

from pydantic import Field

from patchlab.harden.labeled_photos import write_labels
from patchlab.study.estimates import cluster_mean
from patchlab.study.study import DEFAULT_WORK, FinishedStudy, Work, run_study
from patchproof.base.errors import Refused
from patchproof.base.intervals import Estimate
from patchproof.base.output import make_folder
from patchproof.base.validation import StrictModel, read_toml, spelling_hint, validate_model
from patchproof.report.tables import Results, Table, cell_text, write_results

CONFIGS = Path(__file__).parents[1] / "results" / "paper_page"
STORED = CONFIGS / "stored"
# by part: its study; the config is CONFIGS/PART.toml, the quick form's CONFIGS/quick/PART.toml
PARTS = {
    **dict.fromkeys(("hardened", "budget"), "harden"),
    **dict.fromkeys(("textures", "masked"), "transfer"),
    **{"patches": "patch3d", "printed": "printed", "pasted": "patch2d"},
    **{name: name for name in ("robust", "deceive", "stress")},
}
# photographs that packages carry, with their ImageNet classes
_PACKAGED = {
    **{"skimage/data/chelsea.png": 285, "skimage/data/coffee.png": 967, "skimage/data/rocket.jpg": 657},
    "sklearn/datasets/images/flower.jpg": 985,
}


class RowSpec(StrictModel):
    """A row of the page: the paper's figure, and where ours stands in the stored tables."""

    row: str
    paper: str = "none"
    table: str = ""  # PART/TABLE
    where: dict[str, str] = Field(default_factory=dict)  # values by column that choose its rows
    column: str = ""
    by: tuple[str, ...] = ()  # columns that tell clusters apart; without any the first row's own interval is taken
    minus: dict[str, str] | None = None  # the same clusters with other values by column; "column" names another figure
    range: tuple[float, float] | None = None  # the paper's
    claim: Literal["above", "below"] | None = None  # 0
    because: str = ""  # why it cannot be told, whatever the figure is


class PageSpec(StrictModel):
    """A table of the page."""

    name: str
    title: str
    about: str
    rows: tuple[RowSpec, ...]


def run_parts(
    out: Path, parts: Sequence[str], quick: bool = False, photos: Path | None = None, work: Work = DEFAULT_WORK
) -> dict[str, FinishedStudy]:
    """Run parts of the page, each into its folder of `out`; `photos` has images and their labels.csv."""
    if unknown := [part for part in parts if part not in PARTS]:
        raise Refused("parts of the page", f'"{unknown[0]}"', spelling_hint(unknown[0], PARTS))
    finished = {}
    for part in (part for part in PARTS if part in parts):
        changed = {}
        if PARTS[part] == "harden":
            photos = photos or write_photos(out / "photos", quick)
            changed = {"images": str(photos.resolve()), "labels": str((photos / "labels.csv").resolve())}
        elif part == "printed":
            changed = {"patches": str((out / "patches").resolve())}
        config = CONFIGS / ("quick" if quick else "") / f"{part}.toml"
        finished[part] = run_study(PARTS[part], config, out / part, work, changed)
    return finished


def write_photos(folder: Path, quick: bool) -> Path:
    """Write the labeled photographs that installed packages carry to `folder`; if `quick`, two renders of a truck."""
    make_folder(folder)
    rows: list[tuple[str, str | int]] = []
    if quick:
        from patchlab.paper.image_classes import write_renders
        from patchproof.render.stage import set_stage
        from patchproof.scene.scene import load_scene

        stage = set_stage(load_scene(CONFIGS / "quick/truck.toml"))
        return write_labels([(name, "box truck") for name in write_renders(stage, 2, 96, folder)], folder).parent
    for name, label in _PACKAGED.items():
        package, _, file = name.partition("/")
        spec = find_spec(package)
        for place in (spec and spec.submodule_search_locations) or ():
            if (path := Path(place) / file).is_file():
                (folder / path.name).write_bytes(path.read_bytes())
                rows.append((path.name, label))
    if not rows:
        do = "name a folder of photographs with a labels.csv: --photos DIR; or pip install scikit-image scikit-learn"
        raise Refused("labeled photographs", "neither --photos nor a package that carries some", do)
    return write_labels(rows, folder).parent


def page_specs() -> list[PageSpec]:
    """The tables of the page as paper.toml lists them."""
    path = CONFIGS / "paper.toml"
    return [validate_model(PageSpec, each, path.name) for each in read_toml(path)["tables"]]


def page_tables(folder: Path) -> list[Table]:
    """All tables of the page from the studies in `folder`."""
    head = ("row", "the paper", "ours", "verdict")
    tables = []
    for spec in page_specs():
        rows = []
        for row in spec.rows:
            ours, was_run = our_figure(folder, row), bool(stored_rows(folder, row.table, {}))
            rows.append((row.row, row.paper, ours, verdict(row, ours, was_run)))
        tables.append(Table(spec.name, spec.title, head, tuple(rows), spec.about))
    return tables


def our_figure(folder: Path, spec: RowSpec) -> Estimate | float | None:
    """Our figure with its interval; a number where clusters are too few for one, None where nothing is stored."""
    if not (rows := stored_rows(folder, spec.table, spec.where)):
        return None
    if not spec.by:
        row, column = rows[0], spec.column
        if not row.get(f"{column}_low"):  # a column without intervals has no bounds
            return float(row[column]) if row[column] else None
        value, low, high = (float(row[column + end]) for end in ("", "_low", "_high"))
        return Estimate(value, low, high, int(row[f"{column}_n"]))
    means = _cluster_means(rows, spec.by, spec.column)
    if spec.minus is not None:
        where = {**spec.where, **spec.minus}
        column = where.pop("column", spec.column)
        others = _cluster_means(stored_rows(folder, spec.table, where), spec.by, column)
        means = {key: value - others[key] for key, value in means.items() if key in others}
    return cluster_mean(list(means.values()))


def stored_rows(folder: Path, table: str, where: Mapping[str, str]) -> list[dict[str, str]]:
    """The rows of the stored PART/TABLE whose columns have these values; none if it has not been run."""
    part, _, name = table.partition("/")
    if not table or not (path := folder / part / f"{PARTS[part]}_{name}.csv").is_file():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return [row for row in csv.DictReader(file) if all(row[key] == value for key, value in where.items())]


def _cluster_means(rows: Sequence[Mapping[str, str]], by: Sequence[str], column: str) -> dict[tuple, float]:
    groups: dict[tuple, list[float]] = {}
    for row in rows:
        if row[column]:
            groups.setdefault(tuple(row[key] for key in by), []).append(float(row[column]))
    return {key: fmean(values) for key, values in groups.items()}


def verdict(spec: RowSpec, ours: Estimate | float | None, was_run: bool = False) -> str:
    """The verdict on our figure in a sentence."""
    if spec.because:
        return f"cannot be told, because {spec.because}"
    if ours is None:
        return "cannot be told, because the study gave no such figure" if was_run else "not run yet"
    if not isinstance(ours, Estimate):
        return "cannot be told, because too few objects and networks give no interval"
    if spec.claim:
        low, high = (0.0, float("inf")) if spec.claim == "above" else (float("-inf"), 0.0)
        if ours.low <= 0 <= ours.high:
            return "cannot be told, because the interval holds 0"
    elif spec.range:
        low, high = spec.range
    else:
        return "cannot be told, because the paper has no figure"
    if ours.low <= high and ours.high >= low:
        return "agrees in sign" if spec.claim else "agrees"
    return f"does not, ours is {'lower' if ours.high < low else 'higher'}"


def write_paper_page(tables: Sequence[Table], out: Path, source: Path) -> None:
    """Write the page as HTML, JSON and CSV into `out`."""
    make_folder(out)
    words = [str(row[-1]).partition(",")[0] for table in tables for row in table.rows]
    extent = ", ".join(f"{words.count(word)} × {word}" for word in dict.fromkeys(words))
    about = "The paper's tables and claims beside our figures."
    write_results(
        out, Results("table", "paper", about, extent, {"studies": source.name}, tables, (), {}, {}, "patchlab")
    )


def as_markdown(tables: Sequence[Table]) -> str:
    """The page as Markdown."""
    parts = ["# The paper's tables and claims beside ours\n"]
    for table in tables:
        rows = [table.head, ["---"] * len(table.head), *(map(cell_text, row) for row in table.rows)]
        parts.append(f"## {table.title}\n\n{table.about}\n")
        parts.append("\n".join(f"| {' | '.join(row)} |" for row in rows) + "\n")
    return "\n".join(parts)
