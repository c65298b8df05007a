"""Benchmarks: what each knob costs and what it buys, measured on this machine, as charts, a table and JSON.

In: the name of a benchmark. Out: a folder with `NAME.json`, `NAME_<chart>.png` and `table.txt`. A benchmark is a
generator of `Chart`s; times are taken in turn within one run and told as ratios, because a machine's seconds mean
little elsewhere. Every point says how far it could be off; the Pareto front is what nothing else beats in both cost and
error, and the default is ringed, so that one sees whether it lies there. Claims that a chart is made to test stand in
it as `Check`s; a check that fails is reported, not raised.
"""

from __future__ import annotations

import json
import math
import os
import platform
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from patchproof.claims import CONFIDENCE
from patchproof.output import new_folder
from patchproof.settings import Refused, nearest

Interval = tuple[float, float]
OnStage = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Point:
    """One setting of a knob: what it costs and how far off it is, each with an interval."""

    setting: str
    cost: float
    error: float
    cost_interval: Interval
    error_interval: Interval
    default: bool = False
    front: bool = False


@dataclass(frozen=True)
class Series:
    """Points that belong together: a knob's settings, or the sizes of a growing task with the slope of its cost."""

    label: str
    points: tuple[Point, ...]
    slope: float | None = None  # of log time over log size, over the larger half of the sizes


@dataclass(frozen=True)
class Check:
    """A claim with its figure: it holds where the figure is `at_least` or `at_most` the limit."""

    claim: str
    figure: float
    limit: float
    at_least: bool = False

    @property
    def holds(self) -> bool:
        """Whether the figure keeps the limit; one that is no number does not."""
        return self.figure >= self.limit if self.at_least else self.figure <= self.limit


@dataclass(frozen=True)
class Table:
    """Figures behind a chart, as text."""

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Chart:
    """Cost to the right, error upwards, or where `higher_is_better` a quality such as PSNR; `target` is a line across.

    `notes` say what was measured and on what.
    """

    name: str
    title: str
    cost_label: str
    error_label: str
    series: tuple[Series, ...]
    notes: tuple[str, ...] = ()
    checks: tuple[Check, ...] = ()
    tables: tuple[Table, ...] = ()
    higher_is_better: bool = False
    target: float | None = None


@dataclass(frozen=True)
class Growth(Chart):
    """The size of a task to the right (as `cost`), its time upwards (as `error`); both over decades."""


@dataclass(frozen=True)
class Shares(Chart):
    """Parts of a cost as bars: the share to the right; `error` is 0."""


def run_bench(
    name: str = "all",
    out: str | Path = "patchproof-bench",
    *,
    quick: bool = False,
    overwrite: bool = False,
    on_stage: OnStage = lambda stage, done, total: None,
) -> list[str]:
    """Run one benchmark, or `all`, into the folder `out`; returns the summary's lines."""
    from patchproof.study.bench_charts import save_chart

    benches = _benches()
    if name != "all" and name not in benches:
        raise Refused("the name of a benchmark", f'"{name}"', nearest(name, ["all", *benches]))
    chosen = list(benches) if name == "all" else [name]
    own, lines = ("*.json", "*_*.png", "table.txt"), []
    with new_folder(out, own, overwrite) as folder:
        for one in chosen:
            about, charts = machine(), []
            for chart in benches[one](quick, on_stage):
                charts.append(with_front(chart))
                save_chart(charts[-1], about, folder / f"{one}_{chart.name}.png")
            _write_json(folder / f"{one}.json", {"bench": one, "quick": quick, "machine": about}, charts)
            lines += [describe(about), *(line for chart in charts for line in ["", *text(chart)])]
        (folder / "table.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return [*lines, "", f"written: {out}"]


def _benches() -> dict[str, Callable[[bool, OnStage], Iterator[Chart]]]:
    from patchproof.study.bench_detect import detect_charts
    from patchproof.study.bench_printer import printer_charts
    from patchproof.study.bench_render import render_charts

    return {"render": render_charts, "printer": printer_charts, "detect": detect_charts}


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


def pareto(cost: Sequence[float], error: Sequence[float]) -> np.ndarray:
    """Which points no other beats: none is as good in both and better in one; bool, one per point."""
    both = np.stack([cost, error], 1).astype(float)
    no_worse = (both[None] <= both[:, None]).all(2)
    better = (both[None] < both[:, None]).any(2)
    return ~(no_worse & better).any(1)


def with_front(chart: Chart) -> Chart:
    """The chart with the points of each series' Pareto front marked."""
    if isinstance(chart, Growth | Shares):
        return chart
    sign, marked = (-1 if chart.higher_is_better else 1), []
    for one in chart.series:
        front = pareto([p.cost for p in one.points], [sign * p.error for p in one.points]).tolist()
        points = (replace(point, front=on) for point, on in zip(one.points, front, strict=True))
        marked.append(replace(one, points=tuple(points)))
    return replace(chart, series=tuple(marked))


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


def psnr(picture, truth) -> float:
    """Peak signal-to-noise ratio in dB of pictures in [0, 1]."""
    square = float(((picture.double() - truth.double()) ** 2).mean())
    return -10 * math.log10(max(square, 1e-12))


def text(chart: Chart) -> list[str]:
    """The chart as lines of a table, its notes and its checks."""
    lines = [chart.title, f"  x: {chart.cost_label}", *([f"  y: {chart.error_label}"] if chart.error_label else [])]
    for table in (_points_table(chart), *chart.tables):
        lines += _aligned(table)
    lines += [f"  note: {note}" for note in chart.notes]
    lines += [f"  slope of {one.label}: {one.slope:.2f}" for one in chart.series if one.slope is not None]
    return lines + [
        f"  {'holds' if c.holds else 'FAILS'}: {c.claim}: {c.figure:.3g} "
        f"({'at least' if c.at_least else 'at most'} {c.limit:g})"
        for c in chart.checks
    ]


def _points_table(chart: Chart) -> Table:
    rows = []
    for series in chart.series:
        for p in series.points:
            mark = ", ".join(word for word, is_so in (("default", p.default), ("front", p.front)) if is_so)
            y = ("", "") if isinstance(chart, Shares) else (_number(p.error), _span(p.error_interval))
            rows.append((f"{series.label}: {p.setting}", _number(p.cost), _span(p.cost_interval), *y, mark))
    y = ("", "") if isinstance(chart, Shares) else ("y", "from - to")
    return Table(("", "x", "from - to", *y, ""), tuple(rows))


def _aligned(table: Table) -> list[str]:
    widths = [max(map(len, column)) for column in zip(table.head, *table.rows, strict=True)]
    lines = []
    for row in (table.head, *table.rows):
        cells = [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))]
        lines.append("  " + "  ".join(cells).rstrip())
    return lines


def _number(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:,.0f}"


def _span(interval: Interval) -> str:
    low, high = map(_number, interval)
    return "" if low == high else f"{low} - {high}"


def _write_json(path: Path, about: dict[str, Any], charts: list[Chart]) -> None:
    data = about | {"charts": {chart.name: asdict(chart) for chart in charts}}
    for chart in charts:
        for check, entry in zip(chart.checks, data["charts"][chart.name]["checks"], strict=True):
            entry["holds"] = check.holds
    path.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


def _processor() -> str:
    """The processor's name, which Linux keeps in a file of its own."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return named[0] if named else platform.processor() or platform.machine()
