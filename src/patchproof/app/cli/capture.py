"""The verb capture: photographs from a phone."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from patchproof.app.cli.console import Models, names_of, progress, say


def capture(
    sheet: Annotated[Path, typer.Argument(help="The manifest that was written beside the PDF.")],
    out: Annotated[Path, typer.Option(help="Folder for the photographs; an existing one is continued.")] = Path(
        "photos"
    ),
    run: Annotated[
        Path | None, typer.Option(help="The run that the sheet is of: forecasts each photograph at its measured view.")
    ] = None,
    models: Models = None,
    camera: Annotated[str | None, typer.Option(help="The camera that takes them: a camera file or its name.")] = None,
    lan: Annotated[
        bool, typer.Option("--lan", help="Listen on the local network, for a phone; else on this machine alone.")
    ] = False,
) -> None:
    """Receive photographs from a phone's browser, each measured and judged at once."""
    import segno

    from patchproof.app.capture.album import CONTROLS_FOLDER
    from patchproof.app.capture.serve import serve_capture
    from patchproof.report.words import verdict_lines

    def show(address: str) -> None:
        segno.make(address, error="l").terminal(compact=True)
        say(address, "" if lan else "Only this machine can open it; --lan lets a phone.", "Ctrl-C ends it.")

    with progress() as bar:
        report = serve_capture(
            sheet,
            out,
            run=run,
            models=names_of(models),
            camera=camera,
            lan=lan,
            progress=lambda stage, done, total: bar(stage, done, total) if total else None,
            on_address=show,
        )
    controls = f" --controls {out / CONTROLS_FOLDER}" if report.controls else ""
    say(*verdict_lines(report), f"report: patchproof verify {out} --sheet {sheet}{controls} --out report")
