"""The command line: verbs only. Each one reads its arguments, calls one function, and prints a short summary.

Heavy imports happen inside the verbs, so that help is quick. What a user can cause ends in one sentence and exit code
1.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from patchproof.settings import Refused

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Optimise a patch on a 3D object, print it at true size, photograph it, and judge the photographs.",
)

calibrate = typer.Typer(no_args_is_help=True, help="Models of a printer or a camera, from photographs and profiles.")
app.add_typer(calibrate, name="calibrate")


class Intent(str, Enum):
    """How a driver brings colors into its printer's gamut."""

    relative = "relative"
    perceptual = "perceptual"


class Control(str, Enum):
    """Controls that can be printed."""

    mean = "mean"
    grey = "grey"
    noise = "noise"
    shuffled = "shuffled"
    blank = "blank"


class Shown(str, Enum):
    """What hangs on the object in place of the design."""

    bare = "bare"
    mean = "mean"
    grey = "grey"
    noise = "noise"


class Hardening(str, Enum):
    """Ways to step towards the true class."""

    pgd = "pgd"
    fgsm = "fgsm"
    adam = "adam"


Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace this command's earlier output.")]
Device = Annotated[str, typer.Option(help="cpu or cuda.")]
Seed = Annotated[int | None, typer.Option(min=0, help="In place of the scene's own seed.")]
Resume = Annotated[bool, typer.Option("--resume", help="Go on where a run that was stopped left off.")]
Jobs = Annotated[int, typer.Option(min=1, help="Local processes that share the work.")]
Cluster = Annotated[str | None, typer.Option(help="A Dask scheduler's address, in place of local processes.")]
Models = Annotated[str | None, typer.Option(help="Comma-separated classifiers in place of the sheet's own.")]


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Folder for the run, the sheet, the photographs and the report.")] = Path(
        "patchproof-demo"
    ),
    overwrite: Overwrite = False,
) -> None:
    """The whole journey, offline, on a built-in object and classifier."""
    from patchproof.study.demo import run_demo

    with _progress() as bar:
        summary = run_demo(out, overwrite=overwrite, on_stage=bar)
    _say(*summary)


@app.command()
def plan(
    scene: Annotated[Path, typer.Argument(help="The scene file (TOML).")],
    out: Annotated[Path | None, typer.Option(help="Write the plan as JSON, too.")] = None,
    no_timing: Annotated[bool, typer.Option("--no-timing", help="Leave out the cost of a step.")] = False,
    overwrite: Overwrite = False,
) -> None:
    """What is modeled, what is not, and why."""
    from patchproof.output import check_file, write_whole
    from patchproof.study.plan import plan_lines, plan_scene

    if out is not None:
        check_file(out, overwrite)
    with _progress() as bar:
        found = plan_scene(scene, timing=not no_timing, on_stage=bar)
    _warn(found.warnings)
    _say(*plan_lines(found))
    if out is not None:
        write_whole(out, lambda path: path.write_text(found.model_dump_json(indent=1) + "\n", encoding="utf-8"))


@app.command()
def optimize(
    scene: Annotated[Path, typer.Argument(help="The scene file (TOML).")],
    out: Annotated[Path, typer.Option(help="Folder for the run.")],
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the run's checkpoint.")] = False,
    overwrite: Overwrite = False,
    device: Device = "cpu",
    seed: Seed = None,
) -> None:
    """Optimise the patch of a scene and promise its rate."""
    from patchproof.optimize.run import optimize_scene
    from patchproof.report.summary import promise_lines

    with _progress() as bar:
        run = optimize_scene(
            scene,
            out,
            seed=seed,
            device=device,
            resume=resume,
            overwrite=overwrite,
            on_scene=lambda loaded: _warn(loaded.warnings),
            on_step=lambda step, total: bar("optimise", step.state.number, total),
            on_promise=lambda done, total: bar("promise", done, total),
        )
    _say(*promise_lines(run.promise), f"run: {out}")


@app.command()
def evaluate(
    run: Annotated[Path, typer.Argument(help="A finished run.")],
    models: Models = None,
    n: Annotated[int, typer.Option(min=1, help="Fresh conditions.")] = 400,
    seed: Seed = None,
    device: Device = "cpu",
    jobs: Jobs = 1,
    cluster: Cluster = None,
) -> None:
    """Rates on fresh conditions, with controls, on any classifiers."""
    from patchproof.optimize.evaluate import evaluate_run
    from patchproof.report.summary import evaluation_lines

    with _progress() as bar:
        result = evaluate_run(
            run,
            models=_names(models),
            n=n,
            seed=seed,
            device=device,
            jobs=jobs,
            cluster=cluster,
            on_view=lambda done, total: bar("evaluate", done, total),
        )
    _say(*evaluation_lines(result), f"written: {run / 'evaluate.json'}")


@app.command()
def sheet(
    out: Annotated[Path, typer.Option(help="The PDF; its manifest is written beside it.")],
    runs: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[RUN]...", help="Finished runs, on one page; none for blank, chart and board pages."),
    ] = None,
    template: Annotated[str | None, typer.Option(help="A template's name or file.")] = None,
    control: Annotated[Control | None, typer.Option(help="The sheet of a control in place of the design's.")] = None,
    copies: Annotated[int, typer.Option(min=1, max=1000, help="Pages of the same, for label rolls.")] = 1,
    check: Annotated[bool, typer.Option("--check", help="Say what a print shop needs to know.")] = False,
    overwrite: Overwrite = False,
) -> None:
    """Write the page: design, markers, chart and rulers at true size."""
    from patchproof.optimize.run import load_run
    from patchproof.output import check_file
    from patchproof.sheet.shop import shop_lines
    from patchproof.sheet.write import check_sheet, manifest_paths
    from patchproof.study.sheet import blank_page, sheet_of, sheet_of_several

    runs = runs or []
    if copies > 1 and len(runs) != 1:
        raise typer.BadParameter("copies are of one run's sheet", param_hint="--copies")
    paths = manifest_paths(out, len(runs))
    for path in (out, *paths):
        check_file(path, overwrite)
    kind = control.value if control else None
    if not runs:
        manifests = [blank_page(out, template=template, control=kind)]
    elif len(runs) == 1:
        manifests = [sheet_of(load_run(runs[0]), out, template=template, control=kind, copies=copies)]
    else:
        manifests = sheet_of_several([load_run(run) for run in runs], out, template=template, control=kind)
    for manifest, path in zip(manifests, paths, strict=True):
        _say(f"sheet {manifest.sheet_id} ({manifest.kind}): {out}, {path.name}")
    if check:
        lines = (line for manifest in manifests for line in check_sheet(manifest))
        _say(*dict.fromkeys(lines), *shop_lines(out))  # what holds for several designs is said once


@app.command()
def reprint(
    pdf: Annotated[Path, typer.Argument(help="A sheet's PDF.")],
    run: Annotated[Path, typer.Option(help="The run it was made from.")],
    n: Annotated[int, typer.Option("--n", min=1, help="Photographs to take.")],
    out: Annotated[Path, typer.Option(help="Folder for the photographs.")],
    seed: Seed = None,
    printer: Annotated[str | None, typer.Option(help="Another printer than the scene's: a name or a file.")] = None,
    print_scale: Annotated[str, typer.Option(help="Size of the print, 0.97 or 0.97x0.98 (x, y).")] = "1",
    control: Annotated[Shown | None, typer.Option(help="Photograph a control in place of the design.")] = None,
    scan_dpi: Annotated[float | None, typer.Option(min=30, max=1200, help="Scan the uncut page flat instead.")] = None,
    card: Annotated[
        bool, typer.Option("--card", help="Photograph the uncut page with a bank card on it instead.")
    ] = False,
    path_traced: Annotated[
        bool, typer.Option("--path-traced", help="Render with Mitsuba 3 in place of our renderer (slow).")
    ] = False,
    jobs: Jobs = 1,
    cluster: Cluster = None,
    overwrite: Overwrite = False,
) -> None:
    """Print the PDF in simulation, put it back on the object, and photograph it."""
    from patchproof.optimize.run import load_run
    from patchproof.study.reprint import reprint as reprint_sheet
    from patchproof.study.reprint import scan

    scale = _pair(print_scale, "--print-scale")
    if scan_dpi is not None and control is not None:
        raise typer.BadParameter("a scan is of the PDF itself; leave --control out", param_hint="--scan-dpi")
    if card and (scan_dpi is not None or control is not None):
        raise typer.BadParameter("takes the page as it is; leave --scan-dpi and --control out", param_hint="--card")
    if path_traced and (card or scan_dpi is not None):
        raise typer.BadParameter(
            "is of the piece on its object; leave --scan-dpi and --card out", param_hint="--path-traced"
        )
    if scan_dpi is not None:
        truth = scan(pdf, load_run(run), n, out, scan_dpi, printer=printer, print_scale=scale, overwrite=overwrite)
    elif card:
        from patchproof.study.card_photo import photograph_cards

        with _progress() as bar:
            truth = photograph_cards(
                pdf,
                load_run(run),
                n,
                out,
                seed=seed,
                printer=printer,
                print_scale=scale,
                overwrite=overwrite,
                on_photo=lambda done, total: bar("photograph", done, total),
            )
    else:
        with _progress() as bar:
            truth = reprint_sheet(
                pdf,
                load_run(run),
                n,
                out,
                seed=seed,
                printer=printer,
                print_scale=scale,
                control=control.value if control else None,
                path_traced=path_traced,
                jobs=jobs,
                cluster=cluster,
                overwrite=overwrite,
                on_photo=lambda done, total: bar("photograph", done, total),
            )
    _say(f"{len(truth)} photographs: {out}")


@app.command()
def verify(
    photos: Annotated[Path, typer.Argument(help="A folder of photographs.")],
    sheet: Annotated[Path, typer.Option(help="The manifest that was written beside the PDF.")],
    out: Annotated[Path, typer.Option(help="Folder for the report.")],
    models: Models = None,
    controls: Annotated[Path | None, typer.Option(help="Photographs of a control, one control per folder.")] = None,
    scan_dpi: Annotated[
        float | None, typer.Option(min=30, max=4800, help="These are scans at this resolution.")
    ] = None,
    ruler_mm: Annotated[str | None, typer.Option(help="The printed rulers as measured, e.g. 97.1x97.3 (x, y).")] = None,
    card: Annotated[bool, typer.Option("--card", help="A bank card lies in its outline on the uncut page.")] = False,
    camera: Annotated[str | None, typer.Option(help="The camera that took them: a camera file or its name.")] = None,
    require: Annotated[str | None, typer.Option(help='"kept" makes any other verdict exit with 1.')] = None,
    ledger: Annotated[int, typer.Option(min=0, help="Photographs in the gap ledger at most; 0 for none.")] = 24,
    jobs: Jobs = 1,
    cluster: Cluster = None,
    resume: Resume = False,
    overwrite: Overwrite = False,
) -> None:
    """Measure photographs of the print and judge them against the promise."""
    from patchproof.report.summary import verdict_lines
    from patchproof.study.verify import verify_photos

    if require not in (None, "kept"):
        raise typer.BadParameter('takes "kept" only', param_hint="--require")
    with _progress() as bar:
        report = verify_photos(
            photos,
            sheet,
            out,
            models=_names(models),
            controls=controls,
            scan_dpi=scan_dpi,
            ruler_mm=None if ruler_mm is None else _pair(ruler_mm, "--ruler-mm"),
            ledger_photos=ledger,
            card=card,
            camera=camera,
            jobs=jobs,
            cluster=cluster,
            resume=resume,
            overwrite=overwrite,
            on_photo=lambda done, total: bar("verify", done, total),
        )
    _say(*verdict_lines(report), f"report: {out / 'report.html'}")
    nothing = report.summary.judged == 0 and report.summary.measured == 0
    if nothing:
        print(
            "Expected photographs that can be judged or measured, got none: see the codes in the report.",
            file=sys.stderr,
        )
    raise typer.Exit(1 if nothing or (require == "kept" and report.summary.verdict != "kept") else 0)


@calibrate.command("printer")
def calibrate_printer(
    out: Annotated[Path, typer.Option(help="NAME.npz; NAME.json is written beside it.")],
    more: Annotated[list[Path] | None, typer.Argument(metavar="[PHOTO]...", help="More photographs.")] = None,
    icc: Annotated[Path | None, typer.Option(help="An RGB or CMYK output profile.")] = None,
    intent: Annotated[Intent, typer.Option(help="The profile's intent that the driver is set to.")] = Intent.relative,
    licence: Annotated[str, typer.Option(help="Of the profile, for the record.")] = "unknown",
    source: Annotated[str, typer.Option(help="Where the profile is from, for the record.")] = "unknown",
    chart: Annotated[
        list[Path] | None, typer.Option(help="Photographs of the printed chart; a folder holds those of one print.")
    ] = None,
    sheet: Annotated[Path | None, typer.Option(help="The manifest of the chart's page.")] = None,
    camera: Annotated[str | None, typer.Option(help="A camera file with a tone curve.")] = None,
    overwrite: Overwrite = False,
) -> None:
    """A printer from its ICC profile, or from photographs of its printed chart."""
    from patchproof.calibrate.printer import printer_from_chart, printer_from_icc

    photos = [*(chart or []), *(more or [])]
    if (icc is None) == (chart is None) or (more and chart is None):
        raise typer.BadParameter("give either --icc FILE or --chart PHOTO...", param_hint="--icc / --chart")
    if icc is not None:
        lines, warned = printer_from_icc(icc, out, intent.value == "perceptual", licence, source, overwrite), ()
    elif sheet is None:
        raise typer.BadParameter("name the JSON that was written beside the chart's PDF", param_hint="--sheet")
    else:
        with _progress() as bar:
            on_photo = lambda done, total: bar("chart", done, total)  # noqa: E731
            lines, warned = printer_from_chart(photos, sheet, out, camera, overwrite, on_photo)
    _warn(warned)
    _say(*lines)


@calibrate.command("camera")
def calibrate_camera_(
    photos: Annotated[Path, typer.Argument(help="A folder of photographs of a board.")],
    board: Annotated[str, typer.Option(help="The board's template, or the BOARD.json beside its PDF.")] = "charuco_a4",
    out: Annotated[Path, typer.Option(help="The camera file; its figures and a picture are written beside it.")] = Path(
        "camera.json"
    ),
    ruler_mm: Annotated[str | None, typer.Option(help="The printed rulers as measured, e.g. 97.1x97.3 (x, y).")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Focal length, middle and lens distortion of a camera."""
    from patchproof.calibrate.camera import calibrate_camera, calibration_lines

    ruler = None if ruler_mm is None else _pair(ruler_mm, "--ruler-mm")
    with _progress() as bar:
        found = calibrate_camera(photos, board, out, ruler_mm=ruler, overwrite=overwrite, progress=bar)
    _say(*calibration_lines(found), f"camera: {out}")


@app.command()
def harden(
    images: Annotated[Path, typer.Argument(help="A folder of images.")],
    labels: Annotated[Path, typer.Option(help="CSV: file name, label.")],
    model: Annotated[str, typer.Option(help="Comma-separated classifiers to harden for, all together.")],
    out: Annotated[Path, typer.Option(help="Folder for the PNGs and the tables.")],
    method: Annotated[Hardening, typer.Option(help="How to step.")] = Hardening.pgd,
    eps: Annotated[str, typer.Option(help='Largest change of a value in [0, 1]: 0.03, 8/255 or "none".')] = "8/255",
    steps: Annotated[int, typer.Option(min=1, help="Steps.")] = 100,
    step_size: Annotated[float | None, typer.Option(help="In place of the method's own.")] = None,
    judges: Annotated[str | None, typer.Option(help="Comma-separated classifiers that only judge.")] = None,
    evaluate: Annotated[str, typer.Option(help="Attacks to withstand: fgsm, pgd.")] = "",
    attack_eps: Annotated[str, typer.Option(help="Their ε.")] = "0.01,0.02,0.04",
    resume: Resume = False,
    overwrite: Overwrite = False,
    jobs: Jobs = 1,
    cluster: Cluster = None,
) -> None:
    """Change labeled images so that classifiers recognize them better, and attack them."""
    from patchproof.settings import validated
    from patchproof.study.harden import HardenSettings, harden_images

    given = {
        "images": str(images),
        "labels": str(labels),
        "models": _names(model),
        "together": True,
        "judges": _names(judges) or (),
        "methods": (method.value,),
        "epsilons": (eps,),
        "steps": steps,
        "step_size": step_size,
        "attacks": _names(evaluate),
        "attack_epsilons": _names(attack_eps),
    }
    with _progress() as bar:
        finished = harden_images(
            validated(HardenSettings, given, "the options"),
            out,
            resume=resume,
            overwrite=overwrite,
            jobs=jobs,
            cluster=cluster,
            on_cell=lambda done, total: bar("harden", done, total),
        )
    _say_study(finished)
    _say(f"images: {out}, tables: {out / 'harden.html'}")
    raise typer.Exit(0 if finished.results else 1)


@app.command()
def study(
    name: Annotated[str, typer.Argument(help="A study's name.")],
    config: Annotated[Path, typer.Option(help="What to vary: a TOML file.")],
    out: Annotated[Path, typer.Option(help="Folder for tables, figures and the page.")],
    resume: Resume = False,
    overwrite: Overwrite = False,
    jobs: Jobs = 1,
    cluster: Cluster = None,
) -> None:
    """One of the paper's experiments: many cells, tables with intervals, figures and one page."""
    from patchproof.study.study import run_study

    with _progress() as bar:
        finished = run_study(
            name,
            config,
            out,
            resume=resume,
            overwrite=overwrite,
            jobs=jobs,
            cluster=cluster,
            on_cell=lambda done, total: bar("cells", done, total),
        )
    _say_study(finished)
    _say(f"page: {out / name}.html")
    raise typer.Exit(0 if finished.results else 1)


@app.command()
def bench(
    name: Annotated[
        str, typer.Argument(help="A benchmark: render, train, numbers, printer, detect, evidence, or all.")
    ] = "all",
    quick: Annotated[bool, typer.Option("--quick", help="Three minutes: fewer views, rounds and sizes.")] = False,
    out: Annotated[Path, typer.Option(help="Folder for charts, table and JSON.")] = Path("patchproof-bench"),
    overwrite: Overwrite = False,
) -> None:
    """Speed against accuracy of each knob on this machine: charts, a table and JSON."""
    from patchproof.bench.run import run_bench

    with _progress() as bar:
        lines = run_bench(name, out, quick=quick, overwrite=overwrite, on_stage=bar)
    _say(*lines)


def main() -> None:
    """Run the command line; a refusal is one sentence on standard error and exit code 1."""
    warnings.formatwarning = lambda message, *where: f"warning: {message}\n"
    try:
        app()
    except Refused as error:
        print(error, file=sys.stderr)
        raise SystemExit(1) from None
    except OSError as error:
        print(f"Expected files that can be read and written, got {error}: mend that and try again.", file=sys.stderr)
        raise SystemExit(1) from None
    except KeyboardInterrupt:
        print("Stopped.", file=sys.stderr)
        raise SystemExit(130) from None


@contextmanager
def _progress() -> Iterator[Callable[[str, int, int], None]]:
    """A bar with time left on standard error: call it with a stage's name, what is done, and the total."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description:>12}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True)) as progress:
        tasks: dict[str, int] = {}

        def advance(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = progress.add_task(stage, total=total)
            progress.update(tasks[stage], completed=done, total=total)

        yield advance


def _say(*lines: str) -> None:
    for line in lines:
        print(line)


def _say_study(finished) -> None:
    """A study's tables, and on standard error what failed."""
    from patchproof.report.tables import text_lines

    for table in finished.tables:
        _say(table.title, *(f"  {line}" for line in text_lines(table)))
    for cell, sentence in finished.failed.items():
        print(f"failed: {cell}: {sentence}", file=sys.stderr)


def _warn(lines: tuple[str, ...]) -> None:
    for line in lines:
        print(f"warning: {line}", file=sys.stderr)


def _names(models: str | None) -> tuple[str, ...] | None:
    return None if models is None else tuple(name.strip() for name in models.split(",") if name.strip())


def _pair(text: str, option: str) -> tuple[float, float]:
    """A number, or two as XxY."""
    try:
        numbers = [float(part) for part in text.lower().split("x")]
        x, y = numbers * 2 if len(numbers) == 1 else numbers
        if not (0 < x < float("inf") and 0 < y < float("inf")):
            raise ValueError
    except ValueError:
        raise typer.BadParameter(
            "takes one or two positive numbers, such as 0.97 or 0.97x0.98", param_hint=option
        ) from None
    return x, y
