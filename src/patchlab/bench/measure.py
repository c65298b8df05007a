"""How benchmarks measure: times taken in turn within one run, their ratios, and the machine.

In: calls. Out: seconds and ratios. A machine's seconds mean little elsewhere, so that times are compared only with
times of the same run.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Hashable, Mapping
from datetime import date
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from patchlab.study.claims import median
from patchproof.base.claims import Estimate

Name = TypeVar("Name", bound=Hashable)
Answer = TypeVar("Answer")


def machine() -> dict[str, Any]:
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


def describe(about: Mapping[str, Any]) -> str:
    """The machine in one line, for the corner of a chart."""
    threads = f"{about['threads']} thread{'' if about['threads'] == 1 else 's'} of {about['cores']} cores"
    return f"{about['processor']}, {threads}, torch {about['torch']}, {about['date']}"


def timed(calls: Mapping[Name, Callable[[], object]], rounds: int) -> dict[Name, np.ndarray]:
    """Wall seconds of each call, `rounds` of them, all calls in turn in each round after one round of warm-up."""
    seconds: dict[Name, list[float]] = {name: [] for name in calls}
    for _ in range(rounds + 1):
        for name, call in calls.items():
            begin = time.perf_counter()
            call()
            seconds[name].append(time.perf_counter() - begin)
    return {name: np.array(values[1:]) for name, values in seconds.items()}


def clocked(call: Callable[[], Answer]) -> tuple[Answer, float]:
    """What a call returns, and its milliseconds of the processor: other work on the machine does not count."""
    begin = time.process_time()
    return call(), 1000 * (time.process_time() - begin)


def ratio(seconds: Mapping[Name, np.ndarray], a: Name, b: Name) -> Estimate:
    """How many times as long `a` took as `b`: the median over rounds, each with its own ratio."""
    return median(seconds[a] / seconds[b])


def _processor() -> str:
    """The processor's name, which Linux keeps in a file of its own."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return named[0] if named else platform.processor() or platform.machine()
