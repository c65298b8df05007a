"""What benchmarks of rendering and training look at: the demo's scene before made-up clutter, and a design for it.

In: nothing but the package's own object and classifier, so that it runs anywhere. The design comes from a short
optimization, since a real one has more contrast and finer detail than a picture one would make up.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from torch import Tensor

from patchproof.bench.chart import OnStage
from patchproof.journey import demo
from patchproof.optimizer.loop import steps
from patchproof.optimizer.pixels import as_pixels, from_pixels
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.render.pixels import PiecePicture
from patchproof.scene.backgrounds import Backgrounds
from patchproof.scene.patterns import background
from patchproof.scene.scene import build_scene
from patchproof.settings import SceneSettings
from patchproof.strict import read_toml


@dataclass(frozen=True)
class World:
    """The demo's problem with a design that was optimized a little for it (3×h×w)."""

    problem: Problem
    design: Tensor

    def shown(self, kind: str = "design", tiled: int = 1) -> PiecePicture:
        """The printed piece with the design, side by side with itself where it is `tiled`, or with one of its
        controls.
        """
        subject = self.problem.subject
        if kind == "design":
            return subject.shown(self.design.repeat(1, tiled, tiled))
        return subject.shown(from_pixels(subject.control(kind, subject.pixels(self.design))), kind)


def set_world(count: int, on_stage: OnStage) -> World:
    """The demo's problem, and the best design of `count` steps of its optimization."""
    problem = demo_problem()
    for step in steps(with_settings(problem, steps=count)):
        on_stage("design", step.state.number, count)
    return World(problem, from_pixels(as_pixels(step.state.best)))


def demo_problem() -> Problem:
    """The demo's scene before made-up clutter."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "scene.toml"
        path.write_text(demo.SCENE, encoding="utf-8")
        tables = read_toml(path)
    del tables["background"]
    scene = build_scene(SceneSettings.model_validate(tables), Path())
    clutter = (background(np.random.default_rng([demo.SEED, i]), demo.BACKGROUND_PX) for i in range(demo.BACKGROUNDS))
    return set_problem(replace(scene, backgrounds=Backgrounds(tuple(clutter))))


def with_settings(problem: Problem, seed: int | None = None, **optimize: int | float | str) -> Problem:
    """The problem with other settings of the loop, and another seed of its draws."""
    scene = problem.scene
    changed = scene.settings.optimize.model_copy(update=optimize)
    settings = scene.settings.model_copy(update={"optimize": changed})
    return replace(problem, scene=replace(scene, settings=settings, seed=scene.seed if seed is None else seed))
