"""A run from nothing to its page, by the code of several checkouts in turn: `optimize`, its promise, `sheet`.

In: a scene's file, and `src` folders of checkouts (git worktree add). Out: a table of its name, here: by
checkout and round the seconds of a new process and of its parts, and what it promised. Run in this folder, idle:
python whole.py SCENE ROUNDS SRC [SRC ...]
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from patchlab.results.rows import write_rows
from patchlab.study.measure import run_in_checkout

RUN = """
import json, sys, time
begin = time.perf_counter()
import patchproof as pp
ends = []
scene = pp.load_scene(sys.argv[2])
folder = sys.argv[1]


def clock(stage, done, total):
    if stage == "optimize":
        ends.append(time.perf_counter())


run = pp.optimize(scene, folder + "/run", compute=pp.Compute(jobs=2), progress=clock)
promised = time.perf_counter()
pp.sheet(run, folder + "/sheet.pdf")
end = time.perf_counter()
parts = {"steps_s": ends[-1] - begin, "promise_s": promised - ends[-1], "sheet_s": end - promised, "all_s": end - begin}
low, high = run.promise.interval
print(json.dumps(parts | {"rate": run.promise.rate, "low": low, "high": high, "views": run.promise.n}))
"""


def measured(source: Path, number: int, scene: str) -> dict:
    """A line of the table."""
    with TemporaryDirectory() as folder:
        commit, values = run_in_checkout(source, RUN, folder, scene)
    return {"commit": commit, "round": number} | {name: round(v, 4) for name, v in values.items()}


if __name__ == "__main__":
    scene, rounds, *sources = sys.argv[1:]
    rows = (measured(Path(source), n, scene) for n in range(int(rounds)) for source in sources)
    write_rows(f"{Path(scene).stem}.csv", rows)
