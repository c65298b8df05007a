"""A program's graph, computed one operator after the other.

In: weights, steps and the sizes of the input, as onnx_file.py reads them. Out: a Program, N×3×S×S →
N×K. Values have numbers and no names; the only functions called are the operators of the steps. Before pictures of a
new shape are computed, the steps of a file are tried on tensors without memory: there a value of absurd size, a wrong
input are refused.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from patchproof.networks.bounds import MAX_DIMENSIONS, quote
from patchproof.networks.rewrites import rewrite_steps
from patchproof.networks.steps import InputDevice, Step, ValueRef
from patchproof.networks.tensor_observer import TensorObserver

MAX_VALUE = 1 << 30  # numbers in one value, for each picture: VGG's at the largest input_px
MAX_SPLIT = 1 << 16  # along a dimension of what is split into several tensors


class Program(torch.nn.Module):
    """The graph as a function of pictures; weights are buffers, so that they move with the module. One without `sizes`
    is of the user's own code, of which nothing is tried.
    """

    def __init__(self, weights: list[Tensor], steps: list[Step], output: int, sizes: list[int | None] | None):
        super().__init__()
        for number, weight in enumerate(weights):
            self.register_buffer(f"w{number}", weight)
        self.steps, self.output, self.sizes = rewrite_steps(steps, weights), output, sizes
        self.photos = len(weights)  # the number of the pictures, after those of the weights
        self.weighed: set[tuple[torch.Size, int]] = set()

    def forward(self, photos: Tensor) -> Tensor:
        """N×3×S×S → N×K."""
        return self.first(len(self.steps), photos)[self.output]

    def first(self, count: int, photos: Tensor) -> dict[int, Any]:
        """The values that so many steps leave of pictures; of a part of them, pictures may be of another size."""
        self.weigh(count, photos.shape)
        values = self.values(self.photos, photos)
        compute(self.steps[:count], values, photos)
        return values

    def values(self, number: int, value: Tensor) -> dict[int, Any]:
        """The weights, and what has been computed of pictures: the value with that number."""
        return dict(enumerate(self.buffers())) | {number: value}

    def weigh(self, count: int, shape: torch.Size) -> None:
        """Refuse, before memory is taken, pictures of other sizes and values of absurd ones in so many steps."""
        if self.sizes is None or (shape, count) in self.weighed:
            return
        other = any(size not in (None, got) for size, got in zip(self.sizes, shape, strict=True))
        if other and count == len(self.steps):
            raise ValueError(f"it takes {'×'.join(str(size or 'N') for size in self.sizes)}")
        with torch.inference_mode(False), torch.no_grad():
            weights = [weight.to("meta") for weight in self.buffers()]
            photos = torch.empty(shape, device="meta")
            with TensorObserver(partial(_refuse_absurd, MAX_VALUE * len(photos)), _WEIGHED):
                compute(self.steps[:count], dict(enumerate([*weights, photos])), photos)
        self.weighed.add((shape, count))


def compute(steps: Sequence[Step], values: dict[int, Any], like: Tensor) -> None:
    """Put the steps' results among the values that they name, on the device of `like`; drop what is spent."""
    for step in steps:
        arguments = [_filled(argument, values, like) for argument in step.arguments]
        keywords = {name: _filled(argument, values, like) for name, argument in step.keywords.items()}
        if step.several and like.is_meta:
            tensors = [argument for argument in arguments if isinstance(argument, Tensor)]
            if any(size > MAX_SPLIT for tensor in tensors for size in tensor.shape):
                raise ValueError("it splits a tensor of an absurd size")
        results = step.compute(*arguments, **keywords)
        for number, result in zip(step.results, results if step.several else [results], strict=True):
            values[number] = result
        for number in step.spent:  # memory is used again while it is in the cache
            del values[number]


def _like_first(compute: Callable[..., Any]) -> Callable[..., Any]:
    """`compute` where its result has the shape of its first argument."""

    def weighed(first: Any, *others: Any, **keywords: Any) -> Any:
        tensors = [first, *(other for other in others if isinstance(other, Tensor))]
        if all(isinstance(tensor, Tensor) and tensor.dtype == torch.float32 for tensor in tensors):
            if np.broadcast_shapes(*(tensor.shape for tensor in tensors)) == first.shape:
                return first.new_empty_strided(first.shape, first.stride())
        return compute(first, *others, **keywords)

    return weighed


def _convolution(photos: Tensor, weight: Tensor, bias, stride, pad, apart, transposed: bool, *others: Any) -> Tensor:
    """Sizes by the formula of torch.nn.Conv2d's documentation."""
    sizes = (photos.shape[2:], weight.shape[2:], stride, pad, apart)
    if transposed or not all(len(pair) == 2 for pair in sizes):
        return _ATEN.convolution.default(photos, weight, bias, stride, pad, apart, transposed, *others)
    pairs = zip(*sizes, strict=True)
    rows, columns = ((size + 2 * p - a * (kernel - 1) - 1) // s + 1 for size, kernel, s, p, a in pairs)
    return photos.new_empty(photos.shape[0], weight.shape[0], rows, columns)


def _mean(values: Tensor, over: list[int] | None, keep: bool = False, **_: Any) -> Tensor:
    gone = {dimension % values.dim() for dimension in over or range(values.dim())}
    sizes = (1 if at in gone else size for at, size in enumerate(values.shape) if keep or at not in gone)
    return values.new_empty(tuple(sizes))


# On tensors without memory torch computes these in Python, for which it imports its compiler and SymPy: two seconds.
_ATEN = torch.ops.aten
_PLAIN = (
    *(operator.Tensor for operator in (_ATEN.add, _ATEN.sub, _ATEN.mul, _ATEN.div)),
    *(operator.default for operator in (_ATEN.relu, _ATEN.relu_, _ATEN.hardtanh, _ATEN.hardtanh_, _ATEN.hardswish)),
)
_WEIGHED: dict[Callable[..., Any], Callable[..., Any]] = {
    **{operator: _like_first(operator) for operator in _PLAIN},
    _ATEN.convolution.default: _convolution,
    _ATEN.mean.dim: _mean,
}


def _filled(argument: Any, values: dict[int, Any], photos: Tensor) -> Any:
    """An argument with the values that it names."""
    if type(argument) is ValueRef:
        return values[argument.number]
    if type(argument) is list:
        return [_filled(item, values, photos) for item in argument]
    return photos.device if argument is InputDevice else argument


def _refuse_absurd(limit: int, tensor: Tensor) -> None:
    """Also what an operator makes on its way (einsum, paddings)."""
    if tensor.numel() > limit or tensor.dim() > MAX_DIMENSIONS:
        raise ValueError(f"it makes a tensor of an absurd size, {quote(tuple(tensor.shape))}")
