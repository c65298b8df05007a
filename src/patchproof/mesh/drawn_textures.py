"""Textures that do not repeat, drawn out as far as their coordinates reach."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from patchproof.mesh.assets import Assets, Wrap
from patchproof.mesh.mesh import Material, MeshPart

_MOST_PX = 8192  # of a texture's side
_ROUNDING = 1e-4  # beyond 0 to 1: less than a texel


def draw_out_textures(
    parts: Sequence[MeshPart], wraps: Mapping[Material, tuple[Wrap, Wrap]], assets: Assets
) -> list[MeshPart]:
    """Return parts whose textures repeat; `wraps` has (u, v) of the materials whose textures do not."""
    drawn = {id(part): part for part in parts}
    for material, modes in wraps.items():
        texture, scale, shift = material.texture_srgb, np.ones(2), np.zeros(2)
        owners = [(part, part.uv) for part in parts if part.material is material and part.uv is not None]
        if texture is None or not owners:
            continue
        seen = np.concatenate([uv[np.unique(part.faces)] for part, uv in owners])
        for i, (mode, low, high) in enumerate(zip(modes, seen.min(0), seen.max(0), strict=True)):
            if mode == "repeat" or (low >= -_ROUNDING and high <= 1 + _ROUNDING):
                continue
            size, pad = texture.shape[1 - i], np.zeros((3, 2))
            pad[1 - i] = (0, size) if mode == "mirror" else np.ceil(1 + size * np.maximum(0, [-low, high - 1]))
            total = size + pad.sum()
            if total > _MOST_PX or not assets.has_room(int(total) * texture.shape[i]):
                got = f"{total:.0f} texels instead of {size}"
                assets.say(f"the texture of {material.name} is repeated, not {mode}ed: that would take {got}")
                continue
            texture = np.pad(texture, pad.astype(int), "symmetric" if mode == "mirror" else "edge")
            scale[i], shift[i] = size / total, pad[1 - i, 0] / total
        if texture is not material.texture_srgb:
            larger = replace(material, texture_srgb=texture)
            for part, uv in owners:
                drawn[id(part)] = replace(part, material=larger, uv=uv * scale + shift)
    return list(drawn.values())
