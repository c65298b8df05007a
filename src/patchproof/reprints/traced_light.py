"""The light of a path-traced scene: its surroundings, a directional light of some width, and a lamp.

In: the light of one view. Out: Mitsuba's descriptions of emitters. Levels follow `channel.light`: a surface with
nothing around it comes out alike.

Sources: Ramamoorthi and Hanrahan, An Efficient Representation for Irradiance Environment Maps, SIGGRAPH 2001. Veach and
Guibas, Optimally Combining Sampling Techniques for Monte Carlo Rendering, SIGGRAPH 1995, for why the surrounding light
is sampled by the surface alone.
"""

from __future__ import annotations

from types import ModuleType

import numpy as np
import torch

from patchproof.base import geometry
from patchproof.channel.effects import Light
from patchproof.channel.light import irradiance_basis
from patchproof.scene.mesh_scene import MeshScene

LAMP_RADIUS_MM = 20.0
_FAR = 20.0  # the directional light's distance in lengths of the object
_SKY_PX = (64, 128)
_SKY_WEIGHT = 1e-3  # of paths sent to a light on purpose; 0 is refused where there is no other light


def lights(mi: ModuleType, scene: MeshScene, light: Light, radius_deg: float) -> dict:
    """The surroundings, a disk far away for the directional light, and a small sphere for the lamp.

    An outgoing radiance of 1 is white: paper of reflectance ρ gives ρ·E/π, so that E is π where our light is 1.
    """
    emitters = {"sky": _sky(mi, light)}
    frame, middle = scene.frame, scene.middle_mm
    if light.directional[0] > 0:
        toward = geometry.orbit(light.light_azimuth_deg, light.light_elevation_deg, frame.normal, frame.up)[0]
        far, angle = _FAR * scene.length_mm, np.radians(radius_deg)
        place = mi.ScalarTransform4f().look_at(
            (middle + far * toward).tolist(), middle.tolist(), _across(toward).tolist()
        )
        emitters["sun"] = {
            "type": "disk",
            "to_world": place @ mi.ScalarTransform4f().scale(float(far * np.tan(angle))),
            "emitter": _emitter(light.directional[0] / np.sin(angle) ** 2),
        }
    if light.point[0] > 0:
        away = geometry.orbit(light.point_azimuth_deg, light.point_elevation_deg, frame.normal, frame.up)[0]
        distance = float(light.point_distance_mm[0])
        radius = min(LAMP_RADIUS_MM, distance / 4)
        emitters["lamp"] = {
            "type": "sphere",
            "center": (middle + distance * away).tolist(),
            "radius": radius,
            "emitter": _emitter(light.point[0] * (distance / radius) ** 2),
        }
    return emitters


def _emitter(radiance: float) -> dict:
    return {"type": "area", "radiance": {"type": "rgb", "value": [float(radiance)] * 3}}


def _across(direction: np.ndarray) -> np.ndarray:
    """Any unit vector that is not along a direction."""
    return np.eye(3)[np.abs(direction).argmin()]


def _sky(mi: ModuleType, light: Light) -> dict:
    """Light from all around; almost no paths are sent to it: those that surfaces scatter find it anyway."""
    picture = np.repeat(sky_radiance(sky_directions(), light)[..., None], 3, -1).astype(np.float32)
    return {"type": "envmap", "bitmap": mi.Bitmap(picture), "sampling_weight": _SKY_WEIGHT}


def sky_directions() -> np.ndarray:
    """H×W×3 unit directions of the pixels of Mitsuba's pictures of the surroundings: latitude by longitude, y up."""
    height, width = _SKY_PX
    theta, phi = (np.arange(height) + 0.5) / height * np.pi, (np.arange(width) + 0.5) / width * 2 * np.pi
    level, up = np.sin(theta)[:, None], np.cos(theta)[:, None] * np.ones(width)
    return np.stack([level * np.sin(phi), up, -level * np.cos(phi)], -1)


def sky_radiance(toward: np.ndarray, light: Light) -> np.ndarray:
    """Radiance of the surroundings in directions ...×3, whose irradiance is `channel.light`'s ambient light.

    A surface sees first orders with 2/3 and second with 1/4 of the weight of an even light (A1/π and A2/π in
    Ramamoorthi and Hanrahan, 2001). Light that would be negative is 0 here by direction, there by surface.
    """
    ambient, even = light.ambient[0], np.ones(toward.shape[:-1])
    if not light.sh2.any():
        return ambient * even
    basis = np.stack(irradiance_basis(torch.tensor(toward)), -1) / np.repeat([2 / 3, 1 / 4], [3, 5])
    return (ambient * (even + light.sh2[0] * basis @ light.sh2_coefficients[0])).clip(0)
