"""Vertex colors as the subject of optimization, whole or under a mask over the vertices.

In: a problem whose scene is an object's own texture. Out: the problem of the same object colored by its vertices: the
design is 3×1×V, the colors of the vertices of the faces that may change, and a face shows its corners' colors, linearly
between them in sRGB. The object starts from the colors of its texture at the vertices, so it has no finer detail.
Colors are carried by a texture in which each face has its own texels.

Source: Pestana et al., supplement algorithms 3 and 4, with a one-dimensional mask over vertices.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from patchproof.base.errors import Refused
from patchproof.mesh.mesh import Mesh
from patchproof.mesh.unwrap import spans, unwrap
from patchproof.optimizer.problem import Problem
from patchproof.optimizer.subject import as_pixels, from_pixels
from patchproof.optimizer.texture import Texture
from patchproof.render.pixels import ObjectTextures
from patchproof.render.stage import set_stage
from patchproof.scene.texture_scene import GUTTER_TEXELS, TextureScene, select_faces, texture_canvas

_TEXELS = 512  # side of the texture that carries the colors


@dataclass(frozen=True, eq=False)
class VertexColors(Texture):
    """Designs are 3×1×V in [0, 1]: the colors of `vertices`."""

    vertices: np.ndarray  # V numbers of vertices of the canvas's mesh

    def start(self) -> Tensor:
        """The mean color of the texels at each vertex, or gray where the scene starts from gray."""
        near = self._weights.amax(1) > 0.5  # texels that lie nearest to one of their corners
        owner = self._corners[near].gather(1, self._weights[near].argmax(1, keepdim=True))[:, 0]
        count = torch.bincount(owner, minlength=len(self.canvas.mesh.vertices)).clamp(min=1)
        sums = torch.zeros(3, len(count)).index_add_(1, owner, self._texels_at_start[:, 0][:, near])
        return (sums / count)[:, self._chosen][:, None]

    def gradient_levels(self, gradient: Tensor) -> tuple[Tensor, ...]:
        """The gradient alone: vertices are no grid that could be halved."""
        return (gradient,)

    def combine_levels(self, updates: Sequence[Tensor]) -> Tensor:
        """The one level's update."""
        return updates[0]

    def penalty(self, design: Tensor) -> float:
        """No penalty: vertices have no neighbors in a grid."""
        return 0.0

    def appearance(self, design: Tensor, kind: str = "design") -> ObjectTextures:
        """The object colored by a design; differentiable."""
        return self.surface.appearance(self.texels(design))

    def save(self, pixels: np.ndarray, folder: Path) -> None:
        """The object with its new colors as GLB."""
        super().save(as_pixels(self.texels(from_pixels(pixels))), folder)

    def texels(self, design: Tensor) -> Tensor:
        """The texels 3×1×M of a design 3×1×V; corners that may not change keep what their texels start from."""
        colors = design.new_zeros(3, len(self.canvas.mesh.vertices)).index_copy(1, self._chosen, design[:, 0])
        is_chosen = torch.zeros(colors.shape[1]).index_fill_(0, self._chosen, 1.0)[self._corners] * self._weights
        mixed = (colors[:, self._corners] * self._weights).sum(2)
        return (mixed + self._texels_at_start[:, 0] * (1 - is_chosen.sum(1)))[:, None]

    @cached_property
    def _chosen(self) -> Tensor:
        return torch.as_tensor(self.vertices)

    @cached_property
    def _texels_at_start(self) -> Tensor:
        return super().start()

    @cached_property
    def _corners(self) -> Tensor:
        return torch.as_tensor(self._corners_and_weights[0])

    @cached_property
    def _weights(self) -> Tensor:
        return torch.as_tensor(self._corners_and_weights[1])

    @cached_property
    def _corners_and_weights(self) -> tuple[np.ndarray, np.ndarray]:
        parts = [barycentric(self.canvas.mesh, i, mask) for i, mask in enumerate(self.canvas.mask)]
        corners, weights = (np.concatenate(each) for each in zip(*parts, strict=True))
        return corners, weights


def barycentric(mesh: Mesh, material: int, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(vertices M×3, float32 weights M×3) of the texels in `mask`, by rows: those of the face that covers a texel, or
    of one near it, whose weights are then cut to at least 0.
    """
    (height, width), faces = mask.shape, np.flatnonzero(mesh.face_material == material)
    corners = mesh.corner_uv[faces].astype(float) * (width, height)
    owner, place = np.zeros(mask.shape, int), np.zeros((*mask.shape, 2))
    for grow in (GUTTER_TEXELS, 0.0):  # a face's own texels replace its neighbors' rims
        for face, row, first, stop in spans(corners, grow):
            count = stop - first
            x = np.arange(count.sum()) + np.repeat(first - np.cumsum(count) + count, count)
            face, y = face.repeat(count), row.repeat(count)
            owner[y % height, x % width] = face
            place[y % height, x % width] = np.stack([x, y], 1) + 0.5
    a, b, c = np.moveaxis(corners[owner[mask]], 1, 0)
    area = _cross(b - a, c - a)
    safe = np.where(area == 0, 1.0, area)
    u, v = _cross(place[mask] - a, c - a) / safe, _cross(b - a, place[mask] - a) / safe
    weights = np.stack([1 - u - v, u, v], 1).clip(0)
    return mesh.faces[faces[owner[mask]]], (weights / weights.sum(1, keepdims=True)).astype(np.float32)


def vertex_problem(problem: Problem) -> Problem:
    """The problem of the same object, colored by its vertices."""
    scene, patch = problem.scene, problem.scene.settings.patch
    if not isinstance(scene, TextureScene) or patch.mask is not None:
        got = f'patch.kind = "{patch.kind}", mask = "{patch.mask}"'
        raise Refused("a texture, all of it or masked by faces or materials", got, "name patch.faces")
    masked = patch.materials or patch.faces is not None
    chosen = select_faces(scene.mesh, patch.materials, patch.faces, scene.base) if masked else slice(None)
    mesh = unwrap(scene.mesh, np.ones(len(scene.mesh.faces), bool), _TEXELS)
    canvas = texture_canvas(mesh, patch.changed(kind="texture", materials=(), faces=None), scene.base)
    scene = replace(scene, mesh=canvas.mesh, canvas=canvas)
    subject = VertexColors(scene, canvas, problem.device, np.unique(mesh.faces[chosen]))
    return replace(problem, scene=scene, stage=set_stage(scene, problem.device), subject=subject)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
