"""Run benchmarks on this machine and write charts, tables and a page.

In: the name of a benchmark. Out: a folder with `NAME.json`, `NAME.html`, and a CSV and PNG per chart. A benchmark is a
generator of `Chart`s. A failed check is reported, not raised.
"""

from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path

from patchlab.bench.chart import Chart, chart_drawing, checks_table, failed_checks, points_table
from patchlab.bench.measure import machine_details, machine_line
from patchproof.base.errors import Refused
from patchproof.base.output import new_folder
from patchproof.base.progress import Progress
from patchproof.base.validation import spelling_hint
from patchproof.report.tables import Results, write_results

Bench = Callable[[bool, Progress], Iterator[Chart]]
BENCHES = ("render", "train", "effort", "printer", "detect", "evidence", "peers")  # modules with a `charts`
_BENCH_FILES = ("*.json", "*.html", "*_*.csv", "*_*.png")


def run_bench(
    name: str = "all",
    out: str | Path = "patchlab-bench",
    *,
    quick: bool = False,
    overwrite: bool = False,
    progress: Progress = lambda stage, done, total: None,
) -> list[Results]:
    """Run one benchmark, or `all`, and write it into the folder `out`; returns the results."""
    if name not in ("all", *BENCHES):
        raise Refused("the name of a benchmark", f'"{name}"', spelling_hint(name, ("all", *BENCHES)))
    written = []
    with new_folder(out, _BENCH_FILES, overwrite) as folder:
        for bench in BENCHES if name == "all" else (name,):
            charts = list(load_bench(bench)(quick, progress))
            written.append(_results(bench, quick, charts))
            write_results(folder, written[-1])
    return written


def load_bench(name: str) -> Bench:
    """Import a benchmark: its generator of charts."""
    return import_module(f"patchlab.bench.{name}").charts


def _results(name: str, quick: bool, charts: list[Chart]) -> Results:
    about = machine_details()
    tables = [table for chart in charts for table in (points_table(chart), *chart.tables)]
    return Results(
        program="patchlab",
        kind="bench",
        name=name,
        about="What each setting costs and how far off it is, measured on this machine.",
        extent=machine_line(about),
        settings={"quick": quick},
        tables=[*tables, checks_table(charts)],
        figures=[chart_drawing(chart, machine_line(about)) for chart in charts],
        failed=failed_checks(charts),
        more={"machine": about},
    )
