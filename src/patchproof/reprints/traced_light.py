"""The light of a path-traced scene: its surroundings and a directional light of some width.

In: the light of one view. Out: Mitsuba's descriptions of emitters. Levels follow `channel.light`: a surface with
nothing around it comes out alike.

Source: Veach and Guibas, Optimally Combining Sampling Techniques for Monte Carlo Rendering, SIGGRAPH 1995, for why the
surrounding light is sampled by the surface alone.
"""

from __future__ import annotations

from types import ModuleType

import numpy as np

from patchproof.base import geometry
from patchproof.channel.effects import Light
from patchproof.scene.mesh_scene import MeshScene

_FAR = 20.0  # the directional light's distance in lengths of the object
_SKY_PX = (64, 128)
_SKY_WEIGHT = 1e-3  # of paths sent to a light on purpose; 0 is refused where there is no other light


def lights(mi: ModuleType, scene: MeshScene, light: Light, radius_deg: float) -> dict:
    """The surroundings, and a disk far away for the directional light.

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
    return emitters


def _emitter(radiance: float) -> dict:
    return {"type": "area", "radiance": {"type": "rgb", "value": [float(radiance)] * 3}}


def _across(direction: np.ndarray) -> np.ndarray:
    """Any unit vector that is not along a direction."""
    return np.eye(3)[np.abs(direction).argmin()]


def _sky(mi: ModuleType, light: Light) -> dict:
    """Light from all around; almost no paths are sent to it: those that surfaces scatter find it anyway."""
    picture = np.full((*_SKY_PX, 3), light.ambient[0], np.float32)
    return {"type": "envmap", "bitmap": mi.Bitmap(picture), "sampling_weight": _SKY_WEIGHT}
