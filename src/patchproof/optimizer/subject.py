"""The common part of subjects of optimization: a printed design (`patch.Patch`), the object's texture
(`texture.Texture`).

A subject gives the first design, the allowed designs, their penalty and appearance, and the files that a run stores. A
design is a float tensor 3×h×w in [0, 1], its `pixels` are uint8 h×w×3.

The gradient's pyramid moves large parts of a design as readily as single pixels: the optimizer scales each of its
levels, means over blocks of 1, 2, 4 … pixels, on its own, and adds them, so that color and large shapes, which count in
small and blurred views, come first. Laplacian pyramid normalization of DeepDream (Mordvintsev et al., TensorFlow
tutorial, 2015) scales levels likewise, by their spread instead of Adam's.

The loss is the cross-entropy of the *summed* probability of all accepted labels, the quantity that is reported as
confidence; for `deceive`, of its complement. The paper's printed update Θ + α∇L raises the loss (Pestana et al.,
Algorithm 1); recognition needs the descent done here. TV: Mahendran and Vedaldi, CVPR 2015.
"""

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from patchproof.base.color import codes_from_srgb
from patchproof.base.goal import Goal
from patchproof.base.input import open_image
from patchproof.classifier.network import Odds

DESIGN_FILE, OBJECT_FILE, TEXTURE_FILES, MASK_FILE = "design.png", "object.glb", "texture_*.png", "mask.png"
DESIGN_FILES = DESIGN_FILE, OBJECT_FILE, TEXTURE_FILES, MASK_FILE
MIN_COARSEST_BLOCKS = 8  # blocks along the shorter side of the coarsest level
_COLUMNS, _CAPTION_PX = 4, 13  # of pictures side by side
Loss = Callable[[Tensor, Sequence[int]], Tensor]  # (logits N×K, label indices) -> N losses to descend on


def read_png(path: Path, max_side_px: int = 1 << 16) -> np.ndarray:
    """uint8 H×W×3 of a picture file that a run wrote."""
    with open_image(path, "a picture of this run", "optimize again") as image:
        if max(image.size) > max_side_px:
            raise ValueError(f"{image.width} × {image.height} pixels, more than {max_side_px} along a side")
        return np.asarray(image.convert("RGB"))


def as_pixels(design_srgb: Tensor) -> np.ndarray:
    """A picture 3×h×w in [0, 1] as uint8 h×w×3."""
    return codes_from_srgb(design_srgb.detach()).permute(1, 2, 0).cpu().numpy()


def from_pixels(pixels: np.ndarray, device: torch.device | str = "cpu") -> Tensor:
    """uint8 h×w×3 as 3×h×w in [0, 1]."""
    return torch.tensor(pixels, dtype=torch.float32, device=device).permute(2, 0, 1) / 255


def side_by_side(pictures: Tensor, captions: Sequence[str]) -> np.ndarray:
    """Pictures N×3×h×w over their captions in rows of four, as one picture uint8 H×W×3; empty places are white."""
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


def build_pyramid(gradient: Tensor, mask: Tensor | None = None) -> tuple[Tensor, ...]:
    """C×H×W → C×⌈H/2ˡ⌉×⌈W/2ˡ⌉, l = 0, 1, …: means over a block's pixels in picture and `mask` (H×W; 1: may change)."""
    weights = None if mask is None else mask[None, None].to(gradient)
    pooled = []
    for level in range(1, level_count(gradient.shape[1:])):
        mean = avg_pool2d(gradient[None], 2**level, ceil_mode=True)[0]
        if weights is not None:
            mean = mean / avg_pool2d(weights, 2**level, ceil_mode=True)[0].clamp(min=1e-6)
        pooled.append(mean)
    return (gradient, *pooled)


def level_count(size_px: Sequence[int]) -> int:
    """The number of levels for a picture of that size, the full size included."""
    return 1 + max(0, int(math.log2(max(1, min(size_px)) / MIN_COARSEST_BLOCKS)))


def collapse_pyramid(updates: Sequence[Tensor]) -> Tensor:
    """The levels' sum at the finest's size; divided by √count, so that independent levels add up to one step."""
    finest, total = updates[0], updates[0]
    for level, update in enumerate(updates[1:], 1):
        large = interpolate(update[None], scale_factor=2**level, mode="bilinear", align_corners=False)[0]
        total = total + large[:, : finest.shape[1], : finest.shape[2]]
    return total / math.sqrt(len(updates))


def target_loss(odds: Odds, goal: Goal) -> Tensor:
    """N losses: -log of the confidence (`assist`) or of 1 minus it (`deceive`), in float64 so that none saturates."""
    return -(odds.log_confidence if goal.sign > 0 else odds.log_complement)


def total_variation(design_srgb: Tensor) -> Tensor:
    """Mean absolute difference of neighboring pixels of a 3×h×w design."""
    across = (design_srgb[:, :, 1:] - design_srgb[:, :, :-1]).abs().mean()
    return across + (design_srgb[:, 1:] - design_srgb[:, :-1]).abs().mean()
