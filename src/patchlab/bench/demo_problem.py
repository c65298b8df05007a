"""The demo's scene and a design for it, which benchmarks of rendering and training use.

In: only the package's object and classifier, so that benchmarks run anywhere. Out: a `Problem` and a design from a
short optimization, which has more contrast and finer detail than an invented picture.
"""

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
    """The demo's problem, and the best design 3×h×w of `count` optimizer steps."""
    problem = demo_problem().with_training(OptimizeSettings(steps=count))
    state = start(problem)
    for step in steps(problem, state):
        state = step.state
        progress("design", state.number, count)
    return problem, from_pixels(as_pixels(state.best))


def demo_problem() -> Problem:
    """Build the demo's scene and set its problem."""
    with TemporaryDirectory() as folder:
        return set_problem(load_scene(demo_scene(Path(folder))))
