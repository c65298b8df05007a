"""Render everything about a batch of views that does not depend on the design.

In: a stage, conditions and a picture's size. Out: `Views`: for each pixel the light behind the piece, and for each
pixel of the piece its share of the pixel, the texels it looks at and the light that falls there. Rasterizing happens
here and nowhere else: rendered views can be lit, printed and photographed again (`relight`) at a fraction of the cost,
and shaded with any number of designs.

Each pixel takes one sample; outlines are smoothed along edges (see `find_outlines`), those of the piece in its own
millimeters (see `pixels`). Left out on purpose: transparency.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate, pairwise

import numpy as np
import torch
from torch import Tensor

from patchproof.base.color import LINEAR_FROM_CODE, lift_tone
from patchproof.base.geometry import Frame, camera_centers
from patchproof.channel.camera import encode_light, encode_light_by_table, gains, irradiance, lighting_of
from patchproof.render import pixels
from patchproof.render.fragments import Cameras
from patchproof.render.outlines import Outlines, find_outlines
from patchproof.render.pixels import Appearance, ObjectPixels, PiecePicture, PiecePixels, TextureSampling
from patchproof.render.raster import rasterize
from patchproof.render.stage import Stage
from patchproof.render.texture import look_up
from patchproof.scene.conditions import Conditions
from patchproof.scene.interface import require_piece
from patchproof.scene.mesh_scene import MeshScene, require_mesh

NEAR_SHARE = 1e-3  # the near plane's distance as a share of the object's length


@dataclass(frozen=True)
class Views:
    """A batch of views of `size_px`, rendered at `frame_px` (larger if a lens will bend the picture)."""

    stage: Stage
    conditions: Conditions
    size_px: tuple[int, int]
    frame_px: tuple[int, int]
    light: Tensor | None  # 4×N (`lighting_of`); None for pictures, which bring their own
    background: np.ndarray  # uint8 N×H×W×3 sRGB
    object: ObjectPixels | None
    piece: PiecePixels | None
    outlines: Outlines | None

    @property
    def reduced(self) -> bool:
        """True if these views stand for larger photographs that were reduced.

        Reducing a photograph averages its code values, which darkens fine patterns of strong colors. Textures of
        smaller pictures are averaged likewise: at twice a network's size, 40 photographs had 0.04 less confidence than
        promised, and 0.09 less when light was averaged.
        """
        return _reduced(self.stage, self.size_px)

    @property
    def on_object(self) -> ObjectPixels:
        """The object's pixels; a ValueError if the scene is made of pictures."""
        if self.object is None:
            raise ValueError("pictures have no object to look up")
        return self.object

    @property
    def on_piece(self) -> PiecePixels:
        """The piece's pixels; a ValueError if the views were rendered without a piece."""
        if self.piece is None:
            raise ValueError("these views were rendered without a piece")
        return self.piece

    @cached_property
    def bare(self) -> Tensor:
        """The light of the object without the piece, its outlines jagged, N·H·W × 3."""
        return self._behind if self.object is None else self.object_light()

    def object_light(self, texels: Tensor | None = None) -> Tensor:
        """The bare object's light, differentiable; other `texels` need views that were rendered for textures."""
        return self._behind.index_copy(0, self.on_object.pixel, self._object_color(texels).T)

    def _object_color(self, texels: Tensor | None = None) -> Tensor:
        """Return the light 3×P of the object's fragments."""
        visible, reflected = self.on_object, self.on_object.color
        if visible.texels is not None:
            table = self.stage.object_surface.texels(self.reduced, fixed=False) if texels is None else texels
            reflected = look_up(visible.texels, table).T * reflected
        return reflected * irradiance(visible.normal, visible.spread(self._light))

    @property
    def _light(self) -> Tensor:
        if self.light is None:
            raise ValueError("pictures bring their own light")
        return self.light

    @cached_property
    def _behind(self) -> Tensor:
        """The background's light before exposure, N·H·W × 3."""
        tables = np.broadcast_to(LINEAR_FROM_CODE[:, None], (len(self.background), 256, 3))
        return _look_up_codes(self.background, tables, self.stage.device)

    @cached_property
    def bare_exposed(self) -> Tensor:
        """The bare object, its outlines jagged, in a camera without blur and noise, N·H·W × 3 sRGB."""
        # the background has 256 codes per view and channel, which are exposed as a table
        gain, tone = self._sensor_values[:, None].split(3, 2)
        codes = lift_tone(encode_light_by_table(torch.tensor(LINEAR_FROM_CODE)[:, None] * gain), tone)
        image = _look_up_codes(self.background, codes.numpy(), self.stage.device)
        if self.object is None:
            return image
        gain, tone = self.object.spread(self._sensor_on_device.T).split(3)
        color = encode_light_by_table(self._object_color() * gain)
        return image.index_copy_(0, self.object.pixel, lift_tone(color, tone).T)

    def encode(self, light: Tensor, view: Tensor) -> Tensor:
        """Return the code values P×3 of light at pixels of the views P, in a camera without blur and noise."""
        gain, tone = self._sensor_on_device.index_select(0, view).split(3, 1)
        return lift_tone(encode_light(light * gain), tone)

    @cached_property
    def _sensor_values(self) -> Tensor:
        """Each view's gains and tones, N×6, here: a device is not waited for."""
        tone = torch.as_tensor(self.conditions.sensor.tone, dtype=torch.float32)
        return torch.cat([gains(self.conditions.sensor, tone), tone], 1)

    @cached_property
    def _sensor_on_device(self) -> Tensor:
        return self._sensor_values.to(self.stage.device)

    @cached_property
    def piece_white(self) -> Tensor:
        """The light on white paper at the piece's pixels, P×3 or P×1."""
        piece, white = self.on_piece, self.on_piece.white
        return irradiance(piece.normal, self._light.index_select(1, piece.view))[:, None] if white is None else white


def render_views(
    stage: Stage,
    appearance: Appearance,
    conditions: Conditions,
    size_px: tuple[int, int],
    look: TextureSampling = pixels.PHOTO_SAMPLING,
) -> Views:
    """Render the views of `conditions`: the object and, if `appearance` is a piece, that piece, in which any picture of
    the same size can be shown later.
    """
    piece = appearance if isinstance(appearance, PiecePicture) else None
    if not stage.scene.HAS_OBJECT:
        return _render_flat(stage, piece, conditions, size_px)
    scene, surface = require_mesh(stage.scene), stage.object_surface
    frame = lens_frame(stage, scene, size_px)
    poses = scene.camera_from_world(conditions)
    light = lighting_of(conditions.light, scene.frame.normal, scene.frame.up, stage.device)
    eye = torch.as_tensor(camera_centers(poses), device=stage.device)
    matrices, near = np.broadcast_to(frame.matrix_px, (len(poses), 3, 3)), NEAR_SHARE * scene.length_mm
    view_cameras = cameras(poses, matrices, frame.size_px, stage)
    fragments = rasterize(surface.vertices, surface.faces, view_cameras, near)
    nearest = torch.full((math.prod(fragments.shape),), torch.inf, device=stage.device)
    nearest.scatter_(0, fragments.pixel, fragments.depth)
    look, piece_parts = replace(look, taps=pixels.PHOTO_SAMPLING.taps) if scene.LEARNS_TEXTURE else look, None
    if piece is not None:
        print_cameras = cameras(poses @ scene.printed_from_sheet(conditions), matrices, frame.size_px, stage)
        piece_fragments = rasterize(stage.piece_surface.vertices, stage.piece_surface.faces, print_cameras, near)
        hidden = nearest.index_select(0, piece_fragments.pixel) < piece_fragments.depth
        piece_parts = pixels.piece_pixels(stage.piece_surface, piece, piece_fragments, hidden, look)
    has_fixed_textures = not scene.LEARNS_TEXTURE and not isinstance(appearance, pixels.ObjectTextures)
    fixed = surface.texels(_reduced(stage, size_px), fixed=True) if has_fixed_textures else None
    behind = backgrounds(scene, conditions, size_px, frame)
    on_object = pixels.object_pixels(surface, fragments, look, fixed)
    covered = _covers(piece_parts, nearest)
    outlines = find_outlines(surface.edges, surface.vertices, view_cameras, eye, nearest, covered, near)
    return Views(stage, conditions, size_px, frame.size_px, light, behind, on_object, piece_parts, outlines)


def _reduced(stage: Stage, size_px: tuple[int, int]) -> bool:
    return min(size_px) < min(stage.scene.settings.camera.photo_px)


def _covers(piece: PiecePixels | None, nearest: Tensor) -> Tensor:
    """Return which of N·H·W pixels the piece covers wholly."""
    covered = torch.zeros_like(nearest, dtype=torch.bool)
    if piece is not None:
        for pixel, share in ((piece.pixel, piece.share), (piece.back_pixel, piece.back_share)):
            covered[pixel] = share[:, 0] > 1 - pixels.MIN_SHARE
    return covered


def relight(views: Views, conditions: Conditions) -> Views:
    """Return the views under other light, with another print and camera; poses and backgrounds stay."""
    conditions, light = replace(conditions, pose=views.conditions.pose), views.light
    if light is not None:
        frame = require_mesh(views.stage.scene).frame
        light = lighting_of(conditions.light, frame.normal, frame.up, views.stage.device)
    return replace(views, conditions=conditions, light=light)


def relight_and_replace_background(views: Views, conditions: Conditions) -> Views:
    """Return the views under the conditions' light, print, camera and backgrounds; poses stay."""
    views = relight(views, conditions)
    if np.array_equal(views.conditions.pose.background, conditions.pose.background):
        return views
    pose = replace(views.conditions.pose, background=conditions.pose.background)
    conditions, scene = replace(conditions, pose=pose), require_mesh(views.stage.scene)
    frame = lens_frame(views.stage, scene, views.size_px)
    return replace(views, conditions=conditions, background=backgrounds(scene, conditions, views.size_px, frame))


def split_views(views: Views, sizes: Sequence[int]) -> list[Views]:
    """Split views into batches of these sizes, each equal to the bit to a batch that was rendered alone."""
    per_view, parts = views.frame_px[0] * views.frame_px[1], []
    for first, last in pairwise(accumulate(sizes, initial=0)):
        rows, numbers = slice(first, last), range(first, last)
        pixel_fields = {"object": views.object, "piece": views.piece, "outlines": views.outlines}
        selected = {name: None if part is None else part.part(numbers, per_view) for name, part in pixel_fields.items()}
        batch = replace(views, conditions=views.conditions[rows], background=views.background[rows], **selected)
        parts.append(relight(batch, batch.conditions))
    return parts


def cameras(poses: np.ndarray, matrices: np.ndarray, size_px: tuple[int, int], stage: Stage) -> Cameras:
    """Return cameras N×4×4 with matrices N×3×3 on a stage's device."""
    poses_on, matrices_on = (torch.as_tensor(part.copy(), device=stage.device) for part in (poses, matrices))
    return Cameras(poses_on, matrices_on, size_px)


def _render_flat(stage: Stage, piece: PiecePicture | None, conditions: Conditions, size_px: tuple[int, int]) -> Views:
    """Render views of a scene made of pictures: the piece's homography takes the place of camera and mesh."""
    parts, pictures = None, stage.scene.pictures(conditions, size_px)
    if piece is not None:
        scene, surface = require_piece(stage.scene), stage.piece_surface
        homographies = scene.piece_homographies(conditions, size_px)
        flat_cameras = cameras(np.broadcast_to(np.eye(4), (len(homographies), 4, 4)), homographies, size_px, stage)
        fragments = rasterize(surface.vertices, surface.faces, flat_cameras, 1e-9)
        coefficients = torch.as_tensor(scene.piece_light(conditions), dtype=torch.float32, device=stage.device)
        parts = pixels.piece_pixels(surface, piece, fragments, None, white_coefficients=coefficients)
    return Views(stage, conditions, size_px, size_px, None, pictures, None, parts, None)


def lens_frame(stage: Stage, scene: MeshScene, size_px: tuple[int, int]) -> Frame:
    """Return the frame to render for pictures of `size_px`, with the margin that a calibrated lens needs."""
    if stage.scene.camera is None:
        return Frame(size_px, scene.matrix_px(size_px))
    return stage.scene.camera.pinhole_frame(size_px)


def backgrounds(scene: MeshScene, conditions: Conditions, size_px: tuple[int, int], frame: Frame) -> np.ndarray:
    """Return the backgrounds of N views, uint8 N×H×W×3 before exposure; their edges continue into a lens's margin."""
    pictures = scene.pictures(conditions, size_px)
    margin = ((0, 0), (frame.top, frame.bottom), (frame.left, frame.right), (0, 0))
    return np.pad(pictures, margin, mode="edge") if frame.size_px != size_px else pictures


def _look_up_codes(codes: np.ndarray, tables: np.ndarray, device: torch.device) -> Tensor:
    """Look up uint8 pictures N×H×W×3 in tables N×256×3; return pixels by rows."""
    import cv2

    pictures = np.empty(codes.shape, np.float32)
    for code, table, picture in zip(codes, tables.astype(np.float32), pictures, strict=True):
        cv2.LUT(np.ascontiguousarray(code), table[None], picture)
    return torch.as_tensor(pictures, device=device).view(-1, 3)
