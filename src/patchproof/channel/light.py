"""Light on matte surfaces: ambient plus one directional light per view (Lambert).

In: unit normals and per-view light. Out: irradiance per fragment, in units in which 1 shows white paper as sRGB white
at exposure 0. Left out on purpose: cast shadows and interreflection; an object's own shadow on the patch is not
predicted.
"""

from __future__ import annotations

from torch import Tensor


def irradiance(normal: Tensor, view: Tensor, ambient: Tensor, directional: Tensor, toward_light: Tensor) -> Tensor:
    """Light on P fragments of N views: `normal` P×3, `view` P; `ambient`, `directional` N; `toward_light` N×3 (unit)."""
    cosine = (normal * toward_light.index_select(0, view)).sum(-1).clamp_min(0)
    return ambient.index_select(0, view) + directional.index_select(0, view) * cosine
