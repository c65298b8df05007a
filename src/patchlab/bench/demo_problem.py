"""What benchmarks of rendering and training look at: the demo's scene, and a design for it.

In: nothing but the package's own object and classifier, so that it runs anywhere. The design comes from a short
optimization, since a real one has more contrast and finer detail than a picture one would make up.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from torch import Tensor

from patchproof.app.demo import demo_scene
from patchproof.base.progress import Progress
from patchproof.base.settings import OptimizeSettings
from patchproof.optimizer.loop import start, steps
from patchproof.optimizer.pixels import as_pixels, from_pixels
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.scene.scene import load_scene


def optimize_demo_design(count: int, progress: Progress) -> tuple[Problem, Tensor]:
    """The demo's problem, and the best design 3×h×w of `count` steps of its optimization."""
    problem = demo_problem().with_training(OptimizeSettings(steps=count))
    state = start(problem)
    for step in steps(problem, state):
        state = step.state
        progress("design", state.number, count)
    return problem, from_pixels(as_pixels(state.best))


def demo_problem() -> Problem:
    """The demo's problem."""
    with TemporaryDirectory() as folder:
        return set_problem(load_scene(demo_scene(Path(folder))))
