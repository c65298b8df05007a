"""Between designs as tensors and designs as 8-bit pixels."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from patchproof.color import codes_of


def as_pixels(design_srgb: Tensor) -> np.ndarray:
    """A picture 3×h×w in [0, 1] as uint8 h×w×3."""
    return codes_of(design_srgb.detach()).permute(1, 2, 0).cpu().numpy()


def from_pixels(pixels: np.ndarray, device: torch.device | str = "cpu") -> Tensor:
    """uint8 h×w×3 as 3×h×w in [0, 1]."""
    return torch.tensor(pixels, dtype=torch.float32, device=device).permute(2, 0, 1) / 255
