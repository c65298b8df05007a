"""A camera's tone curve: from the light it saw to the code values it wrote, the same for all three channels.

In: a `Camera`; its `tone_light` is the light at evenly spaced code values from 0 to 1, straight in between. Out: light
of codes and codes of light, both in [0, 1]; a camera without a curve encodes as sRGB does. Left out on purpose: curves
that differ between channels, and pictures that a phone tone-maps differently from region to region.
"""

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from patchproof.base.color import linear_from_srgb, srgb_from_linear

if TYPE_CHECKING:
    from patchproof.channel.lens import Camera


def light_of_codes(codes: np.ndarray, camera: "Camera | None") -> np.ndarray:
    """Return the linear light of the code values that a camera wrote."""
    if camera is None or camera.tone_light is None:
        return linear_from_srgb(codes)
    return np.interp(codes, np.linspace(0, 1, len(camera.tone_light)), camera.tone_light)


def codes_of_light(linear: Tensor, camera: "Camera | None") -> Tensor:
    """Return the code values that a camera writes for linear light in [0, 1]; differentiable."""
    if camera is None or camera.tone_light is None:
        return srgb_from_linear(linear)
    light = torch.as_tensor(camera.tone_light).to(linear)
    above = torch.searchsorted(light, linear.detach().contiguous()).clamp(1, len(light) - 1)
    below = light[above - 1]
    return (above - 1 + (linear - below) / (light[above] - below)) / (len(light) - 1)
