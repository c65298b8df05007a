"""Photograph a scene: `photograph` returns the camera's picture of each drawn condition, with the design in it.

In: a stage, an appearance (the piece's picture, the object's textures, or None for the bare object) and conditions.
Out: N×3×H×W sRGB. The work has three parts that can be run alone: `render_views` (see `views`), `shade` (light and
composite; the only part through which gradients reach the design) and the camera (`expose`). Also: `plan_picture`, the
bare object in even light, seen straight from one side.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from patchproof.base.color import linear_from_srgb, photo_codes_from_srgb, srgb_from_linear
from patchproof.base.errors import Refused
from patchproof.base.settings import BackgroundSettings
from patchproof.base.text import brief
from patchproof.channel import camera as camera_model
from patchproof.channel.camera import add_noise, develop, gaussian_blur, is_pointwise, reach_px
from patchproof.channel.effects import Light, Pose
from patchproof.channel.printer import mottle_cells, mottled, print_change, vary_print
from patchproof.render.pixels import Appearance, ObjectTextures, PiecePicture
from patchproof.render.stage import Stage
from patchproof.render.surfaces import light_texels
from patchproof.render.texture import look_up
from patchproof.render.views import Views, relight, render_views
from patchproof.scene.backgrounds import load_backgrounds
from patchproof.scene.conditions import Conditions
from patchproof.scene.mesh_scene import MeshScene, require_mesh
from patchproof.scene.placement import SurfaceFrame

DISTANCE_LENGTHS = 60.0  # of a plan's camera, over the object's length
PAPER_BACK_LINEAR = 0.8  # reflectance of plain white card, for a piece seen from behind
_ROUNDING = 0.01  # of a design's values beyond 0 and 1
_OUTLINE_REACH_PX = 1  # outlines mix neighboring pixels
MeshSceneType = TypeVar("MeshSceneType", bound=MeshScene)
_PICTURE_GRAIN_SEED = 1 << 40  # added to the seed: the base photograph's grain is not that of the simulated camera


def photograph(
    stage: Stage,
    shown: Appearance | Tensor | np.ndarray,
    conditions: Conditions,
    size_px: tuple[int, int],
    jpeg: bool = True,
) -> Tensor:
    """Return N×3×H×W sRGB pictures of `size_px`; `shown=None` is the bare object.

    `shown` may also be a design: uint8 pixels h×w×3, or a float tensor in [0, 1] (3×h×w of any grid for a piece, 3×1×M
    for textures), in which the pictures are differentiable. A square size gives the photograph's centered square.
    `jpeg` is that of `develop`.
    """
    if min(size_px) < 1:
        raise Refused("size_px of 1 pixel at least", f"{size_px}", "give (width, height)")
    if isinstance(shown, np.ndarray | Tensor):
        is_pixels = isinstance(shown, np.ndarray)
        right = shown.ndim == 3 and shown.shape[-1 if is_pixels else 0] == 3 and min(shown.shape) > 0
        right &= shown.dtype == np.uint8 if is_pixels else shown.is_floating_point()
        if not right or not (is_pixels or (shown.min() >= -_ROUNDING and shown.max() <= 1 + _ROUNDING)):  # also NaN
            expected = "a design as uint8 pixels h×w×3, or as a float tensor 3×h×w in [0, 1]"
            raise Refused(expected, brief(shown), "convert it")
        pixels = torch.tensor(shown, device=stage.device).permute(2, 0, 1) / 255 if is_pixels else shown.float()
        shown = stage.design_renderer.appearance(pixels)
    return expose(render_views(stage, shown, conditions, size_px), shown, jpeg)


def shade(views: Views, appearance: Appearance) -> Tensor:
    """Return N×3×H×W linear light before lens and sensor; differentiable in the design."""
    if isinstance(appearance, ObjectTextures):
        return _smooth(views, views.object_light(light_texels(appearance.srgb, views.reduced)), views.reduced)
    image = views.bare
    if appearance is None:
        return _smooth(views, image, views.reduced)
    piece, blur_and_noise = views.on_piece, _picture_blur_and_noise(views)
    image = _blend(image, piece.back_pixel, piece.back_share, image.new_full((1, 3), PAPER_BACK_LINEAR), views.reduced)
    light = _piece_light(views, appearance)
    if blur_and_noise is not None:
        return _paste_piece(views, image, light, *blur_and_noise)
    return _smooth(views, _blend(image, piece.pixel, piece.share, light, views.reduced), views.reduced)


def expose(views: Views, appearance: Appearance, jpeg: bool = True) -> Tensor:
    """Return the photographs of rendered views."""
    camera, sensor, scale = views.stage.scene.camera, views.conditions.sensor, _scale(views)
    has_distortion = camera is not None and camera.has_distortion
    has_blur_or_noise = appearance is not None and _picture_blur_and_noise(views) is not None
    is_local = views.reduced and is_pointwise(sensor, scale, jpeg)
    if has_distortion or has_blur_or_noise or isinstance(appearance, ObjectTextures) or not is_local:
        light = shade(views, appearance)
        if camera is not None:
            light = camera.distort_pictures(light, views.size_px)
        return develop(light, sensor, scale, jpeg)
    image = views.bare_exposed
    if appearance is not None:
        # if each pixel is developed alone, only the piece's pixels differ from the bare object's photograph
        piece, pixels = views.on_piece, views.frame_px[0] * views.frame_px[1]
        if len(piece.back_pixel):
            back = views.encode(image.new_full((1, 1), PAPER_BACK_LINEAR), piece.back_pixel // pixels)
            image = _blend(image, piece.back_pixel, piece.back_share, back, False)
        light = _piece_light(views, appearance)
        image = _blend(image, piece.pixel, piece.share, views.encode(light, piece.view), False)
    return _smooth(views, image, by_code=False)


def affected_windows(views: Views) -> np.ndarray | None:
    """Return N×4 pixels (left, top, right, bottom) outside of which `expose` gives the same for every design. None if
    that is unknown: for textures, through a lens with distortion, and if photographs have blur of their own.
    """
    camera, scale = views.stage.scene.camera, _scale(views)
    reach = reach_px(views.conditions.sensor, scale)
    has_distortion = views.frame_px != views.size_px or (camera is not None and camera.has_distortion)
    if views.piece is None or has_distortion or reach is None or _picture_blur_and_noise(views) is not None:
        return None
    width, height = views.size_px
    return (views.piece.box_px + (reach + _OUTLINE_REACH_PX) * np.array([-1, -1, 1, 1])).clip(0, [width, height] * 2)


def _blend(image: Tensor, pixel: Tensor, share: Tensor, value: Tensor, by_code: bool) -> Tensor:
    """Return `image` with the share of each pixel replaced by `value`; light `by_code` is averaged as code values."""
    if not len(pixel) and not value.requires_grad:  # a design that no view shows has a gradient of zero
        return image
    old, value = image.index_select(0, pixel), value.expand(len(pixel), 3)
    if by_code:
        mixed = linear_from_srgb(torch.lerp(srgb_from_linear(old), srgb_from_linear(value), share))
    else:
        mixed = torch.lerp(old, value, share)
    return image.index_copy(0, pixel, mixed)


def _piece_light(views: Views, picture: PiecePicture) -> Tensor:
    """Return the light P×3 that the piece's pixels send to the camera."""
    variation, piece = views.conditions.print, views.on_piece
    has_mottle = variation.mottle.any()
    seen = look_up(piece.texels, picture.codes if views.reduced else picture.light)
    if has_mottle:
        seen = mottled(seen if views.reduced else srgb_from_linear(seen), _mottle(views))
    reflectance = linear_from_srgb(seen) if views.reduced or has_mottle else seen
    change = torch.as_tensor(print_change(variation)).to(reflectance)
    return vary_print(reflectance, change.index_select(0, piece.view)) * views.piece_white


def _mottle(views: Views) -> Tensor:
    """Return what each print's mottle adds to the piece's pixels, P×3 in sRGB."""
    variation = views.conditions.print
    prints = zip(variation.mottle, variation.mottle_seed, strict=True)
    cells = np.concatenate([rms * mottle_cells(int(seed)) for rms, seed in prints])
    return look_up(views.on_piece.mottle_cells, torch.as_tensor(cells, dtype=torch.float32, device=views.stage.device))


def _paste_piece(views: Views, image: Tensor, light: Tensor, blur_px: np.ndarray, noise: np.ndarray) -> Tensor:
    """Put the piece into photographs with blur and noise of their own, which the photographs around it have already."""
    piece = views.on_piece
    values = torch.cat([light, light.new_ones(len(light), 1)], 1) * piece.share
    layer = _as_pictures(views, image.new_zeros(len(image), 4).index_copy(0, piece.pixel, values))
    layer = gaussian_blur(layer, torch.as_tensor(blur_px).to(image))
    share = layer[:, 3:]
    pictures = _as_pictures(views, image) * (1 - share) + layer[:, :3]
    seeds = views.conditions.sensor.noise_seed + _PICTURE_GRAIN_SEED
    return torch.lerp(pictures, add_noise(pictures, torch.as_tensor(noise).to(image), seeds), share)


def _picture_blur_and_noise(views: Views) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the blur and noise of the scene's own photographs, N each at this size; None if neither shows."""
    blur_px, noise = (values * _scale(views) for values in views.stage.scene.picture_blur_and_noise(views.conditions))
    is_visible = blur_px.max() >= camera_model.SMALLEST_BLUR_PX or noise.max() >= camera_model.SMALLEST_NOISE
    return (blur_px, noise) if is_visible else None


def _scale(views: Views) -> float:
    """Return the pictures' size divided by the photograph's."""
    return min(views.size_px) / min(views.stage.scene.settings.camera.photo_px)


def _smooth(views: Views, image: Tensor, by_code: bool) -> Tensor:
    """Turn pixels by rows into pictures with smooth outlines, mixed as they are or, light `by_code`, as code values."""
    return _as_pictures(views, image if views.outlines is None else views.outlines.smooth(image, by_code))


def _as_pictures(views: Views, image: Tensor) -> Tensor:
    width, height = views.frame_px
    return image.view(len(views.conditions), height, width, -1).permute(0, 3, 1, 2)


def plan_picture(
    stage: Stage, frame: SurfaceFrame, half_mm: np.ndarray, side_px: int = 600, colors: np.ndarray | None = None
) -> np.ndarray:
    """Render a stage's object in even light on white, along a frame's normal, spanning ± half_mm: uint8 H×W×3,
    `side_px` along the longer side. At its distance of 60 lengths, perspective moves nothing by more than 1 % of the
    object's depth. `colors` (uint8 h×w×3) are laid over the scene's piece, without light.
    """
    scene = require_mesh(stage.scene)
    distance = DISTANCE_LENGTHS * scene.length_mm
    px_per_mm = side_px / (2 * half_mm.max())
    width, height = (int(v) for v in np.maximum(np.rint(2 * half_mm * px_per_mm), 16))
    fov = float(np.degrees(2 * np.arctan(half_mm.min() / distance)))
    plain = replace(stage, scene=replace(on_white(scene, (width, height), fov_deg=fov, look_at="object"), frame=frame))
    piece = None if colors is None else PiecePicture.of(torch.tensor(colors, dtype=torch.float32) / 255)
    with torch.no_grad():
        views = render_views(plain, piece, _frontal_conditions(distance, 0.55, 0.45), (width, height))
        light = _pixel_rows(shade(views, None))
        if piece is not None:
            covered = views.on_piece.pixel[views.on_piece.share[:, 0] > 0]
            if len(covered):
                ambient = _frontal_conditions(distance, 1.0, 0.0)
                light[covered] = _pixel_rows(shade(relight(views, ambient), piece))[covered]
    return photo_codes_from_srgb(srgb_from_linear(light.clamp(0, 1)).reshape(height, width, 3).cpu().numpy())


def on_white(scene: MeshSceneType, size_px: tuple[int, int], **view: Any) -> MeshSceneType:
    """The scene before white, in pictures of (width, height) pixels by a camera without distortion."""
    changes, settings = {"view": view, "camera": {"photo_px": size_px, "file": None}}, scene.settings
    tables = {name: getattr(settings, name).model_copy(update=each) for name, each in changes.items()}
    white = load_backgrounds(BackgroundSettings(color=(1.0, 1.0, 1.0)), Path())
    return replace(scene, settings=settings.model_copy(update=tables), backgrounds=white, camera=None)


def _pixel_rows(pictures: Tensor) -> Tensor:
    """Reshape 1×3×H×W to H·W × 3."""
    return pictures[0].permute(1, 2, 0).reshape(-1, 3)


def _frontal_conditions(distance_mm: float, ambient: float, directional: float) -> Conditions:
    """Conditions of one frontal view in ambient light and directional light from the upper left."""
    direction = {"light_azimuth_deg": np.array([-30.0]), "light_elevation_deg": np.array([45.0])}
    light = Light(ambient=np.array([ambient]), directional=np.array([directional]), **direction)
    return Conditions(pose=Pose(distance_mm=np.array([distance_mm])), light=light)
