"""Coarse to fine: a step that moves large parts of a design as readily as single pixels.

In: the gradient at a design C×h×w. Out: its means over blocks of 1, 2, 4 … pixels, each of which the optimizer scales
on its own, and the sum of the scaled levels as one update. The gradient of a pixel is mostly that of the few views it
was drawn from; the mean over a block shares it with every view, so that color and large shapes, which count in small
and blurred views, come first. Laplacian pyramid normalization of DeepDream (Mordvintsev et al., TensorFlow tutorial,
2015) scales levels likewise, by their spread instead of Adam's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

LEVELS = 5
_FEWEST = 4  # blocks along the shorter side of the coarsest level


def levels(gradient: Tensor) -> tuple[Tensor, ...]:
    """C×h×w → C×⌈h/2ˡ⌉×⌈w/2ˡ⌉ for l = 0, 1, …: means over blocks of 2ˡ pixels, of what there is of them at the edge."""
    shorter = min(gradient.shape[1:])
    count = min(LEVELS, 1 + max(0, int(math.log2(max(shorter, 1) / _FEWEST)))) if shorter > _FEWEST else 1
    pooled = (avg_pool2d(gradient[None], 2**level, ceil_mode=True)[0] for level in range(1, count))
    return (gradient, *pooled)


def joined(updates: Sequence[Tensor]) -> Tensor:
    """The levels' sum at the finest's size; divided by √count, so that independent levels add up to one step."""
    finest, total = updates[0], updates[0]
    for level, update in enumerate(updates[1:], 1):
        large = interpolate(update[None], scale_factor=2**level, mode="bilinear", align_corners=False)[0]
        total = total + large[:, : finest.shape[1], : finest.shape[2]]
    return total / math.sqrt(len(updates))
