"""The command line: verbs only. Each one reads its arguments, calls one function, and prints a short summary.

Heavy imports happen inside the verbs, so that help is quick. What a user can cause ends in one sentence and exit code
1.
"""

from __future__ import annotations

import sys
import warnings

import typer

from patchproof.cli.begin import new, plan, preview
from patchproof.cli.calibrate import camera, printer
from patchproof.cli.capture import capture
from patchproof.cli.experiments import ListsStudies, bench, harden, keys, study
from patchproof.cli.journey import demo, evaluate, optimize, reprint, sheet, verify
from patchproof.strict import Refused

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Optimize a patch on a 3D object, print it at true size, photograph it, and judge the photographs.",
)
_calibrate = typer.Typer(no_args_is_help=True, help="Models of a printer or a camera, from photographs and profiles.")

for _verb in (demo, new, preview, plan, optimize, evaluate, sheet, reprint, capture, verify):
    app.command()(_verb)
app.add_typer(_calibrate, name="calibrate")
for _verb in (printer, camera):
    _calibrate.command()(_verb)
app.command()(harden)
app.command(cls=ListsStudies)(study)
for _verb in (keys, bench):
    app.command()(_verb)


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
