"""Only where pictures may change: a piece covers a tenth of a picture, and the first, largest layers of a network see
little more than what lies around it.

In: a network's steps, pictures, and the window of each outside of which its pixels' gradient is not asked for, or it
shows what another did before. Out: the same answers, and in the windows the same gradient. For gradients, the first
steps are computed without a graph and, on the way back, once more with one, on rectangles so large that nothing a
window reaches sees their edges; for answers alone, on rectangles of all pictures of some views but the first. Where
steps can be cut is found by trying: NaN in a pixel shows how far it reaches, whatever the steps are, and a cut counts
if it gives the gradient and the answers of the whole network.
Left out on purpose: further cuts, each computed again by itself, which won nothing more; GPUs, where small pictures
take as long as large ones; networks that torch.fx cannot follow.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from patchproof.networks.graph import Program, compute
from patchproof.networks.tracing import trace_module
from patchproof.networks.windows import Windows, numbers_saved

STRIDES = (2, 4, 8)  # of deeper values a pixel reaches most
STEP_PX = 16  # rectangles' sides are multiples of it: a new size costs 3 ms once
TYPICAL = 0.3  # a window's side, of the picture's, that a cut is chosen for
SAME, SAME_ANSWER = 1e-3, 1e-5  # of the largest gradient, in which kinks count, and of the largest answer


@dataclass(frozen=True)
class Cut:
    """After so many `steps` one value is left, of 1/`stride` of the picture's sides: its j-th row and column see pixels
    from j·`stride` + `low` to j·`stride` + `high`. Until there, `made` numbers are made for each picture.
    """

    program: Program
    steps: int
    value: int
    stride: int
    low: int
    high: int
    made: int

    def rectangles(self, windows: np.ndarray, size_px: int) -> np.ndarray:
        """N×4 like windows, all of one size, that hold what is seen wherever a window's pixels are seen."""
        margin_px = self.high - self.low
        needed = (windows[:, 2:] - windows[:, :2]).max(0) + 2 * margin_px + self.stride
        sides = np.minimum(size_px, -(-needed // STEP_PX) * STEP_PX)
        starts = (windows[:, :2] - margin_px).clip(0, size_px - sides) // self.stride * self.stride
        return np.hstack([starts, starts + sides])

    def saves(self, windows: Windows, size_px: int) -> float:
        """How many numbers less have to be made for these windows."""
        left, top, right, bottom = self.rectangles(windows.px, size_px)[0]
        return numbers_saved(self.made, (right - left) * (bottom - top) / size_px**2, windows.kept is not None)

    def answers(self, photos: Tensor, windows: Windows) -> Tensor:
        """The network's answers to N×3×S×S, whose gradient at the pictures holds in `windows` only."""
        program, rectangles = self.program, self.rectangles(windows.px, photos.shape[-1])
        program.weigh(len(program.steps), photos.shape)
        if windows.kept is None:
            value = _InRectangles.apply(photos, self, rectangles)
        elif self in windows.kept:
            value = _beside(windows.kept[self], photos, self, windows.px, rectangles)
        else:
            value = program.first(self.steps, photos)[self.value]
            windows.kept[self] = value.clone()  # what is left may be written over
        values = program.values(self.value, value)
        compute(program.steps[self.steps :], values, photos)
        return values[program.output]


def _beside(known: Tensor, photos: Tensor, cut: Cut, windows: np.ndarray, rectangles: np.ndarray) -> Tensor:
    """The cut's value of pictures that differ in windows from those whose value is known."""
    value = known.clone()
    again = cut.program.first(cut.steps, _joined(_parts(photos, rectangles)))[cut.value]
    # the rows and columns that see a window
    first = (-((cut.high - windows[:, :2]) // cut.stride)).clip(0)
    last = (windows[:, 2:] - 1 - cut.low) // cut.stride + 1
    seen, corner = np.hstack([first, last]), rectangles[:, :2] // cut.stride
    for part, own in zip(_parts(value, seen), _parts(again, seen - np.hstack([corner, corner])), strict=True):
        part.copy_(own)
    return value


class _InRectangles(torch.autograd.Function):
    """The steps up to a cut, whose gradient is computed in rectangles only."""

    @staticmethod
    def forward(ctx: Any, photos: Tensor, cut: Cut, rectangles: np.ndarray) -> Tensor:
        """The cut's value."""
        ctx.save_for_backward(photos)
        ctx.given = cut, rectangles
        return cut.program.first(cut.steps, photos)[cut.value]

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:  # type: ignore[override]
        """The gradient there, elsewhere 0."""
        (photos,), (cut, rectangles) = ctx.saved_tensors, ctx.given
        cropped = _joined(_parts(photos, rectangles)).requires_grad_()
        with torch.enable_grad():
            again = cut.program.first(cut.steps, cropped)[cut.value]
            height, width = again.shape[2:]
            wanted = [part[:, :height, :width] for part in _parts(gradient, rectangles // cut.stride)]
            told = (again * _joined(wanted)).sum()  # given a gradient, torch would import SymPy, in half a second
        (found,) = torch.autograd.grad(told, cropped)
        whole = torch.zeros_like(photos)
        for part, values in zip(_parts(whole, rectangles), found, strict=True):
            part.copy_(values)
        return whole, None, None


def _parts(values: Tensor, rectangles: np.ndarray) -> list[Tensor]:
    """Of each of N values its rectangle."""
    edges = rectangles.tolist()
    return [value[:, top:bottom, left:right] for value, (left, top, right, bottom) in zip(values, edges, strict=True)]


def _joined(parts: list[Tensor]) -> Tensor:
    """One tensor, colors side by side."""
    return torch.stack(parts).contiguous(memory_format=torch.channels_last)


def find_cut(network: Callable[[Tensor], Tensor], pictures: Tensor) -> Cut | None:
    """Where cutting a network saves most with typical windows, proved with two pictures 2×3×S×S; None where that fails,
    or saves nothing.
    """
    if not isinstance(network, torch.nn.Module):
        return None
    program = network if isinstance(network, Program) else trace_module(network)
    if program is None:
        return None
    size_px = pictures.shape[-1]
    window = Windows(np.array([[0, 0, *2 * [round(TYPICAL * size_px)]]]))
    try:
        best = max(_cuts(program, pictures), key=lambda cut: cut.saves(window, size_px), default=None)
        return best if best and best.saves(window, size_px) > 0 and _holds(network, best, pictures) else None
    except (RuntimeError, ValueError, LookupError):  # steps that take one size only, or the pictures once more
        return None


@torch.no_grad()
def _cuts(program: Program, pictures: Tensor) -> list[Cut]:
    """Wherever one value is left that is smaller than the picture, and how far a pixel reaches in it."""
    size_px, most, cuts, made = pictures.shape[-1], max(STRIDES), [], 0
    if size_px % STEP_PX:
        return cuts
    pixels = [size_px // 2 + torch.tensor([at, most - 1 - at]) for at in range(most // 2)]  # wherever a stride begins
    marked = pictures[:1].repeat(len(pixels), 1, 1, 1).contiguous(memory_format=torch.channels_last)
    for picture, (y, x) in zip(marked, pixels, strict=True):
        picture[:, y, x] = torch.nan
    program.weigh(len(program.steps), marked.shape)
    values = program.values(program.photos, marked)
    for count, step in enumerate(program.steps, 1):
        compute([step], values, marked)
        left = {number: value for number, value in values.items() if number > program.photos}
        value = left.get(step.results[0])
        if not isinstance(value, Tensor):
            continue
        made += value.numel() // len(marked)
        if len(left) > 1 or value.dim() != 4:
            continue
        stride = size_px // value.shape[-1]
        if stride > most:
            break
        if stride in STRIDES:
            marks = zip(pixels, value.isnan().any(1), strict=True)
            away = torch.cat([pixel - stride * picture.nonzero() for pixel, picture in marks])
            cuts.append(Cut(program, count, step.results[0], stride, int(away.min()), int(away.max()), made))
    return cuts


def _holds(network: Callable[[Tensor], Tensor], cut: Cut, pictures: Tensor) -> bool:
    """Whether the gradient is that of the whole network in windows near two corners, so that rectangles have two edges
    of the picture and two of their own, each on either side; and so are answers to pictures that differ there.
    """
    size_px, side = pictures.shape[-1], pictures.shape[-1] // 8
    starts = np.array([[0, 1], [size_px - side - 1, size_px - side]])
    windows = np.hstack([starts, starts + side])
    changed, kept = pictures.clone(memory_format=torch.channels_last), {}
    for part in _parts(changed, windows):
        part.neg_().add_(1)

    @torch.enable_grad()
    def gradients(compute: Callable[[Tensor], Tensor]) -> Tensor:
        photos = pictures.clone(memory_format=torch.channels_last).requires_grad_()
        found = compute(photos)
        weights = torch.linspace(-1, 1, found.numel()).view(found.shape)
        return _joined(_parts(torch.autograd.grad((found * weights).sum(), photos)[0], windows))

    with torch.no_grad():
        _, beside = (cut.answers(photos, Windows(windows, kept)) for photos in (pictures, changed))
        if not _alike(network(changed), beside, SAME_ANSWER):
            return False
    return _alike(gradients(network), gradients(lambda photos: cut.answers(photos, Windows(windows))), SAME)


def _alike(whole: Tensor, cut_off: Tensor, share: float) -> bool:
    largest = float(whole.abs().max())  # 0 proves nothing
    return 0 < largest and float((whole - cut_off).abs().max()) <= share * largest
