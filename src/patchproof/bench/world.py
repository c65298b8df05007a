"""What benchmarks of rendering and training look at: the demo's scene, and a design for it.

In: nothing but the package's own object and classifier, so that it runs anywhere. The design comes from a short
optimization, since a real one has more contrast and finer detail than a picture one would make up.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from torch import Tensor

from patchproof.bench.chart import OnStage
from patchproof.journey.demo import demo_scene
from patchproof.optimizer.loop import start, steps
from patchproof.optimizer.patch import Patch
from patchproof.optimizer.pixels import as_pixels, from_pixels
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.render.pixels import PiecePicture
from patchproof.scene.scene import load_scene
from patchproof.settings import OptimizeSettings
from patchproof.sheets.piece import Piece


@dataclass(frozen=True)
class World:
    """The demo's problem with its patch, and a design that was optimized a little for it (3×h×w)."""

    problem: Problem
    patch: Patch
    piece: Piece
    design: Tensor

    def shown(self, tiled: int = 1) -> PiecePicture:
        """The printed piece with the design, side by side with itself where it is `tiled`."""
        return self.patch.shown(self.design.repeat(1, tiled, tiled))

    def control(self, kind: str) -> PiecePicture:
        """The printed piece with one of the design's controls."""
        return self.patch.shown(from_pixels(self.patch.control(kind, self.patch.pixels(self.design))), kind)


def set_world(count: int, on_stage: OnStage) -> World:
    """The demo's problem, and the best design of `count` steps of its optimization."""
    problem = with_optimize(demo_problem(), OptimizeSettings(steps=count))
    state = start(problem)
    for step in steps(problem, state):
        state = step.state
        on_stage("design", state.number, count)
    return World(problem, problem.patch, problem.patch.scene.piece, from_pixels(as_pixels(state.best)))


def demo_problem() -> Problem:
    """The demo's problem."""
    with TemporaryDirectory() as folder:
        return set_problem(load_scene(demo_scene(Path(folder))))


def with_optimize(problem: Problem, optimize: OptimizeSettings, seed: int | None = None) -> Problem:
    """The problem with these settings of the loop, and another seed of its draws."""
    scene = problem.scene
    settings = scene.settings.changed(optimize=optimize)
    return replace(problem, scene=replace(scene, settings=settings, seed=scene.seed if seed is None else seed))
