"""`see`: everything about a batch of views that what is optimized does not change.

In: a stage, conditions and a picture's size. Out: `Seen`: for each pixel what lies behind the piece, and for each pixel
of the piece how much of it the piece covers, which texels it looks at and what light falls there. Rasterizing happens
here and nowhere else: views that were seen can be lit, printed and photographed anew (`relit`) at a fraction of the
cost, and shaded with any number of designs.

The object's edges take one sample per pixel, or `supersample`² on demand; those of the piece are antialiased always
(see `pixels`). Left out on purpose: transparency.
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
from patchproof.color import linear_from_srgb, srgb_from_linear
from patchproof.render.fragments import Cameras, Fragments
from patchproof.render.pixels import (
    OBJECT_LEARNED_TAPS,
    OBJECT_TAPS,
    ObjectPixels,
    PiecePicture,
    PiecePixels,
    object_pixels,
    piece_pixels,
)
from patchproof.render.raster import rasterize
from patchproof.render.stage import ObjectSurface, PieceSurface, Stage
from patchproof.render.texture import look_up
from patchproof.scene.conditions import Conditions, with_poses_of

NEAR_SHARE = 1e-3  # of the object's length: nearer things are cut


@dataclass(frozen=True)
class Seen:
    """A batch of views of `size_px`, rendered at `frame_px` (larger where a lens will bend the picture)."""

    stage: Stage
    conditions: Conditions
    size_px: tuple[int, int]
    frame_px: tuple[int, int]
    light: Light | None
    eye_mm: Tensor | None  # N×3
    background: np.ndarray  # uint8 N×H×W×3 sRGB
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
            return self._behind
        return self.object_light(self.stage.object.texels(self.reduced))

    def object_light(self, texels: Tensor) -> Tensor:
        """The lit object with these texels before its background, N·H·W × 3; differentiable."""
        seen, color = self.object, self._object_color(texels)
        if seen.samples == 1:
            return self._behind.index_copy(0, seen.pixel, color)
        share = torch.full_like(color[:, :1], 1 / seen.samples**2)
        covered = torch.zeros_like(self._behind[:, :1]).index_add_(0, seen.pixel, share)
        if not self.reduced:
            return (self._behind * (1 - covered)).index_add(0, seen.pixel, color * share)
        codes = srgb_from_linear(self._behind) * (1 - covered)
        return linear_from_srgb(codes.index_add(0, seen.pixel, srgb_from_linear(color) * share))

    def _object_color(self, texels: Tensor) -> Tensor:
        """The light P×3 of the object's fragments."""
        seen = self.object
        light = irradiance(seen.normal, seen.view, self.light, seen.position_mm)[:, None]
        return look_up(seen.texels, texels) * (seen.color * light)

    @cached_property
    def _behind(self) -> Tensor:
        """The background's light before exposure, N·H·W × 3."""
        codes = np.arange(256) / 255
        tables = np.broadcast_to(linear_from_srgb(codes)[:, None], (len(self.background), 256, 3))
        return _looked_up(self.background, tables, self.stage.device)

    @cached_property
    def bare_exposed(self) -> Tensor:
        """The bare object as a camera without blur and noise shows it, N·H·W × 3 sRGB."""
        if self.object is not None and self.object.samples > 1:
            return encoded((self.bare.view(len(self.conditions), -1, 3) * self.gains[:, None]).view(-1, 3))
        # the background has 256 codes per view and channel, which are exposed as a table
        light = linear_from_srgb(np.arange(256) / 255)[:, None] * self.gains[:, None].cpu().double().numpy()
        image = _looked_up(self.background, srgb_from_linear(light.clip(0, 1)), self.stage.device)
        if self.object is None:
            return image
        color = self._object_color(self.stage.object.texels(self.reduced))
        color = color * self.gains.index_select(0, self.object.view)
        return image.index_copy(0, self.object.pixel, encoded(color))

    @cached_property
    def gains(self) -> Tensor:
        """The camera's factors, N×3."""
        return gains(self.conditions, torch.zeros(0, device=self.stage.device))

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

    def drawn(surface: ObjectSurface | PieceSurface, samples: int) -> Fragments:
        fine = np.diag([samples, samples, 1]) @ matrix
        own = poses if surface is stage.object else scene.camera_from_print(conditions)
        cameras = _cameras(stage, own, fine, (frame_px[0] * samples, frame_px[1] * samples))
        return rasterize(surface.vertices, surface.faces, cameras, near_mm)

    fine = drawn(stage.object, supersample)
    parts, taps = None, OBJECT_TAPS if scene.canvas is None else OBJECT_LEARNED_TAPS
    if piece is not None:
        surface = drawn(stage.piece, 1)
        covering = surface if supersample == 1 else drawn(stage.piece, supersample)
        hidden = _hidden_share(surface, covering, fine, supersample)
        parts = piece_pixels(stage.piece, piece, surface, hidden, needs_position=_local(light))
    return Seen(
        stage,
        conditions,
        size_px,
        frame_px,
        light,
        eye.to(stage.device),
        _background(stage, conditions, size_px, frame),
        object_pixels(stage.object, fine, _coarse_pixel(fine, supersample), supersample, light.lamp is not None, taps),
        parts,
    )


def relit(seen: Seen, conditions: Conditions) -> Seen:
    """The same views under other light, with another print and camera; poses and backgrounds stay."""
    conditions = with_poses_of(conditions, seen.conditions)
    light = None if seen.light is None else _light(seen.stage, conditions)
    return replace(seen, conditions=conditions, light=light)


def _cameras(stage: Stage, poses: np.ndarray, matrix: np.ndarray, size_px: tuple[int, int]) -> Cameras:
    matrix = torch.as_tensor(matrix, device=stage.device).expand(len(poses), 3, 3)
    return Cameras(torch.as_tensor(poses, device=stage.device), matrix, size_px)


def _light(stage: Stage, conditions: Conditions) -> Light:
    scene = stage.scene
    return light_of(conditions, scene.frame.normal, scene.frame.up, scene.middle_mm, stage.device)


def _local(light: Light) -> bool:
    """Whether the light on the piece depends on where one is and where one looks from."""
    return light.lamp is not None or light.gloss is not None


def _coarse_pixel(fine: Fragments, samples: int) -> Tensor:
    """The pixel that each fragment lies in of a picture with `samples`² of them to the pixel."""
    if samples == 1:
        return fine.pixel
    _, height, width = fine.shape
    x, row = fine.pixel % width, fine.pixel // width
    y = row % height
    return (fine.view * (height // samples) + y // samples) * (width // samples) + x // samples


def _hidden_share(piece: Fragments, covering: Fragments, front: Fragments, samples: int) -> Tensor:
    """Per fragment of the piece, the share of the piece's samples in its pixel that the object lies in front of."""
    nearest = torch.full(
        (covering.shape[0] * covering.shape[1] * covering.shape[2],), torch.inf, device=piece.depth.device
    )
    nearest[front.pixel] = front.depth
    hidden = (nearest.index_select(0, covering.pixel) < covering.depth).float()
    if samples == 1:
        return hidden
    pixel, count = _coarse_pixel(covering, samples), piece.shape[0] * piece.shape[1] * piece.shape[2]
    sums = torch.zeros(2, count, device=hidden.device)
    sums[0].index_add_(0, pixel, hidden)
    sums[1].index_add_(0, pixel, torch.ones_like(hidden))
    return (sums[0] / sums[1].clamp_min(1)).index_select(0, piece.pixel)


def _see_pictures(stage: Stage, piece: PiecePicture | None, conditions: Conditions, size_px: tuple[int, int]) -> Seen:
    """Views of a scene made of pictures: the piece's homography takes the place of camera and mesh."""
    scene, device, parts = stage.scene, stage.device, None
    if piece is not None:
        homographies = torch.as_tensor(scene.piece_homographies(conditions, size_px), device=device)
        poses = torch.eye(4, dtype=torch.float64, device=device).expand(len(homographies), 4, 4)
        fragments = rasterize(stage.piece.vertices, stage.piece.faces, Cameras(poses, homographies, size_px), 1e-9)
        coefficients = torch.as_tensor(scene.piece_light(conditions), dtype=torch.float32, device=device)
        parts = piece_pixels(stage.piece, piece, fragments, None, white_coefficients=coefficients)
    return Seen(stage, conditions, size_px, size_px, None, None, scene.pictures(conditions, size_px), None, parts)


def _background(stage: Stage, conditions: Conditions, size_px: tuple[int, int], frame: Frame) -> np.ndarray:
    """What lies behind N views, uint8 N×H×W×3 before exposure; its edge goes on in a lens's margin."""
    photo_px = stage.scene.settings.camera.photo_px
    pictures = [stage.scene.backgrounds.picture(choice, photo_px, size_px) for choice in conditions.background]
    margin = ((0, 0), (frame.top, frame.bottom), (frame.left, frame.right), (0, 0))
    return np.pad(np.stack(pictures), margin, mode="edge")


def _looked_up(codes: np.ndarray, tables: np.ndarray, device: torch.device) -> Tensor:
    """uint8 pictures N×H×W×3 through tables N×256×3, pixels by rows."""
    import cv2

    pairs = zip(codes, tables.astype(np.float32), strict=True)
    pictures = [cv2.LUT(np.ascontiguousarray(code), table[None]) for code, table in pairs]
    return torch.as_tensor(np.stack(pictures), device=device).view(-1, 3)
