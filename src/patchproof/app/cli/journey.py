"""The verbs from a scene to a verdict: demo, optimize, import, promise, evaluate, sheet, reprint, capture, verify."""

import signal
import sys
import webbrowser
from pathlib import Path
from typing import Annotated, Any, Literal

from typer import Argument, BadParameter, Exit, Option

from patchproof.app.cli import console
from patchproof.app.cli.console import Cluster, Device, Jobs, Models, Overwrite, Resume, Seed, Trust, say, warn
from patchproof.base.errors import Refused
from patchproof.base.progress import Compute, progress_bar
from patchproof.base.text import command_text

PrintableControl = Literal["mean", "gray", "noise", "blank"]  # that can be printed
PhotographedControl = Literal["bare", "mean", "gray", "noise"]  # that can hang on the object in place of the design


def demo(
    out: Annotated[Path, Option(help="Folder for all of it.")] = Path("patchproof-demo"),
    imagenet: Annotated[bool, Option("--imagenet", help="Use an ImageNet network.")] = False,
    open_report: Annotated[bool, Option("--open", help="Open the report in the browser at the end.")] = False,
    jobs: Jobs = None,
    overwrite: Overwrite = False,
) -> None:
    """The whole journey, offline, on a built-in object and network."""
    from patchproof.app.demo import run_demo

    with progress_bar() as bar:
        summary = run_demo(out, imagenet, jobs=jobs or 1, overwrite=overwrite, progress=bar)
    say(*summary)
    if open_report:
        webbrowser.open((out / "report" / "report.html").resolve().as_uri())


def optimize(
    scene: Annotated[Path, Argument(help="The scene file (TOML).")],
    out: Annotated[Path, Option(help="Folder for the run.")],
    resume: Annotated[bool, Option("--resume", help="Go on from the run's checkpoint.")] = False,
    overwrite: Overwrite = False,
    draft: Annotated[bool, Option("--draft", help="A first look: few steps, promised from few views.")] = False,
    thorough: Annotated[bool, Option("--thorough", help="Three times the steps, four times the views.")] = False,
    steps: Annotated[int | None, Option(min=1, help="In place of the scene's own.")] = None,
    promise: Annotated[int | None, Option(min=8, help="Views to promise from; under 400: a draft.")] = None,
    device: Device = "cpu",
    seed: Seed = None,
    jobs: Jobs = None,
    require: Annotated[Literal["helps"] | None, Option(help='"helps": exit with 1 unless it helps.')] = None,
) -> None:
    """Optimize the patch of a scene and promise its rate."""
    from patchproof.optimizer.promise import PromiseOptions
    from patchproof.optimizer.run import effort_of
    from patchproof.optimizer.run import optimize as optimize_scene
    from patchproof.report.words import run_lines
    from patchproof.scene.scene import load_scene

    if draft and thorough:
        raise BadParameter("is the opposite of --draft; leave one out", param_hint="--thorough")
    with progress_bar() as bar:
        loaded = load_scene(scene, seed)
        steps, promise = effort_of(loaded, draft, thorough, steps, promise)
        loaded = loaded.with_steps(steps)
        warn(loaded.warnings)
        options: dict[str, Any] = {"promise": PromiseOptions(promise), "compute": Compute(device, jobs or 1)}
        run = optimize_scene(loaded, out, **options, resume=resume, overwrite=overwrite, progress=bar)
    warn(tuple(text for text in run.scene.warnings if text not in loaded.warnings))  # of the place that was found
    if (out / "place.json").is_file():  # only then import the search's modules
        from patchproof.optimizer.place_files import read_place
        from patchproof.optimizer.place_search import place_lines

        if (place := read_place(out)) is not None:
            say(*place_lines(place))
    say(*run_lines(run))
    raise Exit(1 if require is not None and run.promise.answer != require else 0)


def import_picture(
    picture: Annotated[Path, Argument(help="A picture file.")],
    scene: Annotated[Path, Argument(help="The scene file (TOML).")],
    out: Annotated[Path, Option(help="Folder for the run.")],
    overwrite: Overwrite = False,
    as_printed: Annotated[
        str | None, Option(help="It is printed already, in this size in mm, such as 594x841: no page, no markers.")
    ] = None,
    promise: Annotated[int | None, Option(min=8, help="Views to promise from; of under 400: a draft.")] = None,
    device: Device = "cpu",
    seed: Seed = None,
    jobs: Jobs = None,
) -> None:
    """Make a run of a picture that was made elsewhere: its promise, as of a design of ours."""
    from patchproof.optimizer.imported_design import import_patch
    from patchproof.optimizer.promise import PromiseOptions
    from patchproof.report.words import imported_lines, run_lines

    with progress_bar() as bar:
        options: dict[str, Any] = {"promise": PromiseOptions(promise), "compute": Compute(device, jobs or 1)}
        size_mm = None if as_printed is None else console.pair_of(as_printed, "--as-printed")
        options |= {"overwrite": overwrite, "progress": bar}
        run = import_patch(picture, scene, out, as_printed=size_mm, seed=seed, **options)
    warn(run.scene.warnings)
    say(*imported_lines(run.details["imported"]), *run_lines(run))


def evaluate(
    runs: Annotated[list[Path], Argument(metavar="RUN...", help="Finished runs; several are compared.")],
    models: Models = None,
    n: Annotated[int, Option(min=1, help="Fresh conditions.")] = 400,
    out: Annotated[Path | None, Option(help="Folder for the table and the page; needed for several runs.")] = None,
    seed: Seed = None,
    device: Device = "cpu",
    jobs: Jobs = None,
    trust: Trust = False,
    overwrite: Overwrite = False,
) -> None:
    """Rates on fresh conditions, with controls, on any classifiers; of several runs side by side."""
    from patchproof.app.compare import compare
    from patchproof.optimizer.evaluate import evaluate as evaluate_run
    from patchproof.report.words import evaluation_lines

    if (out is None) != (len(runs) == 1):
        do = "leave it out: one run has its own folder" if out else "several runs need a folder for their page"
        raise BadParameter(do, param_hint="--out")
    with progress_bar() as bar:
        options: dict[str, Any] = {"models": console.names_of(models), "n": n, "seed": seed, "overwrite": overwrite}
        options |= {"trust": trust, "compute": Compute(device, jobs or 1), "progress": bar}
        if out is None:
            result = evaluate_run(runs[0], **options)
            say(*evaluation_lines(result.model_dump()), f"written: {runs[0] / 'evaluate.json'}")
        else:
            console.say_study(compare(runs, out, **options))
            say(f"page: {out / 'designs.html'}")


def promise(
    run: Annotated[Path, Argument(help="A finished run, such as a draft's.")],
    n: Annotated[int | None, Option("--n", min=8, help="Views to promise from, by default up to 400.")] = None,
    trust: Trust = False,
    device: Device = "cpu",
    jobs: Jobs = None,
) -> None:
    """Promise a finished run's rate again: in full after a draft, or from more views."""
    from patchproof.optimizer.evaluate import promise_run
    from patchproof.report.words import run_lines

    with progress_bar() as bar:
        finished_run = promise_run(run, views=n, trust=trust, compute=Compute(device, jobs or 1), progress=bar)
    say(*run_lines(finished_run), "Sheets made before hold the former promise: make them again.")


def sheet(
    out: Annotated[Path | None, Option(help="The PDF; its manifest is written beside it.")] = None,
    runs: Annotated[
        list[Path] | None,
        Argument(metavar="[RUN]...", help="Finished runs, on one page; none for blank, chart and board pages."),
    ] = None,
    template: Annotated[str | None, Option(help="A template's name or file.")] = None,
    control: Annotated[PrintableControl | None, Option(help="The sheet of a control in place of the design's.")] = None,
    copies: Annotated[int, Option(min=1, max=1000, help="Pages of the same, for label rolls.")] = 1,
    check: Annotated[bool, Option("--check", help="Print instructions for a print shop.")] = False,
    templates: Annotated[bool, Option("--list", help="List the templates.")] = False,
    trust: Trust = False,
    overwrite: Overwrite = False,
) -> None:
    """Write the page: design, markers, chart and rulers at true size."""
    from patchproof.base.output import check_file
    from patchproof.base.settings import NO_PAGE, background_summary
    from patchproof.sheets.blank import blank_page
    from patchproof.sheets.print_advice import SHOP_ADVICE, sheet_advice
    from patchproof.sheets.template import template_summaries
    from patchproof.sheets.write import manifest_paths

    if templates:
        return say(*template_summaries())
    if out is None:
        raise BadParameter("name the PDF to write", param_hint="--out")
    runs = runs or []
    if copies > 1 and len(runs) != 1:
        raise BadParameter("copies are of one run's sheet", param_hint="--copies")
    paths = manifest_paths(out, len(runs))
    for path in (out, *paths):
        check_file(path, overwrite, [folder / "run.json" for folder in runs])
    if not runs:
        manifests = [blank_page(out, template=template, control=control)]
    else:
        from patchproof.optimizer.run import load_run
        from patchproof.reprints import run_sheet

        loaded, content = [load_run(folder, trust) for folder in runs], {"template": template, "control": control}
        if (check or copies > 1) and (template or loaded[0].scene.settings.sheet.template) == NO_PAGE:
            raise Refused("a page for --check and --copies", f"{runs[0]}, a print without one", "leave them out")
        if len(runs) > 1:
            manifests = run_sheet.sheet_of_several(loaded, out, **content)
        else:
            manifests = [run_sheet.sheet(loaded[0], out, **content, copies=copies, overwrite=overwrite)]
    for manifest, path in zip(manifests, paths, strict=True):
        if manifest.promise is not None:
            from patchproof.report.words import promise_summary

            settings = manifest.settings
            say(promise_summary(manifest.promise, settings), f"promise simulated {background_summary(settings)}")
        say(f"sheet {manifest.sheet_id} ({manifest.kind}): {out}{'' if path == out else f', {path.name}'}")
    if check:
        lines = (line for manifest in manifests for line in sheet_advice(manifest))
        say(*dict.fromkeys(lines), *SHOP_ADVICE)  # lines that several designs share are printed once


def reprint(
    pdf: Annotated[Path, Argument(help="A sheet's PDF, or the manifest of a print without a page.")],
    n: Annotated[int, Option("--n", min=1, help="Photographs to take.")],
    out: Annotated[Path, Option(help="Folder for the photographs.")],
    run: Annotated[Path | None, Option(help="The run it was made from; none for blank, chart and board pages.")] = None,
    sessions: Annotated[int, Option(min=1, help="Places to take them in, each with its light, camera and folder.")] = 1,
    seed: Seed = None,
    printer: Annotated[str | None, Option(help="Another printer than the scene's: a name or a file.")] = None,
    print_scale: Annotated[float, Option(min=0.01, max=4, help="Size of the print beside the sheet's.")] = 1.0,
    control: Annotated[PhotographedControl | None, Option(help="Photograph a control in place of the design.")] = None,
    jobs: Jobs = None,
    trust: Trust = False,
    overwrite: Overwrite = False,
) -> None:
    """Print the PDF in simulation, put it back on the object, and photograph it."""
    from patchproof.optimizer.run import load_run
    from patchproof.reprints.page_photos import reprint_pages
    from patchproof.reprints.reprint import ReprintSetup
    from patchproof.reprints.reprint import reprint as reprint_sheet

    how = ReprintSetup(printer, print_scale, control)
    if run is None:
        if control is not None or sessions > 1 or pdf.suffix == ".json":
            raise BadParameter("controls, sessions and prints without a page need --run RUN", param_hint="--run")
        reprint_pages(pdf, n, out, how, seed=seed, overwrite=overwrite)
        return say(f"{n} photographs: {out}")
    finished_run = load_run(run, trust)
    with progress_bar() as bar:
        options: dict[str, Any] = {"sessions": sessions, "seed": seed, "overwrite": overwrite, "progress": bar}
        taken = reprint_sheet(pdf, finished_run, n, out, how, compute=Compute(jobs=jobs or 1), **options)
    say(f"{len(taken.photos)} photographs: {out}")


def capture(
    sheet: Annotated[Path, Argument(help="The manifest that was written beside the PDF.")],
    out: Annotated[Path, Option(help="Folder for the photographs; an existing one is continued.")] = Path("photos"),
    models: Models = None,
    camera: Annotated[str | None, Option(help="The camera that takes them: a camera file or its name.")] = None,
    trust: Trust = False,
    lan: Annotated[bool, Option("--lan", help="Listen on the local network, for a phone.")] = False,
) -> None:
    """Receive photographs from a phone's browser, each measured and judged at once."""
    import segno

    signal.signal(signal.SIGINT, signal.default_int_handler)  # it ends the server, and the verdict follows
    from patchproof.app.capture.album import CONTROLS_FOLDER

    try:
        from patchproof.app.capture.serve import serve_capture
    except ImportError:
        raise Refused("Starlette and uvicorn", "none", "pip install 'patchproof[capture]'") from None
    from patchproof.evidence.annotations import CORNERS_FILE
    from patchproof.report.words import verdict_lines
    from patchproof.sheets.manifest import load_manifest

    def show(address: str) -> None:
        segno.make(address, error="l").terminal(compact=True)
        say(address, "" if lan else "Only this machine can open it; --lan lets a phone.", "Ctrl-C ends it.")

    with progress_bar() as bar:
        progress = lambda stage, done, total: bar(stage, done, total) if total else None  # noqa: E731
        options: dict[str, Any] = {"models": console.names_of(models), "camera": camera, "lan": lan, "trust": trust}
        report = serve_capture(sheet, out, **options, progress=progress, on_address=show)
    words = [out, "--sheet", sheet, *(["--controls", out / CONTROLS_FOLDER] if report.controls else [])]
    if not load_manifest(sheet).markers:
        words += ["--find", *(["--corners", out / CORNERS_FILE] if (out / CORNERS_FILE).is_file() else [])]
    say(*verdict_lines(report), f"report: {command_text('verify', *words, '--out', 'report')}")


def verify(
    photos: Annotated[Path, Argument(help="A folder of photographs, or of folders: one for each place.")],
    sheet: Annotated[Path, Option(help="The manifest that was written beside the PDF.")],
    out: Annotated[Path, Option(help="Folder for the report.")],
    models: Models = None,
    controls: Annotated[Path | None, Option(help="Photographs of a control, one control per folder.")] = None,
    scan_dpi: Annotated[float | None, Option(min=30, max=4800, help="These are scans at this resolution.")] = None,
    ruler_mm: Annotated[str | None, Option(help="The rulers (without a page: sides) as measured: 97.1x97.3")] = None,
    camera: Annotated[str | None, Option(help="The camera that took them: a camera file or its name.")] = None,
    boxes: Annotated[Path | None, Option(help="The object's boxes in photographs (COCO JSON), for detectors.")] = None,
    corners: Annotated[Path | None, Option(help="CSV or COCO JSON with the design's four corners.")] = None,
    find: Annotated[bool, Option("--find", help="Search for the design itself where no marker can be read.")] = False,
    require: Annotated[
        Literal["kept", "helps"] | None,
        Option(help='Exit with 1 unless the promise held ("kept"), and the patch helps, too ("helps").'),
    ] = None,
    ledger: Annotated[
        int, Option(min=0, help="Photographs in the gap ledger at most; 0: no ledger, and no rendered controls.")
    ] = 24,
    trust: Trust = False,
    jobs: Jobs = None,
    cluster: Cluster = None,
    resume: Resume = False,
    overwrite: Overwrite = False,
) -> None:
    """Measure photographs of the print and judge them against the promise."""
    from patchproof.app.verify import CaptureInfo
    from patchproof.app.verify import verify as verify_photos
    from patchproof.report.words import verdict_lines

    with progress_bar() as bar:
        ruler = console.pair_of(ruler_mm, "--ruler-mm") if ruler_mm else None
        options: dict[str, Any] = {"models": console.names_of(models), "controls": controls, "trust": trust}
        options |= {"capture": CaptureInfo(camera, scan_dpi, ruler, boxes, corners, find), "ledger_photos": ledger}
        options |= {"compute": Compute(jobs=jobs or 1, cluster=cluster), "resume": resume, "overwrite": overwrite}
        report = verify_photos(photos, sheet, out, **options, progress=bar)
    say(*verdict_lines(report), f"report: {out / 'report.html'}")
    summary = report.summary
    if nothing := summary.judged == 0 and summary.measured == 0:
        see = "Expected photographs that can be judged or measured, got none: see the codes in the report."
        print(see, file=sys.stderr)
    if require == "kept" and summary.meets("kept") and not summary.meets("helps"):
        print("The promise is kept, but the patch is not shown to help: --require helps needs both.", file=sys.stderr)
    raise Exit(1 if nothing or (require is not None and not summary.meets(require)) else 0)
