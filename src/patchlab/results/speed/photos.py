"""Time reading and measuring photographs of 12 megapixels, with the code of several checkouts in turn.

In: `photos.toml`, and `src` folders of checkouts (git worktree add). Out: `photos.csv`: by checkout, round and
photograph milliseconds of processor time, from the file to figures and the networks' squares, without the networks and
the page, and what was found. One process with one thread each; 24 photographs in two sessions by our own renderer.
Run in this folder, idle: python photos.py ROUNDS SRC [SRC ...]
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import patchproof as pp
from patchlab.results.rows import write_rows
from patchlab.study.measure import run_in_checkout

TIMED = """
import json, sys, time
from pathlib import Path
import cv2, torch
from patchproof.evidence.batch import PhotoItem, _measure_or_reject
from patchproof.evidence.classify import judges_of
from patchproof.evidence.task import task_of
from patchproof.app.verify import options_of
from patchproof.sheets.manifest import load_manifest
from patchproof.base.workers import keep_freed_memory
keep_freed_memory()
torch.set_num_threads(1)
cv2.setNumThreads(1)
sheet = Path(sys.argv[1]) / "sheet.json"
manifest = load_manifest(sheet)
options = options_of(sheet, manifest)
task = task_of(manifest, options, judges_of(options.models, manifest))
items = [PhotoItem(path, path.name, with_pictures=True) for path in sorted(Path(sys.argv[1]).glob("photos/*/*.jpg"))]
rows = []
for item in 2 * items:
    begin = time.process_time()
    measured = _measure_or_reject(task, item)
    took = 1000 * (time.process_time() - begin)
    entry = measured.entry
    found = {"status": entry.status, "code": entry.code, "markers": entry.markers_found}
    rows.append({"photo": f"{item.path.parent.name}/{item.file}", "ms": round(took, 1)} | found)
print(json.dumps(rows[len(items):]))  # the first time warms up
"""


def measured(source: Path, number: int, folder: str) -> list[dict]:
    """Lines of the table."""
    commit, rows = run_in_checkout(source, TIMED, folder)
    return [{"commit": commit, "round": number} | row for row in rows]


if __name__ == "__main__":
    with TemporaryDirectory() as folder:
        at = Path(folder)
        run = pp.optimize("photos.toml", at / "run", promise=pp.PromiseOptions(40))
        pp.sheet(run, at / "sheet.pdf")
        pp.reprint(at / "sheet.pdf", run, 24, at / "photos", sessions=2)
        turns = [(Path(source), n) for n in range(int(sys.argv[1])) for source in sys.argv[2:]]
        write_rows("photos.csv", (row for turn in turns for row in measured(*turn, folder)))
