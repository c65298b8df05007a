"""Views of the object from fixed sides, and its mean color.

In: a problem and an appearance. Out: conditions, a mean color. Views from the sides have even light and a still camera;
they are for people to look at, never for rates.
"""

import numpy as np
import torch

from patchproof.base.color import srgb_from_linear
from patchproof.channel.effects import EFFECT_BY_NAME, Light, Pose, Sensor
from patchproof.optimizer.problem import Problem
from patchproof.render.photograph import Appearance, shade
from patchproof.scene.conditions import Conditions, with_values


def views_from(problem: Problem, azimuth_deg: np.ndarray) -> Conditions:
    """Views from these azimuths in even light, at the middle of all other ranges, with one background."""
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


def views_from_sides(problem: Problem, count: int) -> Conditions:
    """Views for a contact sheet: evenly through the scene's azimuths, or drawn where the scene has no mesh."""
    if not problem.scene.HAS_OBJECT:
        return problem.scene.draw("evaluate", count)
    low, high = problem.scene.settings.view.azimuth_deg
    return views_from(problem, low + (high - low) * (np.arange(count) + 0.5) / count)


def views_in_drawn_light(problem: Problem, lights: int) -> Conditions:
    """Three fixed views of a mesh (`views_from_sides`), each in `lights` drawn lights, backgrounds and cameras:
    3 · lights conditions, view by view.
    """
    poses = views_from_sides(problem, 3)[np.repeat(np.arange(3), lights)]
    drawn = problem.scene.draw("evaluate", 3 * lights)
    return with_values(drawn, **{name: getattr(poses.pose, name) for name in EFFECT_BY_NAME["viewpoint"].fields})


def mean_color(problem: Problem, shown: Appearance, views: int, side_px: int) -> tuple[int, int, int]:
    """sRGB codes of the object's mean light, without its outlines, over a full turn in even white light."""
    turned = problem.see(shown, views_from(problem, np.arange(views) * 360 / views), side_px)
    with torch.no_grad():
        light = shade(turned, shown).permute(0, 2, 3, 1).reshape(-1, 3)
    within = torch.zeros(len(light), dtype=torch.bool, device=light.device)
    within[turned.on_object.pixel] = True
    if turned.outlines is not None:
        within[turned.outlines.pixel] = False
    light = light[within]
    red, green, blue = (srgb_from_linear(light.double().mean(0)) * 255).round().clamp(0, 255).int().tolist()
    return red, green, blue
