"""Convert between designs as tensors and designs as 8-bit pixels."""

import numpy as np
import torch
from torch import Tensor

from patchproof.base.color import codes_from_srgb


def as_pixels(design_srgb: Tensor) -> np.ndarray:
    """A picture 3×h×w in [0, 1] as uint8 h×w×3."""
    return codes_from_srgb(design_srgb.detach()).permute(1, 2, 0).cpu().numpy()


def from_pixels(pixels: np.ndarray, device: torch.device | str = "cpu") -> Tensor:
    """uint8 h×w×3 as 3×h×w in [0, 1]."""
    return torch.tensor(pixels, dtype=torch.float32, device=device).permute(2, 0, 1) / 255


def side_by_side(pictures: Tensor, columns: int = 4) -> np.ndarray:
    """Pictures N×3×h×w in rows of `columns`, as one picture uint8 H×W×3; empty places are white."""
    pixels = codes_from_srgb(pictures).permute(0, 2, 3, 1).cpu().numpy()
    rows = -(-len(pixels) // columns)
    count, height, width, _ = pixels.shape
    blank = np.full((rows * columns - count, height, width, 3), 255, np.uint8)
    grid = np.concatenate([pixels, blank]).reshape(rows, columns, height, width, 3)
    return grid.swapaxes(1, 2).reshape(rows * height, columns * width, 3)
