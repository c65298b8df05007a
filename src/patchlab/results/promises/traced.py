"""Our photographs beside a path tracer's under the same conditions: how far confidences and rates are apart.

In: scene files of this folder. Out, per scene, two lines of `traced.csv`: of a design that is optimized first as its
scene says, and of the bare object, means over the conditions with 95 % intervals (Student's). One design each.
Run in this folder, with `pip install "patchproof[pathtrace]"`:
python traced.py suv postbox light carton kaykit pickup mug box
"""

import sys

import numpy as np
import torch

import patchproof as pp
from patchlab.results.rows import write_rows
from patchlab.validation.path_traced import photograph_traced
from patchproof.base.intervals import student_mean
from patchproof.optimizer.loop import best_design
from patchproof.optimizer.problem import set_problem
from patchproof.optimizer.subject import from_pixels
from patchproof.render.photograph import photograph

N, SEED = 60, 78
NETWORK = "file:${PATCHPROOF_DATA}/models/mobilenet_v1_0.75_192.onnx"


def measured(name: str) -> list[dict]:
    """The lines of one scene."""
    problem = set_problem(pp.load_scene(f"{name}.toml"), models=[NETWORK])
    design = from_pixels(best_design(problem), problem.device)
    conditions, size_px = problem.scene.draw("evaluate", N, SEED), problem.scene.settings.camera.photo_px
    classifier, rows = problem.classifiers[0], []
    for thing, shown in (("design", problem.subject.appearance(design, "design")), ("bare", None)):
        answers = []  # N × (ours, traced) × (confidence, recognized)
        for one in (conditions[i : i + 1] for i in range(N)):
            with torch.no_grad():
                pictures = photograph(problem.stage, shown, one, size_px), photograph_traced(problem.stage, shown, one)
                logits = classifier.logits(torch.cat(pictures))
            indices = problem.indices[0]
            kinds = classifier.confidence(logits, indices), classifier.recognized(logits, indices)
            answers.append(np.stack(kinds, 1))
        ours, traced = np.array(answers).transpose(1, 0, 2)
        row = {"scene": name, "shown": thing, "n": N}
        row |= {"ours_rate": ours[:, 1].mean(), "traced_rate": traced[:, 1].mean()}
        for column, kind in enumerate(("confidence", "rate")):
            off = student_mean(ours[:, column] - traced[:, column])
            row |= {f"{kind}_off": off.value, f"{kind}_low": off.low, f"{kind}_high": off.high}
        rows.append({key: round(float(v), 5) if isinstance(v, float) else v for key, v in row.items()})
    return rows


if __name__ == "__main__":
    write_rows("traced.csv", (row for name in sys.argv[1:] for row in measured(name)))
