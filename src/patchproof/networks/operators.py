"""What a checked program may compute: operators of ATen that only make tensors from tensors, and arithmetic on sizes.

In: an operator's name as the archive writes it. Out: the operator, looked up by our own spelling of it, or None. A name
that is not written here leads nowhere: no file, no seed, no Python function, no control flow, no custom operator.
To allow one more, add the name that the refusal gives to OPERATORS: one that reads and writes nothing but its tensors,
draws no random numbers, and whose size of output follows from its arguments.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

OPERATORS = frozenset(
    # products
    "conv1d.default conv2d.default conv2d.padding convolution.default conv_transpose2d.input linear.default "
    "addmm.default mm.default bmm.default baddbmm.default matmul.default mv.default dot.default einsum.default "
    "outer.default scaled_dot_product_attention.default "
    # normalization
    "batch_norm.default layer_norm.default native_layer_norm.default "
    "group_norm.default instance_norm.default rms_norm.default "
    "linalg_vector_norm.default norm.ScalarOpt_dim dropout.default dropout_.default "
    "feature_dropout.default feature_dropout_.default "
    # activations
    "relu.default relu_.default relu6.default relu6_.default hardtanh.default hardtanh_.default sigmoid.default "
    "sigmoid_.default hardsigmoid.default hardsigmoid_.default hardswish.default hardswish_.default silu.default "
    "silu_.default gelu.default gelu_.default elu.default elu_.default selu.default selu_.default celu.default "
    "leaky_relu.default leaky_relu_.default prelu.default _prelu_kernel.default mish.default mish_.default "
    "softplus.default tanh.default tanh_.default glu.default log_sigmoid.default softmax.int _softmax.default "
    "log_softmax.int _log_softmax.default clamp.default clamp_.default clamp.Tensor clamp_min.default "
    "clamp_min_.default clamp_max.default clamp_max_.default threshold.default "
    # pools and resampling
    "max_pool1d.default max_pool2d.default max_pool2d_with_indices.default avg_pool1d.default avg_pool2d.default "
    "avg_pool3d.default adaptive_avg_pool1d.default adaptive_avg_pool2d.default _adaptive_avg_pool2d.default "
    "adaptive_max_pool2d.default upsample_nearest2d.default upsample_nearest2d.vec upsample_bilinear2d.default "
    "upsample_bilinear2d.vec upsample_bicubic2d.default upsample_bicubic2d.vec _upsample_bilinear2d_aa.default "
    "_upsample_bilinear2d_aa.vec _upsample_bicubic2d_aa.default _upsample_bicubic2d_aa.vec pixel_shuffle.default "
    "pixel_unshuffle.default channel_shuffle.default native_channel_shuffle.default grid_sampler_2d.default "
    "grid_sampler.default "
    # sums, means and extremes
    "mean.default mean.dim sum.default sum.dim_IntList var.dim var.correction var_mean.correction std.dim "
    "std.correction amax.default amin.default max.dim max.default min.dim min.default cumsum.default prod.dim_int "
    "any.default any.dim all.default all.dim argmax.default "
    # arithmetic
    "add.Tensor add_.Tensor add.Scalar add_.Scalar sub.Tensor sub_.Tensor sub.Scalar rsub.Tensor rsub.Scalar "
    "mul.Tensor mul_.Tensor mul.Scalar mul_.Scalar div.Tensor div_.Tensor div.Scalar div.Tensor_mode "
    "div.Scalar_mode floor_divide.default remainder.Scalar remainder.Tensor "
    "fmod.Scalar fmod.Tensor neg.default abs.default exp.default "
    "expm1.default log.default log1p.default log2.default erf.default sin.default cos.default atan.default "
    "sqrt.default rsqrt.default square.default reciprocal.default pow.Tensor_Scalar pow.Tensor_Tensor pow.Scalar "
    "sign.default floor.default ceil.default round.default trunc.default minimum.default maximum.default "
    "addcmul.default addcdiv.default lerp.Scalar lerp.Tensor nan_to_num.default "
    # comparisons and masks
    "eq.Scalar eq.Tensor ne.Scalar ne.Tensor lt.Scalar lt.Tensor le.Scalar le.Tensor gt.Scalar gt.Tensor ge.Scalar "
    "ge.Tensor logical_and.default logical_or.default logical_not.default logical_xor.default bitwise_not.default "
    "bitwise_and.Tensor bitwise_or.Tensor where.self where.ScalarSelf where.ScalarOther masked_fill.Scalar "
    "masked_fill.Tensor masked_fill_.Scalar tril.default triu.default "
    # shapes
    "view.default _unsafe_view.default reshape.default view_as.default reshape_as.default flatten.using_ints "
    "unflatten.int squeeze.default squeeze.dim squeeze.dims unsqueeze.default permute.default transpose.int "
    "t.default numpy_T.default swapaxes.default swapdims.default movedim.int movedim.intlist expand.default "
    "expand_as.default repeat.default repeat_interleave.self_int tile.default cat.default stack.default "
    "split.Tensor split.sizes split_with_sizes.default chunk.default unbind.int select.int slice.Tensor "
    "narrow.default index.Tensor _unsafe_index.Tensor index_select.default gather.default embedding.default "
    "roll.default flip.default pad.default constant_pad_nd.default reflection_pad2d.default "
    "replication_pad2d.default unfold.default im2col.default meshgrid.default meshgrid.indexing "
    "slice_scatter.default select_scatter.default diagonal.default "
    # copies and types
    "clone.default contiguous.default alias.default detach.default detach_.default lift_fresh_copy.default "
    "lift_fresh.default to.dtype to.device to.dtype_layout to.other _to_copy.default type_as.default copy.default "
    "copy_.default fill_.Scalar fill_.Tensor fill.Scalar fill.Tensor zero_.default "
    # new tensors
    "zeros.default ones.default full.default arange.default arange.start arange.start_step linspace.default "
    "eye.default eye.m zeros_like.default ones_like.default full_like.default new_zeros.default new_ones.default "
    "new_full.default scalar_tensor.default sym_size.int sym_numel.default sym_stride.int".split()
)

# what torch checks while it exports; the sizes are checked here, where the program is called
_CHECKS = frozenset(
    "_assert_tensor_metadata.default _assert_scalar.default _assert_async.msg sym_constrain_range.default "
    "sym_constrain_range_for_size.default".split()
)


def _on_numbers(compute: Callable[..., Any]) -> Callable[..., Any]:
    """Plain arithmetic, for numbers of a size that sizes can have."""

    def computed(*numbers: Any) -> Any:
        if not all(type(number) in (bool, int, float) for number in numbers):
            raise TypeError("arithmetic on sizes takes numbers")
        result = compute(*numbers)
        if abs(result) >= 1 << 63:
            raise OverflowError("a size is too large")
        return result

    return computed


def _as_strided(tensor: Tensor, sizes: list[int], strides: list[int], offset: int | None = None) -> Tensor:
    """Only what decomposed poolings ask for: other strides where the size is 1. What other strides find in the memory
    follows from the order that the batch happens to lie in.
    """
    moved = any(size > 1 and old != new for size, old, new in zip(sizes, tensor.stride(), strides, strict=True))
    if list(tensor.shape) != list(sizes) or moved or offset not in (None, tensor.storage_offset()):
        raise RuntimeError("as_strided with other strides than its tensor has")
    return tensor


def _batch_norm(x: Tensor, weight: Any, bias: Any, mean: Tensor, variance: Tensor, momentum: float, eps: float):
    return torch.nn.functional.batch_norm(x, mean, variance, weight, bias, False, momentum, eps), None, None


def _group_norm(x: Tensor, weight: Any, bias: Any, n: int, channels: int, pixels: int, groups: int, eps: float):
    return torch.nn.functional.group_norm(x, groups, weight, bias, eps), None, None


def _attention(q: Tensor, k: Tensor, v: Tensor, dropout_p: float = 0.0, is_causal: bool = False, **options: Any):
    attention = torch.nn.functional.scaled_dot_product_attention
    return attention(q, k, v, options.get("attn_mask"), 0.0, is_causal, scale=options.get("scale")), None


# kernels that leave checks of sizes to the operators above them, and those operators in their place
_CHECKED: dict[str, Callable[..., Any]] = {
    "as_strided.default": _as_strided,
    "_native_batch_norm_legit_no_training.default": _batch_norm,
    "native_group_norm.default": _group_norm,
    "_scaled_dot_product_flash_attention_for_cpu.default": _attention,
}

_ARITHMETIC = {
    **{
        f"_operator.{name}": _on_numbers(getattr(operator, name))
        for name in "add sub mul truediv floordiv mod neg pos eq ne lt le gt ge and_ or_".split()
    },
    **{f"math.{name}": _on_numbers(getattr(math, name)) for name in ("ceil", "floor", "trunc")},
    "torch.sym_int": _on_numbers(int),
    "torch.sym_float": _on_numbers(float),
    "torch.sym_max": _on_numbers(max),
    "torch.sym_min": _on_numbers(min),
    "torch.sym_not": _on_numbers(operator.not_),
    "torch.sym_ite": _on_numbers(lambda condition, one, other: one if condition else other),
}


def operator_named(target: str) -> tuple[Callable[..., Any], Sequence[Any] | None] | None:
    """What computes the operator of that name, and the arguments that its schema lists, None for arithmetic on sizes;
    None where it is not on the list, or this version of torch has none of it.
    """
    if target in _ARITHMETIC:
        return _ARITHMETIC[target], None
    library, _, name = target.rpartition("aten.")
    if library != "torch.ops." or not (name in OPERATORS or name in _CHECKED):
        return None
    packet, _, overload = name.partition(".")
    kernel = getattr(getattr(torch.ops.aten, packet, None), overload, None)
    if kernel is None:
        return None
    return _CHECKED[name] if name in _CHECKED else kernel, kernel._schema.arguments


def is_check(target: str) -> bool:
    """Whether it only checks what torch assumed while it exported, and computes nothing."""
    library, _, name = target.rpartition("aten.")
    return library == "torch.ops." and name in _CHECKS
