"""Textures that are mirrored or clamped, drawn out so that they can be repeated, as the renderer does.

In: parts, and how each material's texture continues along u and v. Out: the same parts with a larger texture where
coordinates leave 0 to 1: a mirrored one is twice as wide, a clamped one gets its last texels as far as they are seen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from patchproof.mesh.assets import Assets
from patchproof.mesh.mesh import Material, MeshPart

Wrap = Literal["repeat", "mirror", "clamp"]
_MOST_PX = 8192  # of a texture's side
_ROUNDING = 1e-4  # beyond 0 to 1: less than a texel


def draw_out_textures(
    parts: Sequence[MeshPart], wraps: Mapping[Material, tuple[Wrap, Wrap]], assets: Assets
) -> list[MeshPart]:
    """Return parts whose textures repeat; `wraps` has (u, v) of the materials whose textures do not."""
    drawn = {id(part): part for part in parts}
    for material, modes in wraps.items():
        texture = material.texture_srgb
        owners = [(part, part.uv) for part in parts if part.material is material and part.uv is not None]
        if texture is None or not owners:
            continue
        seen = np.concatenate([uv[np.unique(part.faces)] for part, uv in owners])
        scale, shift = np.ones(2), np.zeros(2)
        for i, (mode, low, high) in enumerate(zip(modes, seen.min(0), seen.max(0), strict=True)):
            if mode == "repeat" or (low >= -_ROUNDING and high <= 1 + _ROUNDING):
                continue
            size = texture.shape[1 - i]
            before, after = (
                (0, size) if mode == "mirror" else np.ceil([1 - min(low, 0) * size, 1 + max(high - 1, 0) * size])
            )
            total = before + size + after
            if total > _MOST_PX:
                got = f"{total:.0f} texels instead of {size}"
                assets.say(f"the texture of {material.name} is repeated, not {mode}ed: that would take {got}")
                continue
            pad = [(0, 0)] * 3
            pad[1 - i] = int(before), int(after)
            texture = np.pad(texture, pad, "symmetric" if mode == "mirror" else "edge")
            scale[i], shift[i] = size / total, before / total
        if texture is not material.texture_srgb:
            larger = replace(material, texture_srgb=texture)
            for part, uv in owners:
                drawn[id(part)] = replace(part, material=larger, uv=uv * scale + shift)
    return list(drawn.values())
