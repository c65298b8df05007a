"""Views beside full photographs, or these beside a path tracer's, of the same conditions: how far off are answers?

In: scene files. Out, per scene, two lines of `views.csv` or `traced.csv`: of the design, which is optimized first as
its scene says, and of the bare object, means over the conditions with 95 % intervals (Student's). One design each.
Run in this folder: python views.py views suv postbox carton truck small
In `promises`, with `pip install "patchproof[pathtrace]"`:
python ../views/views.py traced suv postbox light carton kaykit pickup mug box
"""

import sys

import numpy as np
import torch

import patchproof as pp
from patchlab.results.rows import write_rows
from patchlab.study.trained_designs import best_design
from patchlab.validation.path_traced import photograph_traced
from patchproof.base.intervals import student_mean
from patchproof.optimizer.problem import set_problem
from patchproof.optimizer.responses import responses
from patchproof.optimizer.subject import from_pixels
from patchproof.render.photograph import photograph

# of each table: conditions, their seed, what is compared, the network in place of the scene's own
WAYS = {
    "views": (200, 79, ("views", "photographs"), None),
    "traced": (60, 78, ("ours", "traced"), ["file:${PATCHPROOF_DATA}/models/mobilenet_v1_0.75_192.onnx"]),
}


@torch.no_grad()
def answers(problem, way, shown, conditions) -> np.ndarray:
    """Confidence and whether it is recognized, 2×N, under all conditions, or under one."""
    if way in ("views", "photographs"):
        side_px = None if way == "views" else min(problem.scene.settings.camera.photo_px)
        told = responses(problem, {"it": shown}, conditions, side_px)["it"]
        return np.concatenate([told.confidence, told.recognized])
    size_px, stage = problem.scene.settings.camera.photo_px, problem.stage
    traced = way == "traced"
    picture = photograph_traced(stage, shown, conditions) if traced else photograph(stage, shown, conditions, size_px)
    logits = problem.classifiers[0].logits(picture)
    kinds = problem.classifiers[0].confidence, problem.classifiers[0].recognized
    return np.stack([kind(logits, problem.indices[0]) for kind in kinds])


def measured(table: str, name: str) -> list[dict]:
    """The lines of one scene."""
    n, seed, ways, networks = WAYS[table]
    problem = set_problem(pp.load_scene(f"{name}.toml"), models=networks)
    design = from_pixels(best_design(problem), problem.device)
    conditions, rows = problem.scene.draw("evaluate", n, seed), []
    for thing, shown in (("design", problem.subject.appearance(design, "design")), ("bare", None)):
        parts = [[conditions] if way == "views" else [conditions[i : i + 1] for i in range(n)] for way in ways]
        first, second = (
            np.hstack([answers(problem, way, shown, one) for one in some]).astype(float)
            for way, some in zip(ways, parts, strict=True)
        )
        row = {"scene": name, "shown": thing, "n": n}
        if table == "views":
            row |= {"view_px": problem.figure_px, "photo_px": min(problem.scene.settings.camera.photo_px)}
        row |= {f"{way}_rate": each[1].mean() for way, each in zip(ways, (first, second), strict=True)}
        for kind, values in zip(("confidence", "rate"), first - second, strict=True):
            mean = student_mean(values)
            row |= {f"{kind}_off": mean.value, f"{kind}_low": mean.low, f"{kind}_high": mean.high}
        rows.append({key: round(float(v), 5) if isinstance(v, float) else v for key, v in row.items()})
    return rows


if __name__ == "__main__":
    write_rows(f"{sys.argv[1]}.csv", (row for name in sys.argv[2:] for row in measured(sys.argv[1], name)), append=True)
