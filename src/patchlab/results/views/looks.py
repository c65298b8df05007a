"""Compare views of other sizes and texture sampling with full photographs.

In: scene files. Out: lines of `looks.csv`, by scene, size (times the network's), width of a pixel that textures are
averaged over, taps and what is shown: means over conditions that `views.py` does not judge by, with 95 % intervals
(Student's). One design each. Run in this folder: python looks.py suv postbox carton small
"""

import sys
from dataclasses import replace

import patchproof as pp
from patchlab.results.rows import write_rows
from patchproof.base.intervals import student_mean
from patchproof.optimizer import problem as problems
from patchproof.optimizer.loop import best_design
from patchproof.optimizer.pixels import from_pixels
from patchproof.optimizer.responses import concatenate_responses, responses

N, SEED = 120, 81
LOOKS = [
    *((1.5, side, taps) for side, taps in ((0.9, 3), (0.8, 3), (0.8, 2), (0.75, 2), (0.7, 2))),
    *((1.4, side, taps) for side, taps in ((0.9, 3), (0.8, 3), (0.85, 2), (0.8, 2), (0.75, 2), (0.7, 2))),
    (1.35, 0.8, 2),
    *((1.25, side, taps) for side, taps in ((0.9, 3), (0.8, 3), (0.7, 3), (0.8, 2), (0.7, 2))),
]


def measured(name: str) -> list[dict]:
    """The lines of one scene."""
    problem = problems.set_problem(pp.load_scene(f"{name}.toml"))
    design = from_pixels(best_design(problem), problem.device)
    shown = {"design": problem.subject.appearance(design, "design"), "bare": None}
    conditions = problem.scene.draw("evaluate", N, SEED)
    photo_px = min(problem.scene.settings.camera.photo_px)
    each = [responses(problem, shown, conditions[i : i + 1], photo_px) for i in range(N)]
    photographs, rows = {thing: concatenate_responses([answers[thing] for answers in each]) for thing in shown}, []
    for scale, side, taps in LOOKS:
        problems.FIGURE_SCALE, problems.FIGURE_SAMPLING = scale, replace(problems.FIGURE_SAMPLING, taps=taps, side=side)
        views = responses(problem, shown, conditions)
        for thing in shown:
            off = student_mean(views[thing].confidence[0] - photographs[thing].confidence[0])
            rate = (views[thing].recognized[0].mean() - photographs[thing].recognized[0].mean()).item()
            figures = {"off": off.value, "low": off.low, "high": off.high, "rate_off": rate}
            row = {"scene": name, "times": scale, "width": side, "taps": taps, "shown": thing}
            rows.append(row | {key: round(value, 4 if key == "off" else 3) for key, value in figures.items()})
    return rows


if __name__ == "__main__":
    write_rows("looks.csv", (row for name in sys.argv[1:] for row in measured(name)), append=True)
