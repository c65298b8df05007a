"""The views that a run is trained in.

In: a scene's draws. Out: `training_conditions`, in which each pose occurs several times, each time with another
background, light, print and camera; and `ViewCache`, which renders poses once and only relights them later, as far as
memory allows.
"""

import math
from dataclasses import replace

import numpy as np

from patchproof.optimizer.problem import Problem
from patchproof.render.views import Views, split_views
from patchproof.scene.conditions import Conditions
from patchproof.scene.interface import Scene

VIEWS_PER_TASK = 2  # views of a step that one process renders together; one by one took 1.4 times as long
STEPS_AHEAD = 4  # steps whose views a process renders together; one by one took 1.4 times as long
# A run has this many poses, or a quarter as many as views if that is more. Over 18 pairs of object and seed, the loss
# was 0.7 % [-0.2, 1.5] higher than with one pose for each view, and as many views were recognized. With one background
# for each pose, too, it was 2 % higher; with one pose for four steps in a row, 25 to 33 %.
MIN_POSES, VIEWS_PER_POSE = 240, 4
CACHE_PX = 240 * 224**2  # of the views that a process keeps, at 20 to 60 bytes a pixel


def training_conditions(scene: Scene) -> Conditions:
    """The conditions of all of a run's views. Poses repeat, backgrounds do not."""
    settings = scene.settings.optimize
    conditions = scene.draw("train", settings.steps * settings.views)
    pose = conditions.pose[np.arange(len(conditions)) % pose_count(scene)]
    if scene.HAS_OBJECT:
        pose = replace(pose, background=conditions.pose.background)
    return replace(conditions, pose=pose)


def pose_count(scene: Scene) -> int:
    """The number of poses in a run, a multiple of a step's views; scenes of pictures have one pose per view."""
    settings = scene.settings.optimize
    views = settings.steps * settings.views
    if not scene.HAS_OBJECT:
        return views
    return math.ceil(max(MIN_POSES, views / VIEWS_PER_POSE) / settings.views) * settings.views


def new_pose_share(scene: Scene) -> float:
    """The share of a run's views that show a pose for the first time, from 0 to 1."""
    settings = scene.settings.optimize
    return min(1.0, pose_count(scene) / (settings.steps * settings.views))


def task_conditions(conditions: Conditions) -> list[tuple[int, Conditions]]:
    """A step's conditions in tasks of VIEWS_PER_TASK, each with the row that it begins at."""
    return [(row, conditions[row : row + VIEWS_PER_TASK]) for row in range(0, len(conditions), VIEWS_PER_TASK)]


def training_views(problem: Problem, conditions: Conditions) -> Views:
    """Views of these conditions at the training's size, in which any design can be shown."""
    return problem.see(problem.start_appearance, conditions, problem.training_px)


class ViewCache:
    """One process's rendered training views: as many as fit are kept, and the next steps' are rendered together."""

    def __init__(self, problem: Problem, conditions: Conditions):
        self._problem, self._conditions = problem, conditions
        self._poses = min(pose_count(problem.scene), len(conditions))
        self._stored, self._ahead = dict[int, Views](), dict[int, Views]()
        repeats = new_pose_share(problem.scene) < 1
        self._capacity = CACHE_PX // (VIEWS_PER_TASK * problem.training_px**2) if repeats else 0

    def views(self, pose: int, conditions: Conditions) -> Views:
        """The views of a task's conditions, whose poses begin with the run's pose number `pose`."""
        if pose not in self._stored and pose not in self._ahead:
            self._render_ahead(pose, len(conditions))
        views = self._stored.get(pose) or self._ahead.pop(pose)
        if len(self._stored) < self._capacity:
            self._stored[pose] = views
        return self._problem.see_again(views, conditions)

    def _render_ahead(self, pose: int, count: int) -> None:
        step = self._problem.scene.settings.optimize.views
        poses = range(pose, self._poses, step)[:STEPS_AHEAD]
        rows = np.concatenate([np.arange(first, first + count) for first in poses])
        together = training_views(self._problem, self._conditions[rows])
        self._ahead |= zip(poses, split_views(together, [count] * len(poses)), strict=True)
