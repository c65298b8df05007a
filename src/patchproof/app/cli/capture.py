"""The verb capture: photographs from a phone."""

import signal
from functools import partial
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from patchproof.app.cli.console import Models, Trust, names_of, say
from patchproof.base.progress import progress_bar
from patchproof.base.text import command_text


def capture(
    sheet: Annotated[Path, Argument(help="The manifest that was written beside the PDF.")],
    out: Annotated[Path, Option(help="Folder for the photographs; an existing one is continued.")] = Path("photos"),
    models: Models = None,
    camera: Annotated[str | None, Option(help="The camera that takes them: a camera file or its name.")] = None,
    trust: Trust = False,
    lan: Annotated[
        bool, Option("--lan", help="Listen on the local network, for a phone; else on this machine alone.")
    ] = False,
) -> None:
    """Receive photographs from a phone's browser, each measured and judged at once."""
    import segno

    signal.signal(signal.SIGINT, signal.default_int_handler)  # it ends the server, and the verdict follows
    from patchproof.app.capture.album import CONTROLS_FOLDER
    from patchproof.app.capture.serve import serve_capture
    from patchproof.evidence.annotations import CORNERS_FILE
    from patchproof.report.words import verdict_lines
    from patchproof.sheets.manifest import load_manifest

    def show(address: str) -> None:
        segno.make(address, error="l").terminal(compact=True)
        say(address, "" if lan else "Only this machine can open it; --lan lets a phone.", "Ctrl-C ends it.")

    with progress_bar() as bar:
        serve = partial(serve_capture, sheet, out, models=names_of(models), camera=camera, lan=lan, trust=trust)
        report = serve(progress=lambda stage, done, total: bar(stage, done, total) if total else None, on_address=show)
    words = [out, "--sheet", sheet, *(["--controls", out / CONTROLS_FOLDER] if report.controls else [])]
    if not load_manifest(sheet).markers:
        words += ["--find", *(["--corners", out / CORNERS_FILE] if (out / CORNERS_FILE).is_file() else [])]
    say(*verdict_lines(report), f"report: {command_text('verify', *words, '--out', 'report')}")
