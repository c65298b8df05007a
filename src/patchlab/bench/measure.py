"""How benchmarks measure: times taken in turn within one run, their ratios, and the machine.

In: calls. Out: seconds and ratios. A machine's seconds mean little elsewhere, so that times are compared only with
times of the same run.
"""

from __future__ import annotations

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
    """What the figures depend on beside the code."""
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
    """The machine in one line, for the corner of a chart."""
    threads = f"{about['threads']} thread{'' if about['threads'] == 1 else 's'} of {about['cores']} cores"
    return f"{about['processor']}, {threads}, torch {about['torch']}, {about['date']}"


def call_in_turn(
    calls: Mapping[Name, Callable[[], ReturnValue]], rounds: int, advance: Advance = no_advance
) -> dict[Name, list[ReturnValue]]:
    """What each call returns in each of some rounds, all calls in turn in every round; a round before them warms up."""
    answers: dict[Name, list[ReturnValue]] = {name: [] for name in calls}
    for number in range(rounds + 1):
        for name, call in calls.items():
            answers[name].append(call())
        advance(number + 1, rounds + 1)
    return {name: values[1:] for name, values in answers.items()}


def time_calls(calls: Mapping[Name, Callable[[], object]], rounds: int) -> dict[Name, np.ndarray]:
    """Wall milliseconds of each call in `rounds` rounds of `call_in_turn`."""
    told = call_in_turn({name: partial(time_call, call, time.perf_counter) for name, call in calls.items()}, rounds)
    return {name: np.array([ms for _, ms in values]) for name, values in told.items()}


def time_call(
    call: Callable[[], ReturnValue], clock: Callable[[], float] = time.process_time
) -> tuple[ReturnValue, float]:
    """What a call returns, and its milliseconds; of the processor, where other work on the machine does not count, if
    no other clock is given.
    """
    begin = clock()
    return call(), 1000 * (clock() - begin)


def time_ratio(times: Mapping[Name, np.ndarray], a: Name, b: Name) -> Estimate:
    """How many times as long `a` took as `b`: the median over rounds, each with its own ratio."""
    return median(times[a] / times[b])


def run_in_checkout(source: Path, code: str, *arguments: str) -> tuple[str, Any]:
    """(the short commit, the JSON in the last line that `code` prints) in a process of its own, which imports from the
    `src` folder of a checkout.
    """
    command, environment = [sys.executable, "-c", code, *arguments], {**os.environ, "PYTHONPATH": str(source.resolve())}
    said = subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True).stdout
    commit = subprocess.run(["git", "-C", source, "rev-parse", "--short", "HEAD"], stdout=subprocess.PIPE, text=True)
    return commit.stdout.strip(), json.loads(said.splitlines()[-1])


def _processor() -> str:
    """The processor's name, which Linux keeps in a file of its own."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return named[0] if named else platform.processor() or platform.machine()
