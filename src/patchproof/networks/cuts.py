"""Compute only where pictures may change: a piece covers a tenth of a picture, and a network's first, largest layers
see little more than what lies around it.

In: a network's steps, pictures, and one window per picture; outside of its window, either the pixels' gradient is not
needed or the picture equals an earlier one. Out: the same answers, and inside the windows the same gradient. For
gradients, the first steps are computed without a graph, and on the way back once more with one, on rectangles large
enough that nothing a window reaches sees their edges; for answers alone, on rectangles of all pictures of some views
but the first. Possible cuts are found by trying: NaN in a pixel shows how far it reaches, and a cut counts if it gives
the gradient and the answers of the whole network. Left out on purpose: further cuts, which gained nothing more; GPUs,
where small pictures take as long as large ones; networks that torch.fx cannot follow.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from patchproof.networks.batches import Windows, numbers_saved
from patchproof.networks.graph import Program, compute
from patchproof.networks.tracing import trace_module

STRIDES = (2, 4, 8)  # in values deeper than these, one pixel reaches most entries
STEP_PX = 16  # sides of rectangles are multiples of it, since each new size costs 3 ms once
TYPICAL_SHARE = 0.3  # a window's side as a share of the picture's, for choosing a cut
GRADIENT_TOLERANCE, ANSWER_TOLERANCE = 1e-3, 1e-5  # as shares of the largest; kinks move gradients more


@dataclass(frozen=True)
class Cut:
    """A split of a program after its first `steps`, where `value` is the only value still needed. It has 1/`stride` of
    the picture's sides; row and column j see pixels j·`stride` + `low` to j·`stride` + `high`. The first steps compute
    `numbers` numbers for each picture.
    """

    program: Program
    steps: int
    value: int
    stride: int
    low: int
    high: int
    numbers: int

    def rectangles(self, windows: np.ndarray, size_px: int) -> np.ndarray:
        """N×4 rectangles (left, top, right, bottom) of one size, large enough for all that the windows influence."""
        margin_px = self.high - self.low
        needed = (windows[:, 2:] - windows[:, :2]).max(0) + 2 * margin_px + self.stride
        sides = np.minimum(size_px, -(-needed // STEP_PX) * STEP_PX)
        starts = (windows[:, :2] - margin_px).clip(0, size_px - sides) // self.stride * self.stride
        return np.hstack([starts, starts + sides])

    def saves(self, windows: Windows, size_px: int) -> float:
        """The count of numbers that need not be computed with these windows, per picture."""
        left, top, right, bottom = self.rectangles(windows.px, size_px)[0]
        return numbers_saved(self.numbers, (right - left) * (bottom - top) / size_px**2, windows.cache is not None)

    def answers(self, photos: Tensor, windows: Windows) -> Tensor:
        """The network's answers to N×3×S×S; the gradient at the pictures is right inside `windows` only."""
        program, rectangles = self.program, self.rectangles(windows.px, photos.shape[-1])
        program.dry_run(len(program.steps), photos.shape)
        if windows.cache is None:
            value = _InRectangles.apply(photos, self, rectangles)
        elif self in windows.cache:
            value = _update_in_windows(windows.cache[self], photos, self, windows.px, rectangles)
        else:
            value = program.first(self.steps, photos)[self.value]
            windows.cache[self] = value.clone()  # later steps may overwrite the value
        values = program.values(self.value, value)
        compute(program.steps[self.steps :], values, photos)
        return values[program.output]


def _update_in_windows(cached: Tensor, photos: Tensor, cut: Cut, windows: np.ndarray, rectangles: np.ndarray) -> Tensor:
    """The cut's value for pictures that equal those of the `cached` value outside of the windows."""
    value = cached.clone()
    new = cut.program.first(cut.steps, _stack(_crops(photos, rectangles)))[cut.value]
    # the rows and columns that see a window
    first = (-((cut.high - windows[:, :2]) // cut.stride)).clip(0)
    last = (windows[:, 2:] - 1 - cut.low) // cut.stride + 1
    affected, corner = np.hstack([first, last]), rectangles[:, :2] // cut.stride
    for part, crop in zip(_crops(value, affected), _crops(new, affected - np.hstack([corner, corner])), strict=True):
        part.copy_(crop)
    return value


class _InRectangles(torch.autograd.Function):
    """Runs the steps before a cut; computes their gradient in rectangles only."""

    @staticmethod
    def forward(ctx: Any, photos: Tensor, cut: Cut, rectangles: np.ndarray) -> Tensor:
        """Return the cut's value."""
        ctx.save_for_backward(photos)
        ctx.given = cut, rectangles
        return cut.program.first(cut.steps, photos)[cut.value]

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:  # type: ignore[override]
        """Return the gradient inside the rectangles, 0 elsewhere."""
        (photos,), (cut, rectangles) = ctx.saved_tensors, ctx.given
        cropped = _stack(_crops(photos, rectangles)).requires_grad_()
        with torch.enable_grad():
            value = cut.program.first(cut.steps, cropped)[cut.value]
            height, width = value.shape[2:]
            parts = [part[:, :height, :width] for part in _crops(gradient, rectangles // cut.stride)]
            weighted = (value * _stack(parts)).sum()  # grad_outputs would make torch import SymPy for half a second
        (gradients,) = torch.autograd.grad(weighted, cropped)
        full = torch.zeros_like(photos)
        for part, values in zip(_crops(full, rectangles), gradients, strict=True):
            part.copy_(values)
        return full, None, None


def _crops(values: Tensor, rectangles: np.ndarray) -> list[Tensor]:
    """Views of N values C×H×W, each cropped to its rectangle."""
    edges = rectangles.tolist()
    return [value[:, top:bottom, left:right] for value, (left, top, right, bottom) in zip(values, edges, strict=True)]


def _stack(parts: list[Tensor]) -> Tensor:
    """Stack crops into one tensor, colors side by side in memory."""
    return torch.stack(parts).contiguous(memory_format=torch.channels_last)


def find_cut(network: Callable[[Tensor], Tensor], pictures: Tensor) -> Cut | None:
    """The cut that saves most with typical windows and passes a check with two pictures 2×3×S×S; None without one."""
    if not isinstance(network, torch.nn.Module):
        return None
    program = network if isinstance(network, Program) else trace_module(network)
    if program is None:
        return None
    size_px = pictures.shape[-1]
    window = Windows(np.array([[0, 0, *2 * [round(TYPICAL_SHARE * size_px)]]]))
    try:
        best = max(_cuts(program, pictures), key=lambda cut: cut.saves(window, size_px), default=None)
        return best if best and best.saves(window, size_px) > 0 and _is_correct(network, best, pictures) else None
    except (RuntimeError, ValueError, LookupError):  # steps that need a fixed size, or use the pictures again
        return None


@torch.no_grad()
def _cuts(program: Program, pictures: Tensor) -> list[Cut]:
    """All cuts: after these steps one value remains, smaller than the picture; with the reach of a pixel in it."""
    size_px, max_stride, cuts, numbers = pictures.shape[-1], max(STRIDES), [], 0
    if size_px % STEP_PX:
        return cuts
    pixels = [size_px // 2 + torch.tensor([i, max_stride - 1 - i]) for i in range(max_stride // 2)]
    marked = pictures[:1].repeat(len(pixels), 1, 1, 1).contiguous(memory_format=torch.channels_last)
    for picture, (y, x) in zip(marked, pixels, strict=True):
        picture[:, y, x] = torch.nan
    program.dry_run(len(program.steps), marked.shape)
    values = program.values(program.photos, marked)
    for count, step in enumerate(program.steps, 1):
        compute([step], values, marked)
        value = values.get(step.results[0])
        if not isinstance(value, Tensor):
            continue
        numbers += value.numel() // len(marked)
        if len(values) > program.photos + 2 or value.dim() != 4:
            continue
        stride = size_px // value.shape[-1]
        if stride > max_stride:
            break
        if stride in STRIDES:
            marks = zip(pixels, value.isnan().any(1), strict=True)
            offsets = torch.cat([pixel - stride * picture.nonzero() for pixel, picture in marks])
            cuts.append(Cut(program, count, step.results[0], stride, int(offsets.min()), int(offsets.max()), numbers))
    return cuts


def _is_correct(network: Callable[[Tensor], Tensor], cut: Cut, pictures: Tensor) -> bool:
    """True if gradients, and answers to pictures that differ there, equal the whole network's in two windows near
    opposite corners.
    """
    size_px, side = pictures.shape[-1], pictures.shape[-1] // 8
    starts = np.array([[0, 1], [size_px - side - 1, size_px - side]])
    windows = np.hstack([starts, starts + side])
    changed, cache = pictures.clone(memory_format=torch.channels_last), {}
    for part in _crops(changed, windows):
        part.neg_().add_(1)

    @torch.enable_grad()
    def gradients(compute: Callable[[Tensor], Tensor]) -> Tensor:
        photos = pictures.clone(memory_format=torch.channels_last).requires_grad_()
        output = compute(photos)
        weights = torch.linspace(-1, 1, output.numel()).view(output.shape)
        return _stack(_crops(torch.autograd.grad((output * weights).sum(), photos)[0], windows))

    with torch.no_grad():
        _, updated = (cut.answers(photos, Windows(windows, cache)) for photos in (pictures, changed))
        if not _are_close(network(changed), updated, ANSWER_TOLERANCE):
            return False
    found = gradients(lambda photos: cut.answers(photos, Windows(windows)))
    return _are_close(gradients(network), found, GRADIENT_TOLERANCE)


def _are_close(expected: Tensor, actual: Tensor, share: float) -> bool:
    largest = float(expected.abs().max())  # 0 proves nothing
    return 0 < largest and float((expected - actual).abs().max()) <= share * largest
