"""What is optimized: one design on one stage, in front of one or more classifiers.

In: a scene, the names of its classifiers and its printer. Out: `Problem`, from which the loop, the promise and
`evaluate` take the pictures that each design gives. The whole piece is shown, design and printed frame, because that is
what will hang there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from patchproof.channel.printer import Printer, load_printer
from patchproof.classifier.labels import find_labels
from patchproof.classifier.load import load_classifier
from patchproof.classifier.network import Classifier
from patchproof.render.photograph import PiecePicture, Stage, set_stage
from patchproof.scene.scene import MeshScene
from patchproof.settings import Refused
from patchproof.sheet.piece import FrameImage, frame_image, lay_out_piece

# A design's pixels are printed as blocks of at least this density. Coarser pictures are smoothed by some PDF readers
# and not by others, and the frame, drawn on the same grid, would lose its markers.
PRINTED_PX_PER_MM = 2.0
# Sides at which views are rendered. Against 40 full photographs of the demo's patch the mean confidence was off by 0.09
# at 96 px, 0.05 at 192 and 0.005 at 384; against 40 of a patch before a network of 224 px by 0.02 at 224 and at 448.
TRAINING_PX, FIGURE_PX = 192, 384


@dataclass(frozen=True, eq=False)
class Problem:
    """A scene on a device with its printer, classifiers and, per classifier, the label indices that count."""

    scene: MeshScene
    stage: Stage
    printer: Printer
    classifiers: tuple[Classifier, ...]
    indices: tuple[tuple[int, ...], ...]
    design_px: tuple[int, int]  # the grid that is optimized; each of its pixels is printed as a block

    @property
    def training_px(self) -> int:
        """The side at which views are rendered for training and selection."""
        return self._view_px(TRAINING_PX)

    @property
    def figure_px(self) -> int:
        """The side at which views are rendered for figures that people will read."""
        return self._view_px(FIGURE_PX)

    @property
    def reduced(self) -> bool:
        """Whether training views come at the networks' own size, and so stand for photographs already reduced to it."""
        return self.training_px == max(classifier.input_px for classifier in self.classifiers)

    def _view_px(self, at_least: int) -> int:
        """The smallest whole multiple of the largest input size that is no smaller, at most the photograph's."""
        network_px = max(classifier.input_px for classifier in self.classifiers)
        return min(network_px * math.ceil(at_least / network_px), min(self.scene.settings.camera.photo_px))

    @property
    def device(self) -> torch.device:
        """Where the tensors are."""
        return self.stage.vertices.device

    @property
    def printed_px(self) -> tuple[int, int]:
        """(width, height) of the design as it is printed: in whole blocks of at least PRINTED_PX_PER_MM."""
        patch, (width, height) = self.scene.settings.patch, self.design_px
        block = math.ceil(PRINTED_PX_PER_MM * max(patch.width_mm / width, patch.height_mm / height))
        return width * block, height * block

    def pixels(self, design_srgb: Tensor) -> np.ndarray:
        """The uint8 H×W×3 that goes to the printer for a design 3×h×w in [0, 1] on the optimized grid."""
        block = self.printed_px[0] // design_srgb.shape[2]
        return as_pixels(design_srgb).repeat(block, 0).repeat(block, 1)

    def piece_picture(self, design_srgb: Tensor, kind: str = "design") -> PiecePicture:
        """The printed piece round a design 3×h×w in [0, 1], on the optimized grid or as printed; differentiable."""
        frame, printed_frame = self._frame(kind, self.printed_px)
        x0, y0, width, height = frame.design_box_px
        printed = self.printer.apply(design_srgb[None])[0].permute(1, 2, 0)
        block = width // design_srgb.shape[2]
        if block > 1:
            printed = printed.repeat_interleave(block, 0).repeat_interleave(block, 1)
        rows = torch.cat(
            [printed_frame[y0 : y0 + height, :x0], printed, printed_frame[y0 : y0 + height, x0 + width :]], 1
        )
        return PiecePicture(torch.cat([printed_frame[:y0], rows, printed_frame[y0 + height :]]), frame.piece_box_px)

    def gamut_excess(self, design_srgb: Tensor) -> Tensor:
        """Mean ΔE00 by which the printer misses the design's colors."""
        return self.printer.gamut_distance(design_srgb[None]).mean()

    @lru_cache(maxsize=8)  # noqa: B019 - a problem lives as long as its run
    def _frame(self, kind: str, design_px: tuple[int, int]) -> tuple[FrameImage, Tensor]:
        """The frame of a kind of sheet, as drawn and as printed (H×W×3)."""
        patch = self.scene.settings.patch
        piece = self.scene.piece
        if kind != "design":
            # the control's own marker ids, as they will be printed
            marker_mm = piece.module_mm * 7
            piece = lay_out_piece((patch.width_mm, patch.height_mm), marker_mm, self.scene.sheet_id, kind)
        frame = frame_image(piece, design_px)
        sent = torch.tensor(np.asarray(frame.srgb), dtype=torch.float32, device=self.device).permute(2, 0, 1)[None]
        return frame, self.printer.apply(sent)[0].permute(1, 2, 0)


def set_problem(scene: MeshScene, device: str = "cpu", models: tuple[str, ...] | None = None) -> Problem:
    """The problem that a scene states; `models` replaces the scene's own classifiers."""
    _check_device(device)
    settings = scene.settings
    classifiers = tuple(load_classifier(name, scene.base, device) for name in models or settings.target.models)
    accept = settings.target.accept
    indices = tuple(find_labels(c.labels, settings.target.label, accept) for c in classifiers)
    printer = load_printer(settings.printer.profile, scene.base)
    network_px = max(classifier.input_px for classifier in classifiers)
    return Problem(scene, set_stage(scene, device), printer, classifiers, indices, scene.design_px(network_px))


def _check_device(device: str) -> None:
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise Refused("a device that this torch can use", f"{device} ({reason})", "use --device cpu") from error


def as_pixels(design_srgb: Tensor) -> np.ndarray:
    """A picture 3×h×w in [0, 1] as uint8 h×w×3."""
    return (design_srgb.detach().clamp(0, 1) * 255).round().byte().permute(1, 2, 0).cpu().numpy()


def from_pixels(pixels: np.ndarray, device: torch.device | str = "cpu") -> Tensor:
    """uint8 h×w×3 as 3×h×w in [0, 1]."""
    return torch.tensor(pixels, dtype=torch.float32, device=device).permute(2, 0, 1) / 255
