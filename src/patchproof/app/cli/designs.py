"""Designs that are there: pictures made elsewhere as runs, and rates on fresh conditions, of one run or of several."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from patchproof.app.cli.console import (
    Cluster,
    Device,
    Jobs,
    Models,
    Overwrite,
    Seed,
    names_of,
    progress,
    say,
    say_study,
    warn,
)


def import_picture(
    picture: Annotated[Path, typer.Argument(help="A picture file, or a folder of them: a run in OUT for each.")],
    scene: Annotated[Path, typer.Argument(help="The scene file (TOML).")],
    out: Annotated[Path, typer.Option(help="Folder for the run, or for the runs.")],
    resume: Annotated[bool, typer.Option("--resume", help="Of a folder: keep the runs that are finished.")] = False,
    overwrite: Overwrite = False,
    draft: Annotated[bool, typer.Option("--draft", help="A first look: promised from few views.")] = False,
    promise: Annotated[int | None, typer.Option(min=8, help="Views to promise from; of under 400: a draft.")] = None,
    device: Device = "cpu",
    seed: Seed = None,
    jobs: Jobs = None,
) -> None:
    """Make a run of a picture that was made elsewhere: its promise, as of a design of ours."""
    from patchproof.base.settings import behind
    from patchproof.optimizer.given import import_folder, import_patch
    from patchproof.optimizer.run import DRAFT
    from patchproof.report.words import imported_lines, promise_lines

    with progress() as bar:
        options: dict[str, Any] = {"seed": seed, "device": device, "overwrite": overwrite, "jobs": jobs or 1}
        options |= {"promise_views": promise or (DRAFT[1] if draft else None), "on_promise": partial(bar, "promise")}
        options |= {"on_scene": lambda loaded: warn(loaded.warnings)}
        if picture.is_dir():
            runs = import_folder(picture, scene, out, resume=resume, **options)
        else:
            runs = [import_patch(picture, scene, out, **options)]
    for run in runs:
        say(*imported_lines(run.details["imported"]))
        say(*promise_lines(run.promise, behind(run.scene.settings.model_dump())), f"run: {run.folder}")


def evaluate(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Finished runs; several are compared.")],
    models: Models = None,
    n: Annotated[int, typer.Option(min=1, help="Fresh conditions.")] = 400,
    out: Annotated[Path | None, typer.Option(help="Folder for the table and the page of several runs.")] = None,
    seed: Seed = None,
    device: Device = "cpu",
    jobs: Jobs = None,
    cluster: Cluster = None,
    overwrite: Overwrite = False,
) -> None:
    """Rates on fresh conditions, with controls, on any classifiers; of several runs side by side."""
    from patchproof.app.compare import compare_runs
    from patchproof.optimizer.evaluate import evaluate_run
    from patchproof.report.words import evaluation_lines

    if (out is None) != (len(runs) == 1):
        raise typer.BadParameter("is for several runs, and they need it; one has its own folder", param_hint="--out")
    with progress() as bar:
        options: dict[str, Any] = {"models": names_of(models), "n": n, "seed": seed, "device": device}
        options |= {"jobs": jobs or 1, "cluster": cluster, "overwrite": overwrite, "on_view": partial(bar, "evaluate")}
        done: Any = evaluate_run(runs[0], **options) if out is None else compare_runs(runs, out, **options)
    if out is None:
        say(*evaluation_lines(done), f"written: {runs[0] / 'evaluate.json'}")
    else:
        say_study(done)
        say(f"page: {out / 'designs.html'}")
