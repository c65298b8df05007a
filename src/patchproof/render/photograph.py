"""`photograph`: what the camera of each drawn condition makes of the scene with the piece in it.

In: a stage, what is shown (the piece's picture, the object's textures, or nothing new) and conditions. Out: N×3×H×W
sRGB. The work has three parts that can be kept apart: `see` (see `views`), `shade` (light and composite; the only part
through which gradients reach what is shown) and the camera (`expose`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from patchproof.channel.camera import (
    SMALLEST_BLUR_PX,
    SMALLEST_NOISE,
    blurred,
    develop,
    diagonal_share_of,
    encoded,
    is_pointwise,
    noisy,
)
from patchproof.channel.lens import distorted
from patchproof.channel.printer import misregistered, vary
from patchproof.color import linear_from_srgb, srgb_from_linear
from patchproof.render.pixels import PiecePicture
from patchproof.render.stage import Stage, light_texels
from patchproof.render.texture import Footprint, look_up, on_copies, texel_table
from patchproof.render.views import Seen, see
from patchproof.scene.conditions import Conditions

PAPER_BACK_LINEAR = 0.8  # plain white card seen from behind


@dataclass(frozen=True)
class ObjectTextures:
    """Textures of the object in place of its own: H×W×3 sRGB in [0, 1], one per material, of the same sizes."""

    srgb: tuple[Tensor, ...]


Shown = PiecePicture | ObjectTextures | None


def photograph(
    stage: Stage,
    shown: Shown,
    conditions: Conditions,
    size_px: tuple[int, int],
    jpeg: bool = True,
    supersample: int = 1,
) -> Tensor:
    """N×3×H×W sRGB pictures of `size_px`; `shown=None` is the bare object.

    A square size shows the photograph's centered square. `jpeg` as in `channel.camera.develop`,
    `supersample` as in `see`.
    """
    piece = shown if isinstance(shown, PiecePicture) else None
    return expose(see(stage, piece, conditions, size_px, supersample), shown, jpeg)


def shade(seen: Seen, shown: Shown) -> Tensor:
    """N×3×H×W linear light before lens and sensor; differentiable in what is shown."""
    if isinstance(shown, ObjectTextures):
        return _as_pictures(seen, seen.object_light(light_texels(shown.srgb, seen.reduced)))
    image = seen.bare
    if shown is None:
        return _as_pictures(seen, image)
    piece = seen.piece
    image = _blend(image, piece.back_pixel, piece.back_share, image.new_full((1, 3), PAPER_BACK_LINEAR), seen.reduced)
    if _own_blur(seen) or _own_noise(seen):
        return _pasted(seen, image, _piece_light(seen, shown))
    return _as_pictures(seen, _blend(image, piece.pixel, piece.share, _piece_light(seen, shown), seen.reduced))


def expose(seen: Seen, shown: Shown, jpeg: bool = True) -> Tensor:
    """The photographs of views already seen."""
    stage, scale = seen.stage, _scale(seen)
    bends = stage.camera is not None and stage.camera.bends
    own = shown is not None and (_own_blur(seen) or _own_noise(seen))
    alone = seen.reduced and is_pointwise(seen.conditions, scale, jpeg)
    if bends or own or isinstance(shown, ObjectTextures) or not alone:
        light = shade(seen, shown)
        if bends:
            light = distorted(light, stage.camera, seen.size_px)
        share = diagonal_share_of(seen.size_px, stage.scene.settings.camera.photo_px)
        return develop(light, seen.conditions, scale, jpeg, share)
    image = seen.bare_exposed
    if shown is not None:
        # where each pixel is developed alone, only the piece's own pixels differ from the bare object's photograph
        piece, pixels = seen.piece, seen.frame_px[0] * seen.frame_px[1]
        back = encoded(PAPER_BACK_LINEAR * seen.gains.index_select(0, piece.back_pixel // pixels))
        image = _blend(image, piece.back_pixel, piece.back_share, back, False)
        light = _piece_light(seen, shown) * seen.gains.index_select(0, piece.view)
        image = _blend(image, piece.pixel, piece.share, encoded(light), False)
    return _as_pictures(seen, image)


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


def _piece_light(seen: Seen, picture: PiecePicture) -> Tensor:
    """The light P×3 that the piece's pixels send to the camera."""
    drawn, view = seen.conditions, seen.piece.view
    footprints, srgb = seen.piece.texels, [picture.srgb]
    if drawn.misregistration_mm.any():
        footprints, srgb = _misregistered(seen, picture)
    table = torch.cat([texel_table([one if seen.reduced else linear_from_srgb(one)], wrap=False) for one in srgb])
    reflectance = look_up(footprints, table)
    if seen.reduced:
        reflectance = linear_from_srgb(reflectance)
    change = torch.as_tensor(np.stack([drawn.dot_gain, drawn.density, drawn.black], 1)).to(reflectance)
    paper = torch.as_tensor(drawn.paper).to(reflectance)
    light = vary(reflectance, change.index_select(0, view)) * paper.index_select(0, view) * seen.piece_white
    return light if seen.piece_gloss is None else light + seen.piece_gloss


def _misregistered(seen: Seen, picture: PiecePicture) -> tuple[Footprint, list[Tensor]]:
    """Each view's own print of the picture, and footprints on all of them."""
    x0, y0, x1, y1 = picture.box_px
    width_mm, height_mm = seen.stage.piece.size_mm
    shifts = torch.as_tensor(seen.conditions.misregistration_mm).to(picture.srgb)
    shifts = shifts * shifts.new_tensor([(x1 - x0) / width_mm, (y1 - y0) / height_mm])
    prints = [misregistered(picture.srgb, shift) for shift in shifts]
    height, width = picture.srgb.shape[:2]
    texels = sum((max(width >> k, 1) + 1) * (max(height >> k, 1) + 1) for k in range(max(width, height).bit_length()))
    return on_copies(seen.piece.texels, seen.piece.view * texels), prints


def _pasted(seen: Seen, image: Tensor, light: Tensor) -> Tensor:
    """The piece put into photographs with their own blur and noise, which the photographs around it have already."""
    piece, scene, scale = seen.piece, seen.stage.scene, _scale(seen)
    layer = (
        torch.zeros(len(image), 4)
        .to(image)
        .index_copy(0, piece.pixel, torch.cat([light, light.new_ones(len(light), 1)], 1) * piece.share)
    )
    layer = _as_pictures(seen, layer)
    layer = blurred(layer, torch.as_tensor(scene.piece_blur_px(seen.conditions) * scale).to(image))
    share = layer[:, 3:]
    whole = _as_pictures(seen, image) * (1 - share) + layer[:, :3]
    noise = torch.as_tensor(scene.piece_noise(seen.conditions) * scale).to(image)
    return torch.lerp(whole, noisy(whole, noise, seen.conditions.noise_seed + _OTHER_GRAIN), share)


_OTHER_GRAIN = 1 << 40  # the photograph's own grain is not that of the camera that photographs it again


def _own_blur(seen: Seen) -> bool:
    """Whether the scene's photographs have a blur of their own that shows at this size."""
    own = seen.object is None and seen.stage.scene.piece_blur_px(seen.conditions).max() * _scale(seen)
    return bool(own >= SMALLEST_BLUR_PX)


def _own_noise(seen: Seen) -> bool:
    own = seen.object is None and seen.stage.scene.piece_noise(seen.conditions).max() * _scale(seen)
    return bool(own >= SMALLEST_NOISE)


def _scale(seen: Seen) -> float:
    """The pictures' size over the photograph's."""
    return min(seen.size_px) / min(seen.stage.scene.settings.camera.photo_px)


def _as_pictures(seen: Seen, image: Tensor) -> Tensor:
    width, height = seen.frame_px
    return image.view(len(seen.conditions), height, width, -1).permute(0, 3, 1, 2)
