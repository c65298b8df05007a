"""The command line: verbs only. Each one reads its arguments, calls one function, and prints a short summary.

Heavy imports happen inside the verbs, so that help is quick. What a user can cause ends in one sentence and exit code
1.
"""

from __future__ import annotations

import io
import sys
import warnings
from typing import Annotated

import typer

from patchproof.cli.begin import new, plan, preview
from patchproof.cli.calibrate import camera, printer
from patchproof.cli.capture import capture
from patchproof.cli.console import carried_out
from patchproof.cli.designs import evaluate, import_picture
from patchproof.cli.experiments import ListsStudies, bench, harden, keys, study
from patchproof.cli.journey import demo, optimize, promise, reprint, sheet, verify
from patchproof.output import disk_is_full
from patchproof.strict import Refused
from patchproof.version import __version__
from patchproof.workers import keep_freed_memory

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Optimize a patch on a 3D object, print it at true size, photograph it, and judge the photographs.",
)
_calibrate = typer.Typer(no_args_is_help=True, help="Models of a printer or a camera, from photographs and profiles.")

for _verb in (demo, new, preview, plan, optimize):
    app.command()(carried_out(_verb))
app.command("import")(carried_out(import_picture))
for _verb in (promise, evaluate, sheet, reprint, capture, verify):
    app.command()(carried_out(_verb))
app.add_typer(_calibrate, name="calibrate")
for _verb in (printer, camera):
    _calibrate.command()(carried_out(_verb))
app.command()(carried_out(harden))
app.command(cls=ListsStudies)(carried_out(study))
for _verb in (keys, bench):
    app.command()(carried_out(_verb))


def _say_version(asked: bool) -> None:
    if asked:
        print(f"patchproof {__version__}")
        raise typer.Exit()


@app.callback()
def _before_all(
    version: Annotated[
        bool, typer.Option("--version", callback=_say_version, is_eager=True, help="Say the version and exit.")
    ] = False,
) -> None:
    pass


def main() -> None:
    """Run the command line; a refusal is one sentence on standard error and exit code 1."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # Windows gives pipes its code page, which has no ε
            stream.reconfigure(encoding="utf-8")
    keep_freed_memory()
    warnings.formatwarning = lambda message, *where: f"warning: {message}\n"
    try:
        app()
    except Refused as error:
        print(error, file=sys.stderr)
        raise SystemExit(1) from None
    except Exception as error:
        if disk_is_full(error):
            print("Expected room on the disk, got none left: make room, then run the command again.", file=sys.stderr)
            raise SystemExit(1) from None
        if not isinstance(error, OSError):
            raise
        print(f"Expected files that can be read and written, got {error}: mend that and try again.", file=sys.stderr)
        raise SystemExit(1) from None
    except KeyboardInterrupt:
        print("Stopped.", file=sys.stderr)
        raise SystemExit(130) from None
