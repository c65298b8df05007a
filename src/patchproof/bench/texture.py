"""How many taps a pixel's footprint needs: the design in views against 16 × 16 samples in each of their pixels.

In: the piece as it is printed, at widths and tilts. Out: one chart, time against signal-to-noise ratio.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from patchproof import geometry
from patchproof.bench.chart import Chart, Check, OnStage, Point
from patchproof.bench.measure import psnr, ratio, timed
from patchproof.bench.world import World
from patchproof.claims import median
from patchproof.render.fragments import Cameras
from patchproof.render.pixels import DESIGN_TAPS, PiecePicture
from patchproof.render.raster import rasterize
from patchproof.render.texture import Layout, footprint, layout, look_up, texel_table
from patchproof.report.tables import Table
from patchproof.sheets.piece import Piece

TAPS = tuple(sorted({1, 2, 4, 6, 8, 12, DESIGN_TAPS}))
WIDTHS_PX, QUICK_WIDTHS_PX, TILTS_DEG = (20, 45, 70, 110, 200), (20, 70, 200), (0, 60)
PICTURE_PX = 224
SUBSAMPLES = 16  # along each side of a pixel, in the references
LEAST_PSNR = 38.0  # dB over the design's own pixels


@dataclass(frozen=True)
class Look:
    """A view of a piece: the uv (and its change per pixel) of P pixels that lie within the design, and the mean P×3 of
    16×16 samples in each.
    """

    uv: tuple[Tensor, Tensor, Tensor]
    truth: Tensor


@dataclass(frozen=True)
class Texels:
    """A piece's picture as the renderer looks it up."""

    where: Layout
    table: Tensor

    def colors(self, look: Look, taps: int) -> Tensor:
        """The P×3 that a view's pixels see."""
        first = torch.zeros(len(look.truth), dtype=torch.long)
        return look_up(footprint(self.where, first, *look.uv, taps, blocks=True), self.table)


def texels(picture: PiecePicture) -> Texels:
    """The mip levels of a picture of the piece, which gradients reach."""
    height, width, _ = picture.srgb.shape
    table = texel_table([picture.srgb.detach()], wrap=False).requires_grad_()
    return Texels(layout([(width, height)], wrap=False), table)


def texture_chart(world: World, widths_px: Sequence[int], rounds: int, on_stage: OnStage) -> Chart:
    """Taps along a footprint's shorter side against the error to 16×16 samples per pixel."""
    kinds = {"optimized design": world.shown(tiled=3), "noise control": world.control("noise")}
    views = [(width, tilt) for width in widths_px for tilt in TILTS_DEG]
    series, checks, rows = {}, [], []
    for kind, picture in kinds.items():
        looks, content = [], texels(picture)
        for view in views:
            looks.append(look(world.piece, picture, *view))
            on_stage("texture", len(series) * len(views) + len(looks), len(kinds) * len(views))
        with torch.no_grad():
            quality = {taps: [psnr(content.colors(view, taps), view.truth) for view in looks] for taps in TAPS}

        def work(taps: int, looks=looks, content=content) -> None:
            for view in looks:
                torch.autograd.grad(content.colors(view, taps).sum(), content.table)

        seconds = timed({taps: lambda taps=taps, work=work: work(taps) for taps in TAPS}, rounds)
        series[kind] = [
            Point(f"{taps}", ratio(seconds, taps, DESIGN_TAPS), median(quality[taps]), taps == DESIGN_TAPS)
            for taps in TAPS
        ]
        claim = f"worst PSNR of the {kind} at the default, dB"
        checks.append(Check(claim, min(quality[DESIGN_TAPS]), LEAST_PSNR, at_least=True))
        rows += [(kind, taps, *quality[taps]) for taps in TAPS]
    head = ("picture", "taps", *(f"{width} px {tilt}°" for width, tilt in views))
    return Chart(
        name="texture",
        title="Texture: taps along the shorter side of a pixel's footprint",
        cost="footprint + look-up + backward, relative to the default",
        error=f"PSNR of the design's pixels, dB (median of {len(views)} views)",
        series=series,
        about="Truth: 16 × 16 samples per pixel of printed blocks, averaged as code values; pixels wholly on the "
        "design. Design: the optimized one three by three, as fine as one for a classifier of three times the pixels.",
        checks=tuple(checks),
        tables=(Table("texture_views", "PSNR in dB by width and tilt", head, tuple(rows)),),
        higher_is_better=True,
        target=LEAST_PSNR,
    )


def look(piece: Piece, picture: PiecePicture, width_px: float, tilt_deg: float) -> Look:
    """A piece whose design is seen `width_px` wide in the middle of a picture."""
    pose, matrix = _pose(piece, width_px, tilt_deg), np.diag([PICTURE_PX, PICTURE_PX, 1.0])
    matrix[:2, 2] = PICTURE_PX / 2
    plane = np.pad(geometry.rect_corners([0, 0, *piece.size_mm]), ((0, 0), (0, 1)))
    faces = torch.tensor([[0, 3, 2], [0, 2, 1]])
    cameras = Cameras(torch.tensor(pose)[None], torch.tensor(matrix)[None], (PICTURE_PX, PICTURE_PX))
    fragments = rasterize(torch.tensor(plane), faces, cameras, 1.0)
    homography = geometry.plane_homography(matrix, pose, np.eye(4))
    truth, inside = reference(homography, piece, picture, fragments.pixel)
    fragments = fragments.where(inside)
    corner_uv = torch.tensor(plane[:, :2] / piece.size_mm, dtype=torch.float32)[faces][fragments.face]
    weights = (fragments.barycentric, fragments.barycentric_dx, fragments.barycentric_dy)
    uv, uv_dx, uv_dy = ((weight[..., None] * corner_uv).sum(1) for weight in weights)
    return Look((uv, uv_dx, uv_dy), truth[inside])


def _pose(piece: Piece, width_px: float, tilt_deg: float) -> np.ndarray:
    """4×4 from piece to camera: tilted about x, turned and shifted a little, so that nothing lies along the pixels."""
    distance = PICTURE_PX * piece.size_mm[0] / width_px  # the focal length is the picture's side
    (cos_x, cos_z), (sin_x, sin_z) = (f(np.radians([tilt_deg, 11.5])) for f in (np.cos, np.sin))
    tilt = np.array([[1, 0, 0], [0, cos_x, -sin_x], [0, sin_x, cos_x]])
    turn = np.array([[cos_z, -sin_z, 0], [sin_z, cos_z, 0], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, :3] = turn @ tilt
    middle = np.array([*np.array(piece.size_mm) / 2, 0])
    shift = np.array([0.37, 0.11, PICTURE_PX]) * distance / PICTURE_PX
    pose[:3, 3] = shift - pose[:3, :3] @ middle
    return pose


def reference(homography: np.ndarray, piece: Piece, picture: PiecePicture, pixel: Tensor) -> tuple[Tensor, Tensor]:
    """Means P×3 of 16×16 samples in each of P pixels, and whether all of them lie within the design."""
    texture = picture.srgb.detach().permute(2, 0, 1)[None]
    corner = np.stack([pixel % PICTURE_PX, pixel // PICTURE_PX], 1)[:, None]  # P×1×2
    along = (np.arange(SUBSAMPLES) + 0.5) / SUBSAMPLES
    total, inside = torch.zeros(len(pixel), 3), np.ones(len(pixel), bool)
    for down in along:
        at = corner + np.stack([along, np.full(SUBSAMPLES, down)], 1)
        mm = geometry.apply_homography(np.linalg.inv(homography), at.reshape(-1, 2))
        within = (mm >= 0).all(1) & (mm <= piece.size_mm).all(1)
        inside &= within.reshape(-1, SUBSAMPLES).all(1)
        grid = torch.tensor(2 * mm / piece.size_mm - 1, dtype=torch.float32).view(1, 1, -1, 2)
        # texels are blocks of one color, as printed
        values = F.grid_sample(texture, grid, mode="nearest", padding_mode="border", align_corners=False)[0, :, 0]
        total += values.view(3, len(pixel), SUBSAMPLES).sum(2).T
    return total / SUBSAMPLES**2, torch.tensor(inside)
