"""Long work: the device and processes that it runs on, and callbacks of its progress.

In: a user's choice. Out: `Compute`, whose fields a verb either uses or refuses by name; `progress_bar`; the type of the
`progress` parameter of every long public function, and its default, which reports nothing. Functions below a public one
take an `advance` callback, for the stage that their caller named.
"""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from patchproof.base.errors import Refused

LINE_EVERY_S = 30.0  # of progress, if standard error is not a terminal
Progress = Callable[[str, int, int], None]
"""Called as `progress(stage, done, total)`: a stage's name ("optimize", "promise", ...), items done, items in all."""

Advance = Callable[[int, int], None]
"""Called as `advance(done, total)`: a `Progress` whose stage is fixed, `partial(progress, "promise")`."""


@dataclass(frozen=True)
class Compute:
    """The device and processes that work runs on. Results do not depend on `jobs` if one job uses one thread, too.

    Attributes:
        device: torch device of scene and networks, "cpu" or "cuda"; photographs are judged on the CPU only.
        jobs: processes on this machine that share the work, 1 or more.
        cluster: address of a dask scheduler whose workers do the work in place of this machine's; None for no cluster.
    """

    device: str = "cpu"
    jobs: int = 1
    cluster: str | None = None

    def without(self, verb: str, *, device: bool = False, cluster: bool = False) -> "Compute":
        """Return this object; refused if it names a device or cluster that `verb`, by the keywords, cannot use."""
        if device and self.device != "cpu":
            raise Refused(f'device = "cpu" for {verb}', f'"{self.device}"', "leave device out of Compute")
        if cluster and self.cluster is not None:
            raise Refused(f"no cluster for {verb}", f'"{self.cluster}"', "use jobs, which share this machine")
        return self


def no_progress(*done: object) -> None:
    """Report nothing."""


no_advance = no_progress


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """Show progress on standard error: yields the function to pass as `progress`. A terminal or notebook gets a bar
    with the time left, a file or pipe a line every 30 s.

    Examples:
        ```python
        with pp.progress_bar() as bar:
            run = pp.optimize("scene.toml", "run", progress=bar)
        ```
    """
    in_notebook = "ipykernel" in sys.modules
    if not sys.stderr.isatty() and not in_notebook:
        yield _print_lines()
        return
    from rich import progress as rich
    from rich.console import Console

    times = rich.TimeElapsedColumn(), rich.TimeRemainingColumn()
    columns = rich.TextColumn("{task.description:>12}"), rich.BarColumn(), rich.MofNCompleteColumn(), *times
    with rich.Progress(*columns, console=Console(stderr=not in_notebook)) as progress:
        tasks: dict[str, rich.TaskID] = {}

        def advance(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = progress.add_task(stage, total=total)
            progress.update(tasks[stage], completed=done, total=total)

        yield advance


def _print_lines() -> Progress:
    last = time.monotonic()

    def advance(stage: str, done: int, total: int) -> None:
        nonlocal last
        if done >= total or time.monotonic() - last >= LINE_EVERY_S:
            last = time.monotonic()
            print(f"{stage}: {done} of {total}", file=sys.stderr, flush=True)

    return advance
