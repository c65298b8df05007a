"""What a view's pixels look at: the object's fragments, and the piece's with their antialiased share of each pixel.

In: fragments and the surfaces they lie on. Out: `ObjectPixels` and `PiecePixels`: texels with weights, normals, and
positions where light needs them. The piece's edge is antialiased from its own millimeters: the share of a pixel's
extent, along each of the piece's sides, that lies within the cut line.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from patchproof.base.color import linear_from_srgb
from patchproof.render.atlas import sample_atlas
from patchproof.render.fragments import Fragments
from patchproof.render.surfaces import ObjectSurface, PieceSurface
from patchproof.render.texture import Footprint, footprint, texel_layout, texel_table

LEAST_SHARE = 1 / 512  # of a pixel: less moves no 8-bit value


@dataclass(frozen=True)
class TextureSampling:
    """How pixels look at textures: each over `side` of its own width and height, in so many `taps` along its
    footprint's shorter side at the object's, and in so many `piece_taps` at the printed piece.
    """

    taps: int
    side: float
    piece_taps: int


# Four taps leave an object's own texture within 0.003 of the confidence that a network has with eight (60 photographs
# of a textured car), one within 0.073. At pieces eight leave 38 dB and more against 16×16 samples per pixel for
# optimized designs 20 to 200 px wide, four 30.
PHOTO_SAMPLING = TextureSampling(taps=4, side=1.0, piece_taps=8)


@dataclass(frozen=True)
class PiecePicture:
    """The whole piece of `size_px` (width, height) as it looks on paper, up to the cut line: the sRGB texels T×3 of all
    levels, averaged as code values, which is what a reduced photograph shows.
    """

    codes: Tensor
    size_px: tuple[int, int]

    @classmethod
    def of(cls, srgb: Tensor) -> PiecePicture:
        """The piece that looks like H×W×3."""
        return cls(texel_table([srgb], wrap=False), (srgb.shape[1], srgb.shape[0]))

    @property
    def srgb(self) -> Tensor:
        """H×W×3."""
        width, height = self.size_px
        finest = self.codes[: (height + 1) * (width + 1)]
        return finest.view(height + 1, width + 1, 3)[:height, :width]

    @cached_property
    def light(self) -> Tensor:
        """Its texels averaged as light, linear: a fifth of a photograph's time, so once for all that show it."""
        return texel_table([linear_from_srgb(self.srgb)], wrap=False)


@dataclass(frozen=True)
class ObjectTextures:
    """Textures of the object in place of its own: H×W×3 sRGB in [0, 1], one per material, of the same sizes."""

    srgb: tuple[Tensor, ...]


Appearance = PiecePicture | ObjectTextures | None


@dataclass(frozen=True)
class ObjectPixels:
    """The object's fragments: in which pixel, what texels they look at, and how they are lit."""

    pixel: Tensor
    view: Tensor
    texels: Footprint | None  # None where textures are fixed, and in `color`
    color: Tensor  # P×3: what the texture is multiplied by
    normal: Tensor

    def part(self, views: range, pixels: int) -> ObjectPixels:
        """Those of some views, of so many pixels each, as if no others had been seen."""
        rows = _rows(self.pixel, views, pixels)
        return ObjectPixels(
            self.pixel[rows] - views.start * pixels,
            self.view[rows] - views.start,
            None if self.texels is None else self.texels.part(rows.start, rows.stop),
            self.color[rows],
            self.normal[rows],
        )


@dataclass(frozen=True)
class PiecePixels:
    """Pixels that the piece covers, each its `share`; `white` is the light P×3 of the base picture's paper where a
    scene is made of pictures, else None. `box_px` N×4 (left, top, right, bottom) holds each view's, of either side.
    """

    pixel: Tensor
    view: Tensor
    share: Tensor
    texels: Footprint
    normal: Tensor
    white: Tensor | None
    back_pixel: Tensor  # where its back is seen
    back_share: Tensor
    box_px: np.ndarray

    def part(self, views: range, pixels: int) -> PiecePixels:
        """Those of some views, of so many pixels each, as if no others had been seen."""
        rows, back = (_rows(pixel, views, pixels) for pixel in (self.pixel, self.back_pixel))
        return PiecePixels(
            self.pixel[rows] - views.start * pixels,
            self.view[rows] - views.start,
            self.share[rows],
            self.texels.part(rows.start, rows.stop),
            self.normal[rows],
            None if self.white is None else self.white[rows],
            self.back_pixel[back] - views.start * pixels,
            self.back_share[back],
            self.box_px[views.start : views.stop],
        )


def _rows(pixel: Tensor, views: range, pixels: int) -> slice:
    """Which of ascending pixels lie in these views."""
    return slice(*torch.searchsorted(pixel, pixel.new_tensor([views.start, views.stop]) * pixels).tolist())


def piece_pixels(
    surface: PieceSurface,
    piece: PiecePicture,
    fragments: Fragments,
    hidden: Tensor | None,
    look: TextureSampling = PHOTO_SAMPLING,
    white_coefficients: Tensor | None = None,
) -> PiecePixels:
    """What the piece's own fragments look at, and their share of each pixel."""
    size = torch.tensor(surface.size_mm, dtype=torch.float32, device=fragments.face.device)
    mm, (mm_dx, mm_dy) = _weighted(surface.corner_mm, fragments), _slopes(surface.corner_mm, fragments)
    # along each of its sides, how much of the pixel's own extent lies inside the cut line
    half = (mm_dx.abs() + mm_dy.abs()).clamp_min(1e-9) / 2
    low, high = (torch.minimum((mm + k * half).clamp_min(0), size) for k in (-1, 1))
    share = ((high - low) / (2 * half)).prod(1)
    if hidden is not None:
        share = share.masked_fill(hidden, 0)
    shown = share > LEAST_SHARE
    kept = fragments.where(shown & fragments.front)
    front, back = ((shown & side).nonzero()[:, 0] for side in (fragments.front, ~fragments.front))
    mm, mm_dx, mm_dy = (values.index_select(0, front) for values in (mm, mm_dx, mm_dy))
    back_pixel = fragments.pixel.index_select(0, back)
    return PiecePixels(
        kept.pixel,
        kept.view,
        share.index_select(0, front)[:, None],
        _piece_footprint(piece, mm / size, mm_dx * look.side / size, mm_dy * look.side / size, look.piece_taps),
        torch.nn.functional.normalize(_weighted(surface.corner_normal, kept), dim=-1),
        None if white_coefficients is None else _white(white_coefficients[kept.view], 2 * mm / size - 1),
        back_pixel,
        share.index_select(0, back)[:, None],
        _boxes(torch.cat([kept.pixel, back_pixel]), fragments.shape),
    )


def _boxes(pixel: Tensor, shape: tuple[int, int, int]) -> np.ndarray:
    """N×4 pixels (left, top, right, bottom) that hold each view's, of (views, height, width); of a view without any, of
    no size.
    """
    views, height, width = shape
    place, view = torch.stack([pixel % width, pixel // width % height], 1), pixel // (width * height)
    row, whole = view[:, None].expand(-1, 2), place.new_tensor([width, height]).repeat(views, 1)
    low, high = whole.scatter_reduce(0, row, place, "amin"), (whole * 0).scatter_reduce(0, row, place + 1, "amax")
    return torch.cat([torch.minimum(low, high), high], 1).cpu().numpy()


def _piece_footprint(piece: PiecePicture, at: Tensor, at_dx: Tensor, at_dy: Tensor, taps: int) -> Footprint:
    """Which texels of the piece's picture are seen; `at` P×2 from 0 to 1 across the piece."""
    where, texture = (
        texel_layout([piece.size_px], wrap=False, device=at.device),
        at.new_zeros(len(at), dtype=torch.long),
    )
    return footprint(where, texture, at, at_dx, at_dy, taps=taps, blocks=True)


def object_pixels(
    surface: ObjectSurface, fragments: Fragments, look: TextureSampling, fixed: Tensor | None
) -> ObjectPixels:
    """The object's fragments, with its textures in their color where they are `fixed` (`ObjectSurface.texels`); faces
    seen from behind turn their normal round.
    """
    at, (uv_dx, uv_dy) = _weighted(surface.corners, fragments), _slopes(surface.corner_uv, fragments)
    material = surface.material.index_select(0, fragments.face)
    turned = torch.nn.functional.normalize(at[:, 5:8], dim=-1) * torch.where(fragments.front, 1.0, -1.0)[:, None]
    where, color, texels = (material, at[:, :2], uv_dx * look.side, uv_dy * look.side, look.taps), at[:, 2:5], None
    if fixed is None:
        texels = footprint(surface.layout, *where)
    else:
        color = sample_atlas(surface.atlas, fixed, *where) * color
    return ObjectPixels(
        fragments.pixel,
        fragments.view,
        texels,
        color,
        turned,
    )


def _weighted(corner_values: Tensor, fragments: Fragments) -> Tensor:
    """Values F×3×C at the faces' corners, interpolated at the fragments."""
    return _sum(corner_values, fragments.corner, fragments.barycentric)


def _slopes(corner_values: Tensor, fragments: Fragments) -> tuple[Tensor, Tensor]:
    """How the same change from pixel to pixel, to the right and down."""
    dx, dy = fragments.barycentric_dx, fragments.barycentric_dy
    return _sum(corner_values, fragments.corner, dx), _sum(corner_values, fragments.corner, dy)


def _sum(corner_values: Tensor, corner: Tensor, weight: Tensor) -> Tensor:
    """P×C: a weighted gather, for which the library has a kernel that is ten times as fast as its parts."""
    table = corner_values.flatten(0, 1)
    return torch.nn.functional.embedding_bag(corner, table, per_sample_weights=weight, mode="sum")


def _white(coefficients: Tensor, uv: Tensor) -> Tensor:
    """Quadratics P×3×6 of [1, u, v, u², uv, v²] at `uv` P×2."""
    u, v = uv.unbind(1)
    terms = torch.stack([torch.ones_like(u), u, v, u * u, u * v, v * v], 1)
    return (coefficients * terms[:, None]).sum(-1).clamp_min(0)
