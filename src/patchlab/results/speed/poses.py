"""Compare designs trained on poses that repeat, each time in other light: no pose twice, the run's own
240 poses before other backgrounds each time, and 240 poses each of which keeps its background.

In: three of the package's objects in the demo's scene. Out: `poses.csv`: by object and seed the mean loss and the rate
of each design, trained on 960 views and kept as it was in the end, in the same 300 fresh views. Run in this folder:
python poses.py
"""

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

import patchproof as pp
from patchlab.results.rows import write_rows
from patchproof.app.demo import SCENE
from patchproof.base.settings import SceneSettings
from patchproof.base.validation import validate_model
from patchproof.base.workers import keep_freed_memory
from patchproof.optimizer.expectation import training_conditions
from patchproof.optimizer.loop import start, take_step
from patchproof.optimizer.pixels import as_pixels, from_pixels
from patchproof.optimizer.problem import set_problem
from patchproof.optimizer.responses import responses
from patchproof.scene.interface import Scene
from patchproof.scene.scene import build_scene

LABELS, SEEDS, JUDGED = ("box truck", "chair", "mailbox"), range(6), 300
# By label: the primitive, its length, the piece's offset from its middle, and the piece's size, in mm.
OBJECTS_BY_LABEL = {
    "box truck": ("box_truck", 400, 45, 147),
    "chair": ("chair", 450, 0, 140),
    "mailbox": ("mailbox", 400, 0, 90),
}


def object_scene(label: str, steps: int) -> Scene:
    """The demo's scene with one of `OBJECTS_BY_LABEL` and this number of optimizer steps."""
    primitive, length_mm, off_mm, size_mm = OBJECTS_BY_LABEL[label]
    settings: dict[str, Any] = tomllib.loads(SCENE)
    settings["object"] |= {"mesh": f"primitive:{primitive}", "length_mm": length_mm}
    settings["patch"] |= {"offset_mm": [0, off_mm], "width_mm": size_mm, "height_mm": size_mm}
    settings["target"]["label"] = label
    settings["optimize"]["steps"] = steps
    return build_scene(validate_model(SceneSettings, settings, label), Path())


def measured(label: str, seed: int) -> dict:
    """A line of the table."""
    scene = pp.make_scene(object_scene(label, 240).settings.changed(optimize={"seed": seed}))
    problem, drawn, again = set_problem(scene), scene.draw("train", 960), training_conditions(scene)
    kept = replace(again, pose=replace(again.pose, background=drawn.pose.background[np.arange(960) % 240]))
    shown = {}
    for name, conditions in (("each", drawn), ("again", again), ("kept", kept)):
        state = start(problem)
        for first in range(0, 960, 4):
            state = take_step(problem, state, conditions[first : first + 4]).state
        shown[name] = problem.subject.appearance(from_pixels(as_pixels(state.design), problem.device))
    row = {"object": label, "seed": seed}
    for name, answer in responses(problem, shown, scene.draw("evaluate", JUDGED)).items():
        row |= {f"{name}_loss": round(float(answer.loss.mean()), 4), f"{name}_rate": round(answer.recognized.mean(), 4)}
    return row


if __name__ == "__main__":
    keep_freed_memory()
    torch.set_num_threads(1)
    write_rows("poses.csv", (measured(label, seed) for label in LABELS for seed in SEEDS))
