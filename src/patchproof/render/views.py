"""`see`: everything about a batch of views that what is optimized does not change.

In: a stage, conditions and a picture's size. Out: `Seen`: for each pixel what lies behind the piece, and for each pixel
of the piece how much of it the piece covers, which texels it looks at and what light falls there. Rasterizing happens
here and nowhere else: views that were seen can be lit, printed and photographed anew (`relit`) at a fraction of the
cost, and shaded with any number of designs.

Edges of the piece are antialiased from its own millimetres: a pixel cut by the edge shows its share. The object's edges
take one sample per pixel, or `supersample`² on demand. Left out on purpose: transparency.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from patchproof.channel.camera import encoded, gains
from patchproof.channel.lens import Frame, pinhole_frame
from patchproof.channel.light import Light, highlight, irradiance, light_of
from patchproof.color import linear_from_srgb
from patchproof.render.raster import Cameras, Fragments, rasterize
from patchproof.render.stage import ObjectSurface, PieceSurface, Stage
from patchproof.render.texture import Footprint, footprint, joined, layout, look_up
from patchproof.scene.conditions import Conditions, with_poses_of

NEAR_SHARE = 1e-3  # of the object's length: nearer things are cut
# Taps along the shorter side of a pixel's footprint. Eight leave 38 dB and more against 16×16 samples per pixel for
# optimized designs 20 to 200 px wide, four 30. The object's own texture has one unless it is what is optimized.
# What frames the design is seen with 4, and nothing is learned there.
DESIGN_TAPS, FRAME_TAPS, OBJECT_TAPS, OBJECT_LEARNED_TAPS = 8, 4, 1, 4
_LEAST_SHARE = 1 / 512  # of a pixel: less moves no 8-bit value


@dataclass(frozen=True)
class PiecePicture:
    """The whole piece as it looks on paper, H×W×3 sRGB; `box_px` (x0, y0, x1, y1) is where the cut line falls, and
    `design_px` where the design does.
    """

    srgb: Tensor
    box_px: tuple[float, float, float, float]
    design_px: tuple[float, float, float, float]


@dataclass(frozen=True)
class ObjectPixels:
    """The object's fragments: in which pixel (of `samples`² each), what texels they look at, and how they are lit."""

    pixel: Tensor
    view: Tensor
    texels: Footprint
    color: Tensor  # P×3: what the texture is multiplied by
    normal: Tensor
    position_mm: Tensor | None  # where light needs it
    samples: int


@dataclass(frozen=True)
class PiecePixels:
    """Pixels that the piece covers, each its `share`; `white` is the light P×3 of the base picture's paper where a
    scene is made of pictures, else None.
    """

    pixel: Tensor
    view: Tensor
    share: Tensor
    texels: Footprint
    normal: Tensor
    position_mm: Tensor | None
    white: Tensor | None
    back_pixel: Tensor  # where its back is seen
    back_share: Tensor


@dataclass(frozen=True)
class Seen:
    """A batch of views of `size_px`, rendered at `frame_px` (larger where a lens will bend the picture)."""

    stage: Stage
    conditions: Conditions
    size_px: tuple[int, int]
    frame_px: tuple[int, int]
    light: Light | None
    eye_mm: Tensor | None  # N×3
    background: Tensor  # N·H·W × 3 linear
    object: ObjectPixels | None
    piece: PiecePixels | None

    @property
    def reduced(self) -> bool:
        """Whether these views stand for larger photographs that were reduced.

        A sensor averages light, but what reduces a photograph averages its code values, and a fine pattern of strong
        colors is darker that way. Textures of smaller pictures are therefore averaged as code values: at twice a
        network's size, 40 photographs had 0.04 less confidence than promised that way, 0.09 when light was averaged.
        """
        return min(self.size_px) < min(self.stage.scene.settings.camera.photo_px)

    @cached_property
    def bare(self) -> Tensor:
        """The lit object without the piece, N·H·W × 3."""
        if self.object is None:
            return self.background
        return self.object_light(self.stage.object.texels(self.reduced))

    def object_light(self, texels: Tensor) -> Tensor:
        """The lit object with these texels before its background; differentiable."""
        seen = self.object
        light = irradiance(seen.normal, seen.view, self.light, seen.position_mm)[:, None]
        color = look_up(seen.texels, texels) * (seen.color * light)
        if seen.samples == 1:
            return self.background.index_copy(0, seen.pixel, color)
        share = 1 / seen.samples**2
        covered = torch.zeros_like(self.background[:, :1]).index_add_(
            0, seen.pixel, torch.full_like(color[:, :1], share)
        )
        return (self.background * (1 - covered)).index_add(0, seen.pixel, color * share)

    @cached_property
    def piece_white(self) -> Tensor:
        """The light on white paper at the piece's pixels, P×3 or P×1."""
        seen = self.piece
        if seen.white is not None:
            return seen.white
        return irradiance(seen.normal, seen.view, self.light, seen.position_mm)[:, None]

    @cached_property
    def piece_gloss(self) -> Tensor | None:
        """What glossy paper reflects on top, P×1; None where it is matte."""
        if self.light is None or self.light.gloss is None:
            return None
        seen = self.piece
        return highlight(seen.normal, seen.position_mm, self.eye_mm, seen.view, self.light)[:, None]

    @cached_property
    def gains(self) -> Tensor:
        """The camera's factors, N×3."""
        return gains(self.conditions, self.background)

    @cached_property
    def bare_exposed(self) -> Tensor:
        """The bare object as a camera without blur and noise shows it, N·H·W × 3 sRGB."""
        light = self.bare.view(len(self.conditions), -1, 3) * self.gains[:, None]
        return encoded(light).view(-1, 3)


def see(
    stage: Stage, piece: PiecePicture | None, conditions: Conditions, size_px: tuple[int, int], supersample: int = 1
) -> Seen:
    """The views of `conditions`, with nothing on the object where `piece` is None. Any picture of the same size as
    `piece` can be shown in them; the object behind it is seen, too.
    """
    if stage.object is None:
        return _see_pictures(stage, piece, conditions, size_px)
    scene = stage.scene
    frame = Frame(size_px, scene.matrix_px(size_px), 0, 0, 0, 0)
    if stage.camera is not None:
        frame = pinhole_frame(stage.camera, size_px)
    frame_px, matrix = frame.size_px, frame.matrix_px
    poses = scene.camera_from_world(conditions)
    near_mm = NEAR_SHARE * scene.settings.object.length_mm
    light = _light(stage, conditions)
    eye = torch.as_tensor(-(poses[:, :3, :3].transpose(0, 2, 1) @ poses[:, :3, 3:])[..., 0], dtype=torch.float32)
    fine = rasterize(
        stage.object.vertices,
        stage.object.faces,
        _cameras(stage, poses, np.diag([supersample, supersample, 1]) @ matrix, frame_px, supersample),
        near_mm,
    )
    pixel = _coarse_pixel(fine, frame_px, supersample)
    parts, taps = None, OBJECT_TAPS if scene.canvas is None else OBJECT_LEARNED_TAPS
    if piece is not None:
        surface = rasterize(stage.piece.vertices, stage.piece.faces, _cameras(stage, poses, matrix, frame_px), near_mm)
        hidden = _hidden_share(surface, fine.depth, pixel, supersample)
        parts = _piece_pixels(stage.piece, piece, surface, hidden, needs_position=_local(light))
    return Seen(
        stage,
        conditions,
        size_px,
        frame_px,
        light,
        eye.to(stage.device),
        _background(stage, conditions, size_px, frame),
        _object_pixels(stage.object, fine, pixel, supersample, light.lamp is not None, taps),
        parts,
    )


def relit(seen: Seen, conditions: Conditions) -> Seen:
    """The same views under other light, with another print and camera; poses and backgrounds stay."""
    conditions = with_poses_of(conditions, seen.conditions)
    light = None if seen.light is None else _light(seen.stage, conditions)
    return replace(seen, conditions=conditions, light=light)


def _cameras(stage: Stage, poses: np.ndarray, matrix: np.ndarray, size_px: tuple[int, int], fine: int = 1) -> Cameras:
    matrix = torch.as_tensor(matrix, device=stage.device).expand(len(poses), 3, 3)
    return Cameras(torch.as_tensor(poses, device=stage.device), matrix, (size_px[0] * fine, size_px[1] * fine))


def _light(stage: Stage, conditions: Conditions) -> Light:
    scene = stage.scene
    return light_of(conditions, scene.frame.normal, scene.frame.up, scene.middle_mm, stage.device)


def _local(light: Light) -> bool:
    """Whether the light on the piece depends on where one is and where one looks from."""
    return light.lamp is not None or light.gloss is not None


def _coarse_pixel(fragments: Fragments, size_px: tuple[int, int], samples: int) -> Tensor:
    """The pixel of `size_px` that each fragment of a picture `samples` times as fine lies in."""
    if samples == 1:
        return fragments.pixel
    width, height = size_px
    x, row = fragments.pixel % (width * samples), fragments.pixel // (width * samples)
    y = row % (height * samples)
    return (fragments.view * height + y // samples) * width + x // samples


def _hidden_share(piece: Fragments, depth: Tensor, pixel: Tensor, samples: int) -> Tensor:
    """Per fragment of the piece, the share of its pixel in which the object lies in front."""
    views, height, width = piece.shape
    nearest = torch.zeros(views * height * width, device=depth.device)
    nearest[piece.pixel] = piece.depth
    in_front = (depth < nearest.index_select(0, pixel)).float() / samples**2
    return torch.zeros_like(nearest).index_add_(0, pixel, in_front).index_select(0, piece.pixel)


def _piece_pixels(
    surface: PieceSurface,
    piece: PiecePicture,
    fragments: Fragments,
    hidden: Tensor | None,
    needs_position: bool = False,
    white_coefficients: Tensor | None = None,
) -> PiecePixels:
    """What the piece's own fragments look at, and their share of each pixel."""
    size = torch.tensor(surface.size_mm, dtype=torch.float32, device=fragments.face.device)
    mm, mm_dx, mm_dy = _interpolated(surface.corner_mm, fragments)
    # along each of its sides, how much of the pixel's own extent lies inside the cut line
    half = (mm_dx.abs() + mm_dy.abs()).clamp_min(1e-9) / 2
    low, high = (torch.minimum((mm + k * half).clamp_min(0), size) for k in (-1, 1))
    share = ((high - low) / (2 * half)).prod(1)
    if hidden is not None:
        share = share * (1 - hidden)
    shown = share > _LEAST_SHARE
    kept = fragments.where(shown & fragments.front)
    front, back = ((shown & side).nonzero()[:, 0] for side in (fragments.front, ~fragments.front))
    mm, mm_dx, mm_dy = (values.index_select(0, front) for values in (mm, mm_dx, mm_dy))
    position = _weighted(surface.vertices.float()[surface.faces], kept) if needs_position else None
    return PiecePixels(
        kept.pixel,
        kept.view,
        share.index_select(0, front)[:, None],
        _piece_footprint(piece, mm / size, mm_dx / size, mm_dy / size),
        torch.nn.functional.normalize(_weighted(surface.corner_normal, kept), dim=-1),
        position,
        None if white_coefficients is None else _white(white_coefficients[kept.view], 2 * mm / size - 1),
        fragments.pixel.index_select(0, back),
        share.index_select(0, back)[:, None],
    )


def _piece_footprint(piece: PiecePicture, at: Tensor, at_dx: Tensor, at_dy: Tensor) -> Footprint:
    """Which texels of the piece's picture are seen; `at` P×2 from 0 to 1 across the piece."""
    height, width, _ = piece.srgb.shape
    x0, y0, x1, y1 = piece.box_px
    scale, size = at.new_tensor([(x1 - x0) / width, (y1 - y0) / height]), at.new_tensor([width, height])
    uv, uv_dx, uv_dy = at * scale + at.new_tensor([x0, y0]) / size, at_dx * scale, at_dy * scale
    # whose pixel reaches into the design, or whose taps may read it: half a pixel and two texels
    low, high = at.new_tensor(piece.design_px).view(2, 2) / size
    reach = (uv_dx.abs() + uv_dy.abs()) * 0.75 + 2 / size
    inside = ((uv + reach > low) & (uv - reach < high)).all(1)
    where, parts = layout([(width, height)], wrap=False, device=at.device), []
    for which, taps, learned in ((inside, DESIGN_TAPS, True), (~inside, FRAME_TAPS, False)):
        index = which.nonzero()[:, 0]
        one = (values.index_select(0, index) for values in (uv, uv_dx, uv_dy))
        parts.append((index, footprint(where, at.new_zeros(len(index), dtype=torch.long), *one, taps, learned)))
    return joined(parts, len(at))


def _object_pixels(
    surface: ObjectSurface, fragments: Fragments, pixel: Tensor, samples: int, needs_position: bool, taps: int
) -> ObjectPixels:
    """The object's fragments; faces seen from behind turn their normal round."""
    uv, uv_dx, uv_dy = _interpolated(surface.corner_uv, fragments)
    material = surface.material.index_select(0, fragments.face)
    normal = torch.nn.functional.normalize(_weighted(surface.corner_normal, fragments), dim=-1)
    return ObjectPixels(
        pixel,
        fragments.view,
        footprint(surface.layout, material, uv, uv_dx, uv_dy, taps),
        _weighted(surface.corner_color, fragments),
        normal * torch.where(fragments.front, 1.0, -1.0)[:, None],
        _weighted(surface.vertices.float()[surface.faces], fragments) if needs_position else None,
        samples,
    )


def _weighted(corner_values: Tensor, fragments: Fragments) -> Tensor:
    """Values F×3×C at the faces' corners, interpolated at the fragments."""
    return _sum(corner_values, fragments.face, fragments.barycentric)


def _interpolated(corner_values: Tensor, fragments: Fragments) -> tuple[Tensor, Tensor, Tensor]:
    """The same, and how it changes from pixel to pixel to the right and down."""
    weights = (fragments.barycentric, fragments.barycentric_dx, fragments.barycentric_dy)
    return tuple(_sum(corner_values, fragments.face, weight) for weight in weights)


def _sum(corner_values: Tensor, face: Tensor, weight: Tensor) -> Tensor:
    """P×C: a weighted gather, for which the library has a kernel that is ten times as fast as its parts."""
    corner = face[:, None] * 3 + torch.arange(3, device=face.device)
    table = corner_values.flatten(0, 1)
    return torch.nn.functional.embedding_bag(corner, table, per_sample_weights=weight, mode="sum")


def _see_pictures(stage: Stage, piece: PiecePicture | None, conditions: Conditions, size_px: tuple[int, int]) -> Seen:
    """Views of a scene made of pictures: the piece's homography takes the place of camera and mesh."""
    scene, device, parts = stage.scene, stage.device, None
    if piece is not None:
        homographies = torch.as_tensor(scene.piece_homographies(conditions, size_px), device=device)
        poses = torch.eye(4, dtype=torch.float64, device=device).expand(len(homographies), 4, 4)
        fragments = rasterize(stage.piece.vertices, stage.piece.faces, Cameras(poses, homographies, size_px), 1e-9)
        coefficients = torch.as_tensor(scene.piece_light(conditions), dtype=torch.float32, device=device)
        parts = _piece_pixels(stage.piece, piece, fragments, None, white_coefficients=coefficients)
    background = _decoded(scene.pictures(conditions, size_px), device)
    return Seen(stage, conditions, size_px, size_px, None, None, background, None, parts)


def _white(coefficients: Tensor, uv: Tensor) -> Tensor:
    """Quadratics P×3×6 of [1, u, v, u², uv, v²] at `uv` P×2."""
    u, v = uv.unbind(1)
    terms = torch.stack([torch.ones_like(u), u, v, u * u, u * v, v * v], 1)
    return (coefficients * terms[:, None]).sum(-1).clamp_min(0)


def _background(stage: Stage, conditions: Conditions, size_px: tuple[int, int], frame: Frame) -> Tensor:
    """What lies behind N views, N·H·W × 3 linear light before exposure; its edge goes on in a lens's margin."""
    photo_px = stage.scene.settings.camera.photo_px
    pictures = [stage.scene.backgrounds.picture(choice, photo_px, size_px) for choice in conditions.background]
    margin = ((0, 0), (frame.top, frame.bottom), (frame.left, frame.right), (0, 0))
    return _decoded(np.pad(np.stack(pictures), margin, mode="edge"), stage.device)


def _decoded(pictures: np.ndarray, device: torch.device) -> Tensor:
    """uint8 pictures as linear light, pixels by rows."""
    table = linear_from_srgb(torch.arange(256, device=device) / 255)
    return table[torch.as_tensor(pictures, device=device).int()].view(-1, 3)
