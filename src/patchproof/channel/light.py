"""Light on surfaces: even ambient light and one directional light per view.

In: per-view light and the unit normals of fragments. Out: irradiance per fragment, in units in which 1 shows white
paper as sRGB white at exposure 0. All light is white: the camera has the white balance.

Left out on purpose: cast shadows and interreflection; an object's own shadow on the patch is not predicted. What that
costs, computed for the default ranges: a ledge 10 mm high along the top of a patch 110 mm wide shades 28 % of it in the
mean view and takes 4 % of its light (9 % at the 95 % point); a card 5 mm off its object darkens a strip of the object 9
mm wide by a third when the light comes from 60 degrees, and nothing on itself. A lamp's fall-off, ambient light that
differs by direction, and highlights on paper are left out, too: together they took 0.5 points [-0.1, 1.0] of the rates
promised for glossy paper half a meter from a lamp, in 9 pairs of scene and network.

Source: Lambert.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from patchproof.base import geometry
from patchproof.channel.effects import Light


@dataclass(frozen=True)
class Lighting:
    """The light of N views: `ambient` and `directional` N, and unit directions `toward` the light N×3."""

    ambient: Tensor
    directional: Tensor
    toward: Tensor


def lighting_of(light: Light, forward, up, device: torch.device | str = "cpu") -> Lighting:
    """Return the light of N views on a patch whose printed side faces `forward`."""
    toward = geometry.orbit(light.light_azimuth_deg, light.light_elevation_deg, forward, up)
    values = np.column_stack([light.ambient, light.directional, toward]).astype(np.float32)  # sent to a device at once
    ambient, directional, *direction = torch.as_tensor(values.T.copy(), device=device)
    return Lighting(ambient, directional, torch.stack(direction, 1))


def irradiance(normal: Tensor, view: Tensor, light: Lighting) -> Tensor:
    """Return the light on P fragments with unit `normal` P×3, each in one of the views (`view` P)."""
    # torch's own sum over three columns takes half as long again
    cosine = geometry.dot(normal.unbind(-1), light.toward.index_select(0, view).unbind(-1)).clamp_min(0)
    return light.ambient.index_select(0, view) + light.directional.index_select(0, view) * cosine
