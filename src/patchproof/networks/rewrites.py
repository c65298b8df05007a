"""Graph rewrites: fold padding into convolutions, activate in place.

In: a program's steps and weights. Out: steps that compute the same, gradients too, to the bit where values are finite.
On a CPU, copies take most of a small network's time, and these steps make fewer. Figures are of four pictures of 224 px
on one core, torch 2.13, November 2026.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from patchproof.networks.steps import Step, value_numbers

_ATEN = torch.ops.aten


def rewrite_steps(steps: list[Step], weights: Sequence[Tensor]) -> list[Step]:
    """Equivalent steps with fewer copies; the first values are the weights."""
    return _activate_in_place(_fold_padding(steps, weights))


def _activate_in_place(steps: list[Step]) -> list[Step]:
    """Let an activation overwrite its input where nothing else needs it: fresh memory took a tenth of the time of
    MobileNetV2's answers (75 and 67 ms), and 3 % of its gradients'.
    """
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


def _fold_padding(steps: list[Step], weights: Sequence[Tensor]) -> list[Step]:
    """Replace an uneven padding, which is how TensorFlow pads, by even padding and weights with a row or column of
    zeros more, if the weights have one color. With four copies less, MobileNetV2's answers and gradients take 0.95 of
    the time.
    """
    result: list[Step] = []
    for step in steps:
        padded = result and result[-1].compute is _ATEN.constant_pad_nd.default
        if padded and (replacement := _widen(step, result[-1], weights)):
            result[-1:] = replacement
        else:
            result.append(step)
    return result


def _widen(step: Step, pad: Step, weights: Sequence[Tensor]) -> list[Step] | None:
    """The padding of the weights and the convolution that replace `pad` and `step`; None where that is impossible or
    slower. onnx_aten.py writes such a pad only for the convolution behind it, which has no padding of its own.
    """
    photos, (left, right, top, bottom) = pad.arguments
    padded_value, weight, bias, stride, _, dilation, *others = step.arguments
    missing = [max(0, right - left), max(0, left - right), max(0, bottom - top), max(0, top - bottom)]
    one_color = weight.number < len(weights) and weights[weight.number].shape[1:2] == (1,)
    # with more colors, computing the added zeros takes longer
    if not one_color or min(left, right, top, bottom) < 0 or max(missing) > 1 or dilation != [1, 1]:
        return None
    weight_pad = replace(pad, arguments=[weight, missing], last_uses=[])
    even_padding = [max(top, bottom), max(left, right)]
    arguments = [photos, padded_value, bias, stride, even_padding, dilation, *others]
    return [weight_pad, replace(step, arguments=arguments, last_uses=[*pad.last_uses, *step.last_uses])]


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
