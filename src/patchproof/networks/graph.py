"""A network's graph, computed one operator after the other.

In: weights, numbered steps and the sizes of the input, as onnx_file.py reads them from a file or tracing.py from a
module. Out: a Program, N×3×S×S → N×K. Values have numbers and no names; the only functions called are the operators of
the steps. Before pictures of a new shape are computed, a file's steps run once on tensors without memory, to refuse
values of absurd size and wrong inputs. Activations overwrite their input where nothing else needs it.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from patchproof.networks.bounds import MAX_DIMENSIONS, quote

_ATEN = torch.ops.aten
MAX_VALUE = 1 << 30  # numbers in one value, for each picture: VGG's at the largest input_px
MAX_VALUES = 1 << 32  # numbers in all values, for each picture, which are 17 GB
MAX_PRODUCTS = 1 << 35  # in one operator, for each picture: 18 times as many as VGG's largest has at 224 px
MAX_SPLIT = 1 << 16  # size of a dimension that is split into several tensors


@dataclass(frozen=True)
class ValueRef:
    """An argument that stands for the value with this number."""

    number: int


class InputDevice:
    """As an argument, the class itself stands for the device that the pictures are on."""


@dataclass(frozen=True)
class Step:
    """One operator, the numbers of its results, and the values that no later step needs."""

    compute: Callable[..., Any]
    arguments: list[Any]
    keywords: dict[str, Any]
    results: list[int]
    returns_sequence: bool  # of several tensors
    last_uses: list[int] = field(default_factory=list)


def mark_last_uses(steps: list[Step], outputs: set[int]) -> None:
    """Write into each step's `last_uses` the values that no later step needs."""
    needed = set(outputs)
    for step in reversed(steps):
        used = {*step.results, *value_numbers(step.arguments), *value_numbers(step.keywords.values())}
        step.last_uses.extend(used - needed)
        needed |= used


def value_numbers(arguments: Iterable[Any]) -> Iterator[int]:
    """The numbers of the values that arguments refer to."""
    for argument in arguments:
        if type(argument) is ValueRef:
            yield argument.number
        elif type(argument) is list:
            yield from value_numbers(argument)


class Program(torch.nn.Module):
    """A graph as a function of pictures, with weights as buffers. Without `sizes` (a user's code) it is not dry-run."""

    def __init__(self, weights: list[Tensor], steps: list[Step], output: int, sizes: list[int | None] | None):
        super().__init__()
        for number, weight in enumerate(weights):
            self.register_buffer(f"w{number}", weight)
        self.steps, self.output, self.sizes = _activate_in_place(steps), output, sizes
        self.photos = len(weights)  # the number of the pictures, after those of the weights
        self.tested: set[tuple[torch.Size, int]] = set()

    def forward(self, photos: Tensor) -> Tensor:
        """N×3×S×S → N×K."""
        return self.first(len(self.steps), photos)[self.output]

    def first(self, count: int, photos: Tensor) -> dict[int, Any]:
        """The values that remain after the first `count` steps; short of all steps, pictures may have another size."""
        self.dry_run(count, photos.shape)
        values = self.values(self.photos, photos)
        compute(self.steps[:count], values, photos)
        return values

    def values(self, number: int, value: Tensor) -> dict[int, Any]:
        """The weights by number, and one value that was computed from pictures."""
        return dict(enumerate(self.buffers())) | {number: value}

    def dry_run(self, count: int, shape: torch.Size) -> None:
        """Refuse pictures of wrong size, and absurdly large values in the first `count` steps, before they exist."""
        if self.sizes is None or (shape, count) in self.tested:
            return
        differs = any(size not in (None, got) for size, got in zip(self.sizes, shape, strict=True))
        if differs and count == len(self.steps):
            raise ValueError(f"it takes {'×'.join(str(size or 'N') for size in self.sizes)}")
        with torch.inference_mode(False), torch.no_grad():
            weights = [weight.to("meta") for weight in self.buffers()]
            photos = torch.empty(shape, device="meta")
            with TensorObserver(_WorkCount(len(photos)), _SHAPE_ONLY):
                compute(self.steps[:count], dict(enumerate([*weights, photos])), photos)
        self.tested.add((shape, count))


def compute(steps: Sequence[Step], values: dict[int, Any], like: Tensor) -> None:
    """Add the steps' results to `values`, on the device of `like`; delete each value after its last use."""
    for step in steps:
        arguments = [_filled(argument, values, like) for argument in step.arguments]
        keywords = {name: _filled(argument, values, like) for name, argument in step.keywords.items()}
        if step.returns_sequence and like.is_meta:
            tensors = [argument for argument in arguments if isinstance(argument, Tensor)]
            if any(size > MAX_SPLIT for tensor in tensors for size in tensor.shape):
                raise ValueError("it splits a tensor of an absurd size")
        results = step.compute(*arguments, **keywords)
        for number, result in zip(step.results, results if step.returns_sequence else [results], strict=True):
            values[number] = result
        for number in step.last_uses:  # so that memory is reused while it is in the cache
            del values[number]


def _activate_in_place(steps: list[Step]) -> list[Step]:
    """Let an activation overwrite an input that nothing else needs: MobileNetV2 answers in 67 instead of 75 ms."""
    uses = Counter(number for step in steps for number in value_numbers([*step.arguments, *step.keywords.values()]))
    free = {number for step in steps if step.compute in _ALLOCATING for number in step.results if uses[number] == 1}
    return [
        replace(step, compute=_IN_PLACE[step.compute])
        if step.compute in _IN_PLACE
        and free.issuperset(value_numbers(step.arguments[:1]))
        and free & set(step.last_uses)
        else step
        for step in steps
    ]


class _Clamp(torch.autograd.Function):
    """`hardtanh_` with a gradient that needs its result only; torch's own keeps a copy of the input."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, low: float, high: float) -> Tensor:
        """Clamp the tensor in place."""
        ctx.mark_dirty(values)
        clamped = _ATEN.hardtanh_.default(values, low, high)
        ctx.save_for_backward(clamped)
        ctx.limits = low, high
        return clamped

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:  # type: ignore[override]
        """Pass the gradient where a value lies between the limits, where clamping changed nothing."""
        (clamped,) = ctx.saved_tensors
        return _ATEN.hardtanh_backward.default(gradient, clamped, *ctx.limits), None, None


def _hardtanh_(values: Tensor, low: float = -1, high: float = 1) -> Tensor:
    with_gradient = values.requires_grad and torch.is_grad_enabled()
    return (_Clamp.apply if with_gradient else _ATEN.hardtanh_.default)(values, low, high)


# operators whose gradient needs their result only, and in-place forms of them
_IN_PLACE: dict[Any, Callable[..., Any]] = {_ATEN.relu.default: _ATEN.relu_.default, _ATEN.hardtanh.default: _hardtanh_}
# operators that allocate their result and do not need it for their own gradient
_ALLOCATING = {_ATEN.convolution.default, _ATEN.add.Tensor}


def _shape_of_first(compute: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap `compute`: on tensors without memory it computes nothing if the result has the first argument's shape."""

    def result_shape(first: Any, *others: Any, **keywords: Any) -> Any:
        tensors = [first, *(other for other in others if isinstance(other, Tensor))]
        if all(isinstance(tensor, Tensor) and tensor.is_meta and tensor.dtype == torch.float32 for tensor in tensors):
            if np.broadcast_shapes(*(tensor.shape for tensor in tensors)) == first.shape:
                return first.new_empty_strided(first.shape, first.stride())
        return compute(first, *others, **keywords)

    return result_shape


def _convolution(photos: Tensor, weight: Tensor, bias, stride, pad, dilation, transposed: bool, *others: Any) -> Tensor:
    """An empty result with sizes by the formula of torch.nn.Conv2d's documentation."""
    sizes = (photos.shape[2:], weight.shape[2:], stride, pad, dilation)
    if transposed or not all(len(pair) == 2 for pair in sizes):
        return _ATEN.convolution.default(photos, weight, bias, stride, pad, dilation, transposed, *others)
    pairs = zip(*sizes, strict=True)
    rows, columns = ((size + 2 * p - a * (kernel - 1) - 1) // s + 1 for size, kernel, s, p, a in pairs)
    return photos.new_empty(photos.shape[0], weight.shape[0], rows, columns)


def _mean(values: Tensor, dims: list[int] | None, keep: bool = False, **_: Any) -> Tensor:
    reduced = {dimension % values.dim() for dimension in dims or range(values.dim())}
    sizes = (1 if axis in reduced else size for axis, size in enumerate(values.shape) if keep or axis not in reduced)
    return values.new_empty(tuple(sizes))


# For tensors without memory torch computes these in Python and imports its compiler and SymPy: two seconds.
_ELEMENTWISE = (
    *(operator.Tensor for operator in (_ATEN.add, _ATEN.sub, _ATEN.mul, _ATEN.div)),
    *(operator.default for operator in (_ATEN.relu, _ATEN.relu_, _ATEN.hardtanh, _ATEN.hardtanh_, _ATEN.hardswish)),
)
_POOLS = (_ATEN.max_pool2d_with_indices, _ATEN.avg_pool2d)
_SHAPE_ONLY: dict[Callable[..., Any], Callable[..., Any]] = {
    **{operator: _shape_of_first(operator) for operator in _ELEMENTWISE},
    _ATEN.convolution.default: _convolution,
    _ATEN.mean.dim: _mean,
}


def _filled(argument: Any, values: dict[int, Any], photos: Tensor) -> Any:
    """The argument with values in place of their numbers."""
    if type(argument) is ValueRef:
        return values[argument.number]
    if type(argument) is list:
        return [_filled(item, values, photos) for item in argument]
    return photos.device if argument is InputDevice else argument


class _WorkCount:
    """Refuses absurd sizes: of a tensor, of an operator's sum of products, and of all tensors together."""

    def __init__(self, pictures: int):
        self.pictures, self.numbers = pictures, 0

    def __call__(self, tensor: Tensor, operator: Any, arguments: tuple) -> None:
        if tensor.numel() > MAX_VALUE * self.pictures or tensor.dim() > MAX_DIMENSIONS:
            raise ValueError(f"it makes a tensor of an absurd size, {quote(tuple(tensor.shape))}")
        self.numbers += tensor.numel()
        terms = _TERMS[operator](*arguments) if operator in _TERMS else 1
        if self.numbers > MAX_VALUES * self.pictures or tensor.numel() * terms > MAX_PRODUCTS * self.pictures:
            raise ValueError(f"it asks for too many computations, with {quote(operator)} of {tuple(tensor.shape)}")


# how many numbers are added up for each number of a result
_TERMS: dict[Any, Callable[..., int]] = {
    **{operator.default: lambda a, *_: a.shape[-1] for operator in (_ATEN.mm, _ATEN.bmm)},
    **{operator.default: lambda _, a, *__: a.shape[-1] for operator in (_ATEN.addmm, _ATEN.baddbmm)},
    **{operator.default: lambda _, kernel, *__: math.prod(kernel) for operator in _POOLS},
    _ATEN.convolution.default: lambda _, weight, *others: weight[:, 0].numel() if others[4] else weight[0].numel(),
}


class TensorObserver(TorchDispatchMode):
    """A context that calls `look(tensor, operator, arguments)` for each tensor that operators (or `instead`) create."""

    def __init__(
        self, look: Callable[[Tensor, Any, tuple], None], instead: Mapping[Any, Callable[..., Any]] | None = None
    ):
        super().__init__()
        self._look, self._instead = look, instead or {}

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """Answer without torch's own check, which would import its compiler; nothing here is compiled."""
        return False

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        compute: Any = self._instead.get(func, func)
        results = compute(*args, **(kwargs or {}))
        for value in results if isinstance(results, (list, tuple)) else [results]:
            if isinstance(value, Tensor):
                self._look(value, func, args)
        return results
