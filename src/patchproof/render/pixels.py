"""The texels that a view's pixels look at: the object's fragments, and the piece's with their share of each pixel.

In: fragments and the surfaces they lie on. Out: `ObjectPixels` and `PiecePixels`: texels with weights, normals, and
positions if light needs them. The piece's edge is antialiased in its own millimeters: by the share of a pixel's extent,
along each of the piece's sides, that lies within the cut line.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
import torch
from torch import Tensor

from patchproof.base.color import linear_from_srgb
from patchproof.base.geometry import dot
from patchproof.channel.printer import MOTTLE_CELLS
from patchproof.render.fragments import Fragments
from patchproof.render.surfaces import ObjectSurface, PieceSurface, sample_atlas
from patchproof.render.texture import Footprint, footprint, texel_layout, texel_table

MIN_SHARE = 1 / 512  # of a pixel: less changes no 8-bit value


@dataclass(frozen=True)
class TextureSampling:
    """Each pixel covers `side` of its width, with `taps` (pieces: `piece_taps`) on its footprint's shorter side."""

    taps: int
    side: float
    piece_taps: int


# With four taps on an object's own texture, a network's confidence is within 0.003 of that with eight (60 photographs
# of a textured car), with one within 0.073. On pieces, eight reach 38 dB and more against 16×16 samples per pixel for
# optimized designs 20 to 200 px wide, four 30.
PHOTO_SAMPLING = TextureSampling(taps=4, side=1.0, piece_taps=8)


@dataclass(frozen=True)
class PiecePicture:
    """The printed piece up to the cut line: sRGB texels T×3 of all levels, averaged as code values."""

    codes: Tensor
    size_px: tuple[int, int]

    @classmethod
    def of(cls, srgb: Tensor) -> "PiecePicture":
        """Return the piece that looks like H×W×3."""
        return cls(texel_table([srgb]), (srgb.shape[1], srgb.shape[0]))

    @property
    def srgb(self) -> Tensor:
        """The picture H×W×3."""
        width, height = self.size_px
        return self.codes[: height * width].view(height, width, 3)

    @cached_property
    def light(self) -> Tensor:
        """The texels averaged as linear light; they take a fifth of a photograph's time, and are computed once."""
        return texel_table([linear_from_srgb(self.srgb)])


@dataclass(frozen=True)
class ObjectTextures:
    """Textures that replace the object's own: H×W×3 sRGB in [0, 1], one per material, of the same sizes."""

    srgb: tuple[Tensor, ...]


Appearance = PiecePicture | ObjectTextures | None


@dataclass(frozen=True)
class ObjectPixels:
    """The object's fragments, `counts` of them in each view: their pixels, the texels they look at, and their light.
    Values that are the same for a view, `spread` over its fragments, are multiplied by columns in a third of the time.
    """

    pixel: Tensor
    counts: tuple[int, ...]
    texels: Footprint | None  # None if textures are fixed and part of `color`
    color: Tensor  # 3×P: multiplies the texture
    normal: Tensor  # 3×P

    def spread(self, values: Tensor) -> Tensor:
        """Return K×P: for each fragment the values K×N of its view."""
        return torch.cat([row[:, None].expand(-1, n) for row, n in zip(values.T, self.counts, strict=True)], 1)

    def part(self, views: range, pixels: int) -> "ObjectPixels":
        """Return those of some views, of `pixels` pixels each, equal to those of these views alone."""
        first, counts = sum(self.counts[: views.start]), self.counts[views.start : views.stop]
        rows = slice(first, first + sum(counts))
        texels = None if self.texels is None else self.texels.part(rows.start, rows.stop)
        pixel = self.pixel[rows] - views.start * pixels
        return ObjectPixels(pixel, counts, texels, self.color[:, rows], self.normal[:, rows])


@dataclass(frozen=True)
class PiecePixels:
    """The pixels that the piece covers, each by its `share`. `white` P×3 is the light of the base picture's paper, None
    without pictures; `box_px` N×4 (left, top, right, bottom) bounds each view's pixels of both sides.
    """

    pixel: Tensor
    view: Tensor
    share: Tensor
    texels: Footprint
    size_px: tuple[int, int]  # of the piece
    normal: Tensor  # 3×P
    white: Tensor | None
    back_pixel: Tensor  # pixels that see its back
    back_share: Tensor
    box_px: np.ndarray

    @cached_property
    def mottle_cells(self) -> Footprint:
        """The cells of the prints' mottle that the pixels see, those of each view after the ones before."""
        cell = _cell_of_texel(self.size_px, self.view.device).index_select(0, self.texels.texel)
        first = (self.view * MOTTLE_CELLS**2).int().index_select(0, self.texels.fragment)
        return replace(self.texels, texel=cell.add_(first))

    def part(self, views: range, pixels: int) -> "PiecePixels":
        """Return those of some views, of `pixels` pixels each, equal to those of these views alone."""
        rows, back = (_rows(pixel, views, pixels) for pixel in (self.pixel, self.back_pixel))
        pixel, view = self.pixel[rows] - views.start * pixels, self.view[rows] - views.start
        texels, white = self.texels.part(rows.start, rows.stop), None if self.white is None else self.white[rows]
        front = (pixel, view, self.share[rows], texels, self.size_px, self.normal[:, rows], white)
        back_pixel, box_px = self.back_pixel[back] - views.start * pixels, self.box_px[views.start : views.stop]
        return PiecePixels(*front, back_pixel, self.back_share[back], box_px)


@lru_cache(maxsize=4)
def _cell_of_texel(size_px: tuple[int, int], device: torch.device) -> Tensor:
    """Return the cell of a print's mottle in which each texel of a picture's levels has its middle."""
    across, down = ((torch.arange(n) + 0.5) * (MOTTLE_CELLS / max(size_px)) for n in size_px)
    middle = texel_table([torch.stack(torch.meshgrid(down, across, indexing="ij"), -1)]).long()
    return (middle[:, 0] * MOTTLE_CELLS + middle[:, 1]).int().to(device)


def _rows(pixel: Tensor, views: range, pixels: int) -> slice:
    """Return the slice of ascending pixels that lie in these views."""
    return slice(*torch.searchsorted(pixel, pixel.new_tensor([views.start, views.stop]) * pixels).tolist())


def piece_pixels(
    surface: PieceSurface,
    piece: PiecePicture,
    fragments: Fragments,
    hidden: Tensor | None,
    look: TextureSampling = PHOTO_SAMPLING,
    white_coefficients: Tensor | None = None,
) -> PiecePixels:
    """Return the texels that the piece's fragments look at, and their share of each pixel."""
    size = torch.tensor(surface.size_mm, dtype=torch.float32, device=fragments.face.device)
    mm = _interpolate(surface.corner_mm, fragments)
    mm_dx, mm_dy = fragments.derivatives(surface.corner_mm, mm)
    # the share of the pixel's extent, along each of the piece's sides, that lies inside the cut line
    half = (mm_dx.abs() + mm_dy.abs()).clamp_min(1e-9) / 2
    low, high = (torch.minimum((mm + k * half).clamp_min(0), size) for k in (-1, 1))
    share = ((high - low) / (2 * half)).prod(1)
    if hidden is not None:
        share = share.masked_fill(hidden, 0)
    is_covered = share > MIN_SHARE
    visible = fragments.where(is_covered & fragments.front)
    front, back = ((is_covered & side).nonzero()[:, 0] for side in (fragments.front, ~fragments.front))
    # by columns in memory: selecting rows takes thirty times as long there
    mm, mm_dx, mm_dy = (values.T.contiguous().index_select(1, front).T for values in (mm, mm_dx, mm_dy))
    back_pixel = fragments.pixel.index_select(0, back)
    layout, only = texel_layout([piece.size_px], wrap=False, device=mm.device), mm.new_zeros(1, dtype=torch.long)
    uv, uv_dx, uv_dy = mm / size, mm_dx * look.side / size, mm_dy * look.side / size
    texels = footprint(layout, only, uv, uv_dx, uv_dy, taps=look.piece_taps, blocks=True)
    normal = torch.nn.functional.normalize(_interpolate(surface.corner_normal, visible), dim=-1).T
    white = None if white_coefficients is None else _paper_light(white_coefficients[visible.view], 2 * mm / size - 1)
    front_share, back_share = (share.index_select(0, side)[:, None] for side in (front, back))
    box_px = _boxes(torch.cat([visible.pixel, back_pixel]), fragments.shape)
    seen = (visible.pixel, visible.view, front_share, texels, piece.size_px, normal, white)
    return PiecePixels(*seen, back_pixel, back_share, box_px)


def _boxes(pixel: Tensor, shape: tuple[int, int, int]) -> np.ndarray:
    """Return N×4 boxes (left, top, right, bottom) of each view's pixels; a view without any has one of no size."""
    views, height, width = shape
    xy, view = torch.stack([pixel % width, pixel // width % height], 1), pixel // (width * height)
    row, size = view[:, None].expand(-1, 2), xy.new_tensor([width, height]).repeat(views, 1)
    low, high = size.scatter_reduce(0, row, xy, "amin"), (size * 0).scatter_reduce(0, row, xy + 1, "amax")
    return torch.cat([torch.minimum(low, high), high], 1).cpu().numpy()


def object_pixels(
    surface: ObjectSurface, fragments: Fragments, look: TextureSampling, fixed: Tensor | None
) -> ObjectPixels:
    """Return the object's pixels, with normals towards the viewer; `fixed` textures are looked up at once."""
    uv, color, normal = (values.T for values in _interpolate(surface.corners, fragments).split((2, 3, 3), 1))
    uv_dx, uv_dy = fragments.derivatives(surface.corner_uv, uv.T)
    material = surface.material[:1]
    if len(surface.textures_srgb) > 1:
        material = surface.material.index_select(0, fragments.face)
    query = (material, uv.T, uv_dx * look.side, uv_dy * look.side, look.taps)
    texels = None
    if fixed is None:
        texels = footprint(surface.layout, *query)
    else:
        color = sample_atlas(surface.atlas, fixed, *query).T * color
    length = dot(*[normal.unbind()] * 2).sqrt_().clamp_min_(1e-12)
    length = torch.where(fragments.front, length, -length)
    normal = torch.div(normal, length, out=torch.empty_like(normal, memory_format=torch.contiguous_format))
    starts = torch.arange(fragments.shape[0] + 1, device=material.device) * math.prod(fragments.shape[1:])
    counts = torch.searchsorted(fragments.pixel, starts).diff().tolist()
    return ObjectPixels(fragments.pixel, tuple(counts), texels, color.contiguous(), normal)


def _interpolate(corner_values: Tensor, fragments: Fragments) -> Tensor:
    """Return P×C: values F×3×C of the faces' corners, interpolated at the fragments; a weighted gather, for which the
    library has a kernel that is ten times as fast as its parts.
    """
    table, weight = corner_values.flatten(0, 1), fragments.barycentric
    return torch.nn.functional.embedding_bag(fragments.corner, table, per_sample_weights=weight, mode="sum")


def _paper_light(coefficients: Tensor, uv: Tensor) -> Tensor:
    """Evaluate quadratics P×3×6 of [1, u, v, u², uv, v²] at `uv` P×2."""
    u, v = uv.unbind(1)
    terms = torch.stack([torch.ones_like(u), u, v, u * u, u * v, v * v], 1)
    return (coefficients * terms[:, None]).sum(-1).clamp_min(0)
