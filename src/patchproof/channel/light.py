"""Light on matte surfaces: ambient plus one directional light per view (Lambert).

In: unit normals and per-view light. Out: irradiance per fragment, in units in which 1 shows white paper as sRGB white
at exposure 0. Left out on purpose: cast shadows and interreflection; an object's own shadow on the patch is not
predicted.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Light:
    """The light of N views: `ambient` and `directional` N, and the unit directions `toward` the light, N×3."""

    ambient: Tensor
    directional: Tensor
    toward: Tensor


def irradiance(normal: Tensor, view: Tensor, light: Light) -> Tensor:
    """Light on P fragments with unit `normal` P×3, each in one of the views (`view` P)."""
    cosine = (normal * light.toward.index_select(0, view)).sum(-1).clamp_min(0)
    return light.ambient.index_select(0, view) + light.directional.index_select(0, view) * cosine
