"""`photograph`: what the camera of each drawn condition makes of the object with the piece on it.

In: a scene set on a `Stage` (its tensors on one device), the piece's picture in linear reflectance, and conditions.
Out: N×3×H×W sRGB. The work has three parts that can be kept apart: `see` (rasterize, texture the object, find which
texels of the piece each pixel looks at), `shade` (light and composite; the only part through which gradients reach the
piece) and the camera. Views that were seen once can be shaded again with another design, light or camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from patchproof import geometry
from patchproof.channel.camera import develop
from patchproof.channel.light import irradiance
from patchproof.channel.printer import vary
from patchproof.color import linear_from_srgb
from patchproof.render.raster import Cameras, Fragments, rasterize
from patchproof.render.texture import Footprint, Layout, footprint, layout, look_up, texel_table
from patchproof.scene.conditions import Conditions
from patchproof.scene.scene import MeshScene

NEAR_SHARE = 1e-3  # of the object's length: nearer things are cut
PAPER_BACK_LINEAR = 0.8  # plain white card seen from behind
# A card's corners run clockwise as one faces it; counter-clockwise faces show their outside.
_CARD_FACES = ((0, 3, 2), (0, 2, 1))


@dataclass(frozen=True)
class PiecePicture:
    """The whole piece, frame and design, as H×W×3 linear reflectance; `box_px` (x0, y0, x1, y1) is where the cut line
    falls.
    """

    linear: Tensor
    box_px: tuple[float, float, float, float]


@dataclass(frozen=True)
class Stage:
    """A scene's tensors on one device; the card's two faces come after the object's."""

    scene: MeshScene
    vertices: Tensor
    faces: Tensor
    bare_faces: Tensor
    corner_uv: Tensor
    corner_normal: Tensor
    corner_color: Tensor  # vertex color times base color
    material: Tensor
    textures: Layout
    texels: Tensor
    card_normal: Tensor


@dataclass(frozen=True)
class Seen:
    """A batch of views before light: what lies behind, the object's own color and normal, and the piece's texels."""

    conditions: Conditions
    size_px: tuple[int, int]
    background: Tensor  # N·H·W × 3 linear
    object_pixel: Tensor
    object_view: Tensor
    object_albedo: Tensor
    object_normal: Tensor
    piece_pixel: Tensor
    piece_view: Tensor
    piece_texels: Footprint | None
    card_normal: Tensor


def set_stage(scene: MeshScene, device: torch.device | str = "cpu") -> Stage:
    """Move a scene's mesh, textures and card to a device."""
    mesh, card = scene.mesh, scene.card
    vertices, faces, card_normal = mesh.vertices, mesh.faces, np.zeros(3)
    if card is not None:
        corners = card.world(geometry.rect_corners([0, 0, *card.size_mm]))
        faces = np.concatenate([faces, np.array(_CARD_FACES) + len(vertices)])
        vertices, card_normal = np.concatenate([vertices, corners]), card.normal
    base = np.array([material.base_color_linear for material in mesh.materials], np.float32)
    textures = [_linear_texture(material.texture_srgb) for material in mesh.materials]

    def on(array) -> Tensor:
        return torch.as_tensor(np.ascontiguousarray(array), device=device)

    return Stage(
        scene,
        on(vertices),
        on(faces),
        on(mesh.faces),
        on(mesh.corner_uv),
        on(mesh.corner_normal),
        on(mesh.corner_color_linear * base[mesh.face_material][:, None]),
        on(mesh.face_material),
        layout([(t.shape[1], t.shape[0]) for t in textures], wrap=True, device=device),
        texel_table(textures).to(device),
        on(card_normal.astype(np.float32)),
    )


def photograph(
    stage: Stage,
    piece: PiecePicture | None,
    conditions: Conditions,
    size_px: tuple[int, int],
    reduced: bool = False,
    jpeg: bool = True,
) -> Tensor:
    """N×3×H×W sRGB pictures of `size_px`; `piece=None` shows the bare object.

    A square size shows the photograph's centered square. `reduced` and `jpeg` as in `channel.camera.develop`.
    """
    return expose(stage, see(stage, piece, conditions, size_px), piece, reduced, jpeg)


def see(stage: Stage, piece: PiecePicture | None, conditions: Conditions, size_px: tuple[int, int]) -> Seen:
    """Everything about these views that neither light nor the piece's colors change."""
    scene = stage.scene
    poses = torch.as_tensor(scene.camera_from_world(conditions), device=stage.vertices.device)
    matrix = torch.as_tensor(scene.matrix_px(size_px), device=stage.vertices.device).expand(len(poses), 3, 3)
    faces = stage.bare_faces if piece is None else stage.faces
    near_mm = NEAR_SHARE * scene.settings.object.length_mm
    fragments = rasterize(stage.vertices, faces, Cameras(poses, matrix, size_px), near_mm)
    on_card = fragments.face >= len(stage.bare_faces)
    of_object, of_card = fragments.where(~on_card), fragments.where(on_card)
    albedo, normal = _object_surface(stage, of_object)
    background = _backgrounds(stage, conditions, size_px)
    back = of_card.where(~of_card.front)
    background.index_fill_(0, back.pixel, PAPER_BACK_LINEAR)
    of_card = of_card.where(of_card.front)
    seen = None if piece is None else _piece_footprint(stage, piece, of_card)
    return Seen(
        conditions,
        size_px,
        background,
        of_object.pixel,
        of_object.view,
        albedo,
        normal,
        of_card.pixel,
        of_card.view,
        seen,
        stage.card_normal,
    )


def shade(stage: Stage, seen: Seen, piece: PiecePicture | None) -> Tensor:
    """N×3×H×W linear light at the sensor; differentiable in the piece's picture."""
    conditions, device = seen.conditions, seen.background.device
    scene = stage.scene
    toward = geometry.orbit(
        conditions.light_azimuth_deg, conditions.light_elevation_deg, scene.frame.normal, scene.frame.up
    )
    ambient, directional, toward = (
        torch.as_tensor(v, dtype=torch.float32, device=device)
        for v in (conditions.ambient, conditions.directional, toward)
    )
    light = irradiance(seen.object_normal, seen.object_view, ambient, directional, toward)
    image = seen.background.index_copy(0, seen.object_pixel, seen.object_albedo * light[:, None])
    if piece is not None:
        normal = seen.card_normal.expand(len(seen.piece_view), 3)
        light = irradiance(normal, seen.piece_view, ambient, directional, toward)
        draws = torch.as_tensor(conditions.print_draw, dtype=torch.float32, device=device)
        reflectance = vary(look_up(seen.piece_texels, texel_table([piece.linear])), draws[seen.piece_view])
        image = image.index_copy(0, seen.piece_pixel, reflectance * light[:, None])
    width, height = seen.size_px
    return image.view(len(conditions), height, width, 3).permute(0, 3, 1, 2)


def expose(stage: Stage, seen: Seen, piece: PiecePicture | None, reduced: bool = False, jpeg: bool = True) -> Tensor:
    """The photographs of views already seen."""
    scale = min(seen.size_px) / min(stage.scene.settings.camera.photo_px)
    return develop(shade(stage, seen, piece), seen.conditions, scale, reduced, jpeg)


def _object_surface(stage: Stage, fragments: Fragments) -> tuple[Tensor, Tensor]:
    """Albedo and unit normal, P×3 each, of the object's fragments; faces seen from behind turn their normal round."""
    b, face = fragments.barycentric, fragments.face
    color = _interpolate(stage.corner_color, face, b)
    corner_uv = stage.corner_uv.index_select(0, face)
    uv, dx, dy = (
        (weights[..., None] * corner_uv).sum(1) for weights in (b, fragments.barycentric_dx, fragments.barycentric_dy)
    )
    looks = footprint(stage.textures, stage.material.index_select(0, face), uv, dx, dy, taps=1)
    normal = _interpolate(stage.corner_normal, face, b)
    normal = torch.nn.functional.normalize(normal, dim=-1) * torch.where(fragments.front, 1.0, -1.0)[:, None]
    return look_up(looks, stage.texels) * color, normal


def _interpolate(corner_values: Tensor, face: Tensor, barycentric: Tensor) -> Tensor:
    return (corner_values.index_select(0, face) * barycentric[..., None]).sum(1)


def _piece_footprint(stage: Stage, piece: PiecePicture, fragments: Fragments) -> Footprint:
    """Which texels of the piece's picture each fragment of the card looks at."""
    height, width, _ = piece.linear.shape
    x0, y0, x1, y1 = piece.box_px
    corners = geometry.rect_corners([x0, y0, x1 - x0, y1 - y0]) / [width, height]
    face_uv = torch.as_tensor(corners[np.array(_CARD_FACES)], dtype=torch.float32, device=fragments.face.device)
    corner_uv = face_uv.index_select(0, fragments.face - len(stage.bare_faces))
    uv, dx, dy = (
        (weights[..., None] * corner_uv).sum(1)
        for weights in (fragments.barycentric, fragments.barycentric_dx, fragments.barycentric_dy)
    )
    where = layout([(width, height)], wrap=False, device=uv.device)
    return footprint(where, torch.zeros_like(fragments.face), uv, dx, dy)


def _backgrounds(stage: Stage, conditions: Conditions, size_px: tuple[int, int]) -> Tensor:
    """What lies behind N views, N·H·W × 3 linear light before exposure."""
    photo_px = stage.scene.settings.camera.photo_px
    pictures = [stage.scene.backgrounds.picture(choice, photo_px, size_px) for choice in conditions.background]
    table = linear_from_srgb(torch.arange(256, device=stage.vertices.device) / 255)
    codes = torch.as_tensor(np.stack(pictures), device=stage.vertices.device)
    return table[codes.int()].view(-1, 3)


def _linear_texture(texture_srgb: np.ndarray | None) -> Tensor:
    if texture_srgb is None:
        return torch.ones(1, 1, 3)
    return linear_from_srgb(torch.tensor(texture_srgb, dtype=torch.float32) / 255)
