"""Options, progress and output that all commands share.

Summaries go to standard output; warnings, failures and progress to standard error.
"""

import io
import re
import shlex
import sys
import warnings
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Annotated, Any

from typer import BadParameter, Exit, Option, Typer

from patchproof.base.errors import Refused
from patchproof.base.text import printable
from patchproof.base.version import __version__

Overwrite = Annotated[bool, Option("--overwrite", help="Replace this command's earlier output.")]
Device = Annotated[str, Option(help="cpu or cuda.")]
Seed = Annotated[int | None, Option(min=0, max=2**32 - 1, help="In place of the scene's own seed.")]
Resume = Annotated[bool, Option("--resume", help="Continue a stopped run.")]
Jobs = Annotated[
    int | None, Option(min=1, help="Local processes, one for each free core; any number gives the same results.")
]
Cluster = Annotated[
    str | None, Option(help="A Dask scheduler, in place of local processes; workers need this code and the same paths.")
]
Trust = Annotated[
    bool, Option("--trust", help="Use code, downloads and variables that the run or sheet names: you know who made it.")
]
Models = Annotated[str | None, Option(help="Comma-separated classifiers; a sheet's first one still judges.")]

# how torch, OpenCV and the system say that there is none; numpy and Python raise a MemoryError
_NO_MEMORY = re.compile(
    r"(?i)can(no|')t (allocate memory|start new thread)|(insufficient|out of) memory|failed to map seg"
)


def as_command(verb: Callable[..., None]) -> Callable[..., None]:
    """Make a verb a command: with `jobs` it uses the free cores; Ctrl-C ends it with exit code 130 and a sentence on
    what was kept and how to continue.
    """

    @wraps(verb)
    def command(**arguments: Any) -> None:
        _running[:] = [arguments]
        try:
            if verb.__name__ not in ("demo", "keys") and verb.__module__.startswith("patchproof."):
                from patchproof.app.cli.files import check_files

                check_files(arguments)
            from patchproof.base.workers import keep_freed_memory, share_cores

            keep_freed_memory()
            if "jobs" not in arguments:
                return verb(**arguments)
            with share_cores(arguments["jobs"], arguments.get("device", "cpu"), arguments.get("cluster")) as jobs:
                verb(**arguments | {"jobs": jobs})
        except KeyboardInterrupt:
            say_stopped()
            raise Exit(130) from None

    return command


_running: list[dict[str, Any]] = [{}]  # the arguments of the command; empty once it was said that it stopped


def say_stopped() -> None:
    """Print once what a stopped command kept, and show the cursor again, which a progress bar hides."""
    if _running:
        show_cursor = "\x1b[?25h" if sys.stderr.isatty() else ""
        print(f"{show_cursor}{_stop_sentence(_running.pop())}", file=sys.stderr, flush=True)


def _stop_sentence(arguments: dict[str, Any]) -> str:
    out = arguments.get("out")
    if "resume" not in arguments or not Path(out or "").is_dir():
        return "Stopped: nothing was written."
    words = [word for word in sys.argv[1:] if word not in ("--overwrite", "--resume")]
    return f"Stopped: {out} keeps what was finished. Go on with: {shlex.join([_program(), *words, '--resume'])}"


def _program() -> str:
    """The name that the command was called by."""
    path = Path(sys.argv[0])
    return path.parent.name if path.stem == "__main__" else path.stem


def _say_version(requested: bool) -> None:
    if requested:
        print(f"{_program()} {__version__}")
        raise Exit()


def version_option(
    version: Annotated[
        bool, Option("--version", callback=_say_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Options before the verb."""


def run_command_line(app: Typer) -> None:
    """Run the command line; a refusal ends in one sentence on standard error and exit code 1."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # Windows gives pipes its code page, which has no ε
            stream.reconfigure(encoding="utf-8")
    warnings.formatwarning = lambda message, *where: f"warning: {printable(' '.join(str(message).split()))}\n"
    try:
        app()
    except Exception as error:
        from patchproof.base.output import disk_is_full

        if isinstance(error, Refused):
            sentence = str(error)
        elif disk_is_full(error):
            sentence = (
                "Expected room on the disk, got none left: make room, then go on, with --resume where there is one."
            )
        elif isinstance(error, MemoryError) or _NO_MEMORY.search(str(error)):
            sentence = "Expected enough memory, got none left: give it more, fewer --jobs, or smaller files."
        elif isinstance(error, OSError):
            sentence = printable(f"Expected files that can be read and written, got {error}: fix that and try again.")
        else:
            raise
        print(sentence, file=sys.stderr)
        raise SystemExit(1) from None
    except KeyboardInterrupt:
        say_stopped()
        raise SystemExit(130) from None


def say(*lines: str) -> None:
    """Print a summary's lines to standard output."""
    for line in lines:
        print(printable(line))


def say_study(finished) -> None:
    """Print a study's or chart's tables, and its failures on standard error."""
    from patchproof.report.tables import text_lines

    for table in finished.tables:
        say(table.title, *(f"  {line}" for line in text_lines(table)))
    for cell, sentence in finished.failed.items():
        print(printable(f"failed: {cell}: {sentence}"), file=sys.stderr)


def warn(lines: tuple[str, ...]) -> None:
    """Print each warning on a line of standard error."""
    for line in lines:
        print(printable(f"warning: {line}"), file=sys.stderr)


def names_of(models: str | None) -> tuple[str, ...] | None:
    """Split names at commas; None stays None."""
    return None if models is None else tuple(name.strip() for name in models.split(",") if name.strip())


def pair_of(text: str, option: str) -> tuple[float, float]:
    """Parse one positive number, or two as XxY; refused as a bad value of `option`."""
    try:
        numbers = [float(part) for part in text.lower().split("x")]
        x, y = numbers * 2 if len(numbers) == 1 else numbers
        if not (0 < x < float("inf") and 0 < y < float("inf")):
            raise ValueError
    except ValueError:
        needed = "takes one or two numbers in mm, without the unit, such as 120 or 97.1x97.3"
        raise BadParameter(needed, param_hint=option) from None
    return x, y
