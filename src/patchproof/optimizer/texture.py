"""The object's own texture as the subject of optimization, whole or under a mask.

In: a scene with a canvas (which texels may change, and their start). Out: `Texture`: its design is the list of those
texels, 3×1×M, so that the loop treats it like any picture and no other texel can change. With `epsilon` every texel
stays within that distance of its start. Nothing is printed, hence no printer and no gamut.

Source: Pestana et al., algorithms "Full Texture" and "Masked Textures and 3D Patches".
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, islice
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from patchproof.base.errors import Refused
from patchproof.base.output import image_bytes, write_atomically
from patchproof.mesh.load_mesh import write_glb
from patchproof.optimizer import subject
from patchproof.optimizer.subject import as_pixels, from_pixels
from patchproof.render.pixels import ObjectTextures
from patchproof.render.stage import LearnedTextures
from patchproof.scene.interface import Scene
from patchproof.scene.texture_scene import Canvas
from patchproof.sheets.piece import control_design


@dataclass(frozen=True, eq=False)
class Texture:
    """Designs are 3×1×M in [0, 1]: the texels that may change, texture by texture, by rows."""

    # Larger steps suit only the networks that train: a fourth network recognized a letter box made for three in 60 % of
    # views as it came, 60, 70, 76 % with steps of 0.1, 0.03, 0.015 (96 views), 81 % with twice as many of 0.015.
    scene: Scene
    canvas: Canvas
    device: torch.device

    def start(self) -> Tensor:
        """The texels that the canvas starts from."""
        return from_pixels(self.surface.texels(self.canvas.start_srgb), self.device)

    def clip(self, design: Tensor) -> Tensor:
        """The nearest design within `epsilon` of the start."""
        epsilon = self.scene.settings.patch.epsilon
        if epsilon is None:
            return design.clamp(0, 1)
        # whole code values, so that rounding to 8 bits stays within epsilon
        reach = np.floor(epsilon * 255 + 1e-6) / 255
        return torch.minimum(torch.maximum(design, self._start - reach), self._start + reach).clamp(0, 1)

    def gradient_levels(self, gradient: Tensor) -> tuple[Tensor, ...]:
        """The gradient's pyramids, texture by texture."""
        return tuple(chain(*map(subject.build_pyramid, self.surface.images(gradient), self.surface.masks)))

    def combine_levels(self, updates: Sequence[Tensor]) -> Tensor:
        """Combine the updates of the pyramids' levels into one update of the design."""
        remaining, masks = iter(updates), self.surface.masks
        levels = [list(islice(remaining, subject.level_count(mask.shape))) for mask in masks]
        parts = [subject.collapse_pyramid(each)[:, mask] for each, mask in zip(levels, masks, strict=True)]
        return torch.cat(parts, 1)[:, None]

    def penalty(self, design: Tensor) -> Tensor | float:
        """Total variation of neighboring texels that may both change, if the scene asks for it."""
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
        """uint8 1×M×3, as the textures store them."""
        return as_pixels(design)

    def control(self, kind: str, pixels: np.ndarray) -> np.ndarray:
        """The texels of a control: one mean color, gray, or noise of 16 cells along each texture's shorter side."""
        if kind != "noise":
            return control_design(kind, pixels, self.scene.sheet_id)
        textures = [np.zeros((*mask.shape, 3), np.uint8) for mask in self.canvas.mask]
        return self.surface.texels([control_design(kind, texture, self.scene.sheet_id) for texture in textures])

    def appearance(self, design: Tensor, kind: str = "design") -> ObjectTextures:
        """The object's textures with a design; differentiable."""
        return self.surface.appearance(design)

    def print_design(self, design: Tensor) -> Tensor:
        """The design itself: it is not printed."""
        return design

    def appearance_of_print(self, printed: Tensor) -> ObjectTextures:
        """The object's textures with the design."""
        return self.appearance(printed)

    def save(self, pixels: np.ndarray, folder: Path) -> None:
        """Write the object with its new textures, each texture, and masks one below the other, white if changeable."""
        textures, masks = self.surface.textures(pixels), self.canvas.mask
        write_atomically(folder / subject.OBJECT_FILE, lambda path: write_glb(self.canvas.mesh, textures, path))
        for i, texture in enumerate(textures):
            write_atomically(folder / subject.TEXTURE_FILES.replace("*", f"{i}"), image_bytes(texture, "PNG"))
        width = max(mask.shape[1] for mask in masks)
        wide = np.concatenate([np.pad(mask, ((0, 0), (0, width - mask.shape[1]))) for mask in masks])
        write_atomically(folder / subject.MASK_FILE, image_bytes(wide.astype(np.uint8) * 255, "PNG"))

    @property
    def texels_per_mm(self) -> float:
        """The resolution of the textures, per millimeter of the surface on average."""
        mesh, masks = self.canvas.mesh, self.canvas.mask
        sizes = np.array([mask.shape[1::-1] for mask in masks])
        uv = mesh.corner_uv.astype(float) * sizes[mesh.face_material][:, None]
        flat = np.abs(np.linalg.det(uv[:, 1:] - uv[:, :1])).sum()
        a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
        area_mm2 = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
        return float(np.sqrt(flat / area_mm2))

    @cached_property
    def surface(self) -> LearnedTextures:
        """The textures with their changeable texels."""
        return LearnedTextures(self.canvas, self.device)

    @cached_property
    def _start(self) -> Tensor:
        return self.start()


def read_texels(scene: Scene, folder: Path) -> np.ndarray:
    """Read the changeable texels of the textures that `Texture.save` wrote; refused where they do not fit the scene."""
    canvas = scene.object_canvas()
    textures = [subject.read_png(folder / subject.TEXTURE_FILES.replace("*", f"{i}")) for i in range(len(canvas.mask))]
    for texture, mask in zip(textures, canvas.mask, strict=True):
        if texture.shape[:2] != mask.shape:
            height, width = texture.shape[:2]
            raise Refused("the textures of this scene", f"{width} × {height} pixels", "optimize again")
    return LearnedTextures(canvas, torch.device("cpu")).texels(textures)


def _neighbors(texture: Tensor, mask: Tensor):
    """(one, other, where both may change) along rows and down columns of 3×H×W."""
    yield texture[:, :, 1:], texture[:, :, :-1], mask[:, 1:] & mask[:, :-1]
    yield texture[:, 1:], texture[:, :-1], mask[1:] & mask[:-1]
