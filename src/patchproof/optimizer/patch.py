"""A printed patch as the subject of optimization: a design in its piece.

In: a scene with a piece, and its printer. Out: `Patch`: the first design, the allowed designs, their penalty, and the
pixels that go to the printer. `render.stage` draws the whole piece on paper.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from patchproof.base.errors import Refused
from patchproof.base.output import image_bytes, write_atomically
from patchproof.channel.printer import Printer
from patchproof.optimizer.subject import DESIGN_FILE, as_pixels, build_pyramid, collapse_pyramid, total_variation
from patchproof.render.pixels import PiecePicture
from patchproof.render.stage import PrintedPiece
from patchproof.scene.interface import PieceScene
from patchproof.sheets.manifest import MAX_PRINTED_PX
from patchproof.sheets.piece import control_design, whiten_marker_pixels

# A design's pixels are printed as blocks of at least this density. Some PDF readers smooth coarser pictures, and
# markers, drawn on the same grid, would be lost.
PRINTED_PX_PER_MM = 2.0


@dataclass(frozen=True, eq=False)
class Patch:
    """Designs are 3×h×w in [0, 1] on the optimized grid `design_px` (width, height); pixels are printed as blocks."""

    scene: PieceScene
    printer: Printer
    design_px: tuple[int, int]
    device: torch.device

    def __post_init__(self) -> None:
        if max(self.printed_px) > MAX_PRINTED_PX:  # what no manifest holds is refused before it is optimized
            expected = f"a piece whose design is printed with at most {MAX_PRINTED_PX} pixels along its longer side"
            width_mm, height_mm = self.scene.piece.size_mm
            got = f"{max(self.printed_px)} for {width_mm:.0f} × {height_mm:.0f} mm"
            raise Refused(expected, got, "make the piece smaller: patch.width_mm")

    def start(self) -> Tensor:
        """A mid-gray design."""
        width, height = self.design_px
        return torch.full((3, height, width), 0.5, device=self.device)

    def clip(self, design: Tensor) -> Tensor:
        """The nearest design in [0, 1]."""
        return design.clamp(0, 1)

    def gradient_levels(self, gradient: Tensor) -> tuple[Tensor, ...]:
        """The gradient's pyramid."""
        return build_pyramid(gradient)

    def combine_levels(self, updates: Sequence[Tensor]) -> Tensor:
        """Combine the updates of the pyramid's levels into one update of the design."""
        return collapse_pyramid(updates)

    def penalty(self, design: Tensor) -> Tensor | float:
        """The penalty of a design by the scene's settings: total variation, colors that the printer misses."""
        settings = self.scene.settings.optimize
        cost = settings.tv * total_variation(design) if settings.tv else 0.0
        if settings.gamut:
            # ΔE00 / 100: black in place of white costs one unit of loss
            cost = cost + settings.gamut * self.printer.gamut_distance(design[None]).mean() / 100
        return cost

    def pixels(self, design: Tensor) -> np.ndarray:
        """The uint8 H×W×3 that goes to the printer."""
        block = self.printed_px[0] // design.shape[2]
        return whiten_marker_pixels(as_pixels(design).repeat(block, 0).repeat(block, 1), self.scene.piece)

    def control(self, kind: str, pixels: np.ndarray) -> np.ndarray:
        """The pixels that the control sheet of this kind prints in place of the design's."""
        return control_design(kind, pixels, self.scene.sheet_id, self.scene.piece)

    def appearance(self, design: Tensor, kind: str = "design") -> PiecePicture:
        """The printed piece with a design of any grid (the optimized one, or as printed); differentiable."""
        return self._printed.appearance(design, kind)

    def print_design(self, design: Tensor) -> Tensor:
        """The printed piece's texels T×3 for an optimized design; differentiable."""
        return self.appearance(design).codes

    def appearance_of_print(self, printed: Tensor) -> PiecePicture:
        """The piece with these texels."""
        return PiecePicture(printed, self.design_px)

    def save(self, pixels: np.ndarray, folder: Path) -> None:
        """Write `design.png`."""
        write_atomically(folder / DESIGN_FILE, image_bytes(pixels, "PNG"))

    @property
    def texels_per_mm(self) -> float:
        """The resolution of the optimized grid."""
        return self.design_px[0] / self.scene.piece.size_mm[0]

    @property
    def printed_px(self) -> tuple[int, int]:
        """(width, height) of the design as it is printed: in whole blocks of at least PRINTED_PX_PER_MM."""
        width, height = self.design_px
        width_mm, height_mm = self.scene.piece.size_mm
        block = math.ceil(PRINTED_PX_PER_MM * max(width_mm / width, height_mm / height))
        return width * block, height * block

    @cached_property
    def _printed(self) -> PrintedPiece:
        return PrintedPiece(self.scene.piece, self.scene.sheet_id, self.printer, self.device)
