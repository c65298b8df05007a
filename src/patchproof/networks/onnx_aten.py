"""ONNX operators that ATen has too; as ATen operators they take part in the rewrites of rewrites.py.

In: a node's name, its inputs and attributes, and the numbers of values that are known to have four dimensions. Out:
ATen operators that the first input passes through one after the other; none where onnx_operators.py has to compute the
node. Without them MobileNetV2 took 1.46 times as long for its answers and 1.85 times with gradients (torch 2.13, one
core, November 2026).
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from patchproof.networks.steps import ValueRef

_ATEN = torch.ops.aten
AtenCalls = list[tuple[Callable[..., Any], list[Any]]]  # operators, each with its arguments after the first


def aten_calls(
    name: str, inputs: Sequence[Any], attributes: dict[str, Any], of_four: Mapping[int | None, Any]
) -> AtenCalls:
    """The operators for a node; `of_four` holds the numbers of weights and pictures, N×C×H×W, with H×W of weights."""
    numbers = [item.number if type(item) is ValueRef else None for item in inputs]
    weight = numbers[1] if name == "Conv" else None
    if weight in of_four and not isinstance(inputs[-1], Tensor):
        if attributes.get("kernel_shape", of_four[weight]) != of_four[weight]:
            return []
        return _conv(*inputs[1:], **attributes)
    if name == "Clip" and numbers[0] is not None:
        return _clip(*inputs[1:], **attributes)
    if name == "Relu" and numbers[0] is not None:
        return [(_ATEN.relu.default, [])]
    if name == "Add" and all(number in of_four for number in numbers):
        return [(_ATEN.add.Tensor, [inputs[1]])]
    return []


def _conv(w, b=None, *, auto_pad="NOTSET", dilations=None, group=1, pads=None, strides=None, **_: Any) -> AtenCalls:
    if auto_pad != "NOTSET" or (pads is not None and len(pads) != 4):
        return []
    top, left, bottom, right = pads or [0] * 4
    others = [dilations or [1, 1], False, [0, 0], group]
    if (top, left) == (bottom, right):
        return [(_ATEN.convolution.default, [w, b, strides or [1, 1], [top, left], *others])]
    uneven = (_ATEN.constant_pad_nd.default, [[left, right, top, bottom]])
    return [uneven, (_ATEN.convolution.default, [w, b, strides or [1, 1], [0, 0], *others])]


def _clip(min: Any = None, max: Any = None) -> AtenCalls:
    """A hardtanh if both limits are known; unlike torch.clamp, its gradient is 0 at the limits, as ReLU6's is."""
    ends = [torch.tensor(end) if isinstance(end, float) else end for end in (min, max)]
    limits = [float(end) for end in ends if isinstance(end, Tensor) and end.is_floating_point() and not end.dim()]
    return [(_ATEN.hardtanh.default, limits)] if len(limits) == 2 and limits[0] <= limits[1] else []
