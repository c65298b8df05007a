"""Benchmarks: what each knob costs and what it buys, measured on this machine, as charts, a table and JSON.

In: the name of a benchmark. Out: a folder with `NAME.json`, `NAME_<chart>.png` and `table.txt`. A benchmark is a
generator of `Chart`s. A check that fails is reported, not raised.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from patchproof.bench.chart import Chart, OnStage, text, with_default_checks, with_front
from patchproof.bench.measure import describe, machine
from patchproof.output import new_folder
from patchproof.strict import Refused, nearest


def run_bench(
    name: str = "all",
    out: str | Path = "patchproof-bench",
    *,
    quick: bool = False,
    overwrite: bool = False,
    on_stage: OnStage = lambda stage, done, total: None,
) -> list[str]:
    """Run one benchmark, or `all`, into the folder `out`; returns the summary's lines."""
    from patchproof.bench.draw import save_chart

    benches = _benches()
    if name != "all" and name not in benches:
        raise Refused("the name of a benchmark", f'"{name}"', nearest(name, ["all", *benches]))
    chosen = list(benches) if name == "all" else [name]
    own, lines = ("*.json", "*_*.png", "table.txt"), []
    with new_folder(out, own, overwrite) as folder:
        for one in chosen:
            about, charts = machine(), []
            for chart in benches[one](quick, on_stage):
                charts.append(with_default_checks(with_front(chart)))
                save_chart(charts[-1], about, folder / f"{one}_{chart.name}.png")
            _write_json(folder / f"{one}.json", {"bench": one, "quick": quick, "machine": about}, charts)
            lines += [describe(about), *(line for chart in charts for line in ["", *text(chart)])]
        (folder / "table.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return [*lines, "", f"written: {out}"]


def _benches() -> dict[str, Callable[[bool, OnStage], Iterator[Chart]]]:
    from patchproof.bench.detect import detect_charts
    from patchproof.bench.evidence import evidence_charts
    from patchproof.bench.numbers import numbers_charts
    from patchproof.bench.printer import printer_charts
    from patchproof.bench.render import render_charts
    from patchproof.bench.train import train_charts

    return {
        "render": render_charts,
        "train": train_charts,
        "numbers": numbers_charts,
        "printer": printer_charts,
        "detect": detect_charts,
        "evidence": evidence_charts,
    }


def _write_json(path: Path, about: dict[str, Any], charts: list[Chart]) -> None:
    data = about | {"charts": {chart.name: asdict(chart) for chart in charts}}
    for chart in charts:
        for check, entry in zip(chart.checks, data["charts"][chart.name]["checks"], strict=True):
            entry["holds"] = check.holds
    path.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
