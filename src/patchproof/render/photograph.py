"""`photograph`: what the camera of each drawn condition makes of the scene with the piece in it.

In: a stage, what is shown (the piece's picture, the object's textures, or nothing new) and conditions. Out: N×3×H×W
sRGB. The work has three parts that can be kept apart: `render_views` (see `views`), `shade` (light and composite; the only part
through which gradients reach what is shown) and the camera (`expose`).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from patchproof.base.color import linear_from_srgb, srgb_from_linear
from patchproof.channel.camera import (
    SMALLEST_BLUR_PX,
    SMALLEST_NOISE,
    add_noise,
    develop,
    encode_light,
    gaussian_blur,
    is_pointwise,
    reach_px,
)
from patchproof.channel.printer import vary_print
from patchproof.render.pixels import Appearance, ObjectTextures, PiecePicture
from patchproof.render.stage import Stage
from patchproof.render.surfaces import light_texels
from patchproof.render.texture import look_up
from patchproof.render.views import Views, render_views
from patchproof.scene.conditions import Conditions

PAPER_BACK_LINEAR = 0.8  # plain white card seen from behind


def photograph(
    stage: Stage,
    shown: Appearance | Tensor | np.ndarray,
    conditions: Conditions,
    size_px: tuple[int, int],
    jpeg: bool = True,
) -> Tensor:
    """N×3×H×W sRGB pictures of `size_px`; `shown=None` is the bare object.

    A design may be shown as it is: a float tensor in [0, 1] (3×h×w of any grid for a piece, 3×1×M for textures), in
    which the pictures are differentiable, or its uint8 pixels h×w×3. A square size shows the photograph's centered
    square. `jpeg` as in `channel.camera.develop`.
    """
    if isinstance(shown, np.ndarray):
        shown = torch.tensor(shown, dtype=torch.float32, device=stage.device).permute(2, 0, 1) / 255
    if isinstance(shown, Tensor):
        shown = stage.look.shown(shown)
    return expose(render_views(stage, shown, conditions, size_px), shown, jpeg)


def shade(views: Views, shown: Appearance) -> Tensor:
    """N×3×H×W linear light before lens and sensor; differentiable in what is shown."""
    if isinstance(shown, ObjectTextures):
        return _smooth(views, views.object_light(light_texels(shown.srgb, views.reduced)), views.reduced)
    image = views.bare
    if shown is None:
        return _smooth(views, image, views.reduced)
    piece, own = views.on_piece, _own_blur_and_noise(views)
    image = _blend(image, piece.back_pixel, piece.back_share, image.new_full((1, 3), PAPER_BACK_LINEAR), views.reduced)
    light = _piece_light(views, shown)
    if own is not None:
        return _pasted(views, image, light, *own)
    return _smooth(views, _blend(image, piece.pixel, piece.share, light, views.reduced), views.reduced)


def expose(views: Views, shown: Appearance, jpeg: bool = True) -> Tensor:
    """The photographs of what was seen."""
    camera, sensor, scale = views.stage.camera, views.conditions.sensor, _scale(views)
    bends = camera is not None and camera.bends
    own = shown is not None and _own_blur_and_noise(views) is not None
    alone = views.reduced and is_pointwise(sensor, scale, jpeg)
    if bends or own or isinstance(shown, ObjectTextures) or not alone:
        light = shade(views, shown)
        if camera is not None:
            light = camera.distorted(light, views.size_px)
        return develop(light, sensor, scale, jpeg, camera)
    image = views.bare_exposed
    if shown is not None:
        # where each pixel is developed alone, only the piece's own pixels differ from the bare object's photograph
        piece, pixels = views.on_piece, views.frame_px[0] * views.frame_px[1]
        back = encode_light(PAPER_BACK_LINEAR * views.exposure(piece.back_pixel // pixels), camera)
        image = _blend(image, piece.back_pixel, piece.back_share, back, False)
        light = _piece_light(views, shown) * views.exposure(piece.view)
        image = _blend(image, piece.pixel, piece.share, encode_light(light, camera), False)
    return _smooth(views, image, by_code=False)


def affected_windows(views: Views) -> np.ndarray | None:
    """N×4 pixels (left, top, right, bottom) outside of which `expose` makes the same of any design in these views; None
    where that is not known: of textures, through a lens that bends, and where photographs have blur of their own.
    """
    camera, scale = views.stage.camera, _scale(views)
    reach = reach_px(views.conditions.sensor, scale)
    bends = views.frame_px != views.size_px or (camera is not None and camera.bends)
    if views.piece is None or bends or reach is None or _own_blur_and_noise(views) is not None:
        return None
    width, height = views.size_px
    return (views.piece.box_px + (reach + _SMOOTHED_PX) * np.array([-1, -1, 1, 1])).clip(0, [width, height] * 2)


_SMOOTHED_PX = 1  # outlines mix neighbors


def _blend(image: Tensor, pixel: Tensor, share: Tensor, value: Tensor, by_code: bool) -> Tensor:
    """`image` with the share of each pixel replaced by `value`; of light `by_code`, averaged as code values."""
    if not len(pixel) and not value.requires_grad:  # a design that no view shows has a gradient, too: zero
        return image
    before, value = image.index_select(0, pixel), value.expand(len(pixel), 3)
    if by_code:
        mixed = linear_from_srgb(torch.lerp(srgb_from_linear(before), srgb_from_linear(value), share))
    else:
        mixed = torch.lerp(before, value, share)
    return image.index_copy(0, pixel, mixed)


def _piece_light(views: Views, picture: PiecePicture) -> Tensor:
    """The light P×3 that the piece's pixels send to the camera."""
    drawn, piece = views.conditions.print, views.on_piece
    reflectance = look_up(piece.texels, picture.codes if views.reduced else picture.light)
    if views.reduced:
        reflectance = linear_from_srgb(reflectance)
    change = torch.as_tensor(np.stack([drawn.dot_gain, drawn.density, drawn.black], 1)).to(reflectance)
    return vary_print(reflectance, change.index_select(0, piece.view)) * views.piece_white


def _pasted(views: Views, image: Tensor, light: Tensor, blur_px: np.ndarray, noise: np.ndarray) -> Tensor:
    """The piece put into photographs with their own blur and noise, which the photographs around it have already."""
    piece = views.on_piece
    values = torch.cat([light, light.new_ones(len(light), 1)], 1) * piece.share
    layer = _as_pictures(views, torch.zeros(len(image), 4).to(image).index_copy(0, piece.pixel, values))
    layer = gaussian_blur(layer, torch.as_tensor(blur_px).to(image))
    share = layer[:, 3:]
    whole = _as_pictures(views, image) * (1 - share) + layer[:, :3]
    seeds = views.conditions.sensor.noise_seed + _OTHER_GRAIN
    return torch.lerp(whole, add_noise(whole, torch.as_tensor(noise).to(image), seeds), share)


_OTHER_GRAIN = 1 << 40  # the photograph's own grain is not that of the camera that photographs it again


def _own_blur_and_noise(views: Views) -> tuple[np.ndarray, np.ndarray] | None:
    """What the scene's photographs have of their own, N at this size; None where neither shows."""
    blur_px, noise = (own * _scale(views) for own in views.stage.scene.picture_blur_and_noise(views.conditions))
    return (blur_px, noise) if blur_px.max() >= SMALLEST_BLUR_PX or noise.max() >= SMALLEST_NOISE else None


def _scale(views: Views) -> float:
    """The pictures' size over the photograph's."""
    return min(views.size_px) / min(views.stage.scene.settings.camera.photo_px)


def _smooth(views: Views, image: Tensor, by_code: bool) -> Tensor:
    """Pixels by rows as pictures with smooth outlines, mixed as they are or, light `by_code`, as code values."""
    return _as_pictures(views, image if views.outlines is None else views.outlines.smooth(image, by_code))


def _as_pictures(views: Views, image: Tensor) -> Tensor:
    width, height = views.frame_px
    return image.view(len(views.conditions), height, width, -1).permute(0, 3, 1, 2)
