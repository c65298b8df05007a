"""A small study, and functions for workers to run: they live here so that other processes can import them."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from patchlab.study.study import Cell, Study
from patchproof.base import input as bounds
from patchproof.base.errors import Refused
from patchproof.base.intervals import rate
from patchproof.base.validation import StrictModel
from patchproof.photo import limits
from patchproof.photo.rejection import PhotoRejected
from patchproof.report.tables import Drawing, Table


class ToySettings(StrictModel):
    numbers: tuple[int, ...]
    pause_s: float = 0.0
    die_in: str | None = None  # a folder; a cell's worker dies while the file named after the cell is there


def cells(settings, base):
    return [Cell(f"n{number}", {"number": number}) for number in settings.numbers]


def run(settings, base, cell):
    number = cell.values["number"]
    time.sleep(settings.pause_s)
    if settings.die_in is not None:
        die_once(Path(settings.die_in) / cell.name)
    if number == 13:
        raise Refused("a number that brings luck", "13", "use another")
    if number == 14:
        raise ArithmeticError("over\nflow")
    if number == 15:
        return {"square": float("nan")}
    return {"square": number**2, "parts": (1, 2), f"n{number}.txt": str(number).encode()}


def tables(settings, results):
    rows = tuple((one.cell.name, one.answers["square"], rate([one.answers["square"] > 3] * 4)) for one in results)
    return (Table("squares", "Squares", ("cell", "square", "large"), rows, "of whole numbers"),)


def figures(settings, results):
    def draw(figure):
        figure.add_subplot().plot([one.answers["square"] for one in results])

    return (Drawing("squares", "Squares", draw, (3.0, 2.0)),)


STUDY = Study("toy", ToySettings, cells, run, tables, figures)


def double(number):
    return 2 * number


def refuse(number):
    raise Refused("a", f"{number}", "c")


def threads(_):
    import torch

    return torch.get_num_threads()


def die_once(path: Path) -> None:
    """Kill this process, the first time."""
    if path.exists():
        path.unlink()
        os.kill(os.getpid(), signal.SIGKILL)


def double_or_die(task):
    folder, number = task
    die_once(Path(folder) / str(number))
    return 2 * number


def double_unless_three(number):
    if number == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return 2 * number


def spin(seconds):
    """Keep the processor busy for that long."""
    begin = time.process_time()
    while time.process_time() - begin < seconds:
        pass
    return seconds


def given_up(seconds):
    """What a limit of 0.2 s makes of that, in whichever process this is."""
    bounds.TIME_LIMIT_S = 0.2
    try:
        return limits.run_limited(spin, seconds)
    except PhotoRejected as cannot:
        return cannot.code


def begin_with_timer(_):
    """As a process apart for photographs begins: they are measured in a main thread, where their time is limited. Not
    beside its test, which imports more than that process needs.
    """
    from patchproof.app.capture.collection import prepare_worker

    assert bounds.has_timer()
    prepare_worker(None)
