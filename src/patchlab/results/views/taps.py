"""Compare views with fewer texture taps at a piece with those of photographs' taps.

In: scene files. Out: `taps.csv`, by scene and taps along a pixel's shorter side: confidences of 200 views of a
design less those with as many taps as photographs have, as mean and root mean square, and views that change sides. One
design each. Run in this folder: python taps.py suv postbox carton truck
"""

import sys
from dataclasses import replace

import numpy as np

import patchproof as pp
from patchlab.results.rows import write_rows
from patchproof.optimizer import problem as problems
from patchproof.optimizer.loop import best_design
from patchproof.optimizer.promise import pictures_with_controls
from patchproof.optimizer.responses import responses
from patchproof.render.pixels import PHOTO_SAMPLING

N, TAPS = 200, (6, 4, 3, 2)


def measured(name: str) -> list[dict]:
    """The lines of one scene."""
    problem, look, told = problems.set_problem(pp.load_scene(f"{name}.toml")), problems.FIGURE_SAMPLING, {}
    shown = pictures_with_controls(problem, best_design(problem), ())
    conditions = problem.scene.draw("promise", N, per_session=4)
    for taps in (PHOTO_SAMPLING.piece_taps, *TAPS):
        problems.FIGURE_SAMPLING = replace(look, piece_taps=taps)
        told[taps] = responses(problem, shown, conditions)["design"]
    problems.FIGURE_SAMPLING, rows, many = look, [], told[PHOTO_SAMPLING.piece_taps]
    for taps in TAPS:
        off, other = (told[taps].confidence - many.confidence)[0], told[taps].recognized != many.recognized
        figures = {"mean": off.mean(), "rms": np.sqrt((off**2).mean())}
        row = {"scene": name, "taps": taps, **{key: f"{value:.5f}" for key, value in figures.items()}}
        rows.append(row | {"other": int(other.sum())})
    return rows


if __name__ == "__main__":
    write_rows("taps.csv", (row for name in sys.argv[1:] for row in measured(name)))
