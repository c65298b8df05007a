"""Measure time: calls in turn within one run, ratios of their times, and the machine.

In: calls. Out: milliseconds and ratios. Seconds of one machine mean little on another, so times are compared only
within a run.
"""

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Hashable, Mapping
from datetime import date
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from patchlab.study.estimates import median
from patchproof.base.intervals import Estimate
from patchproof.base.progress import Advance, no_advance

Name = TypeVar("Name", bound=Hashable)
ReturnValue = TypeVar("ReturnValue")


def machine_details() -> dict[str, Any]:
    """Everything besides the code that times depend on: processor, cores, threads, versions, date."""
    import torch

    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "system": platform.system(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "date": date.today().isoformat(),
    }


def machine_line(about: Mapping[str, Any]) -> str:
    """One line about the machine, for the corner of a chart."""
    threads = f"{about['threads']} thread{'' if about['threads'] == 1 else 's'} of {about['cores']} cores"
    return f"{about['processor']}, {threads}, torch {about['torch']}, {about['date']}"


def call_in_turn(
    calls: Mapping[Name, Callable[[], ReturnValue]], rounds: int, advance: Advance = no_advance
) -> dict[Name, list[ReturnValue]]:
    """By name the results of each call in `rounds` rounds; every round makes all calls in turn; one before warms up."""
    answers: dict[Name, list[ReturnValue]] = {name: [] for name in calls}
    for number in range(rounds + 1):
        for name, call in calls.items():
            answers[name].append(call())
        advance(number + 1, rounds + 1)
    return {name: values[1:] for name, values in answers.items()}


def time_calls(calls: Mapping[Name, Callable[[], object]], rounds: int) -> dict[Name, np.ndarray]:
    """Wall milliseconds of each call, one per round of `call_in_turn`."""
    results = call_in_turn({name: partial(time_call, call, time.perf_counter) for name, call in calls.items()}, rounds)
    return {name: np.array([ms for _, ms in values]) for name, values in results.items()}


def time_call(
    call: Callable[[], ReturnValue], clock: Callable[[], float] = time.process_time
) -> tuple[ReturnValue, float]:
    """(the call's result, milliseconds); by default processor time, which other work on the machine leaves alone."""
    begin = clock()
    return call(), 1000 * (clock() - begin)


def time_ratio(times: Mapping[Name, np.ndarray], a: Name, b: Name) -> Estimate:
    """Time of `a` over time of `b`: the median of the rounds' ratios."""
    return median(times[a] / times[b])


def run_in_checkout(source: Path, code: str, *arguments: str) -> tuple[str, Any]:
    """Run code that imports from a checkout's `src`: (short commit, JSON in the last line that it prints)."""
    command, environment = [sys.executable, "-c", code, *arguments], {**os.environ, "PYTHONPATH": str(source.resolve())}
    output = subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True).stdout
    commit = subprocess.run(["git", "-C", source, "rev-parse", "--short", "HEAD"], stdout=subprocess.PIPE, text=True)
    return commit.stdout.strip(), json.loads(output.splitlines()[-1])


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return named[0] if named else platform.processor() or platform.machine()
