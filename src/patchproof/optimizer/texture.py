"""The object's own texture as the thing that is optimized, whole or under a mask.

In: a scene with a canvas (which texels may change, and from what start). Out: `Texture`: its design is the list of
those texels, 3×1×M, so that the loop treats it like any picture and no other texel can change. With `epsilon` every
texel stays within that distance of its start. Nothing is printed, hence no printer and no gamut.

Source: Pestana et al., algorithms "Full Texture" and "Masked Textures and 3D Patches".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from patchproof.optimizer import pyramid
from patchproof.optimizer.pixels import as_pixels, from_pixels
from patchproof.render.designs import LearnedTextures
from patchproof.render.photograph import ObjectTextures
from patchproof.scene.mesh_scene import MeshScene
from patchproof.sheets.piece import CELLS, control_design


@dataclass(frozen=True, eq=False)
class Texture:
    """Designs are 3×1×M in [0, 1]: the texels that may change, texture by texture, by rows."""

    # Larger steps suit the networks that train and no other: of a letter box for three networks, a fourth recognized
    # 60 % as it came, 60, 70, 76 % with steps of 0.1, 0.03, 0.015 (96 views), 81 % with twice as many of 0.015.
    STEP_SIZE: ClassVar[float] = 0.015
    scene: MeshScene
    device: torch.device

    def start(self) -> Tensor:
        """The texels that the canvas starts from."""
        return from_pixels(self.surface.texels(self.scene.canvas.start_srgb), self.device)

    def clipped(self, design: Tensor) -> Tensor:
        """The nearest design within the ball round the start."""
        epsilon = self.scene.settings.patch.epsilon
        if epsilon is None:
            return design.clamp(0, 1)
        # whole code values: rounding to 8 bits must not leave the ball
        reach = np.floor(epsilon * 255 + 1e-6) / 255
        return torch.minimum(torch.maximum(design, self._start - reach), self._start + reach).clamp(0, 1)

    def levels(self, gradient: Tensor) -> tuple[Tensor, ...]:
        """The gradient's pyramids, texture by texture."""
        return tuple(
            level
            for image, mask in zip(self.surface.images(gradient), self.surface.masks, strict=True)
            for level in pyramid.levels(image, mask)
        )

    def joined(self, updates: Sequence[Tensor]) -> Tensor:
        """The update of a design that the pyramids' own add up to."""
        parts, first = [], 0
        for mask in self.surface.masks:
            count = pyramid.level_count(mask.shape)
            whole = pyramid.joined(updates[first : first + count])
            parts.append(whole[:, mask])
            first += count
        return torch.cat(parts, 1)[:, None]

    def penalty(self, design: Tensor) -> Tensor | float:
        """Total variation within the changed texels of each row or column of the textures, where settings ask."""
        weight = self.scene.settings.optimize.tv
        if not weight:
            return 0.0
        changes = [
            (a - b).abs()[..., both].mean()
            for texture, mask in zip(self.surface.filled(design), self.surface.masks, strict=True)
            for a, b, both in _neighbors(texture.permute(2, 0, 1), mask)
            if both.any()
        ]
        return weight * torch.stack(changes).mean() if changes else 0.0

    def pixels(self, design: Tensor) -> np.ndarray:
        """uint8 1×M×3: what the textures store."""
        return as_pixels(design)

    def control(self, kind: str, pixels: np.ndarray) -> np.ndarray:
        """The same texels in one mean color, gray, or noise of 16 cells along each texture's shorter side; or
        "shuffled": the design's own, such cells in another order.
        """
        if kind == "shuffled":
            return self._shuffled(pixels)
        if kind != "noise":
            return control_design(kind, pixels, self.scene.sheet_id)
        textures = [np.zeros((*mask.shape, 3), np.uint8) for mask in self.scene.canvas.mask]
        return self.surface.texels([control_design(kind, texture, self.scene.sheet_id) for texture in textures])

    def _shuffled(self, pixels: np.ndarray) -> np.ndarray:
        """Each texture's texels moved cell by cell; cells that a mask cuts push the next ones along."""
        rng = np.random.default_rng(int(self.scene.sheet_id, 36))
        result, first = pixels.copy(), 0
        for mask in self.scene.canvas.mask:
            rows, columns = np.nonzero(mask)
            cell = max(min(mask.shape) / CELLS, 1)
            number = (rows / cell).astype(int) * mask.shape[1] + (columns / cell).astype(int)
            place = rng.permutation(number.max(initial=0) + 1)[number]
            part = result[0, first : first + len(rows)]
            part[np.argsort(number, kind="stable")] = part[np.argsort(place, kind="stable")]
            first += len(rows)
        return result

    def shown(self, design: Tensor, kind: str = "design") -> ObjectTextures:
        """The object's textures with a design; differentiable."""
        return self.surface.shown(design)

    @cached_property
    def surface(self) -> LearnedTextures:
        """The textures with their changeable texels."""
        return LearnedTextures(self.scene.canvas, self.device)

    @cached_property
    def _start(self) -> Tensor:
        return self.start()


def _neighbors(texture: Tensor, mask: Tensor):
    """(one, other, where both may change) along rows and down columns of 3×H×W."""
    yield texture[:, :, 1:], texture[:, :, :-1], mask[:, 1:] & mask[:, :-1]
    yield texture[:, 1:], texture[:, :-1], mask[1:] & mask[:-1]
