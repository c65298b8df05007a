"""Coarse to fine: a gradient pyramid, with which a step moves large parts of a design as readily as single pixels.

In: the gradient at a picture C×H×W, and a mask of the pixels that may change. Out: its means over blocks of 1, 2, 4 …
pixels, each level of which the optimizer scales on its own, and the sum of the scaled levels as one update. The
gradient of a pixel is mostly that of the few views it was drawn from; the mean over a block shares it with every view,
so that color and large shapes, which count in small and blurred views, come first. Laplacian pyramid normalization of
DeepDream (Mordvintsev et al., TensorFlow tutorial, 2015) scales levels likewise, by their spread instead of Adam's.
"""

import math
from collections.abc import Sequence

from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

MIN_COARSEST_BLOCKS = 8  # blocks along the shorter side of the coarsest level


def build_pyramid(gradient: Tensor, mask: Tensor | None = None) -> tuple[Tensor, ...]:
    """C×H×W → C×⌈H/2ˡ⌉×⌈W/2ˡ⌉ for l = 0, 1, …: means over the pixels of a block that lie in picture and mask.

    `mask` is H×W, 1 where the picture may change; the gradient is 0 elsewhere.
    """
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
