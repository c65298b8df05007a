"""ONNX operators that slice, join and reshape, written with torch; see onnx_operators.py for the table and its rules.

In: data before `/`, sizes and axes after it, as an attribute's list or as a tensor. Out: tensors. Sizes must follow
from sizes and constants alone, since tensors without memory have no values.
"""

import math
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from patchproof.networks.bounds import MAX_DIMENSIONS

Sides = list[tuple[int, int]]  # of each dimension, numbers added before and after
MAX_SIZES = 64  # numbers on the CPU in one value: an outer product of three such values has 262 thousand


def numbers(values: Any) -> list[Any]:
    """A list of sizes, axes or factors; empty if they are omitted."""
    if isinstance(values, Tensor):
        if values.is_meta:
            raise ValueError("sizes in it depend on the pictures' content, or on a list that is too long")
        return values.reshape(-1).tolist()
    return [values] if isinstance(values, float | int) else values or []


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


def gather_nd(x, indices, /, *, batch_dims=0):
    """Pick what the last dimension of `indices` points to, behind `batch_dims` dimensions that both have."""
    counted = [torch.arange(size, device=x.device) for size in x.shape[:batch_dims]]
    batch = [each.reshape(-1, *[1] * (indices.dim() - 2 - axis)) for axis, each in enumerate(counted)]
    return x[(*batch, *indices.unbind(-1))]


def gather_elements(x, indices, /, *, axis=0):
    """Pick one number for each index, at the index's own place on the other axes."""
    return x.gather(axis, torch.where(indices < 0, indices + x.shape[axis], indices))


_REDUCTIONS = {"add": "sum", "mul": "prod", "max": "amax", "min": "amin"}  # of scatters, in torch's words


def scatter_elements(x, indices, updates, /, *, axis=0, reduction="none"):
    """Write each update at its index along `axis`, or combine it with the present value."""
    positions = torch.where(indices < 0, indices + x.shape[axis], indices)
    if reduction == "none":
        return x.scatter(axis, positions, updates)
    return x.scatter_reduce(axis, positions, updates, _REDUCTIONS[reduction])


def scatter_nd(x, indices, updates, /, *, reduction="none"):
    """Write `updates` at the positions that `indices` name, or combine them with the present values."""
    places = tuple(indices.unbind(-1))
    if reduction in ("none", "add"):
        return x.index_put(places, updates, accumulate=reduction == "add")
    numbered = torch.arange(math.prod(x.shape[: len(places)]), device=x.device).reshape(x.shape[: len(places)])
    rows, flat = numbered[places].reshape(-1, 1), x.reshape(numbered.numel(), -1)
    updates = updates.reshape(len(rows), -1)
    return flat.scatter_reduce(0, rows.expand_as(updates), updates, _REDUCTIONS[reduction]).reshape(x.shape)


def one_hot(indices, /, depth, values, *, axis=-1, device):
    """The second one of `values` at each index along a new axis, the first one elsewhere."""
    count = int(numbers(depth)[0])
    indices = indices if count <= MAX_SIZES else indices.to(device)
    hot = torch.where(indices < 0, indices + count, indices)[..., None] == torch.arange(count, device=indices.device)
    off, on = values.to(indices.device).unbind()
    return torch.where(hot, on, off).movedim(-1, axis)


def non_zero(x, /):
    """Return the positions of numbers other than zero, for short lists that follow from sizes."""
    if x.device.type != "cpu" or x.numel() > MAX_SIZES:
        raise ValueError("places of numbers that are not zero, which depend on the pictures' content")
    return x.nonzero().T


def depth_to_space(x, /, *, blocksize, mode="DCR"):
    """Move channels into blocks of pixels; the block's pixels come before (DCR) or after the channels that remain."""
    if mode == "CRD":
        return F.pixel_shuffle(x, blocksize)
    n, channels, height, width = x.shape
    blocks = x.reshape(n, blocksize, blocksize, channels // blocksize**2, height, width)
    return blocks.permute(0, 3, 4, 1, 5, 2).reshape(n, -1, height * blocksize, width * blocksize)


def space_to_depth(x, /, *, blocksize):
    """Move blocks of pixels into channels, the block's pixels before the former channels."""
    n, channels, height, width = x.shape
    blocks = x.reshape(n, channels, height // blocksize, blocksize, width // blocksize, blocksize)
    return blocks.permute(0, 3, 5, 1, 2, 4).reshape(n, -1, height // blocksize, width // blocksize)


def pad(x, /, pads, value=None, axes=None, *, mode="constant"):
    """Pad both ends of each axis; a negative number crops."""
    pads, listed_axes = numbers(pads), numbers(axes) or range(x.dim())
    sides = [(0, 0)] * x.dim()
    for axis, *side in zip(listed_axes, pads[: len(listed_axes)], pads[len(listed_axes) :], strict=True):
        sides[axis] = (side[0], side[1])
    if mode == "constant":
        return pad_sides(x, sides, *numbers(value))
    x = pad_sides(x, [(min(before, 0), min(after, 0)) for before, after in sides])
    for axis, side in enumerate(sides):
        before, after = max(side[0], 0), max(side[1], 0)
        if before or after:
            places, last = torch.arange(-before, x.shape[axis] + after, device=x.device), x.shape[axis] - 1
            if mode == "reflect":
                places = last - (places % max(2 * last, 1) - last).abs()
            x = x.index_select(axis, {"edge": places.clamp(0, last), "wrap": places % (last + 1)}.get(mode, places))
    return x


def pad_sides(x: Tensor, sides: Sides, fill: float = 0.0) -> Tensor:
    """Pad the last dimensions with `fill`, or crop them where a number is negative."""
    return F.pad(x, [pad for side in reversed(sides) for pad in side], value=fill) if any(map(any, sides)) else x


def arange(start, limit, delta, *, device):
    """torch.arange(start, limit, delta)."""
    first, end, step = (numbers(number)[0] for number in (start, limit, delta))
    is_short = math.ceil((end - first) / step) <= MAX_SIZES
    return torch.arange(first, end, step, dtype=start.dtype, device="cpu" if is_short else device)
