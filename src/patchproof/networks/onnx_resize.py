"""ONNX's Resize and Upsample, written with torch; see onnx_operators.py for the rules.

In: data of any dimensions, factors or sizes, and attributes as ONNX writes them. Out: tensors. Each axis is a product
with a matrix, new × old, whose rows hold what one new number takes from the old ones; where torch's own interpolation
is the same, it is used, which is faster.

Source: onnx.ai/onnx/operators/onnx__Resize.html, opsets 10 to 19; R. Keys, 1981, for the cubic kernel.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from patchproof.networks.onnx_shapes import numbers

_GRIDS = ("half_pixel", "pytorch_half_pixel", "align_corners")
# by mode, grid and rounding: the mode of torch.nn.functional.interpolate that gives the same
_TORCHS_MODES = {
    ("nearest", "asymmetric", "floor"): "nearest",
    **{("nearest", "half_pixel", f"round_prefer_{end}"): "nearest-exact" for end in ("floor", "ceil")},
    **{("linear", grid): "bilinear" for grid in _GRIDS},
    **{("cubic", grid): "bicubic" for grid in _GRIDS},
}


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
    """New × old shares: a triangle or Keys' cubic kernel around each place, wider by 1 / `shrunk`; what lies outside
    is the border's, or nobody's.
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
