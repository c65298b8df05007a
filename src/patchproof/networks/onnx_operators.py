"""The operators that an ONNX file may use: those of image classifiers, written with torch.

In: a name as the file writes it. Out: a function of tensors, which reads and writes nothing else and draws no random
numbers; a name that is not in the table is refused. In a signature, inputs before `/` are data, inputs after it are
sizes or axes; these and what follows `*` may be attributes of that name. Data are sent to the pictures' device, which
has no memory during the dry run in graph.py; only for the operators in `_ON_SIZES`, whose results are no larger than
their inputs allow, a few numbers stay on the CPU, so that sizes can be computed.
What is left out on purpose, and why, is in `REFUSED`.

Source: onnx.ai/onnx/operators, opsets 7 to 28; where two differ, both forms are read.
"""

import functools
import inspect
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

import patchproof.networks.onnx_shapes as shapes
import patchproof.networks.onnx_windows as windows
from patchproof.networks.bounds import UnsupportedNetwork, quote
from patchproof.networks.onnx_shapes import MAX_SIZES, numbers

MAX_STEPS = 1 << 12  # of a sequence, one after the other
_GATES = [0, 2, 3, 1]  # torch's in ONNX's order
# the numbers of TensorProto.DataType
_INTEGERS = {2: torch.uint8, 3: torch.int8, 5: torch.int16, 6: torch.int32, 7: torch.int64}
DTYPES = _INTEGERS | {1: torch.float32, 9: torch.bool, 10: torch.float16, 11: torch.float64, 16: torch.bfloat16}
_ON_SIZES = frozenset(
    "Abs Add And Cast CastLike Ceil Clip Concat ConstantOfShape CumSum Div Equal Expand Flatten Floor Gather "
    "GatherElements GatherND Greater GreaterOrEqual Less LessOrEqual Max Min Mod Mul Neg NonZero Not OneHot Or Pow "
    "Range Reciprocal ReduceMax ReduceMin ReduceProd ReduceSum Reshape Round ScatterElements ScatterND Sign Slice "
    "Split Sqrt Squeeze Sub Sum Transpose Unsqueeze Where Xor".split()
)
# attributes that have to have this value, or (None) that change nothing here
FIXED_ATTRIBUTES: dict[str, dict[str, Any]] = {
    "BatchNormalization": {"momentum": None, "spatial": 1},
    **{name: {"round_mode": None, "saturate": None} for name in ("Cast", "CastLike")},  # 8-bit floats
    "Dropout": {"seed": None},
    **{name: {"stash_type": 1} for name in ("GroupNormalization", "LayerNormalization", "RMSNormalization")},
    "MaxPool": {"storage_order": None},  # of the second result
    "LSTM": {"layout": 0},
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


# --- products and normalization ---


def _gemm(a, b, c=None, /, *, alpha=1.0, beta=1.0, transA=0, transB=0):
    a, b = a.mT if transA else a, b.mT if transB else b
    return alpha * (a @ b) if c is None else torch.addmm(c, a, b, beta=beta, alpha=alpha)


def _batch_norm(x, scale, b, mean, variance, /, *, epsilon=1e-5, training_mode=0):
    if training_mode:  # of weights: onnx_file.py refuses it of what comes from pictures
        mean = variance = None
    return F.batch_norm(x, mean, variance, scale, b, bool(training_mode), 0.0, epsilon)


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


def _of_rows(compute: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """A softmax as before opset 13: of rows that hold all axes from `axis` on."""
    return lambda x, /, *, axis=1: compute(x.reshape(math.prod(x.shape[:axis]), -1), -1).reshape(x.shape)


def _extreme_place(compute: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """The index of an extreme, the first or with `select_last_index` the last one."""

    def computed(x, /, *, axis=0, keepdims=1, select_last_index=0):
        found = compute(x.flip(axis) if select_last_index else x, axis, keepdim=bool(keepdims))
        return x.shape[axis] - 1 - found if select_last_index else found

    return computed


def _top(x, /, k, *, axis=-1, largest=1, sorted=1):
    """The `k` largest or smallest and their indices; of equal ones the first."""
    ordered, indices = x.sort(stable=True, dim=axis, descending=bool(largest))
    return ordered.narrow(axis, 0, numbers(k)[0]), indices.narrow(axis, 0, numbers(k)[0])


def _cumulative_sum(x, /, axis, *, exclusive=0, reverse=0):
    (along,) = numbers(axis)
    x = x.flip(along) if reverse else x
    sums = x.cumsum(along, dtype=x.dtype)
    sums = sums - x if exclusive else sums
    return sums.flip(along) if reverse else sums


def _grid_sample(x, grid, /, *, align_corners=0, mode="linear", padding_mode="zeros"):
    kind = {"linear": "bilinear", "cubic": "bicubic"}.get(mode, mode)  # opset 16 has torch's words
    return F.grid_sample(x, grid, kind, padding_mode, bool(align_corners))


# --- sequences ---


def _lstm(
    x, w, r, b=None, lengths=None, h=None, c=None, peepholes=None, /, *, hidden_size, activations=None,
    direction="forward", input_forget=0
):  # fmt: skip
    """A long short-term memory of one or two directions."""
    directions = len(w)
    if activations not in (None, ["Sigmoid", "Tanh", "Tanh"] * directions) or input_forget:
        raise ValueError(f"an LSTM with {activations}")
    if lengths is not None or peepholes is not None:
        raise ValueError("an LSTM with lengths or peepholes")
    if len(x) > MAX_STEPS:
        raise ValueError(f"a sequence of {len(x)} steps")
    zeros = x.new_zeros(directions, x.shape[1], hidden_size)
    states = [zeros if state is None else state for state in (h, c)]
    parts = w, r, *(() if b is None else b.chunk(2, 1))
    parts = [part.unflatten(1, (4, -1))[:, _GATES].flatten(1, 2) for part in parts]
    weights = [part[direction] for direction in range(directions) for part in parts]
    backward = direction == "reverse"
    options = (b is not None, 1, 0.0, False, directions == 2, False)
    y, *last = torch.lstm(x.flip(0) if backward else x, states, weights, *options)
    y = (y.flip(0) if backward else y).unflatten(2, (directions, hidden_size)).transpose(1, 2)
    return (y, *last)


# names of the standard, and torch's for the same where they differ
_UNARY = """Abs Acos Acosh Asin Asinh Atan Atanh BitwiseNot:bitwise_not Ceil Cos Cosh Det Erf Exp Floor IsNaN Log Neg
Not:logical_not Reciprocal Relu Round Sigmoid Sign Sin Sinh Sqrt Tan Tanh"""
_BINARY = """Add And:logical_and BitwiseAnd:bitwise_and BitwiseOr:bitwise_or BitwiseXor:bitwise_xor Equal:eq Greater
GreaterOrEqual:ge Less LessOrEqual:le MatMul Mul Or:logical_or Sub Xor:logical_xor"""


def _named(words: str, module: Any, kind: Callable[..., Any]) -> dict[str, Callable[..., Any]]:
    pairs = (word.partition(":")[::2] for word in words.split())
    return {name: kind(getattr(module, of or name.lower())) for name, of in pairs}


_TABLE: dict[str, Callable[..., Any]] = {
    # of one input
    **_named(_UNARY, torch, _unary),
    **_named("HardSwish Mish Softplus Softsign", F, _unary),
    "GlobalAveragePool": _unary(lambda x: x.mean(tuple(range(2, x.dim())), keepdim=True)),
    "GlobalMaxPool": _unary(lambda x: x.amax(tuple(range(2, x.dim())), keepdim=True)),
    "Celu": lambda x, /, *, alpha=1.0: F.celu(x, alpha),
    "Elu": lambda x, /, *, alpha=1.0: F.elu(x, alpha),
    "Selu": lambda x, /, *, alpha=1.67326319217681884765625, gamma=1.05070102214813232421875: gamma * F.elu(x, alpha),
    "LeakyRelu": lambda x, /, *, alpha=0.01: F.leaky_relu(x, alpha),
    "ThresholdedRelu": lambda x, /, *, alpha=1.0: torch.where(x > alpha, x, 0.0),
    "Shrink": lambda x, /, *, lambd=0.5, bias=0.0: (x + bias).where(x < -lambd, (x - bias).where(x > lambd, 0.0)),
    "Swish": lambda x, /, *, alpha=1.0: x * (alpha * x).sigmoid(),
    "HardSigmoid": lambda x, /, *, alpha=0.2, beta=0.5: (alpha * x + beta).clamp(0, 1),
    "Gelu": lambda x, /, *, approximate="none": F.gelu(x, approximate=approximate),
    "Softmax": lambda x, /, *, axis=-1: x.softmax(axis),
    "LogSoftmax": lambda x, /, *, axis=-1: x.log_softmax(axis),
    "IsInf": lambda x, /, *, detect_negative=1, detect_positive=1: (
        (x.isposinf() & bool(detect_positive)) | (x.isneginf() & bool(detect_negative))
    ),
    "Cast": lambda x, /, *, to: x.to(DTYPES[to]),
    # of two or more
    **_named(_BINARY, torch, _binary),
    "BitShift": lambda x, by, /, *, direction: x << by if direction == "LEFT" else x >> by,
    "CastLike": _binary(lambda x, like: x.to(like.dtype)),
    "Div": _binary(lambda a, b: a / b if a.is_floating_point() else torch.div(a, b, rounding_mode="trunc")),
    "Mod": lambda a, b, /, *, fmod=0: torch.fmod(a, b) if fmod else torch.remainder(a, b),
    "Pow": _binary(lambda x, y: torch.pow(x, y).to(x.dtype)),
    "PRelu": _binary(lambda x, slope: torch.where(x < 0, slope * x, x)),
    "Where": lambda condition, x, y, /: torch.where(condition, x, y),
    "Clip": lambda x, /, min=None, max=None: x if min is None and max is None else torch.clamp(x, min, max),
    "Mean": lambda *tensors: functools.reduce(torch.add, tensors) / len(tensors),
    **{"Max": _variadic(torch.maximum), "Min": _variadic(torch.minimum), "Sum": _variadic(torch.add)},
    "Gemm": _gemm,
    "Einsum": lambda *tensors, equation: torch.einsum(equation, *tensors),
    # along axes
    **{f"Reduce{name}": _reduction(getattr(torch, name.lower())) for name in ("Mean", "Sum")},
    **{f"Reduce{name}": _reduction(getattr(torch, f"a{name.lower()}")) for name in ("Max", "Min")},
    "ReduceProd": _reduction(_product),
    "ReduceL1": _reduction(lambda x, along, keepdim: x.abs().sum(along, keepdim), torch.abs),
    "ReduceSumSquare": _reduction(lambda x, along, keepdim: x.square().sum(along, keepdim), torch.square),
    "ReduceLogSum": _reduction(lambda x, along, keepdim: x.sum(along, keepdim).log(), torch.log),
    "ReduceLogSumExp": _reduction(torch.logsumexp),
    "ReduceL2": _reduction(lambda x, along, keepdim: torch.linalg.vector_norm(x, 2, along, keepdim), torch.abs),
    **{"ArgMax": _extreme_place(torch.argmax), "ArgMin": _extreme_place(torch.argmin)},
    "TopK": _top,
    "CumSum": _cumulative_sum,
    "LpNormalization": lambda x, /, *, axis=-1, p=2: F.normalize(x, p, axis, 1e-37),
    # windows and norms
    "Conv": windows.padded_conv,
    "ConvTranspose": windows.conv_transpose,
    "MaxPool": windows.max_pool,
    "AveragePool": windows.average_pool,
    "LRN": windows.lrn,
    "Col2Im": windows.col2im,
    "BatchNormalization": _batch_norm,
    "RMSNormalization": lambda x, s, /, *, axis=-1, epsilon=1e-5: F.rms_norm(x, x.shape[axis:], s, epsilon),
    "LayerNormalization": lambda x, s, b=None, /, *, axis=-1, epsilon=1e-5: F.layer_norm(
        x, x.shape[axis:], s, b, epsilon
    ),
    "GroupNormalization": _group_norm,
    "InstanceNormalization": lambda x, a, b, /, *, epsilon=1e-5: F.instance_norm(x, None, None, a, b, eps=epsilon),
    "Dropout": _dropout,
    "LSTM": _lstm,
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
    "GatherElements": shapes.gather_elements,
    "GatherND": shapes.gather_nd,
    **{name: shapes.scatter_elements for name in ("ScatterElements", "Scatter")},
    "ScatterND": shapes.scatter_nd,
    "OneHot": shapes.one_hot,
    "NonZero": shapes.non_zero,
    "Trilu": lambda x, /, k=None, *, upper=1: (torch.triu if upper else torch.tril)(x, *numbers(k)),
    "EyeLike": lambda x, /, *, dtype=None, k=0: torch.ones_like(x, dtype=dtype and DTYPES[dtype]).triu(k).tril(k),
    "DepthToSpace": shapes.depth_to_space,
    "SpaceToDepth": shapes.space_to_depth,
    "Expand": lambda x, /, shape: x.expand(torch.broadcast_shapes(x.shape, numbers(shape))),
    "Tile": lambda x, /, repeats: x.tile(numbers(repeats)),
    "Pad": shapes.pad,
    **{"Resize": windows.resize, "Upsample": windows.upsample},
    "GridSample": _grid_sample,
    "AffineGrid": lambda theta, /, size, *, align_corners=0: F.affine_grid(theta, numbers(size), bool(align_corners)),
    "Size": lambda x, /: torch.tensor(x.numel()),
    "Shape": lambda x, /, *, start=0, end=None: torch.tensor(x.shape[start:end], dtype=torch.int64),
    "Range": shapes.arange,
    "ConstantOfShape": lambda shape, *, value=0.0: torch.as_tensor(value).reshape(()).expand(numbers(shape)),
}
OPERATORS = {name: Operator(name, compute) for name, compute in _TABLE.items()}
# operators that did something else before an opset
_FORMER = {
    "Softmax": (13, Operator("Softmax", _of_rows(torch.softmax))),
    "LogSoftmax": (13, Operator("LogSoftmax", _of_rows(torch.log_softmax))),
    "Resize": (11, Operator("Upsample", windows.upsample)),
}
RESULTS = {"TopK": 2, "LSTM": 3}  # how many, where there are several
# operators of the standard that are left out, by the reason
REFUSED = {
    "draws random numbers": "Bernoulli Multinomial RandomNormal RandomNormalLike RandomUniform RandomUniformLike",
    "has results whose size depends on the pictures' content": "Compress Unique",
    "is left to patchproof (nms=False where it is exported)": "NonMaxSuppression",
    "runs parts of the file several times or not at all": "If Loop Scan SequenceMap",
    "rounds to a few bits, which has no gradient": "ConvInteger DequantizeLinear DynamicQuantizeLinear MatMulInteger "
    "QLinearConv QLinearMatMul QuantizeLinear",
    "has no like in torch": "DeformConv MaxRoiPool MaxUnpool RoiAlign",
    "no known network of pictures has": "CenterCropPad GRU GlobalLpPool Hardmax LpPool MeanVarianceNormalization RNN",
    "is of lists, texts, sounds, files, former calls or training": """Adagrad Adam Attention BlackmanWindow
    ConcatFromSequence DFT Gradient HammingWindow HannWindow ImageDecoder MelWeightMatrix Momentum
    NegativeLogLikelihoodLoss Optional OptionalGetElement OptionalHasElement RegexFullMatch ReverseSequence
    RotaryEmbedding STFT SequenceAt SequenceConstruct SequenceEmpty SequenceErase SequenceInsert SequenceLength
    SoftmaxCrossEntropyLoss SplitToSequence StringConcat StringNormalizer StringSplit TensorScatter TfIdfVectorizer""",
}


def find_operator(name: str, opset: int) -> Operator:
    """The operator as the opset defines it; refused with the reason if it is not in the table."""
    until, former = _FORMER.get(name, (0, None))
    if opset < until and former:
        return former
    if name not in OPERATORS:
        reasons = [f", which {reason}" for reason, names in REFUSED.items() if name in names.split()]
        raise UnsupportedNetwork(f"the operator {quote(name)}{''.join(reasons)}")
    return OPERATORS[name]
