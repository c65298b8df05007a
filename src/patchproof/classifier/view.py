"""What a classifier sees of a photograph: the centered square at the network's size.

One function for training, promise, reprint and verification, so that none of them sees anything else. Antialiased
bilinear resampling, as Pillow does it: each output pixel averages its whole footprint, so a large photograph does not
alias; differentiable, so that gradients reach the patch.
"""

from __future__ import annotations

import torch
from torch import Tensor


def center_square(photos_srgb: Tensor, size_px: int) -> Tensor:
    """N×3×H×W in any range → N×3×S×S, unchanged where it has that size; an odd pixel is lost on the right or below."""
    height, width = photos_srgb.shape[-2:]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    square = photos_srgb[..., top : top + side, left : left + side]
    if side == size_px:
        return square
    size = (size_px, size_px)
    return torch.nn.functional.interpolate(square, size, mode="bilinear", align_corners=False, antialias=True)
