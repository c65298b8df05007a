"""`photograph`: what the camera of each drawn condition makes of the object with the piece on it.

In: a scene set on a `Stage` (its tensors on one device), the piece's picture, and conditions.
Out: N×3×H×W sRGB. The work has three parts that can be kept apart: `see` (rasterize, texture the object, find which
texels of the piece each pixel looks at), `shade` (light and composite; the only part through which gradients reach the
piece) and the camera. Views that were seen once can be shaded again with another design, light or camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from patchproof import geometry
from patchproof.channel.camera import develop, encoded, gains, is_pointwise
from patchproof.channel.light import Light, irradiance
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
    """The whole piece as it looks on paper, H×W×3 sRGB; `box_px` (x0, y0, x1, y1) is where the cut line falls."""

    srgb: Tensor
    box_px: tuple[float, float, float, float]


@dataclass(frozen=True)
class Stage:
    """A scene's tensors on one device; the card's corners come after the object's vertices."""

    scene: MeshScene
    vertices: Tensor
    faces: Tensor
    card_faces: Tensor
    corner_uv: Tensor
    corner_normal: Tensor
    corner_color: Tensor  # vertex color times base color
    material: Tensor
    textures: tuple[Tensor, ...]  # H×W×3 sRGB in [0, 1]
    layout: Layout
    card_normal: Tensor

    @cached_property
    def linear_texels(self) -> Tensor:
        """All textures' mip levels, averaged as light."""
        return texel_table([linear_from_srgb(texture) for texture in self.textures])

    @cached_property
    def encoded_texels(self) -> Tensor:
        """All textures' mip levels, averaged as code values."""
        return texel_table(list(self.textures))


@dataclass(frozen=True)
class Seen:
    """A batch of views: what lies behind, the object's own color and normal, which texels of the piece show where."""

    conditions: Conditions
    size_px: tuple[int, int]
    background: Tensor  # N·H·W × 3 linear
    light: Light
    object_pixel: Tensor
    object_view: Tensor
    object_albedo: Tensor
    object_normal: Tensor
    piece_pixel: Tensor
    piece_view: Tensor
    piece_normal: Tensor
    piece_texels: Footprint | None  # None where no piece was looked for
    back_pixel: Tensor  # where the card shows its back

    @cached_property
    def bare(self) -> Tensor:
        """The lit object without the piece, N·H·W × 3."""
        light = irradiance(self.object_normal, self.object_view, self.light)
        return self.background.index_copy(0, self.object_pixel, self.object_albedo * light[:, None])

    @cached_property
    def gains(self) -> Tensor:
        """The camera's factors, N×3."""
        return gains(self.conditions, self.background)

    @cached_property
    def bare_exposed(self) -> Tensor:
        """The bare object as a camera without blur and noise shows it, N·H·W × 3 sRGB."""
        light = self.bare.view(len(self.conditions), -1, 3) * self.gains[:, None]
        return encoded(light).view(-1, 3)


def set_stage(scene: MeshScene, device: torch.device | str = "cpu") -> Stage:
    """Move a scene's mesh, textures and card to a device."""
    mesh, card = scene.mesh, scene.card
    vertices, card_normal = mesh.vertices, np.zeros(3)
    if card is not None:
        corners = card.world(geometry.rect_corners([0, 0, *card.size_mm]))
        vertices, card_normal = np.concatenate([vertices, corners]), card.normal
    base = np.array([material.base_color_linear for material in mesh.materials], np.float32)
    textures = tuple(_texture(material.texture_srgb).to(device) for material in mesh.materials)

    def on(array) -> Tensor:
        return torch.as_tensor(np.ascontiguousarray(array), device=device)

    return Stage(
        scene,
        on(vertices),
        on(mesh.faces),
        on(np.array(_CARD_FACES) + len(mesh.vertices)),
        on(mesh.corner_uv),
        on(mesh.corner_normal),
        on(mesh.corner_color_linear * base[mesh.face_material][:, None]),
        on(mesh.face_material),
        textures,
        layout([(t.shape[1], t.shape[0]) for t in textures], wrap=True, device=device),
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
    """Everything about these views that the piece's colors do not change; the object is seen behind the card, too."""
    scene, device = stage.scene, stage.vertices.device
    poses = torch.as_tensor(scene.camera_from_world(conditions), device=device)
    matrix = torch.as_tensor(scene.matrix_px(size_px), device=device).expand(len(poses), 3, 3)
    cameras, near_mm = Cameras(poses, matrix, size_px), NEAR_SHARE * scene.settings.object.length_mm
    seen = rasterize(stage.vertices, stage.faces, cameras, near_mm)
    card = rasterize(stage.vertices, stage.card_faces[: 0 if piece is None else 2], cameras, near_mm)
    background = _backgrounds(stage, conditions, size_px)
    nearest = torch.full((len(background),), torch.inf, device=device)
    nearest[seen.pixel] = seen.depth
    card = card.where(card.depth <= nearest[card.pixel])
    front, back = card.where(card.front), card.where(~card.front)
    albedo, normal = _object_surface(stage, seen, _reduces(stage, size_px))
    return Seen(
        conditions,
        size_px,
        background,
        _light(stage, conditions),
        seen.pixel,
        seen.view,
        albedo,
        normal,
        front.pixel,
        front.view,
        stage.card_normal.expand(len(front), 3),
        None if piece is None else _piece_footprint(piece, front),
        back.pixel,
    )


def shade(stage: Stage, seen: Seen, piece: PiecePicture | None) -> Tensor:
    """N×3×H×W linear light at the sensor; differentiable in the piece's picture. `None` shows the bare object."""
    image = seen.bare
    if piece is not None:
        image = image.index_fill(0, seen.back_pixel, PAPER_BACK_LINEAR)
        image = image.index_copy(0, seen.piece_pixel, _piece_light(stage, seen, piece))
    return _as_pictures(seen, image)


def expose(stage: Stage, seen: Seen, piece: PiecePicture | None, reduced: bool = False, jpeg: bool = True) -> Tensor:
    """The photographs of views already seen."""
    scale = min(seen.size_px) / min(stage.scene.settings.camera.photo_px)
    if not is_pointwise(seen.conditions, scale, reduced, jpeg):
        return develop(shade(stage, seen, piece), seen.conditions, scale, reduced, jpeg)
    if piece is None:
        return _as_pictures(seen, seen.bare_exposed)
    # where each pixel is developed alone, only the piece's own pixels differ from the bare object's photograph
    light = _piece_light(stage, seen, piece) * seen.gains[seen.piece_view]
    back = encoded(PAPER_BACK_LINEAR * seen.gains[seen.back_pixel // (seen.size_px[0] * seen.size_px[1])])
    image = seen.bare_exposed.index_copy(0, seen.back_pixel, back)
    return _as_pictures(seen, image.index_copy(0, seen.piece_pixel, encoded(light)))


def _piece_light(stage: Stage, seen: Seen, piece: PiecePicture) -> Tensor:
    """The light P×3 that the piece's fragments send to the camera."""
    draws = torch.as_tensor(seen.conditions.print_draw).to(seen.background)
    reflectance = _look_up_light(seen.piece_texels, piece.srgb, _reduces(stage, seen.size_px))
    light = irradiance(seen.piece_normal, seen.piece_view, seen.light)
    return vary(reflectance, draws[seen.piece_view]) * light[:, None]


def _as_pictures(seen: Seen, image: Tensor) -> Tensor:
    width, height = seen.size_px
    return image.view(len(seen.conditions), height, width, 3).permute(0, 3, 1, 2)


def _light(stage: Stage, conditions: Conditions) -> Light:
    frame = stage.scene.frame
    toward = geometry.orbit(conditions.light_azimuth_deg, conditions.light_elevation_deg, frame.normal, frame.up)
    values = (conditions.ambient, conditions.directional, toward)
    return Light(*(torch.as_tensor(v, dtype=torch.float32, device=stage.vertices.device) for v in values))


def _reduces(stage: Stage, size_px: tuple[int, int]) -> bool:
    """Whether a picture stands for a larger photograph that was reduced.

    A sensor averages light, but what reduces a photograph averages its code values, and a fine pattern of strong colors
    is darker that way. Textures of smaller pictures are therefore averaged as code values: at twice a network's size,
    40 photographs had 0.04 less confidence than promised that way, and 0.09 less when light was averaged.
    """
    return min(size_px) < min(stage.scene.settings.camera.photo_px)


def _look_up_light(seen: Footprint, texture_srgb: Tensor, encoded: bool) -> Tensor:
    """The light P×3 that footprints see in one texture, averaged as light or as code values."""
    if encoded:
        return linear_from_srgb(look_up(seen, texel_table([texture_srgb])))
    return look_up(seen, texel_table([linear_from_srgb(texture_srgb)]))


def _object_surface(stage: Stage, fragments: Fragments, encoded: bool) -> tuple[Tensor, Tensor]:
    """Albedo and unit normal, P×3 each, of the object's fragments; faces seen from behind turn their normal round."""
    b, face = fragments.barycentric, fragments.face
    color = _interpolate(stage.corner_color, face, b)
    corner_uv = stage.corner_uv.index_select(0, face)
    uv, dx, dy = (
        (weights[..., None] * corner_uv).sum(1) for weights in (b, fragments.barycentric_dx, fragments.barycentric_dy)
    )
    looks = footprint(stage.layout, stage.material.index_select(0, face), uv, dx, dy, taps=1)
    normal = _interpolate(stage.corner_normal, face, b)
    normal = torch.nn.functional.normalize(normal, dim=-1) * torch.where(fragments.front, 1.0, -1.0)[:, None]
    light = linear_from_srgb(look_up(looks, stage.encoded_texels)) if encoded else look_up(looks, stage.linear_texels)
    return light * color, normal


def _interpolate(corner_values: Tensor, face: Tensor, barycentric: Tensor) -> Tensor:
    return (corner_values.index_select(0, face) * barycentric[..., None]).sum(1)


def _piece_footprint(piece: PiecePicture, fragments: Fragments) -> Footprint:
    """Which texels of the piece's picture each fragment of the card looks at."""
    height, width, _ = piece.srgb.shape
    x0, y0, x1, y1 = piece.box_px
    corners = geometry.rect_corners([x0, y0, x1 - x0, y1 - y0]) / [width, height]
    face_uv = torch.as_tensor(corners[np.array(_CARD_FACES)], dtype=torch.float32, device=fragments.face.device)
    corner_uv = face_uv.index_select(0, fragments.face)
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


def _texture(texture_srgb: np.ndarray | None) -> Tensor:
    return torch.ones(1, 1, 3) if texture_srgb is None else torch.tensor(texture_srgb, dtype=torch.float32) / 255
