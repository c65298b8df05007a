"""Kills at any moment: what is there under its final name is whole, and a rerun gives the bytes of an unbroken run.

`python tests/test_kill_anywhere.py --kills N [--seed S] [--job NAME]` kills N times. A process imports once and forks
for every run; a fork dies at its n-th change to the file system, or after a share of its processor time. `optimize`,
`verify` and `study` are resumed, `sheet` and `reprint` done again.
`--interrupts N` presses Ctrl-C N times, at any moment of the commands that take long, and finishes each.
"""

from __future__ import annotations

import argparse
import gc
import importlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from patchproof.optimizer.promise import PromiseOptions

CHANGES = {"os.rename", "os.remove", "os.mkdir", "os.rmdir"}
JOBS = ("optimize", "verify", "sheet", "reprint", "study")
IN_THE_SUITE = len(JOBS)
LATE = """
    patchproof.mesh.primitives patchproof.networks.tracing torch.onnx reportlab.lib.fonts kornia.enhance
    kornia.filters matplotlib.figure matplotlib.backends.backend_agg scipy.stats.qmc scipy.spatial jinja2 pikepdf
    pypdfium2 reportlab.pdfgen.canvas segno safetensors.torch fuzz.readers test_optimize test_verify_run fake_networks
    toy_studies patchlab.study.study patchproof.app.verify patchproof.optimizer.run
    patchproof.reprints.run_sheet patchproof.reprints.reprint patchproof.classifier.builtin
    patchproof.classifier.custom patchproof.report.write"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs os.fork")
def test_killed_runs_leave_nothing_half_done_and_end_in_the_same_bytes(tmp_path):
    lines = list(kills(tmp_path, IN_THE_SUITE))
    assert sum("killed" in line for line in lines) >= IN_THE_SUITE / 2, lines


def optimize(base: Path, out: Path, again: bool) -> None:
    from patchproof.optimizer import loop, run

    run.PROMISE_VIEWS, loop.SELECT_VIEWS, loop.SELECT_AFTER, loop.SAVE_AFTER = 4, 4, 8, 4
    run.optimize(base / "scene.toml", out, promise=PromiseOptions(controls=("bare",)), resume=again)


def verify(base: Path, out: Path, again: bool) -> None:
    from fuzz.readers import network

    from patchproof.app.verify import verify as verify_photos

    verify_photos(base / "photos", base / "sheet.json", out, models=[network()], resume=again)


def sheet(base: Path, out: Path, again: bool) -> None:
    from patchproof.optimizer.run import load_run
    from patchproof.reprints.run_sheet import sheet as sheet_of

    out.mkdir(exist_ok=True)
    sheet_of(load_run(base / "run"), out / "sheet.pdf", control="gray")  # without its plan of photographs


def reprint(base: Path, out: Path, again: bool) -> None:
    from patchproof.optimizer.run import load_run
    from patchproof.reprints.reprint import reprint

    reprint(base / "sheet.pdf", load_run(base / "run"), 3, out)


def study(base: Path, out: Path, again: bool) -> None:
    import toy_studies as toy

    from patchlab.study.study import Work, run_cells

    run_cells(toy.STUDY, toy.ToySettings(numbers=(1, 2, 13, 4)), base, out, Work(resume=again))  # one cell fails


DO = dict(zip(JOBS, (optimize, verify, sheet, reprint, study), strict=True))


def prepare(base: Path) -> None:
    """What the jobs work on: a scene, a finished run and its sheet, photographs and theirs."""
    from fuzz.readers import honest_photo, manifests

    from test_optimize import toml

    toml(base / "scene.toml", optimize__steps=6, background__color=[0.5, 0.5, 0.5])
    optimize(base, base / "run", False)
    sheet(base, base / "page", False)
    shutil.copy(base / "page" / "sheet.pdf", base)
    (base / "sheet.json").write_text(json.dumps(manifests()[0]))
    (base / "photos").mkdir()
    for name in "abc":
        (base / "photos" / f"{name}.jpg").write_bytes(honest_photo())


def contents(folder: Path) -> dict[str, bytes]:
    """What lies in a folder under final names, by path."""
    files = (path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def check_whole(job: str, out: Path, unbroken: dict[str, bytes]) -> None:
    """Whatever a killed run has left under a final name is whole: a page or photograph is one of the unbroken run's."""
    left = contents(out) if out.is_dir() else {}
    if job == "sheet":
        assert all(unbroken[name] == content for name, content in left.items()), sorted(left)
    if job == "reprint":
        assert left in ({}, unbroken), sorted(left)
    if job == "study":  # toy.json has the settings before it has the tables
        assert all(unbroken[name] == content for name, content in left.items() if name != "toy.json"), sorted(left)
    for name in ("run.json", "design.png", "views.png", "report.json", "report.csv", "report.html"):
        assert left.get(name) in (None, unbroken.get(name)), name


def forked(work: Callable[[], None], die: Callable[[], None] = lambda: None) -> int:
    """The wait status of a fork that does the work, and calls `die` before."""
    child = os.fork()
    if child == 0:
        try:
            die()
            work()
        except BaseException:
            import traceback

            traceback.print_exc()
            os._exit(1)
        os._exit(0)
    return os.waitpid(child, 0)[1]


def on_changes(call: Callable[[], None]) -> None:
    """Call a function right before every change to the file system, for good."""

    def hook(event: str, arguments: tuple) -> None:
        if event in CHANGES or (event == "open" and isinstance(arguments[1], str) and arguments[1][0] in "wax"):
            call()

    sys.addaudithook(hook)


def at_change(number: int) -> Callable[[], None]:
    """Die right before a change to the file system, counted from 1."""
    left = iter(range(number - 1))
    return lambda: on_changes(lambda: next(left, None) is None and os.kill(os.getpid(), signal.SIGKILL))


def after(seconds: float) -> Callable[[], None]:
    """Die after so much processor time: nothing of ours runs then."""
    return lambda: signal.setitimer(signal.ITIMER_PROF, seconds)


def changes_of(work: Callable[[], None], count: Path) -> int:
    """How many changes to the file system the work makes, in a fork; `count` is a file to tell it by."""

    def counting() -> None:
        changes: list[int] = []
        on_changes(lambda: changes.append(1))
        work()
        count.write_text(str(len(changes)))

    assert forked(counting) == 0
    return int(count.read_text())


def killed(base: Path, job: str, rng: np.random.Generator) -> Iterator[str]:
    """Kill a job again and again, and finish it; a line for each."""
    unbroken_out, out = base / f"{job}_whole", base / f"{job}_killed"

    def work(out: Path, again: bool = False) -> Callable[[], None]:
        return lambda: DO[job](base, out, again)

    begin = os.times()
    total = changes_of(work(unbroken_out), base / "count")
    seconds = os.times().children_user - begin.children_user
    unbroken = contents(unbroken_out)
    while True:
        by_change = rng.random() < 0.7
        moment = int(rng.integers(1, total + 1)) if by_change else float(rng.uniform(0, seconds))
        status = forked(work(out), at_change(moment) if by_change else after(moment))
        where = f"at change {moment} of {total}" if by_change else f"after {moment:.2f} s"
        check_whole(job, out, unbroken)
        if died := os.WIFSIGNALED(status):
            assert forked(work(out, True)) == 0, (job, where)
        assert contents(out) == unbroken, (job, where, sorted(contents(out).keys() ^ unbroken.keys()))
        shutil.rmtree(out)
        yield f"{job}: {'killed' if died else 'done'} {where}"


def kills(base: Path, count: int, seed: int = 0, job: str | None = None) -> Iterator[str]:
    """Kill so many times, one job after the other; a line for each."""
    from patchproof.base.workers import use_threads

    rng, jobs = np.random.default_rng(seed), [job] if job else JOBS
    with warnings.catch_warnings(), use_threads(1):  # of the fake network, by every fork; which has no other threads
        warnings.simplefilter("ignore")
        for module in LATE.split():  # once, and not in every fork
            importlib.import_module(module)
        Image.init()
        gc.freeze()  # a fork that collected garbage would copy what it looks through, in 0.2 s
        assert forked(lambda: prepare(base)) == 0
        lines = [killed(base, job, rng) for job in jobs]
        for i in range(count):
            yield next(lines[i % len(lines)])
        gc.unfreeze()


SWALLOWS = "import time\nwhile True:\n    try:\n        time.sleep(9)\n    except BaseException:\n        pass"
SETUP = "from patchproof.app import interrupt; interrupt.STOP_AFTER_S = 0.1; interrupt.handle_interrupts(); "


@pytest.mark.parametrize("work", [SWALLOWS, "import swallows"], ids=["a library", "an import"])
def test_ctrl_c_stops_what_swallows_it(work, tmp_path):
    (tmp_path / "swallows.py").write_text(SWALLOWS)
    code = f"{SETUP}print(flush=True)\n{work}"
    with subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path, stdout=-1, stderr=-1) as process:
        assert process.stdout and process.stdout.readline()
        time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=2)
    assert process.returncode == 130 and error == b"Stopped: nothing was written.\n"


VERBS = {  # each with what it writes
    "optimize": ("optimize scene.toml --out made --steps 20 --promise 8", "made"),
    "promise": ("promise run --n 16", "run"),
    "reprint": ("reprint sheet.pdf --run run --n 4 --out taken", "taken"),
    "verify": ("verify photos --sheet sheet.json --out report", "report"),
    "evaluate": ("evaluate run --n 16 --overwrite", "run"),
}


def interrupts(base: Path, count: int, seed: int) -> Iterator[str]:
    """Interrupt the commands of `VERBS` in turn at random moments, and finish each; a line for each moment."""

    def start(line: str, **options) -> subprocess.Popen[bytes]:
        options = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL} | options
        return subprocess.Popen([sys.executable, "-m", "patchproof", *line.split()], cwd=base, **options)

    def results(folder: Path) -> dict[str, bytes]:  # but for the journal, whose lines come as photographs are finished
        return {name: data for name, data in contents(folder).items() if name != "photos.jsonl"}

    (base / "scene.toml").write_text(
        'object = {mesh = "primitive:box_truck", length_mm = 400}\npatch = {width_mm = 90, height_mm = 90}\n'
        'target = {label = "box truck", models = ["builtin"]}'
    )
    for line in (
        "optimize scene.toml --out run --steps 4 --promise 16",
        "sheet run --out sheet.pdf",
        "reprint sheet.pdf --run run --n 4 --out photos",
        "evaluate run --n 16",
    ):
        assert start(line).wait() == 0, line
    rng, seconds, unbroken = np.random.default_rng(seed), {}, {}
    signal.signal(signal.SIGINT, signal.default_int_handler)  # what a shell starts in the background inherits none
    for verb, (line, out) in VERBS.items():
        begin = time.monotonic()
        assert start(line).wait() == 0, line
        seconds[verb], unbroken[verb] = time.monotonic() - begin, results(base / out)
        if out != "run":
            shutil.rmtree(base / out)
    for number in range(count):
        verb = list(VERBS)[number % len(VERBS)]
        line, out = VERBS[verb]
        moment = float(rng.uniform(0.1, seconds[verb]))
        process = start(line, stderr=-1, start_new_session=True)
        time.sleep(moment)
        os.killpg(process.pid, signal.SIGINT)
        begin = time.monotonic()
        _, error = process.communicate()
        took, code = time.monotonic() - begin, process.returncode
        again = " --resume" if "--resume" in error.decode() else ""
        if not (finished := (base / out).is_dir() and results(base / out) == unbroken[verb]):  # else as it ended
            assert code != 0 and start(line + again).wait() == 0, (verb, moment, error)
        same = finished or results(base / out) == unbroken[verb]
        if out != "run":
            shutil.rmtree(base / out)
        yield f"{verb}: at {moment:.2f} of {seconds[verb]:.2f} s, code {code} after {took:.2f} s, same bytes: {same}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--job", choices=JOBS)
    parser.add_argument("--interrupts", type=int, default=0)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        done = kills(Path(name), chosen.kills, chosen.seed, chosen.job)
        for line in interrupts(Path(name), chosen.interrupts, chosen.seed) if chosen.interrupts else done:
            print(line, flush=True)


if __name__ == "__main__":
    main()
