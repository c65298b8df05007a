"""A program's graph, computed one operator after the other.

In: weights, steps and the sizes of the input, as description.py read them. Out: a Program, N×3×S×S → N×K. Values have
numbers and no names; the only functions called are the operators of the steps. Before pictures of a new shape are
computed, the steps are tried on tensors without memory: there a value of absurd size, a wrong input and a change of the
weights or of the input are refused.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from patchproof.classifier.archive import MAX_DIMENSIONS, quoted

MAX_VALUE = 1 << 30  # numbers in one value, for each picture: VGG's at the largest input_px
MAX_SPLIT = 1 << 16  # along a dimension of what is split into several tensors


@dataclass(frozen=True)
class Value:
    """In an argument: the value with that number."""

    number: int


class Here:
    """In an argument, the class itself: the device that the pictures are on."""


@dataclass(frozen=True)
class Step:
    """One operator, where its results go, and which values nobody needs afterwards."""

    compute: Callable[..., Any]
    arguments: list[Any]
    keywords: dict[str, Any]
    results: list[int]
    several: bool  # the operator returns a sequence
    spent: list[int]


def mark_spent(steps: list[Step], kept: set[int]) -> None:
    """Write into each step which values it is the last to need."""
    needed = set(kept)
    for step in reversed(steps):
        used = {*step.results, *_numbers(step.arguments), *_numbers(step.keywords.values())}
        step.spent.extend(used - needed)
        needed |= used


def written_over(steps: list[Step]) -> list[Step]:
    """The same steps, where an activation writes over what was made for it alone. Numbers stay the same; fresh memory
    took a tenth of the time of MobileNetV2's answers (75 and 67 ms for four pictures of 224 px on one core, torch 2.13,
    November 2026), none of its gradients'.
    """
    used = Counter(number for step in steps for number in _numbers([*step.arguments, *step.keywords.values()]))
    made = {number for step in steps if step.compute in _MADE_ANEW for number in step.results if used[number] == 1}
    return [
        replace(step, compute=_IN_PLACE[step.compute])
        if step.compute in _IN_PLACE and made.issuperset(_numbers(step.arguments[:1])) and made & set(step.spent)
        else step
        for step in steps
    ]


def padded_within(steps: list[Step]) -> list[Step]:
    """The same steps, where zeros on all sides that only a convolution reads are its own padding: with 13 copies less
    MobileNetV2's answers take 0.92 and its gradients 0.93 of the time, to the bit (as above).
    """
    kept: list[Step] = []
    for step in steps:
        if kept and (padded := _with_padding(step, kept[-1])):
            kept[-1] = padded
        else:
            kept.append(step)
    return kept


def _with_padding(step: Step, pad: Step) -> Step | None:
    """`step` in place of itself and of the step before it; None where they are no convolution of what a pad made."""
    if pad.compute not in _PADS or step.compute not in _CONVOLUTIONS or pad.keywords or step.keywords:
        return None
    (made,), (photos, sides, *filled) = pad.results, pad.arguments
    arguments = [*step.arguments, *_CONVOLUTION_DEFAULTS[len(step.arguments) - 2 :]]
    here, weight, bias, stride, own, *others = arguments
    zeros = all(item in ("constant", None, 0) for item in filled)
    even = all(type(side) is int and side >= 0 for side in [*sides, *own]) and sides[::2] == sides[1::2]
    alone = here == Value(made) and made in step.spent and [*_numbers(arguments)].count(made) == 1
    if not (zeros and even and alone and (len(sides), len(own)) == (4, 2)) or (
        step.compute is _ATEN.convolution.default and others[1]
    ):
        return None
    own = [own[0] + sides[2], own[1] + sides[0]]
    spent = [*pad.spent, *(number for number in step.spent if number != made)]
    return replace(step, arguments=[photos, weight, bias, stride, own, *others], spent=spent)


def _numbers(arguments: Iterable[Any]) -> Iterator[int]:
    for argument in arguments:
        if type(argument) is Value:
            yield argument.number
        elif type(argument) is list:
            yield from _numbers(argument)


class Program(torch.nn.Module):
    """The graph as a function of pictures; weights are buffers, so that they move with the module."""

    def __init__(self, weights: list[Tensor], steps: list[Step], output: int, sizes: list[int | None]):
        super().__init__()
        for number, weight in enumerate(weights):
            self.register_buffer(f"w{number}", weight)
        self.steps, self.output, self.sizes = written_over(padded_within(steps)), output, sizes
        self.weighed: set[torch.Size] = set()

    def forward(self, photos: Tensor) -> Tensor:
        """N×3×S×S → N×K."""
        if photos.shape not in self.weighed:
            self._weigh(photos.shape)
        return self._computed(list(self.buffers()), photos)

    def _computed(self, weights: list[Tensor], photos: Tensor) -> Tensor:
        values: dict[int, Any] = dict(enumerate([*weights, photos]))
        for step in self.steps:
            arguments = [_filled(argument, values, photos) for argument in step.arguments]
            keywords = {name: _filled(argument, values, photos) for name, argument in step.keywords.items()}
            if step.several and photos.is_meta:
                _check_split(arguments)
            results = step.compute(*arguments, **keywords)
            for number, result in zip(step.results, results if step.several else [results], strict=True):
                values[number] = result
            for number in step.spent:  # memory is used again while it is in the cache
                del values[number]
        return values[self.output]

    def _weigh(self, shape: torch.Size) -> None:
        """Refuse, before memory is taken, pictures of other sizes and values of absurd ones."""
        if any(size not in (None, got) for size, got in zip(self.sizes, shape, strict=True)):
            raise ValueError(f"it takes {'×'.join(str(size or 'N') for size in self.sizes)}")
        with torch.inference_mode(False), torch.no_grad():
            weights = [weight.to("meta") for weight in self.buffers()]
            photos = torch.empty(shape, device="meta")
            with _Watched(MAX_VALUE * len(photos)):
                self._computed(weights, photos)
        if any(tensor._version for tensor in [*weights, photos]):
            raise ValueError("it changes its weights or its input")
        self.weighed.add(shape)


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
# their gradients need what they made, not what they got; and those who make it do not need it
_IN_PLACE = {getattr(_ATEN, name).default: getattr(_ATEN, f"{name}_").default for name in ("relu", "relu6", "hardtanh")}
_MADE_ANEW = {_ATEN.conv2d.default, _ATEN.conv2d.padding, _ATEN.batch_norm.default, _ATEN.add.Tensor}
_PADS = (_ATEN.pad.default, _ATEN.constant_pad_nd.default)
_CONVOLUTIONS = (_ATEN.conv2d.default, _ATEN.convolution.default)
_CONVOLUTION_DEFAULTS = [None, [1, 1], [0, 0]]  # bias, stride, padding
_PLAIN = (_ATEN.add, _ATEN.sub, _ATEN.mul, _ATEN.div), (_ATEN.relu, _ATEN.hardtanh, _ATEN.hardswish)
_WEIGHED: dict[Callable[..., Any], Callable[..., Any]] = {
    **{operator.Tensor: _like_first(operator.Tensor) for operator in _PLAIN[0]},
    **{operator.default: _like_first(operator.default) for operator in _PLAIN[1]},
    **{changed: _like_first(changed) for changed in _IN_PLACE.values()},
    _ATEN.convolution.default: _convolution,
    _ATEN.mean.dim: _mean,
}


def _filled(argument: Any, values: dict[int, Any], photos: Tensor) -> Any:
    """An argument with the values that it names."""
    if type(argument) is Value:
        return values[argument.number]
    if type(argument) is list:
        return [_filled(item, values, photos) for item in argument]
    return photos.device if argument is Here else argument


class _Watched(TorchDispatchMode):
    """Refuses tensors of absurd sizes, also those that an operator makes on its way (einsum, paddings)."""

    def __init__(self, limit: int):
        super().__init__()
        self.limit = limit

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """Nothing here is compiled; to be told so, torch would import its compiler."""
        return False

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        compute: Any = _WEIGHED.get(func, func)
        results = compute(*args, **(kwargs or {}))
        for value in results if isinstance(results, (list, tuple)) else [results]:
            if isinstance(value, Tensor) and (value.numel() > self.limit or value.dim() > MAX_DIMENSIONS):
                raise ValueError(f"it makes a tensor of an absurd size, {quoted(tuple(value.shape))}")
        return results


def _check_split(arguments: list[Any]) -> None:
    if any(size > MAX_SPLIT for tensor in arguments if isinstance(tensor, Tensor) for size in tensor.shape):
        raise ValueError("it splits a tensor of an absurd size")
