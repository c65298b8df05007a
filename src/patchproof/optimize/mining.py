"""Mining: train more where the clean object fails.

In: a problem whose settings ask for `mine` tries. Out: the conditions of all training steps. Before the first step
the clean object is shown in a quarter as many poses and lights, forward only, each before the same `BACKDROPS` draws of
background, print and camera: alone, a draw's loss says more of its background than of its pose (in one scene, of the
worst eighth of 256 single draws, 6 % lay in the worst tenth of pose × light). Every other training view then takes its
pose and light from the worst eighth. The rest stays as drawn, so that what is easy is not forgotten.

Which draws are worst depends on the scene and its seed alone, never on the design: a run that was stopped mines the
same ones when it goes on. Trying hard views anew in each step (online hard example mining: Shrivastava et al., CVPR
2016) would follow the design, but it costs passes in every step. Poses that fail: Alcorn et al., Strike (with) a Pose,
CVPR 2019.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from patchproof.optimize.goals import target_loss
from patchproof.optimize.problem import Problem
from patchproof.render.photograph import expose
from patchproof.scene.conditions import Conditions

# What of a draw is the pose and the light; the rest is background, print and camera.
POSE = ("azimuth_deg", "elevation_deg", "distance_mm", "roll_deg", "look_at_offset")
LIGHT = (
    "ambient",
    "directional",
    "light_azimuth_deg",
    "light_elevation_deg",
    "exposure_ev",
    "point",
    "point_azimuth_deg",
    "point_elevation_deg",
    "point_distance_mm",
    "sh2",
    "sh2_coefficients",
)
WORST_SHARE = 0.125
BACKDROPS = 4
_CHUNK = 16


def training_conditions(problem: Problem) -> Conditions:
    """The conditions of all steps, `views` rows each; mined where the scene's settings ask for it."""
    settings = problem.scene.settings.optimize
    count = settings.steps * settings.views
    drawn = problem.scene.draw("train", count + settings.mine)
    if not settings.mine:
        return drawn
    tried = drawn[count:]  # other draws than those that are trained on
    tried, backdrops = tried[: max(settings.mine // BACKDROPS, 1)], tried[:BACKDROPS]
    tried = tried[_shows_what_is_trained(problem, tried)]
    if not len(tried):
        return drawn[:count]
    losses = clean_losses(problem, each_before_all(tried, backdrops)).reshape(len(tried), -1).mean(1)
    return with_pose_and_light(drawn[:count], tried[hardest(losses)])


def each_before_all(tried: Conditions, rest: Conditions, names: Sequence[str] = POSE + LIGHT) -> Conditions:
    """The fields `names` of each row of `tried`, with all else from each row of `rest`: row by row of `tried`."""
    rows = np.tile(np.arange(len(rest)), len(tried))
    return replace(rest[rows], **{name: getattr(tried, name).repeat(len(rest), 0) for name in names})


def clean_losses(problem: Problem, conditions: Conditions) -> np.ndarray:
    """N losses of the clean object (bare, or with its own texture), as training sees it: the mean over classifiers."""
    goal, losses = problem.scene.settings.target.goal, []
    with torch.no_grad():
        for first in range(0, len(conditions), _CHUNK):
            pictures = expose(problem.see(None, conditions[first : first + _CHUNK], problem.training_px), None)
            each = [
                target_loss(classifier.logits(pictures), indices, goal)
                for classifier, indices in zip(problem.classifiers, problem.indices, strict=True)
            ]
            losses.append(torch.stack(each).mean(0).cpu().numpy())
    return np.concatenate(losses)


def hardest(losses: np.ndarray) -> np.ndarray:
    """Indices of the worst eighth, at least one, the worst first; equal losses in their order."""
    return np.argsort(-losses, kind="stable")[: max(int(WORST_SHARE * len(losses)), 1)]


def _shows_what_is_trained(problem: Problem, conditions: Conditions) -> np.ndarray:
    """N bool: not from behind the patch, where the object may well fail, but no patch can help it."""
    if problem.scene.piece is None:
        return np.ones(len(conditions), bool)
    return ~(np.abs(problem.scene.piece_azimuth_deg(conditions)) >= 90)  # unknown angles are of photographs of it


def with_pose_and_light(conditions: Conditions, worst: Conditions) -> Conditions:
    """`conditions`, every other row with pose and light of the next row of `worst`, over and over."""
    rows = np.arange(1, len(conditions), 2)
    source = (rows // 2) % len(worst)
    changed = {name: getattr(conditions, name).copy() for name in POSE + LIGHT}
    for name, values in changed.items():
        values[rows] = getattr(worst, name)[source]
    return replace(conditions, **changed)
