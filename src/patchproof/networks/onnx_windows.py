"""ONNX operators that slide a window over pictures or resize them, in torch; the rules are in onnx_operators.py.

In: data N×C×sizes of one to three dimensions (Resize: any), and attributes as ONNX writes them. Out: tensors. torch's
own padding is used where it is the same: alike at both ends, and in pools at most half a window. Resize multiplies each
axis by a matrix, new × old; torch's own interpolation, which is faster, is used where it is the same.

Sources: onnx.ai/onnx/operators/onnx__Resize.html, opsets 10 to 19; R. Keys, 1981, for the cubic kernel.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from patchproof.networks.onnx_shapes import Sides, numbers, pad_sides

_GRIDS = ("half_pixel", "pytorch_half_pixel", "align_corners")
# by mode, grid and rounding: the mode of torch.nn.functional.interpolate that gives the same
_TORCHS_MODES = {
    ("nearest", "asymmetric", "floor"): "nearest",
    **{("nearest", "half_pixel", f"round_prefer_{end}"): "nearest-exact" for end in ("floor", "ceil")},
    **{("linear", grid): "bilinear" for grid in _GRIDS},
    **{("cubic", grid): "bicubic" for grid in _GRIDS},
}


def _sides(auto_pad: str, pads: list[int] | None, totals: Sequence[int]) -> Sides:
    """What is added at both ends; by `auto_pad`, `totals` are divided, an odd number at the end first if SAME_UPPER."""
    if auto_pad in ("SAME_UPPER", "SAME_LOWER"):
        halves = [(max(total, 0) // 2, max(total, 0) - max(total, 0) // 2) for total in totals]
        return halves if auto_pad == "SAME_UPPER" else [(after, before) for before, after in halves]
    if auto_pad not in ("NOTSET", "VALID") or (auto_pad == "VALID" and any(pads or [])):
        raise ValueError(f"an auto_pad {auto_pad!r} with the pads {pads}")
    n = len(totals)
    return list(zip((pads or [0] * n)[:n], (pads or [0] * n)[-n:], strict=True))


class _Windows:
    """Where the windows of an operator lie on `x`: their kernel, steps and sides, one number for each dimension."""

    def __init__(
        self, x: Tensor, kernel_shape, auto_pad="NOTSET", dilations=None, pads=None, strides=None, ceil_mode=0
    ):
        self.n, self.kernel, self.sizes = len(kernel_shape), list(kernel_shape), list(x.shape[2:])
        self.strides, self.dilations = strides or [1] * self.n, dilations or [1] * self.n
        self.spans = [(k - 1) * d + 1 for k, d in zip(self.kernel, self.dilations, strict=True)]
        both = list(zip(self.sizes, self.spans, self.strides, strict=True))
        totals = [(math.ceil(size / stride) - 1) * stride + span - size for size, span, stride in both]
        self.sides = self.filled_sides = _sides(auto_pad, pads, totals)
        if ceil_mode:  # a last window may reach past the padding, but not begin there
            self.filled_sides = []
            for (before, after), (size, span, stride) in zip(self.sides, both, strict=True):
                count = math.ceil((size + before + after - span) / stride) + 1
                count = min(count, math.ceil((size + before) / stride))
                self.filled_sides.append((before, (count - 1) * stride + span - size - before))

    def is_plain(self, limits: Sequence[float]) -> bool:
        """True if torch pads like that: alike at both ends, at most by `limits`."""
        return all(a == b and 0 <= a <= limit for (a, b), limit in zip(self.sides, limits, strict=True))

    def padded(self, x: Tensor, fill: float = 0.0) -> Tensor:
        """The input with its sides, for windows without padding."""
        return pad_sides(x, self.filled_sides, fill)

    def sums(self, padded: Tensor) -> Tensor:
        """The sum of each window of each channel, of any sides and dilations."""
        rows, zeros = padded.reshape(-1, 1, *padded.shape[2:]), [0] * self.n
        ones = rows.new_ones(1, 1, *self.kernel)
        summed = torch.convolution(rows, ones, None, self.strides, zeros, self.dilations, False, zeros, 1)
        return summed.reshape(*padded.shape[:2], *summed.shape[2:])


def padded_conv(
    x, w, b=None, /, *, auto_pad="NOTSET", dilations=None, group=1, kernel_shape=None, pads=None, strides=None
):
    """torch.convolution with ONNX's paddings."""
    _check_kernel(w, kernel_shape)
    windows = _Windows(x, w.shape[2:], auto_pad, dilations, pads, strides)
    plain, zeros = windows.is_plain([math.inf] * windows.n), [0] * windows.n
    padding = [before for before, _ in windows.sides] if plain else zeros
    x = x if plain else windows.padded(x)
    return torch.convolution(x, w, b, windows.strides, padding, windows.dilations, False, zeros, group)


def _check_kernel(w: Tensor, kernel_shape: list[int] | None) -> None:
    if kernel_shape not in (None, list(w.shape[2:])):
        raise ValueError(f"weights of {tuple(w.shape)} for kernel_shape = {kernel_shape}")


def conv_transpose(
    x, w, b=None, /, *, auto_pad="NOTSET", dilations=None, group=1, kernel_shape=None, output_padding=None,
    output_shape=None, pads=None, strides=None
):  # fmt: skip
    """A transposed convolution, cut or widened to the size that its paddings or `output_shape` say."""
    _check_kernel(w, kernel_shape)
    n = x.dim() - 2
    ones, extra = [1] * n, output_padding or [0] * n
    strides, dilations = strides or ones, dilations or ones
    whole = torch.convolution(x, w, None, strides, [0] * n, dilations, True, [0] * n, group)
    targets = list(output_shape or [])[-n:]
    if not targets and auto_pad.startswith("SAME"):
        targets = [size * stride for size, stride in zip(x.shape[2:], strides, strict=True)]
    if targets:
        totals = [size + more - target for size, more, target in zip(whole.shape[2:], extra, targets, strict=True)]
        extra = [more - min(total, 0) for more, total in zip(extra, totals, strict=True)]
        sides = _sides(auto_pad if auto_pad == "SAME_UPPER" else "SAME_LOWER", None, totals)
    else:
        sides = _sides(auto_pad, pads, ones)
    result = pad_sides(whole, [(-before, more - after) for (before, after), more in zip(sides, extra, strict=True)])
    return result if b is None else result + b.reshape(-1, *ones)


def max_pool(x, /, *, kernel_shape, auto_pad="NOTSET", ceil_mode=0, dilations=None, pads=None, strides=None):
    """The largest number in each window; padding is never the largest."""
    windows = _Windows(x, kernel_shape, auto_pad, dilations, pads, strides, ceil_mode)
    if any(max(side) >= span for side, span in zip(windows.sides, windows.spans, strict=True)):
        raise ValueError(f"a MaxPool of kernel_shape = {kernel_shape} with windows in its padding")
    plain = windows.is_plain([size // 2 for size in kernel_shape])
    padding = [before for before, _ in windows.sides] if plain else [0] * windows.n
    padded, pool = x if plain else windows.padded(x, -math.inf), getattr(F, f"max_pool{windows.n}d")
    return pool(padded, kernel_shape, windows.strides, padding, windows.dilations, bool(ceil_mode and plain))


def average_pool(
    x, /, *, kernel_shape, auto_pad="NOTSET", ceil_mode=0, count_include_pad=0, dilations=None, pads=None, strides=None
):
    """The mean of each window, of the picture's numbers or with `count_include_pad` of the padding's, too."""
    windows = _Windows(x, kernel_shape, auto_pad, dilations, pads, strides, ceil_mode)
    if set(windows.dilations) == {1} and windows.is_plain([size // 2 for size in kernel_shape]):
        pool, padding = getattr(F, f"avg_pool{windows.n}d"), [before for before, _ in windows.sides]
        return pool(x, kernel_shape, windows.strides, padding, bool(ceil_mode), bool(count_include_pad))
    counted = pad_sides(torch.ones_like(x[:1, :1]), windows.sides, float(count_include_pad))
    beyond = [(0, end - after) for (_, end), (_, after) in zip(windows.filled_sides, windows.sides, strict=True)]
    return windows.sums(windows.padded(x)) / windows.sums(pad_sides(counted, beyond))


def lrn(x, /, *, size, alpha=1e-4, beta=0.75, bias=1.0):
    """Divide by the sum of squares of `size` neighboring channels; an even number has one more behind the channel."""
    before = (size - 1) // 2
    squares = pad_sides(x.square().flatten(2), [(before, size - 1 - before), (0, 0)])
    sums = F.avg_pool2d(squares[:, None], (size, 1), 1, divisor_override=1)
    return x / (bias + alpha / size * sums.reshape(x.shape)) ** beta


def col2im(x, /, image_shape, block_shape, *, dilations=None, pads=None, strides=None):
    """Add up blocks N×(C·block)×places into pictures N×C×H×W."""
    sizes, block = numbers(image_shape), tuple(numbers(block_shape))
    top, left, bottom, right = pads or [0] * 4
    sides = (sizes[0] + top + bottom, sizes[1] + left + right)
    return pad_sides(F.fold(x, sides, block, dilations or 1, 0, strides or 1), [(-top, -bottom), (-left, -right)])


def upsample(x, /, scales, *, mode="nearest"):
    """Resize as Upsample, and as Resize of opset 10."""
    return resize(x, None, scales, mode=mode, coordinate_transformation_mode="asymmetric", nearest_mode="floor")


def resize(
    x, /, roi=None, scales=None, sizes=None, *, antialias=0, axes=None, coordinate_transformation_mode="half_pixel",
    cubic_coeff_a=-0.75, exclude_outside=0, extrapolation_value=0.0, keep_aspect_ratio_policy="stretch", mode="nearest",
    nearest_mode="round_prefer_floor"
):  # fmt: skip
    """Resize along `axes` (None: all) by `scales`, or to `sizes`."""
    grid, along = coordinate_transformation_mode, [axis % x.dim() for axis in axes or range(x.dim())]
    before, factors, after = [x.shape[axis] for axis in along], numbers(scales), numbers(sizes)
    scaled, stretched = bool(factors), keep_aspect_ratio_policy == "stretch"
    if scaled:  # in float32, as onnxruntime counts
        after = [int(np.float32(old) * np.float32(factor)) for old, factor in zip(before, factors, strict=True)]
    else:
        factors = [new / old for new, old in zip(after, before, strict=True)]
        if not stretched:
            factors = [(min if keep_aspect_ratio_policy == "not_larger" else max)(factors)] * len(factors)
            after = [int(old * factor + 0.5) for old, factor in zip(before, factors, strict=True)]
    if scaled or stretched:
        kind = _TORCHS_MODES.get((mode, grid, nearest_mode) if mode == "nearest" else (mode, grid))
        changes = {axis: (factor, new) for axis, factor, new in zip(along, factors, after, strict=True)}
        as_usual = not (antialias or exclude_outside) and (mode != "cubic" or cubic_coeff_a == -0.75)
        if kind and as_usual and _is_torchs(x, changes, grid, scaled, nearest_mode if mode == "nearest" else ""):
            options: dict[str, Any] = {} if mode == "nearest" else {"align_corners": grid == "align_corners"}
            scale, size = zip(*(changes.get(axis, (1.0, x.shape[axis])) for axis in (2, 3)), strict=True)
            return F.interpolate(x, None if scaled else size, scale if scaled else None, kind, **options)
    n = len(along)
    regions = (numbers(roi) if grid == "tf_crop_and_resize" else []) or [0.0] * n + [1.0] * n
    for axis, new, factor, *region in zip(along, after, factors, regions[:n], regions[n:], strict=True):
        size = x.shape[axis]
        if new == size and factor == 1 and region == [0.0, 1.0]:
            continue
        places = _PLACES[grid](torch.arange(new, dtype=torch.float32, device=x.device), size, new, factor, *region)
        if mode == "nearest":
            x = x.index_select(axis, _ROUNDED[nearest_mode](places).clamp(0, size - 1).long())
        else:
            shrunk = min(factor, 1.0) if antialias else 1.0
            matrix = _matrix(places, size, mode, cubic_coeff_a, shrunk, bool(exclude_outside))
            x = (x.movedim(axis, -1) @ matrix.to(x.dtype).mT).movedim(-1, axis)
        if grid == "tf_crop_and_resize":
            outside = ((places < 0) | (places > size - 1)).reshape(-1, *[1] * (x.dim() - 1 - axis))
            x = x.masked_fill(outside, extrapolation_value)
    return x


def _is_torchs(x: Tensor, changes: dict[int, tuple[float, int]], grid: str, scaled: bool, rounding: str) -> bool:
    """False where torch takes the other one of two equally near pixels, or another place for a result of one pixel."""
    if x.dim() != 4 or any(change != (1, x.shape[axis]) for axis, change in changes.items() if axis < 2):
        return False
    pairs = [(x.shape[axis], *changes[axis]) for axis in (2, 3) if axis in changes]
    if any(scaled and int(old * factor) != new for old, factor, new in pairs):
        return False
    if rounding:
        return rounding != "round_prefer_floor" or not any(factor % 1 for _, factor, _ in pairs)
    return grid != "pytorch_half_pixel" or not any(new == 1 < old for old, _, new in pairs)


# by grid: the place among the old numbers of each new one, from its index, the sizes, the factor and the region
_PLACES: dict[str, Callable[..., Tensor]] = {
    "half_pixel": lambda i, size, new, factor, *_: (i + 0.5) / factor - 0.5,
    "pytorch_half_pixel": lambda i, size, new, factor, *_: (i + 0.5) / factor - 0.5 if new > 1 else i,
    "half_pixel_symmetric": lambda i, size, new, factor, *_: (
        size / 2 * (1 - new / (factor * size)) + (i + 0.5) / factor - 0.5
    ),
    "align_corners": lambda i, size, new, *_: i * (size - 1) / max(new - 1, 1),
    "asymmetric": lambda i, size, new, factor, *_: i / factor,
    "tf_half_pixel_for_nn": lambda i, size, new, factor, *_: (i + 0.5) / factor,
    "tf_crop_and_resize": lambda i, size, new, _, start, end: (
        (size - 1) * (start + i * (end - start) / (new - 1) if new > 1 else i + (start + end) / 2)
    ),
}
_ROUNDED: dict[str, Callable[[Tensor], Tensor]] = {
    "round_prefer_floor": lambda places: (places - 0.5).ceil(),
    "round_prefer_ceil": lambda places: (places + 0.5).floor(),
    "floor": torch.floor,
    "ceil": torch.ceil,
}


def _matrix(places: Tensor, size: int, mode: str, a: float, shrunk: float, excludes_outside: bool) -> Tensor:
    """Return new × old shares: a triangle or Keys' cubic kernel around each place, wider by 1 / `shrunk`. Shares
    outside are the border's, or dropped if `excludes_outside`.
    """
    reach = math.ceil({"linear": 1, "cubic": 2}[mode] / shrunk)
    indices = places.floor()[:, None] + torch.arange(1 - reach, reach + 1, device=places.device)
    d = ((indices - places[:, None]) * shrunk).abs()
    if mode == "linear":
        shares = (1 - d).clamp(min=0)
    else:
        far = torch.where(d < 2, a * (((d - 5) * d + 8) * d - 4), 0.0)
        shares = torch.where(d <= 1, ((a + 2) * d - (a + 3)) * d * d + 1, far)
    if excludes_outside:
        shares = torch.where((indices < 0) | (indices >= size), 0.0, shares)
    if excludes_outside or shrunk < 1:
        shares = shares / shares.sum(1, keepdim=True)
    return places.new_zeros(len(places), size).scatter_add(1, indices.long().clamp(0, size - 1), shares)
