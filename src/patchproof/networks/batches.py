"""Call a network in batches that it accepts and in the memory order that is fastest for it.

In: a network for N×3×S×S. Out: the same logits for any N, on a CPU in about half the time. Two things cost that time
(16 pictures forward and backward, one core, torch 2.13): the system hands out and clears a tensor of over 32 MiB as
fresh memory each time, a third of MobileNetV2's time; and convolutions want the colors of a pixel side by side
("channels last"), another third. The share of the plain call's time that remains is 0.45 with MobileNetV2 at 224 px,
0.60 with SqueezeNet 1.1, 0.72 with MobileNetV1 0.75 at 192 px; small inputs are faster in one batch and stay so. Large
networks are computed only in windows where pictures change or need gradients (cuts.py).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from patchproof.networks.graph import TensorObserver

if TYPE_CHECKING:
    from patchproof.networks.cuts import Cut

# Rectangles save about (GRADIENT_GAIN - their share of the picture) · (all numbers computed by the first steps) -
# CUT_COST: with windows of 0.2 to 0.6 of the side, MobileNetV2 saves nothing from a share of 0.53 on, SqueezeNet 1.1
# from 0.49, MobileNet v1 0.75 from 0.44; MobileNet v1 0.25 would lose a tenth with any. For answers alone nothing is
# computed twice: there 1 replaces GRADIENT_GAIN.
GRADIENT_GAIN, CUT_COST = 0.54, 270_000
CPU_BATCH_PIXELS = 4 * 224**2  # 2 to 8 pictures of 224 px cost the same each, 12 a third more


@dataclass(frozen=True)
class Windows:
    """Where views may differ, N×4 pixels (left, top, right, bottom). With `cache`, no gradient is needed: the network's
    values for the first pictures are stored in it and reused for all later ones.
    """

    px: np.ndarray
    cache: dict[Any, Any] | None = None

    def part(self, first: int, last: int) -> "Windows":
        """The windows of the views from `first` to before `last`."""
        return Windows(self.px[first:last], None if self.cache is None else self.cache.setdefault(first, {}))


def numbers_saved(numbers: float, share: float, answers_alone: bool = False) -> float:
    """Return how many of a picture's `numbers` are saved by rectangles that cover this share of it."""
    return numbers * ((1 if answers_alone else GRADIENT_GAIN) - share) - CUT_COST


class BatchedNetwork(torch.nn.Module):
    """Calls `network` for any N, at most `max_pictures` at a time (None: all). A network that takes exactly `size`
    pictures gets short batches filled up with their last picture.
    """

    def __init__(self, network: Callable[[Tensor], Tensor], size: int | None = None):
        super().__init__()
        self.network, self.size, self.max_pictures, self.memory_format = network, size, size, torch.contiguous_format
        self.sample: Tensor | None = None  # on a CPU, two of the pictures given for tuning
        self.checked_as: Any = None  # the kind, device, size and labels with which `load_classifier` has checked it

    def train(self, mode: bool = True) -> "BatchedNetwork":
        """Change nothing: networks stay in the mode they came in."""
        return self

    def forward(self, photos: Tensor, windows: Windows | None = None) -> Tensor:
        """N×3×S×S → N×K logits. With `windows`, the gradient at the pictures is right only inside of them."""
        logits, max_pictures = [], self.max_pictures or len(photos)
        for number, batch in enumerate(photos.split(max_pictures)):
            missing = (self.size or 0) - len(batch)
            padded = torch.cat([batch, batch[-1:].expand(missing, -1, -1, -1)]) if missing > 0 else batch
            ordered = padded.contiguous(memory_format=self.memory_format)
            first = number * max_pictures
            batch_windows = windows.part(first, first + len(batch)) if windows is not None and missing <= 0 else None
            logits.append(self._logits(ordered, batch_windows)[: len(batch)])
        return torch.cat(logits)

    def _logits(self, photos: Tensor, windows: Windows | None) -> Tensor:
        cut = None if windows is None or self.sample is None else self.cut
        if windows is None or cut is None or cut.saves(windows, photos.shape[-1]) <= 0:
            return self.network(photos)
        return cut.answers(photos, windows)

    @cached_property
    def cut(self) -> "Cut | None":
        """The split after the first layers, searched for on first access; None if windows would save nothing."""
        if self.sample is None or not worth_cutting(self, self.sample):
            return None
        from patchproof.networks.cuts import find_cut  # only large networks need this import

        return find_cut(self.network, self.sample)


def tune_batches(network: Callable[[Tensor], Tensor], pictures: Tensor) -> BatchedNetwork:
    """Wrap `network` with the batch size and memory order for the device, tried with `pictures` N×3×S×S. A network that
    fails in "channels last" order, as by reshaping its input, keeps the usual one.
    """
    batches = network if isinstance(network, BatchedNetwork) else BatchedNetwork(network)
    if pictures.device.type == "cpu":
        batches.max_pictures = batches.size or cpu_batch_size(pictures.shape[-1])
    batches.sample = pictures[:2] if pictures.device.type == "cpu" else None
    batches.memory_format = torch.channels_last
    try:
        photos = pictures.clone().requires_grad_()
        torch.autograd.grad(batches(photos).sum(), photos)
    except RuntimeError:
        batches.memory_format = torch.contiguous_format
    return batches


def cpu_batch_size(input_px: int) -> int:
    """The number of pictures of side `input_px` that a CPU takes at a time."""
    return max(1, CPU_BATCH_PIXELS // input_px**2)


def worth_cutting(network: Callable[[Tensor], Tensor], pictures: Tensor) -> bool:
    """True if windows could save anything, judged by all numbers computed for such pictures N×3×S×S."""
    numbers: list[int] = []
    with torch.no_grad(), TensorObserver(lambda tensor, *_: numbers.append(tensor.numel())):
        network(pictures)
    return numbers_saved(sum(numbers) / len(pictures), 0.0) > 0
