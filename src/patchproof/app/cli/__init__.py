"""The command line. Each verb reads its arguments, calls one function, and prints a short summary.

Heavy imports happen inside the verbs, so that help is quick. Errors that a user can cause end in one sentence and exit
code 1.
"""

import typer

from patchproof.app.cli import journey
from patchproof.app.cli.begin import camera, examples, keys, new, plan, preview, printer
from patchproof.app.cli.console import as_command, run_command_line, version_option

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Optimize a patch on a 3D object, print it at true size, photograph it, and judge the photographs.",
)
_calibrate = typer.Typer(no_args_is_help=True, help="Models of a printer or a camera, from photographs and profiles.")

for _verb in (journey.demo, examples, new, preview, plan, journey.optimize):
    app.command()(as_command(_verb))
app.command("import")(as_command(journey.import_picture))
for _verb in (journey.promise, journey.evaluate, journey.sheet, journey.reprint, journey.capture, journey.verify):
    app.command()(as_command(_verb))
app.add_typer(_calibrate, name="calibrate")
for _verb in (printer, camera):
    _calibrate.command()(as_command(_verb))
app.command()(keys)
app.callback()(version_option)


def main() -> None:
    """Run the command line."""
    run_command_line(app)
