"""ONNX operators that slice, join and reshape, written with torch; see onnx_operators.py for the table and its rules.

In: data before `/`, sizes and axes after it, as an attribute's list or as a tensor. Out: tensors. Sizes must follow
from sizes and constants alone, since tensors without memory have no values.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from patchproof.networks.bounds import MAX_DIMENSIONS

MAX_SIZES = 64  # numbers on the CPU in one value: an outer product of three such values has 262 thousand


def numbers(values: Any) -> list[Any]:
    """A list of sizes, axes or factors; empty if they are omitted."""
    if isinstance(values, Tensor):
        if values.is_meta:
            raise ValueError("sizes in it depend on the pictures' content, or on a list that is too long")
        return values.reshape(-1).tolist()
    return values or []


def reshape(x, /, shape, *, allowzero=0):
    """Reshape; a zero keeps the size of that dimension unless `allowzero`."""
    return x.reshape([size if size or allowzero else x.shape[i] for i, size in enumerate(numbers(shape))])


def unsqueeze(x, /, axes):
    """Insert dimensions of size 1; `axes` count in the result."""
    positions = numbers(axes)
    if x.dim() + len(positions) > MAX_DIMENSIONS:
        raise ValueError(f"a tensor of more than {MAX_DIMENSIONS} dimensions")
    for position in sorted(axis % (x.dim() + len(positions)) for axis in positions):
        x = x.unsqueeze(position)
    return x


def split(x, /, split=None, *, axis=0, num_outputs=None):
    """Split into parts of the sizes in `split`, or into `num_outputs` equal ones."""
    return x.split(numbers(split) or math.ceil(x.shape[axis] / num_outputs), axis)


def slice_along(x, /, starts, ends, axes=None, steps=None):
    """Slice along some axes, as Python does, also backward."""
    starts, ends = numbers(starts), numbers(ends)
    axes, steps = numbers(axes) or range(len(starts)), numbers(steps) or [1] * len(starts)
    for axis, start, end, step in zip(axes, starts, ends, steps, strict=True):
        indices = range(*slice(start, end, step).indices(x.shape[axis]))
        forward = indices if step > 0 else indices[::-1]
        selection = slice(forward.start, forward.stop, forward.step) if indices else slice(0, 0)
        x = x[(*[slice(None)] * (axis % x.dim()), selection)]
        x = x if step > 0 else x.flip(axis)
    return x


def gather(x, indices, /, *, axis=0):
    """Pick entries along an axis by indices of any shape."""
    axis = axis % x.dim()
    positions = torch.where(indices < 0, indices + x.shape[axis], indices)
    return x.index_select(axis, positions.reshape(-1)).reshape(x.shape[:axis] + indices.shape + x.shape[axis + 1 :])


def scatter_nd(x, indices, updates, /):
    """Put `updates` in the places that `indices` name."""
    return x.index_put(tuple(indices.unbind(-1)), updates)


def pad(x, /, pads, value=None, axes=None, *, mode="constant"):
    """Pad both ends of each axis; a negative number crops."""
    pads, listed_axes = numbers(pads), numbers(axes) or range(x.dim())
    sides = [(0, 0)] * x.dim()
    for axis, *side in zip(listed_axes, pads[: len(listed_axes)], pads[len(listed_axes) :], strict=True):
        sides[axis] = (side[0], side[1])
    first = next((axis for axis, side in enumerate(sides) if any(side)), x.dim())
    kind = {"constant": "constant", "reflect": "reflect", "edge": "replicate"}[mode]
    return F.pad(x, in_torchs_order(sides[first:]), kind, *(numbers(value) if kind == "constant" else []))


def in_torchs_order(sides: list[tuple[int, int]]) -> list[int]:
    """Flatten paddings (before, after) of each dimension, the last dimension first."""
    return [pad for side in reversed(sides) for pad in side]


def arange(start, limit, delta, *, device):
    """torch.arange(start, limit, delta)."""
    first, end, step = (numbers(number)[0] for number in (start, limit, delta))
    is_short = math.ceil((end - first) / step) <= MAX_SIZES
    return torch.arange(first, end, step, dtype=start.dtype, device="cpu" if is_short else device)


_PIXEL_GRIDS = ("half_pixel", "pytorch_half_pixel", "align_corners")
_RESIZED = {
    ("nearest", "asymmetric", "floor"): "nearest",
    **{("nearest", "half_pixel", f"round_prefer_{end}"): "nearest-exact" for end in ("floor", "ceil")},
    **{("linear", grid): "bilinear" for grid in _PIXEL_GRIDS},
    **{("cubic", grid): "bicubic" for grid in _PIXEL_GRIDS},
}


def resize(
    x, /, roi=None, scales=None, sizes=None, *, mode="nearest", coordinate_transformation_mode="half_pixel",
    nearest_mode="round_prefer_floor"
):  # fmt: skip
    """Resize pictures by factors or sizes for all four dimensions; refused where torch would take the other one of two
    equally near pixels, or another place for a result of one pixel.
    """
    corners = coordinate_transformation_mode
    kind = _RESIZED.get((mode, corners, nearest_mode) if mode == "nearest" else (mode, corners))
    factors, target = numbers(scales), numbers(sizes)
    keeps_batch = factors[:2] == [1, 1] if factors else target[:2] == list(x.shape[:2])
    after = target[2:] or [int(size * factor) for size, factor in zip(x.shape[2:], factors[2:], strict=True)]
    ratios = factors[2:] or [new / old for new, old in zip(after, x.shape[2:], strict=True)]
    lone = any(new == 1 < old for new, old in zip(after, x.shape[2:], strict=True))
    differs = corners == "pytorch_half_pixel" and lone
    if mode == "nearest":
        differs = nearest_mode == "round_prefer_floor" and any(ratio % 1 for ratio in ratios)
    if kind is None or not keeps_batch or differs:
        raise ValueError(f"a Resize of an unsupported kind ({mode}, {corners})")
    options: dict[str, Any] = {} if mode == "nearest" else {"align_corners": corners == "align_corners"}
    return F.interpolate(x, target[2:] or None, factors[2:] or None, kind, **options)
