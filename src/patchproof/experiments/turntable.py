"""The object all round and from three sides: pictures to look at, mean colors, and what a network looks at.

In: a problem and what shows. Out: views and pictures of a turn, a mean color, attributions. Turntable views have even
light and a still camera; they are for eyes and are never counted as a rate. Attributions are integrated gradients
(Sundararajan et al., ICML 2017, equation 1) from the original's picture to the design's: they add up to the change of
the log of the target's confidence, so that they say what of the change did it.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from patchproof.channel.effects import EFFECT, Light, Pose, Sensor
from patchproof.color import srgb_from_linear
from patchproof.optimizer.goals import target_loss
from patchproof.optimizer.problem import Problem
from patchproof.render.photograph import Shown, shade
from patchproof.scene.conditions import Conditions, with_values
from patchproof.study.pictures import photographs

_PATH_STEPS = 24  # of the integral; builtin's attributions then add up to within a few percent


def from_sides(problem: Problem, azimuth_deg: np.ndarray) -> Conditions:
    """Views from these azimuths at the middle of the scene's other ranges, in even light, before one background."""
    drawn, view = problem.scene.draw("evaluate", 1), problem.scene.settings.view
    pose = Pose(
        azimuth_deg=np.asarray(azimuth_deg, float),
        elevation_deg=np.array([np.mean(view.elevation_deg)]),
        distance_mm=np.array([np.mean(view.distance_mm)]),
        background=drawn.pose.background,
        printed_scale=drawn.pose.printed_scale,
    )
    light, sensor = Light(ambient=np.ones(1)), Sensor(jpeg=np.array([95]), noise_seed=drawn.sensor.noise_seed)
    return Conditions(pose=pose, light=light, print=drawn.print, sensor=sensor)


def sides(problem: Problem, count: int) -> Conditions:
    """Views for a contact sheet: evenly through the scene's azimuths, or draws where there is no mesh to go round."""
    if not problem.scene.HAS_OBJECT:
        return problem.scene.draw("evaluate", count)
    low, high = problem.scene.settings.view.azimuth_deg
    return from_sides(problem, low + (high - low) * (np.arange(count) + 0.5) / count)


def three_views(problem: Problem, lights: int) -> Conditions:
    """Three fixed views round a mesh (see `sides`), each in `lights` drawn lights, backgrounds and cameras; 3 · lights
    conditions, view by view.
    """
    poses = sides(problem, 3)[np.repeat(np.arange(3), lights)]
    drawn = problem.scene.draw("evaluate", 3 * lights)
    return with_values(drawn, **{name: getattr(poses.pose, name) for name in EFFECT["viewpoint"].fields})


def turn(problem: Problem, shown: Shown, views: int, side_px: int) -> Tensor:
    """N×3×S×S pictures of a full turn."""
    return photographs(problem, shown, from_sides(problem, np.arange(views) * 360 / views), side_px)


def mean_color(problem: Problem, shown: Shown, views: int, side_px: int) -> tuple[int, int, int]:
    """sRGB codes of the mean light of the object's pixels over a full turn in even white light."""
    seen = problem.see(shown, from_sides(problem, np.arange(views) * 360 / views), side_px)
    with torch.no_grad():
        light = shade(seen, shown).permute(0, 2, 3, 1).reshape(-1, 3)[seen.on_object.pixel]
    red, green, blue = (srgb_from_linear(light.double().mean(0)) * 255).round().clamp(0, 255).int().tolist()
    return red, green, blue


def attributions(problem: Problem, before: Tensor, after: Tensor) -> Tensor:
    """N×H×W: how much each pixel's change from `before` to `after` added to the mean log of the target's confidence
    (for `deceive`, of its complement) over the problem's networks; their sum is its change.
    """
    total = torch.zeros_like(before)
    for step in range(_PATH_STEPS):
        between = torch.lerp(before, after, (step + 0.5) / _PATH_STEPS).requires_grad_()
        (gradient,) = torch.autograd.grad(goal_log(problem, between).sum(), between)
        total += gradient / _PATH_STEPS
    return (total * (after - before)).sum(1)


def goal_log(problem: Problem, photos: Tensor) -> Tensor:
    """N: the mean over networks of the log of what the goal wants."""
    goal = problem.scene.settings.target.goal
    both = zip(problem.classifiers, problem.indices, strict=True)
    return torch.stack([-target_loss(one.logits(photos), indices, goal) for one, indices in both]).mean(0)


def heat(values: Tensor) -> Tensor:
    """Attributions N×H×W as N×3×H×W: red helped, blue hurt, white did nothing; one scale per picture."""
    import matplotlib

    top = values.abs().flatten(1).quantile(0.995, 1)[:, None, None].clamp_min(1e-12)
    colors = matplotlib.colormaps["RdBu_r"]((0.5 + 0.5 * values / top).clamp(0, 1).numpy())
    return torch.tensor(colors[..., :3], dtype=torch.float32).permute(0, 3, 1, 2)
