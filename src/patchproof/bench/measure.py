"""How benchmarks measure: times taken in turn within one run, medians and means with intervals, the machine.

In: calls, or figures. Out: seconds, ratios and intervals. A machine's seconds mean little elsewhere, so that times are
compared only with times of the same run.
"""

from __future__ import annotations

import math
import os
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from patchproof.bench.chart import Interval
from patchproof.claims import CONFIDENCE


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


def slope(size: Sequence[float], seconds: Sequence[float]) -> float:
    """Exponent k of seconds ~ size^k over the larger half of the sizes: a fixed cost hides in the smaller ones."""
    half = len(size) // 2
    return float(np.polyfit(np.log(size[half:]), np.log(seconds[half:]), 1)[0])


def timed(calls: Mapping[Any, Callable[[], object]], rounds: int) -> dict[Any, np.ndarray]:
    """Wall seconds of each call, `rounds` of them, all calls in turn in each round after one round of warm-up."""
    seconds: dict[Any, list[float]] = {name: [] for name in calls}
    for _ in range(rounds + 1):
        for name, call in calls.items():
            begin = time.perf_counter()
            call()
            seconds[name].append(time.perf_counter() - begin)
    return {name: np.array(values[1:]) for name, values in seconds.items()}


def median_interval(values: np.ndarray) -> tuple[float, Interval]:
    """The median with its distribution-free 95 % interval from order statistics; of few values, their range."""
    from scipy.stats import binom

    ordered, n = np.sort(values), len(values)
    skipped = max(int(binom.ppf((1 - CONFIDENCE) / 2, n, 0.5)) - 1, 0)
    return float(np.median(ordered)), (float(ordered[skipped]), float(ordered[n - 1 - skipped]))


def ratio(seconds: Mapping[Any, np.ndarray], one: Any, other: Any) -> tuple[float, Interval]:
    """How many times as long one call took as another: the median over rounds, each with its own ratio."""
    return median_interval(seconds[one] / seconds[other])


def mean_interval(values: np.ndarray) -> tuple[float, Interval]:
    """The mean with its 95 % bootstrap interval (percentiles of 2000 draws from a fixed seed)."""
    draws = np.random.default_rng(0).integers(len(values), size=(2000, len(values)))
    tail = 100 * (1 - CONFIDENCE) / 2
    low, high = np.percentile(np.asarray(values)[draws].mean(1), [tail, 100 - tail])
    return float(np.mean(values)), (float(low), float(high))


def paired_means(values: np.ndarray) -> list[tuple[float, Interval]]:
    """Means of the columns of S×K (K settings tried on the same S seeds) with 95 % intervals for comparing them.

    What all settings of a seed have in common is taken out: Student's intervals of what is left, as in Morey,
    Confidence intervals from normalized data: a correction to Cousineau (2005), 2008.
    """
    from scipy.stats import t

    seeds, settings = values.shape
    left = values - values.mean(1, keepdims=True)
    spread = left.std(0, ddof=1) * math.sqrt(settings / (settings - 1) / seeds)
    half = float(t.ppf(0.5 + CONFIDENCE / 2, seeds - 1)) * spread
    middles = values.mean(0)
    return [(float(m), (float(m - h), float(m + h))) for m, h in zip(middles, half, strict=True)]


def checked_pick(values: np.ndarray, costs: Sequence[float], default: int) -> tuple[int, float]:
    """(which of K settings that cost no more than the default is best on every second seed, by what share the default's
    error exceeds its error on the other seeds), of S×K errors, S ≥ 2. Chosen and judged on the same seeds, the luckiest
    would look best.
    """
    affordable = [k for k, cost in enumerate(costs) if cost <= costs[default]]
    pick = min(affordable, key=lambda k: values[0::2, k].mean())
    others = values[1::2].mean(0)
    return pick, float(others[default] / others[pick] - 1)


def psnr(picture, truth) -> float:
    """Peak signal-to-noise ratio in dB of pictures in [0, 1]."""
    square = float(((picture.double() - truth.double()) ** 2).mean())
    return -10 * math.log10(max(square, 1e-12))


def _processor() -> str:
    """The processor's name, which Linux keeps in a file of its own."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return named[0] if named else platform.processor() or platform.machine()
