"""A camera's tone curve: how the light it saw became the code values it wrote, the same for all three channels.

In: a `Camera`; its `tone_light` is the light at evenly spaced code values from 0 to 1, straight in between. Out: light
of codes and codes of light, both in [0, 1]; a camera without one encodes as sRGB does. Left out on purpose: curves that
differ between channels, and pictures that a phone tone-maps from place to place.
"""

from __future__ import annotations

import numpy as np

from patchproof.channel.lens import Camera
from patchproof.color import linear_from_srgb, srgb_from_linear


def light_of_codes(codes: np.ndarray, camera: Camera | None) -> np.ndarray:
    """Linear light of the code values that a camera wrote."""
    if camera is None or camera.tone_light is None:
        return linear_from_srgb(codes)
    return np.interp(codes, np.linspace(0, 1, len(camera.tone_light)), camera.tone_light)


def codes_of_light(linear: np.ndarray, camera: Camera | None) -> np.ndarray:
    """The code values that a camera writes for linear light; what is brighter than 1 clips."""
    linear = np.clip(linear, 0, 1)
    if camera is None or camera.tone_light is None:
        return srgb_from_linear(linear)
    return np.interp(linear, camera.tone_light, np.linspace(0, 1, len(camera.tone_light)))
