"""The verbs for existing designs: import (pictures made elsewhere) and evaluate (one run, or several compared)."""

from pathlib import Path
from typing import Annotated, Any

from typer import Argument, BadParameter, Option

from patchproof.app.cli import console
from patchproof.app.cli.console import Cluster, Device, Jobs, Models, Overwrite, Seed, Trust, say, warn
from patchproof.base.compute import Compute
from patchproof.base.progress import progress_bar


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
    from patchproof.scene.scene import load_scene

    with progress_bar() as bar:
        loaded = load_scene(scene, seed)
        warn(loaded.warnings)
        options: dict[str, Any] = {"promise": PromiseOptions(promise), "compute": Compute(device, jobs or 1)}
        size_mm = None if as_printed is None else console.pair_of(as_printed, "--as-printed")
        run = import_patch(picture, loaded, out, as_printed=size_mm, **options, overwrite=overwrite, progress=bar)
    say(*imported_lines(run.details["imported"]), *run_lines(run))


def evaluate(
    runs: Annotated[list[Path], Argument(metavar="RUN...", help="Finished runs; several are compared.")],
    models: Models = None,
    n: Annotated[int, Option(min=1, help="Fresh conditions.")] = 400,
    out: Annotated[Path | None, Option(help="Folder for the table and the page of several runs.")] = None,
    seed: Seed = None,
    device: Device = "cpu",
    jobs: Jobs = None,
    cluster: Cluster = None,
    trust: Trust = False,
    overwrite: Overwrite = False,
) -> None:
    """Rates on fresh conditions, with controls, on any classifiers; of several runs side by side."""
    from patchproof.app.compare import compare
    from patchproof.optimizer.evaluate import evaluate as evaluate_run
    from patchproof.report.words import evaluation_lines

    if (out is None) != (len(runs) == 1):
        raise BadParameter("is for several runs, and they need it; one has its own folder", param_hint="--out")
    with progress_bar() as bar:
        options: dict[str, Any] = {"models": console.names_of(models), "n": n, "seed": seed, "overwrite": overwrite}
        options |= {"trust": trust, "compute": Compute(device, jobs or 1, cluster), "progress": bar}
        if out is None:
            result = evaluate_run(runs[0], **options)
            say(*evaluation_lines(result.model_dump()), f"written: {runs[0] / 'evaluate.json'}")
        else:
            console.say_study(compare(runs, out, **options))
            say(f"page: {out / 'designs.html'}")
