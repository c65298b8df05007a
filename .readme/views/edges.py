"""What jagged outlines cost: photographs of the bare object with 1 and 4 samples to a pixel beside 9.

In: scene files of `../promises`. Out: a line of `edges.csv` per scene: confidence less that of 9 samples, means over the
conditions with 95 % intervals (Student's). Run in this folder: python edges.py suv pickup light postbox mug carton
"""

import csv
import sys

import torch

import patchproof as pp
from patchproof.claims import student_mean
from patchproof.optimizer.problem import set_problem
from patchproof.render.photograph import photograph

N, SEED = 60, 78
NETWORK = "file:${PATCHPROOF_DATA}/models/mobilenet_v1_0.75_192.pt2"


def measured(name: str) -> dict:
    """The line of one scene."""
    problem = set_problem(pp.load_scene(f"../promises/{name}.toml"), models=[NETWORK])
    conditions, size_px = problem.scene.draw("evaluate", N, SEED), problem.scene.settings.camera.photo_px
    classifier, sure = problem.classifiers[0], []
    for one in (conditions[i : i + 1] for i in range(N)):
        with torch.no_grad():
            pictures = [
                photograph(problem.stage, None, one, size_px, jpeg=False, supersample=side) for side in (1, 2, 3)
            ]
            sure.append(classifier.confidence(classifier.logits(torch.cat(pictures)), problem.indices[0]))
    one, four, nine = torch.stack(sure, 1).double().numpy()
    row = {"scene": name, "n": N, "confidence": nine.mean()}
    for samples, values in (("1", one), ("4", four)):
        off = student_mean(values - nine)
        row |= {f"{samples}_off": off.value, f"{samples}_low": off.low, f"{samples}_high": off.high}
    return {key: round(value, 5) if isinstance(value, float) else value for key, value in row.items()}


if __name__ == "__main__":
    rows = [measured(name) for name in sys.argv[1:]]
    with open("edges.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
