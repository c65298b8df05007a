"""The object's edges at which its appearance may change abruptly, found once per mesh.

In: a mesh. Out: `Edges`: those that show in every view (rims, and creases or changes of color between faces of which
one has no texture) and those that show when one of their faces is turned away, which the planes of both tell. Corners
at one position are one. Left out on purpose: creases between two textured faces. A texture continues smoothly across
most of them, and mixing neighboring pixels would only blur it: a textured car was farther from 3×3 samples with them.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from patchproof.mesh.mesh import Mesh, position_numbers

CREASE_DEG = 10.0  # between normals: below it light changes by a sixth at most
_COLOR_STEP = 0.02  # of linear light


@dataclass(frozen=True)
class Edges:
    """Edges of a mesh: `ends` E×2 vertices and `faces` E×2 (one face twice at a rim); `always` E: seen from every side;
    `reversed` E: both faces run along it the same way, so that their fronts disagree. `planes` F×4 float64: a face's
    outside is where (x, y, z, 1) times its plane is positive.
    """

    ends: Tensor
    faces: Tensor
    always: Tensor
    reversed: Tensor
    planes: Tensor


def find_edges(mesh: Mesh, device: torch.device | str = "cpu") -> Edges:
    """Find the edges of a mesh and put them on a device."""
    place = position_numbers(mesh.vertices)[mesh.faces]
    first, second = place.ravel(), place[:, [1, 2, 0]].ravel()
    key = np.minimum(first, second) * (len(mesh.vertices) + 1) + np.maximum(first, second)
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.r_[True, np.diff(key[order]) != 0])
    count = np.diff(np.r_[starts, len(order)])
    one, other = order[starts[count == 2]], order[starts[count == 2] + 1]
    # a rim has one face; an edge of more than two faces counts as a rim of each
    rim = order[np.repeat(count != 2, count)]
    same_way = first[one] == first[other]
    always = np.r_[_has_jump(mesh, one, other, same_way), np.ones(len(rim), bool)]
    one, other = np.r_[one, rim], np.r_[other, rim]
    ends = np.stack([mesh.faces.ravel()[one], mesh.faces.ravel()[_next_corner(one)]], 1)
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    planes = np.concatenate([normal, -(normal * a).sum(1, keepdims=True)], 1)
    arrays = (ends, np.stack([one, other], 1) // 3, always, np.r_[same_way, np.zeros(len(rim), bool)], planes)
    return Edges(*(torch.as_tensor(array, device=device) for array in arrays))


def _next_corner(corner: np.ndarray) -> np.ndarray:
    """Return the next corner of the same face."""
    return corner // 3 * 3 + (corner + 1) % 3


def _has_jump(mesh: Mesh, one: np.ndarray, other: np.ndarray, same_way: np.ndarray) -> np.ndarray:
    """Return at which edges the appearance jumps because the normals or colors of their two faces do."""
    textured = np.array([material.texture_srgb is not None for material in mesh.materials])
    base = np.array([material.base_color_linear for material in mesh.materials])
    color = (mesh.corner_color_linear * base[mesh.face_material][:, None]).reshape(-1, 3)
    normal, faces = mesh.corner_normal.reshape(-1, 3), (one // 3, other // 3)
    jumps = np.zeros(len(one), bool)
    # two faces that agree on their front run along an edge in opposite directions
    other_corners = (np.where(same_way, other, _next_corner(other)), np.where(same_way, _next_corner(other), other))
    for near, far in zip((one, _next_corner(one)), other_corners, strict=True):
        cosine = np.where(same_way, -1, 1) * (normal[near] * normal[far]).sum(1)
        jumps |= (cosine < np.cos(np.radians(CREASE_DEG))) | (np.abs(color[near] - color[far]).max(1) > _COLOR_STEP)
    textured_sides = [textured[mesh.face_material[face]] for face in faces]
    return (jumps | (textured_sides[0] != textured_sides[1])) & ~(textured_sides[0] & textured_sides[1])
