"""The command line `patchlab`: run studies, make charts and a gallery, harden images, trace paths, print figures."""

import re
from pathlib import Path
from typing import Annotated, Literal

import typer
from typer.core import TyperCommand

from patchproof.app.cli import console
from patchproof.base.errors import Refused
from patchproof.base.progress import progress_bar
from patchproof.base.validation import spelling_hint

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Studies and charts that produce the figures which patchproof's documents quote.",
)
_PAGE = Path(__file__).parent / "results/measured.md"


def harden(
    images: Annotated[Path, typer.Argument(help="A folder of images.")],
    labels: Annotated[Path, typer.Option(help="CSV: file name, label.")],
    models: Annotated[str, typer.Option(help="Comma-separated classifiers to harden for, all together.")],
    out: Annotated[Path, typer.Option(help="Folder for the PNGs and the tables.")],
    method: Annotated[Literal["pgd", "fgsm", "adam"], typer.Option(help="How to step.")] = "pgd",
    eps: Annotated[str, typer.Option(help='Largest change of a value in [0, 1]: 0.03, 8/255 or "none".')] = "8/255",
    steps: Annotated[int, typer.Option(min=1, help="Steps.")] = 100,
    step_size: Annotated[float | None, typer.Option(help="First step size; by default the method's own.")] = None,
    through: Annotated[float | None, typer.Option(help="ε of a PGD attack that each step is taken under.")] = None,
    judges: Annotated[str | None, typer.Option(help="Comma-separated classifiers that only judge.")] = None,
    evaluate: Annotated[str, typer.Option(help="Attacks to withstand: fgsm, pgd.")] = "",
    attack_eps: Annotated[str, typer.Option(help="Values of ε of these attacks.")] = "0.01,0.02,0.04",
    resume: console.Resume = False,
    overwrite: console.Overwrite = False,
    jobs: console.Jobs = None,
    cluster: console.Cluster = None,
) -> None:
    """Change labeled images so that classifiers recognize them better, and attack them."""
    from patchlab.harden.harden_study import HardenSettings, harden_images
    from patchlab.study.study import Work
    from patchproof.base.validation import validate_model

    options = {
        "images": str(images),
        "labels": str(labels),
        "models": console.names_of(models),
        "together": True,
        "judges": console.names_of(judges) or (),
        "methods": (method,),
        "epsilons": (eps,),
        "steps": steps,
        "step_size": step_size,
        "through": through,
        "attacks": console.names_of(evaluate),
        "attack_epsilons": console.names_of(attack_eps),
    }
    with progress_bar() as bar:
        work = Work(resume, overwrite, jobs or 1, cluster, lambda done, total: bar("harden", done, total))
        finished = harden_images(validate_model(HardenSettings, options, "the options"), out, work)
    console.say_study(finished)
    console.say(f"images: {out}, tables: {out / 'harden.html'}")
    raise typer.Exit(0 if finished.results else 1)


class StudyCommand(TyperCommand):
    """A command whose help ends with a list of all studies."""

    def format_help(self, ctx, formatter) -> None:
        """Write typer's help, then a line per study."""
        from patchlab.study.study import STUDIES, module_summary

        super().format_help(ctx, formatter)
        console.say("Studies (all keys of a config: patchlab keys NAME):")
        console.say(*(f"  {name:<10} {module_summary(module)}" for name, module in STUDIES.items()))


def study(
    name: Annotated[str, typer.Argument(help="One of the studies below.")],
    config: Annotated[Path | None, typer.Option(help="What to vary: a TOML file.")] = None,
    cells: Annotated[
        Path | None, typer.Option(help="real-prints: other cells of known color (NPZ), held against the stored config.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for tables, figures and the page.")] = None,
    example: Annotated[bool, typer.Option("--example", help="Print a config to start from.")] = False,
    resume: console.Resume = False,
    overwrite: console.Overwrite = False,
    jobs: console.Jobs = None,
    cluster: console.Cluster = None,
) -> None:
    """Run an experiment of the paper or a test of the tool: tables with intervals, figures and one page."""
    from patchlab.keys import example_config
    from patchlab.study.study import Work, run_study

    if example:
        print(example_config(name), end="")
        return
    if cells is not None:
        config = config or Path(__file__).parent / "results" / "real_prints" / "real-prints.toml"
        out = out or Path("real-prints")
    if config is None or out is None:
        missing = "--config" if config is None else "--out"
        raise typer.BadParameter("missing; a config to start from: --example", param_hint=missing)
    with progress_bar() as bar:
        work = Work(resume, overwrite, jobs or 1, cluster, lambda done, total: bar("cells", done, total), console.say)
        changed = None if cells is None else {"cells": str(cells.resolve()), "left_out": "nothing"}
        finished = run_study(name, config, out, work, changed)
    console.say_study(finished)
    console.say(f"page: {out / name}.html")
    raise typer.Exit(0 if finished.results else 1)


def keys(name: Annotated[str | None, typer.Argument(help="A study; without one, all.")] = None) -> None:
    """Print all keys of studies' configs as Markdown: range, unit, default and meaning."""
    from patchlab.keys import HEAD, documents
    from patchproof.app.keys import keys_page

    print(keys_page(documents(), name, HEAD), end="")


def table(
    name: Annotated[str | None, typer.Argument(help="A word of the heading, or paper; without one, all.")] = None,
    run: Annotated[Path | None, typer.Option(help="paper: run or resume its studies in this folder first.")] = None,
    part: Annotated[str | None, typer.Option(help="paper: comma-separated parts to run; by default all.")] = None,
    photos: Annotated[Path | None, typer.Option(help="paper: labeled photographs, with labels.csv.")] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="paper: run tiny forms that only show that all works.")
    ] = False,
    out: Annotated[Path | None, typer.Option(help="paper: folder for the page as HTML, JSON and CSV.")] = None,
    jobs: console.Jobs = None,
    cluster: console.Cluster = None,
) -> None:
    """Print the current figures with their dates, commands and stored data, as Markdown; `paper`: one page of the
    paper's tables and claims beside ours.
    """
    if name != "paper":
        print(figures_page(name), end="")
        return
    from patchlab.paper import page
    from patchlab.study.study import Work

    failed = {}
    if run is not None:
        parts = console.names_of(part) or tuple(page.PARTS)
        with progress_bar() as bar:
            work = Work(True, False, jobs or 1, cluster, lambda done, total: bar("cells", done, total))
            finished = page.run_parts(run, parts, quick, photos, work)
        failed = {f"{part} {cell}": text for part, each in finished.items() for cell, text in each.failed.items()}
    source = page.STORED if run is None else run
    tables = page.page_tables(source)
    print(page.as_markdown(tables), end="")
    if out is not None:
        page.write_paper_page(tables, out, source)
    for cell, text in failed.items():
        console.say(f"failed: {cell}: {text}")
    raise typer.Exit(1 if failed else 0)


def charts(
    name: Annotated[str, typer.Argument(help="A chart: speed, breaks, terms, or all.")] = "all",
    quick: Annotated[bool, typer.Option("--quick", help="Five minutes: a tenth of everything, to try it.")] = False,
    out: Annotated[Path, typer.Option(help="Folder for pictures, tables and pages.")] = Path("patchlab-charts"),
    resume: console.Resume = False,
    overwrite: console.Overwrite = False,
    jobs: console.Jobs = None,
) -> None:
    """Make the README's charts on this machine: speed against accuracy, where it breaks, what each term is worth."""
    from patchlab.charts.make import make_charts
    from patchlab.study.study import Work

    with progress_bar() as bar:
        work = Work(resume, overwrite, jobs or 1, on_cell=lambda done, total: bar("cells", done, total))
        finished = make_charts(name, out, quick, work)
    for each, study in finished.items():
        console.say_study(study)
        console.say(f"picture: {out / each / each}_chart.png")
    raise typer.Exit(0 if all(study.results for study in finished.values()) else 1)


def gallery(
    out: Annotated[Path, typer.Option(help="Folder for the page, and the objects' runs and sheets.")] = Path(
        "patchlab-gallery"
    ),
    overwrite: console.Overwrite = False,
    jobs: console.Jobs = None,
) -> None:
    """Draft designs for ten objects: a page of the designs, their sheets, and photographs of the prints."""
    from patchlab.charts.gallery import make_gallery

    with progress_bar() as bar:
        page = make_gallery(out, jobs or 1, overwrite, bar)
    console.say(f"page: {page}")


def trace(
    pdf: Annotated[Path, typer.Argument(help="A sheet's PDF.")],
    run: Annotated[Path, typer.Option(help="The run it was made from.")],
    n: Annotated[int, typer.Option("--n", min=1, help="Photographs to take.")],
    out: Annotated[Path, typer.Option(help="Folder for the photographs.")],
    sessions: Annotated[int, typer.Option(min=1, help="Places to take them in.")] = 1,
    trust: console.Trust = False,
    overwrite: console.Overwrite = False,
) -> None:
    """Photograph a run's sheet as `patchproof reprint` does, by the path tracer Mitsuba 3 (slow)."""
    from patchlab.validation.path_traced import photograph_traced
    from patchproof.optimizer.run import load_run
    from patchproof.reprints.reprint import ReprintSetup, reprint

    setup = ReprintSetup(render=photograph_traced)
    with progress_bar() as bar:
        reprint(pdf, load_run(run, trust), n, out, setup, sessions=sessions, overwrite=overwrite, progress=bar)
    console.say(f"{n} photographs: {out}")


app.command(cls=StudyCommand)(console.as_command(study))
for _verb in (charts, gallery, harden, table, trace, keys):
    app.command()(console.as_command(_verb))
app.callback()(console.version_option)


def main() -> None:
    """Run the command line of the laboratory."""
    console.run_command_line(app)


def figures_page(name: str | None = None) -> str:
    """The whole page as Markdown, or its sections whose heading holds `name`; refused where none does."""
    page = _PAGE.read_text(encoding="utf-8")
    if name is None:
        return page
    sections = re.split(r"^(?=## )", page, flags=re.MULTILINE)[1:]
    found = [section for section in sections if name.lower() in section.partition("\n")[0].lower()]
    if not found:
        headings = [section.partition("\n")[0].removeprefix("## ") for section in sections]
        expected = f"a word of one of the headings {', '.join(headings)}"
        raise Refused(expected, f'"{name}"', spelling_hint(name, headings))
    return "".join(found)
