"""The operators that an ONNX file may use: those of image classifiers, written with torch.

In: a name as the file writes it. Out: a function of tensors, which reads and writes nothing else and draws no random
numbers; a name that is not in the table is refused. In a signature, inputs before `/` are data, inputs after it are
sizes or axes; these and what follows `*` may be attributes of that name. Data are sent to the pictures' device, which
has no memory during the dry run in graph.py; only for the operators in `_ON_SIZES`, whose results are no larger than
their inputs allow, a few numbers stay on the CPU, so that sizes can be computed.
Left out on purpose: control flow, sequences, text, random numbers, quantized and recurrent networks, boxes.

Source: onnx.ai/onnx/operators, opsets 13 to 28; where two differ, both forms are read.
"""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

import patchproof.networks.onnx_shapes as shapes
from patchproof.networks.bounds import UnsupportedNetwork, quote
from patchproof.networks.onnx_shapes import MAX_SIZES, numbers

# the numbers of TensorProto.DataType
_INTEGERS = {2: torch.uint8, 3: torch.int8, 5: torch.int16, 6: torch.int32, 7: torch.int64}
DTYPES = _INTEGERS | {1: torch.float32, 9: torch.bool, 10: torch.float16, 11: torch.float64, 16: torch.bfloat16}
_ON_SIZES = frozenset(
    "Abs Add And Cast Ceil Concat ConstantOfShape Div Equal Expand Floor Gather Greater GreaterOrEqual Less Mod Mul "
    "LessOrEqual Neg Not Or Pow Range Reciprocal ReduceProd Reshape ScatterND Slice Split Sqrt Squeeze Sub Transpose "
    "Unsqueeze Where".split()
)
# attributes that have to have this value, or (None) that change nothing here
FIXED_ATTRIBUTES: dict[str, dict[str, Any]] = {
    "AveragePool": {"dilations": [1, 1]},
    "BatchNormalization": {"training_mode": 0, "momentum": None},
    "Cast": {"saturate": None},  # 8-bit floats
    "Dropout": {"seed": None},
    **{name: {"stash_type": 1} for name in ("GroupNormalization", "LayerNormalization")},
    "MaxPool": {"storage_order": None},  # of the second result
    "Resize": {
        **{"antialias": 0, "cubic_coeff_a": -0.75, "exclude_outside": 0, "keep_aspect_ratio_policy": "stretch"},
        "extrapolation_value": None,  # of crops
    },
    "ScatterND": {"reduction": "none"},
}


class Operator:
    """A line of the table, as a function of the pictures' device and the operator's inputs."""

    def __init__(self, name: str, compute: Callable[..., Any]):
        self.fixed = FIXED_ATTRIBUTES.get(name, {})
        self.compute, self.on_sizes, self.signature = compute, name in _ON_SIZES, inspect.signature(compute)
        kinds = [parameter.kind for parameter in self.signature.parameters.values()]
        variadic = inspect.Parameter.VAR_POSITIONAL in kinds
        self.data = None if variadic else kinds.count(inspect.Parameter.POSITIONAL_ONLY)
        self.needs_device = "device" in self.signature.parameters

    def check(self, inputs: Sequence[Any], attributes: dict[str, Any]) -> None:
        """Raise UnsupportedNetwork for inputs or attributes that the operator does not take; remove fixed ones."""
        if "device" in attributes:
            raise UnsupportedNetwork("an attribute 'device'")
        for name in self.fixed.keys() & attributes.keys():
            if self.fixed[name] is not None and repr(attributes[name]) != repr(self.fixed[name]):
                raise UnsupportedNetwork(f"the attribute {name} = {quote(attributes[name])}")
            del attributes[name]
        try:
            self.signature.bind(*inputs, **attributes, **({"device": None} if self.needs_device else {}))
        except TypeError as error:
            raise UnsupportedNetwork(f"unsupported inputs or attributes ({error})") from error

    def __call__(self, device: torch.device, *inputs: Any, **attributes: Any) -> Any:
        """Return the result, a tensor or a tuple of them; omitted inputs are None."""
        if self.needs_device:
            attributes["device"] = device
        data, rest = inputs[: self.data], inputs[len(inputs) if self.data is None else self.data :]
        if self.on_sizes and all(x is None or (x.device.type == "cpu" and x.numel() <= MAX_SIZES) for x in data):
            result = self.compute(*inputs, **attributes)
            return result.to(device) if isinstance(result, Tensor) and result.numel() > MAX_SIZES else result
        return self.compute(*(x if x is None else x.to(device) for x in data), *rest, **attributes)


# --- windows and products ---


def _pad_unevenly(x: Tensor, pads: list[int] | None, limits: Sequence[float], fill: float) -> tuple[Tensor, list[int]]:
    """The input and the padding left for torch, which pads both ends alike and pools by half a window at most."""
    n = x.dim() - 2
    before, after = list(pads or [0] * n)[:n], list(pads or [0] * n)[-n:]
    if before == after and all(pad <= limit for pad, limit in zip(before, limits, strict=True)):
        return x, before
    return F.pad(x, shapes.in_torchs_order(list(zip(before, after, strict=True))), value=fill), [0] * n


def _check_auto_pad(auto_pad: str, pads: list[int] | None) -> None:
    if auto_pad not in ("NOTSET", "VALID") or (auto_pad == "VALID" and any(pads or [])):
        raise ValueError("paddings that depend on the size (auto_pad)")


def _conv(x, w, b=None, /, *, auto_pad="NOTSET", dilations=None, group=1, kernel_shape=None, pads=None, strides=None):
    _check_auto_pad(auto_pad, pads)
    if kernel_shape not in (None, list(w.shape[2:])):
        raise ValueError(f"weights of {tuple(w.shape)} for kernel_shape = {kernel_shape}")
    ones = [1] * (x.dim() - 2)
    x, padding = _pad_unevenly(x, pads, [math.inf] * len(ones), 0.0)
    return torch.convolution(x, w, b, strides or ones, padding, dilations or ones, False, [0] * len(ones), group)


def _max_pool(x, /, *, kernel_shape, auto_pad="NOTSET", ceil_mode=0, dilations=None, pads=None, strides=None):
    _check_auto_pad(auto_pad, pads)
    pads, strides = pads or [0] * 4, strides or [1, 1]
    if any(pad >= size for pad, size in zip(pads, kernel_shape * 2, strict=True)):
        raise ValueError(f"a MaxPool of kernel_shape = {kernel_shape} with windows in its padding")
    padded, padding = _pad_unevenly(x, pads, [size // 2 for size in kernel_shape], -math.inf)
    pooled = F.max_pool2d(padded, kernel_shape, strides, padding, dilations or [1, 1], bool(ceil_mode))
    if ceil_mode:  # no window begins in the padding at the end, which torch does not know where it was padded above
        ends = [math.ceil((x.shape[2 + i] + pads[i]) / strides[i]) for i in (0, 1)]
        pooled = pooled[..., : ends[0], : ends[1]]
    return pooled


def _average_pool(x, /, *, kernel_shape, auto_pad="NOTSET", ceil_mode=0, count_include_pad=0, pads=None, strides=None):
    _check_auto_pad(auto_pad, pads)
    padded, padding = _pad_unevenly(x, pads, [size // 2 for size in kernel_shape], 0.0)
    if padded is not x and (ceil_mode or not count_include_pad):
        raise ValueError("an AveragePool with different paddings before and after")
    return F.avg_pool2d(padded, kernel_shape, strides or [1, 1], padding, bool(ceil_mode), bool(count_include_pad))


def _gemm(a, b, c=None, /, *, alpha=1.0, beta=1.0, transA=0, transB=0):
    a, b = a.mT if transA else a, b.mT if transB else b
    return alpha * (a @ b) if c is None else torch.addmm(c, a, b, beta=beta, alpha=alpha)


# --- normalization ---


def _group_norm(x, scale, b, /, *, num_groups, epsilon=1e-5):
    repeats = x.shape[1] // len(scale)  # before opset 21, there is one scale for each group
    return F.group_norm(x, num_groups, scale.repeat_interleave(repeats), b.repeat_interleave(repeats), epsilon)


def _dropout(x, /, ratio=None, training_mode=None):
    if any(numbers(training_mode)):
        raise ValueError("a Dropout in training mode")
    return x


# --- activations and arithmetic ---


def _unary(compute: Callable[..., Tensor]) -> Callable[..., Tensor]:
    return lambda x, /: compute(x)


def _binary(compute: Callable[..., Tensor]) -> Callable[..., Tensor]:
    return lambda a, b, /: compute(a, b)


def _variadic(compute: Callable[..., Tensor]) -> Callable[..., Tensor]:
    return lambda *tensors: functools.reduce(compute, tensors)


def _reduction(compute: Callable[..., Tensor], of_one: Callable[..., Tensor] = lambda x: x) -> Callable[..., Tensor]:
    """A sum or an extreme along `axes`, by default along all; `of_one` computes that of each number alone."""

    def computed(x, /, axes=None, *, keepdims=1, noop_with_empty_axes=0):
        dims = numbers(axes)
        if not dims and noop_with_empty_axes:
            return of_one(x)
        return compute(x, dims or list(range(x.dim())), keepdim=bool(keepdims))

    return computed


def _product(x: Tensor, dims: list[int], keepdim: bool) -> Tensor:
    for axis in dims:
        x = x.prod(axis, keepdim=True)
    return x if keepdim else x.squeeze(dims)


_TABLE: dict[str, Callable[..., Any]] = {
    # of one input
    **{name: _unary(getattr(torch, name.lower())) for name in "Abs Ceil Cos Erf Exp Floor Log Neg Reciprocal".split()},
    **{name: _unary(getattr(torch, name.lower())) for name in "IsNaN Relu Sigmoid Sign Sin Sqrt Tanh".split()},
    **{name: _unary(getattr(F, name.lower())) for name in ("HardSwish", "Mish", "Softplus")},
    "Not": _unary(torch.logical_not),
    "GlobalAveragePool": _unary(lambda x: x.mean(tuple(range(2, x.dim())), keepdim=True)),
    "GlobalMaxPool": _unary(lambda x: x.amax(tuple(range(2, x.dim())), keepdim=True)),
    "Elu": lambda x, /, *, alpha=1.0: F.elu(x, alpha),
    "LeakyRelu": lambda x, /, *, alpha=0.01: F.leaky_relu(x, alpha),
    "HardSigmoid": lambda x, /, *, alpha=0.2, beta=0.5: (alpha * x + beta).clamp(0, 1),
    "Gelu": lambda x, /, *, approximate="none": F.gelu(x, approximate=approximate),
    "Softmax": lambda x, /, *, axis=-1: x.softmax(axis),
    "LogSoftmax": lambda x, /, *, axis=-1: x.log_softmax(axis),
    "Cast": lambda x, /, *, to: x.to(DTYPES[to]),
    # of two or more
    **{name: _binary(getattr(torch, name.lower())) for name in "Add Sub Mul MatMul Greater Less".split()},
    **{
        name: _binary(getattr(torch, of))
        for name, of in (("Equal", "eq"), ("GreaterOrEqual", "ge"), ("LessOrEqual", "le"))
    },
    **{name: _binary(getattr(torch, f"logical_{name.lower()}")) for name in ("And", "Or")},
    "Div": _binary(lambda a, b: a / b if a.is_floating_point() else torch.div(a, b, rounding_mode="trunc")),
    "Mod": lambda a, b, /, *, fmod=0: torch.fmod(a, b) if fmod else torch.remainder(a, b),
    "Pow": _binary(lambda x, y: torch.pow(x, y).to(x.dtype)),
    "PRelu": _binary(lambda x, slope: torch.where(x < 0, slope * x, x)),
    "Where": lambda condition, x, y, /: torch.where(condition, x, y),
    "Clip": lambda x, low=None, high=None, /: x if low is None and high is None else torch.clamp(x, low, high),
    **{"Max": _variadic(torch.maximum), "Min": _variadic(torch.minimum), "Sum": _variadic(torch.add)},
    "Gemm": _gemm,
    "Einsum": lambda *tensors, equation: torch.einsum(equation, *tensors),
    # along axes
    **{f"Reduce{name}": _reduction(getattr(torch, name.lower())) for name in ("Mean", "Sum")},
    **{f"Reduce{name}": _reduction(getattr(torch, f"a{name.lower()}")) for name in ("Max", "Min")},
    "ReduceProd": _reduction(_product),
    "ReduceL2": _reduction(lambda x, along, keepdim: torch.linalg.vector_norm(x, 2, along, keepdim), torch.abs),
    # windows and norms
    "Conv": _conv,
    "MaxPool": _max_pool,
    "AveragePool": _average_pool,
    "BatchNormalization": lambda x, s, b, mean, var, /, *, epsilon=1e-5: F.batch_norm(x, mean, var, s, b, eps=epsilon),
    "LayerNormalization": lambda x, s, b=None, /, *, axis=-1, epsilon=1e-5: F.layer_norm(
        x, x.shape[axis:], s, b, epsilon
    ),
    "GroupNormalization": _group_norm,
    "InstanceNormalization": lambda x, a, b, /, *, epsilon=1e-5: F.instance_norm(x, None, None, a, b, eps=epsilon),
    "Dropout": _dropout,
    # shapes
    "Reshape": shapes.reshape,
    "Flatten": lambda x, /, *, axis=1: x.reshape(math.prod(x.shape[:axis]), math.prod(x.shape[axis:])),
    "Squeeze": lambda x, /, axes=None: x.squeeze() if axes is None else x.squeeze(numbers(axes)),
    "Unsqueeze": shapes.unsqueeze,
    "Transpose": lambda x, /, *, perm=None: x.permute(perm or list(reversed(range(x.dim())))),
    "Concat": lambda *tensors, axis: torch.cat(tensors, axis),
    "Split": shapes.split,
    "Slice": shapes.slice_along,
    "Gather": shapes.gather,
    "ScatterND": shapes.scatter_nd,
    "Expand": lambda x, /, shape: x.expand(torch.broadcast_shapes(x.shape, numbers(shape))),
    "Tile": lambda x, /, repeats: x.tile(numbers(repeats)),
    "Pad": shapes.pad,
    "Resize": shapes.resize,
    "Shape": lambda x, /, *, start=0, end=None: torch.tensor(x.shape[start:end], dtype=torch.int64),
    "Range": shapes.arange,
    "ConstantOfShape": lambda shape, *, value=None: (torch.zeros(1) if value is None else value).expand(numbers(shape)),
}
OPERATORS = {name: Operator(name, compute) for name, compute in _TABLE.items()}
