"""`see`: everything about a batch of views that what is optimized does not change.

In: a stage, conditions and a picture's size. Out: `Views`: for each pixel what lies behind the piece, and for each
pixel of the piece how much of it the piece covers, which texels it looks at and what light falls there. Rasterizing
happens here and nowhere else: views that were seen can be lit, printed and photographed anew (`relit`) at a fraction of
the cost, and shaded with any number of designs.

The object's edges take one sample per pixel, or `supersample`² on demand; those of the piece are antialiased always
(see `pixels`). Left out on purpose: transparency.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from patchproof.channel.camera import encoded, gains
from patchproof.channel.lens import Frame, pinhole_frame
from patchproof.channel.light import Lighting, highlight, irradiance, lighting_of
from patchproof.color import LIGHT_OF_CODE, linear_from_srgb, srgb_from_linear
from patchproof.render.fragments import Cameras, Fragments
from patchproof.render.pixels import (
    OBJECT_TAPS,
    ObjectPixels,
    PiecePicture,
    PiecePixels,
    Shown,
    object_pixels,
    piece_pixels,
)
from patchproof.render.raster import rasterize
from patchproof.render.stage import Stage
from patchproof.render.surfaces import ObjectSurface, PieceSurface
from patchproof.render.texture import look_up
from patchproof.scene.conditions import Conditions, with_poses_of
from patchproof.scene.mesh_scene import MeshScene
from patchproof.scene.scene import needs_mesh, needs_pictures

NEAR_SHARE = 1e-3  # of the object's length


@dataclass(frozen=True)
class Views:
    """A batch of views of `size_px`, rendered at `frame_px` (larger where a lens will bend the picture)."""

    stage: Stage
    conditions: Conditions
    size_px: tuple[int, int]
    frame_px: tuple[int, int]
    light: Lighting | None  # None, like the eyes, where pictures bring their own
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

    @property
    def on_object(self) -> ObjectPixels:
        """The object's pixels; a ValueError where a scene is made of pictures."""
        if self.object is None:
            raise ValueError("pictures have no object to look up")
        return self.object

    @property
    def on_piece(self) -> PiecePixels:
        """The piece's pixels; a ValueError where nothing was seen on the object."""
        if self.piece is None:
            raise ValueError("these views were seen without a piece")
        return self.piece

    @cached_property
    def bare(self) -> Tensor:
        """The lit object without the piece, N·H·W × 3."""
        return self._behind if self.object is None else self.object_light(self._own_texels)

    def object_light(self, texels: Tensor) -> Tensor:
        """The lit object with these texels before its background, N·H·W × 3; differentiable."""
        pixels, color = self.on_object, self._object_color(texels)
        if pixels.samples == 1:
            return self._behind.index_copy(0, pixels.pixel, color)
        share = torch.full_like(color[:, :1], 1 / pixels.samples**2)
        covered = torch.zeros_like(self._behind[:, :1]).index_add_(0, pixels.pixel, share)
        if not self.reduced:
            return (self._behind * (1 - covered)).index_add(0, pixels.pixel, color * share)
        codes = srgb_from_linear(self._behind) * (1 - covered)
        return linear_from_srgb(codes.index_add(0, pixels.pixel, srgb_from_linear(color) * share))

    def _object_color(self, texels: Tensor) -> Tensor:
        """The light P×3 of the object's fragments."""
        return look_up(self.on_object.texels, texels) * (self.on_object.color * self._irradiance(self.on_object))

    def _irradiance(self, pixels: ObjectPixels | PiecePixels) -> Tensor:
        """The light P×1 that falls on pixels."""
        if self.light is None:
            raise ValueError("pictures bring their own light")
        return irradiance(pixels.normal, pixels.view, self.light, pixels.position_mm)[:, None]

    @property
    def _own_texels(self) -> Tensor:
        return self.stage.object_surface.texels(self.reduced)

    @cached_property
    def _behind(self) -> Tensor:
        """The background's light before exposure, N·H·W × 3."""
        tables = np.broadcast_to(LIGHT_OF_CODE[:, None], (len(self.background), 256, 3))
        return _looked_up(self.background, tables, self.stage.device)

    @cached_property
    def bare_exposed(self) -> Tensor:
        """The bare object as a camera without blur and noise shows it, N·H·W × 3 sRGB."""
        camera = self.stage.camera
        if self.object is not None and self.object.samples > 1:
            return encoded((self.bare.view(len(self.conditions), -1, 3) * self.gains[:, None]).view(-1, 3), camera)
        # the background has 256 codes per view and channel, which are exposed as a table
        light = torch.tensor(LIGHT_OF_CODE)[:, None] * self.gains[:, None].cpu().double()
        image = _looked_up(self.background, encoded(light, camera).numpy(), self.stage.device)
        if self.object is None:
            return image
        color = self._object_color(self._own_texels) * self.gains.index_select(0, self.object.view)
        return image.index_copy(0, self.object.pixel, encoded(color, camera))

    @cached_property
    def gains(self) -> Tensor:
        """The camera's factors, N×3."""
        return gains(self.conditions.sensor, torch.zeros(0, device=self.stage.device))

    @cached_property
    def piece_white(self) -> Tensor:
        """The light on white paper at the piece's pixels, P×3 or P×1."""
        white = self.on_piece.white
        return self._irradiance(self.on_piece) if white is None else white

    @cached_property
    def piece_gloss(self) -> Tensor | None:
        """What glossy paper reflects on top, P×1; None where it is matte."""
        if self.light is None or self.eye_mm is None:
            return None
        pixels = self.on_piece
        shine = highlight(pixels.normal, pixels.position_mm, self.eye_mm, pixels.view, self.light)
        return None if shine is None else shine[:, None]


def see(
    stage: Stage,
    shown: Shown,
    conditions: Conditions,
    size_px: tuple[int, int],
    supersample: int = 1,
    taps: int = OBJECT_TAPS,
) -> Views:
    """The views of `conditions`, with nothing on the object unless a piece is `shown`. Any picture of the same size can
    be shown in them; the object behind it is seen, too, in so many `taps` of its texture unless that is learned.
    """
    piece = shown if isinstance(shown, PiecePicture) else None
    if not stage.scene.HAS_OBJECT:
        return _see_pictures(stage, piece, conditions, size_px)
    scene = needs_mesh(stage.scene)
    frame = lens_frame(stage, scene, size_px)
    poses = scene.camera_from_world(conditions)
    light = _light(scene, stage.device, conditions)
    eye = torch.as_tensor(-(poses[:, :3, :3].transpose(0, 2, 1) @ poses[:, :3, 3:])[..., 0], dtype=torch.float32)

    def drawn(surface: ObjectSurface | PieceSurface, poses: np.ndarray, samples: int) -> Fragments:
        width, height = frame.size_px
        fine = np.diag([samples, samples, 1]) @ frame.matrix_px
        matrices = np.broadcast_to(fine, (len(poses), 3, 3))
        placed = cameras(poses, matrices, (width * samples, height * samples), stage)
        return rasterize(surface.vertices, surface.faces, placed, near_mm(scene))

    fine = drawn(stage.object_surface, poses, supersample)
    parts, taps = None, OBJECT_TAPS if scene.LEARNED else taps
    if piece is not None:
        printed = scene.camera_from_print(conditions)
        surface = drawn(stage.piece_surface, printed, 1)
        covering = surface if supersample == 1 else drawn(stage.piece_surface, printed, supersample)
        hidden = _hidden_share(surface, covering, fine, supersample)
        needs_position = light.lamp is not None or light.gloss is not None
        parts = piece_pixels(stage.piece_surface, piece, surface, hidden, needs_position)
    pixel, local = _coarse_pixel(fine, supersample), light.lamp is not None
    return Views(
        stage,
        conditions,
        size_px,
        frame.size_px,
        light,
        eye.to(stage.device),
        backgrounds(scene, conditions, size_px, frame),
        object_pixels(stage.object_surface, fine, pixel, supersample, local, taps),
        parts,
    )


def relit(views: Views, conditions: Conditions) -> Views:
    """The same views under other light, with another print and camera; poses and backgrounds stay."""
    conditions, light = with_poses_of(conditions, views.conditions), views.light
    if light is not None:
        light = _light(needs_mesh(views.stage.scene), views.stage.device, conditions)
    return replace(views, conditions=conditions, light=light)


def cameras(poses: np.ndarray, matrices: np.ndarray, size_px: tuple[int, int], stage: Stage) -> Cameras:
    """Cameras N×4×4 with matrices N×3×3 on a stage's device."""
    poses_on, matrices_on = (torch.as_tensor(part.copy(), device=stage.device) for part in (poses, matrices))
    return Cameras(poses_on, matrices_on, size_px)


def near_mm(scene: MeshScene) -> float:
    """What is nearer to a camera is cut."""
    return NEAR_SHARE * scene.length_mm


def _light(scene: MeshScene, device: torch.device, conditions: Conditions) -> Lighting:
    return lighting_of(conditions.light, scene.frame.normal, scene.frame.up, scene.middle_mm, device)


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
    nearest = torch.full((math.prod(covering.shape),), torch.inf, device=piece.depth.device)
    nearest[front.pixel] = front.depth
    hidden = (nearest.index_select(0, covering.pixel) < covering.depth).float()
    if samples == 1:
        return hidden
    pixel = _coarse_pixel(covering, samples)
    sums = torch.zeros(2, math.prod(piece.shape), device=hidden.device)
    sums[0].index_add_(0, pixel, hidden)
    sums[1].index_add_(0, pixel, torch.ones_like(hidden))
    return (sums[0] / sums[1].clamp_min(1)).index_select(0, piece.pixel)


def _see_pictures(stage: Stage, piece: PiecePicture | None, conditions: Conditions, size_px: tuple[int, int]) -> Views:
    """Views of a scene made of pictures: the piece's homography takes the place of camera and mesh."""
    scene, parts = needs_pictures(stage.scene), None
    if piece is not None:
        homographies, surface = scene.piece_homographies(conditions, size_px), stage.piece_surface
        flat = cameras(np.broadcast_to(np.eye(4), (len(homographies), 4, 4)), homographies, size_px, stage)
        fragments = rasterize(surface.vertices, surface.faces, flat, 1e-9)
        coefficients = torch.as_tensor(scene.piece_light(conditions), dtype=torch.float32, device=stage.device)
        parts = piece_pixels(surface, piece, fragments, None, white_coefficients=coefficients)
    return Views(stage, conditions, size_px, size_px, None, None, scene.pictures(conditions, size_px), None, parts)


def lens_frame(stage: Stage, scene: MeshScene, size_px: tuple[int, int]) -> Frame:
    """The frame to render for pictures of `size_px`, with what a calibrated lens will bring into them."""
    if stage.camera is None:
        return Frame(size_px, scene.matrix_px(size_px), 0, 0, 0, 0)
    return pinhole_frame(stage.camera, size_px)


def backgrounds(scene: MeshScene, conditions: Conditions, size_px: tuple[int, int], frame: Frame) -> np.ndarray:
    """What lies behind N views, uint8 N×H×W×3 before exposure; its edge goes on in a lens's margin."""
    photo_px = scene.settings.camera.photo_px
    pictures = [scene.backgrounds.picture(choice, photo_px, size_px) for choice in conditions.pose.background]
    margin = ((0, 0), (frame.top, frame.bottom), (frame.left, frame.right), (0, 0))
    return np.pad(np.stack(pictures), margin, mode="edge")


def _looked_up(codes: np.ndarray, tables: np.ndarray, device: torch.device) -> Tensor:
    """uint8 pictures N×H×W×3 through tables N×256×3, pixels by rows."""
    import cv2

    pairs = zip(codes, tables.astype(np.float32), strict=True)
    pictures = [cv2.LUT(np.ascontiguousarray(code), table[None]) for code, table in pairs]
    return torch.as_tensor(np.stack(pictures), device=device).view(-1, 3)
