"""What drafts say of designs that help and of designs that do not: `python tests/draft_answers.py drafts.csv`.

Scenes are objects of the package × places × targets × seeds; large pieces in hard views may help, tiny ones and pieces
on what is recognized anyway cannot. A draft of each is made and answers; its design is then promised from `VIEWS`
views, which say what it is. Rows are added to the CSV, those that are there are kept; it ends with the counts.
"""

from __future__ import annotations

import csv
import sys
import tempfile
from collections import Counter
from itertools import product
from pathlib import Path
from typing import Any

import patchproof as pp
from patchproof.optimizer.evaluate import promise_run

EACH, VIEWS = 20, 200  # designs of either kind; views that decide which kind a design is
HARD = {
    "view": {"azimuth_deg": [-35, 35], "elevation_deg": [-15, 25], "distance_mm": [520, 900], "roll_deg": [-15, 15]},
    "light": {"ambient": [0.1, 0.45], "directional": [0.05, 0.45]},
}
EASY = {"view": {"azimuth_deg": [-40, 40], "elevation_deg": [0, 25], "distance_mm": [450, 650]}}
TRUCK, CARTON, MAILBOX = ("box_truck", "+y", [0, 45]), ("carton", "+z", [0, 0]), ("mailbox", "+x", [0, 0])
HELPS = [  # object with side and offset, target, width in mm
    *((TRUCK, "box truck", 140), (TRUCK, "carton", 147), (CARTON, "mailbox", 130), (MAILBOX, "mailbox", 110)),
    *((CARTON, "box truck", 130), (MAILBOX, "carton", 120), (TRUCK, "mailbox", 140), (CARTON, "chair", 130)),
]
DO_NOT = [  # tiny ones, and on what is recognized without
    *((HARD, (TRUCK, "box truck", 20)), (HARD, (CARTON, "mailbox", 16)), (HARD, (MAILBOX, "carton", 18))),
    *((EASY, (CARTON, "carton", 60)), (HARD, (CARTON, "box truck", 20)), (HARD, (TRUCK, "mailbox", 18))),
    *((EASY, (MAILBOX, "mailbox", 40)), (HARD, (MAILBOX, "box truck", 18))),
]
ONCE = {("mailbox", 110), ("mailbox", 120)}  # object and width: did not help with the first seed, nor would they later
HEAD = ("scene", "draft", "draft_gain", "draft_low", "draft_high", "is", "gain", "low", "high")


def candidates() -> list[tuple[str, dict[str, Any]]]:
    """Scenes by name, seed after seed, in turn one that may help and one that cannot."""
    found = []
    kinds = [kind for pair in zip(((HARD, case) for case in HELPS), DO_NOT, strict=True) for kind in pair]
    for seed, (how, ((name, side, offset), label, width)) in product(range(1, 9), kinds):
        if seed > 1 and (name, width) in ONCE:
            continue
        patch = {"side": side, "offset_mm": offset, "width_mm": width, "height_mm": width}
        settings = {"object": {"mesh": f"primitive:{name}", "length_mm": 400}, "patch": patch, **how}
        settings |= {"target": {"label": label, "models": ["builtin"]}, "optimize": {"seed": seed}}
        settings |= {"sheet": {"markers": width > 40}}
        found.append((f"{name} as {label} {width} mm {seed}", settings))
    return found


def answers(settings: dict[str, Any], folder: Path) -> list[object]:
    """A draft's answer with its gain, and what its design is."""
    scene = pp.make_scene(settings)
    draft = pp.optimize(scene, folder / "run", draft=True, compute=pp.Compute(jobs=1)).promise
    row: list[object] = []
    for promise in (draft, promise_run(folder / "run", views=VIEWS).promise):
        claim = promise.controls[promise.best_control]
        ends = (claim.difference, *claim.difference_interval)
        row += [promise.answer, *(f"{end:.3f}" for end in ends)]
    return row


def main(path: Path) -> None:
    rows = list(csv.DictReader(path.read_text("utf-8").splitlines())) if path.exists() else []
    for name, settings in candidates():
        counts = Counter(row["is"] for row in rows)
        if min(counts["helps"], counts["does_not_help"]) >= EACH:
            break
        kind = "helps" if settings["patch"]["width_mm"] > 100 else "does_not_help"
        if counts[kind] >= EACH or any(row["scene"] == name for row in rows):
            continue
        with tempfile.TemporaryDirectory() as folder:
            rows.append(dict(zip(HEAD, [name, *answers(settings, Path(folder))], strict=True)))
        print(*rows[-1].values(), flush=True)
        with path.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, HEAD, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    for (kind, said), count in sorted(Counter((row["is"], row["draft"]) for row in rows).items()):
        print(f"{kind}: {count} drafts say {said}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
