"""Convert between designs as tensors and designs as 8-bit pixels."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from patchproof.base.color import codes_from_srgb

_COLUMNS, _CAPTION_PX = 4, 13


def as_pixels(design_srgb: Tensor) -> np.ndarray:
    """A picture 3×h×w in [0, 1] as uint8 h×w×3."""
    return codes_from_srgb(design_srgb.detach()).permute(1, 2, 0).cpu().numpy()


def from_pixels(pixels: np.ndarray, device: torch.device | str = "cpu") -> Tensor:
    """uint8 h×w×3 as 3×h×w in [0, 1]."""
    return torch.tensor(pixels, dtype=torch.float32, device=device).permute(2, 0, 1) / 255


def side_by_side(pictures: Tensor, captions: Sequence[str]) -> np.ndarray:
    """Pictures N×3×h×w over their captions in rows of four, as one picture uint8 H×W×3; empty places are white."""
    from PIL import Image, ImageDraw

    pixels = codes_from_srgb(pictures).permute(0, 2, 3, 1).cpu().numpy()
    rows, (count, height, width) = -(-len(pixels) // _COLUMNS), pixels.shape[:3]
    height += _CAPTION_PX
    grid = np.full((rows * _COLUMNS, height, width, 3), 255, np.uint8)
    grid[:count, :-_CAPTION_PX] = pixels
    grid = grid.reshape(rows, _COLUMNS, height, width, 3)
    page = Image.fromarray(grid.swapaxes(1, 2).reshape(rows * height, _COLUMNS * width, 3))
    for i, caption in enumerate(captions):
        at = i % _COLUMNS * width + 3, (i // _COLUMNS + 1) * height - _CAPTION_PX + 1
        ImageDraw.Draw(page).text(at, caption.encode("latin-1", "replace").decode("latin-1"), fill="black")
    return np.asarray(page)
