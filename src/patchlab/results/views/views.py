"""Views that promises are made of beside full photographs under the same conditions: how far off both are.

In: scene files. Out, per scene, two lines of `views.csv`: of the design, which is optimized first as its scene says,
and of the bare object, means over the conditions with 95 % intervals (Student's). One design each.
Run in this folder: python views.py suv postbox carton truck small
"""

import sys

import patchproof as pp
from patchlab.results.rows import write_rows
from patchproof.base.intervals import student_mean
from patchproof.optimizer.loop import best_design
from patchproof.optimizer.problem import set_problem
from patchproof.optimizer.responses import concatenate_responses, responses
from patchproof.optimizer.subject import from_pixels

N, SEED = 200, 79


def measured(name: str) -> list[dict]:
    """The lines of one scene."""
    problem = set_problem(pp.load_scene(f"{name}.toml"))
    design = from_pixels(best_design(problem), problem.device)
    shown = {"design": problem.subject.appearance(design, "design"), "bare": None}
    conditions = problem.scene.draw("evaluate", N, SEED)
    photo_px = min(problem.scene.settings.camera.photo_px)
    views = responses(problem, shown, conditions)
    photographs = [responses(problem, shown, conditions[i : i + 1], photo_px) for i in range(N)]
    rows = []
    for thing in shown:
        view, photograph = views[thing], concatenate_responses([each[thing] for each in photographs])
        confidence = student_mean(view.confidence[0] - photograph.confidence[0])
        rate = student_mean(view.recognized[0].astype(float) - photograph.recognized[0])
        row = {"scene": name, "shown": thing, "n": N, "view_px": problem.figure_px, "photo_px": photo_px}
        row |= {"views_rate": view.recognized[0].mean(), "photographs_rate": photograph.recognized[0].mean()}
        for kind, mean in (("confidence", confidence), ("rate", rate)):
            row |= {f"{kind}_off": mean.value, f"{kind}_low": mean.low, f"{kind}_high": mean.high}
        rows.append({key: round(float(v), 5) if isinstance(v, float) else v for key, v in row.items()})
    return rows


if __name__ == "__main__":
    write_rows("views.csv", (row for name in sys.argv[1:] for row in measured(name)), append=True)
