"""How pictures reach a network: in batches that it takes, in the order of memory that it is fastest with.

In: a network for N×3×S×S. Out: the same logits for any N, on a CPU in about half the time. Two things cost that time
(medians of 6 forward and backward passes of 16 pictures on one core, torch 2.13, November 2026): a tensor of over
32 MiB is memory that the system hands out and clears anew each time, which MobileNetV2 paid with a third of its time;
and convolutions want the colors of a pixel side by side ("channels last"), another third. Of the plain call's time
remain 0.45 with MobileNetV2 at 224 px, 0.60 with SqueezeNet 1.1, 0.72 with MobileNetV1 0.75 at 192 px; small inputs
are faster whole and stay so. A gradient that is asked for in windows only takes less (cuts.py).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from patchproof.networks.windows import Windows, worth_cutting

if TYPE_CHECKING:
    from patchproof.networks.cuts import Cut

CPU_BATCH_PIXELS = 4 * 224**2  # 2 to 8 pictures of 224 px cost the same each, 12 a third more


class BatchedNetwork(torch.nn.Module):
    """`network` for any N, though itself it may take one number of pictures, `size`, only: short batches repeat their
    last. At most `most` go at a time, None for all.
    """

    def __init__(self, network: Callable[[Tensor], Tensor], size: int | None = None):
        super().__init__()
        self.network, self.size, self.most, self.order = network, size, size, torch.contiguous_format
        self.tried: Tensor | None = None  # on a CPU, two of the pictures that the order was tried with

    def train(self, mode: bool = True) -> BatchedNetwork:
        """Nothing to switch: networks come as they are to be used."""
        return self

    def forward(self, photos: Tensor, windows: Windows | None = None) -> Tensor:
        """N×3×S×S → N×K logits. The pictures' gradient need hold in `windows` only."""
        logits, most = [], self.most or len(photos)
        for number, batch in enumerate(photos.split(most)):
            missing = (self.size or 0) - len(batch)
            padded = torch.cat([batch, batch[-1:].expand(missing, -1, -1, -1)]) if missing > 0 else batch
            ordered = padded.contiguous(memory_format=self.order)
            first = number * most
            own = windows.part(first, first + len(batch)) if windows is not None and missing <= 0 else None
            logits.append(self._answers(ordered, own)[: len(batch)])
        return torch.cat(logits)

    def _answers(self, photos: Tensor, windows: Windows | None) -> Tensor:
        cut = None if windows is None or self.tried is None else self.cut
        if windows is None or cut is None or cut.saves(windows, photos.shape[-1]) <= 0:
            return self.network(photos)
        return cut.answers(photos, windows)

    @cached_property
    def cut(self) -> Cut | None:
        """Where its first layers can be told from the others, found when it is first asked for."""
        if self.tried is None or not worth_cutting(self, self.tried):
            return None
        from patchproof.networks.cuts import find_cut  # which follows a network step by step: small ones do without

        return find_cut(self.network, self.tried)


def tune_batches(network: Callable[[Tensor], Tensor], pictures: Tensor) -> BatchedNetwork:
    """`network` in the batches and the order that suit the device; `pictures` N×3×S×S are tried for it.

    A network may hold a view that takes one order only; such a network is left as it was.
    """
    batches = network if isinstance(network, BatchedNetwork) else BatchedNetwork(network)
    if pictures.device.type == "cpu":
        batches.most = batches.size or cpu_batch_size(pictures.shape[-1])
    batches.tried = pictures[:2] if pictures.device.type == "cpu" else None
    batches.order = torch.channels_last
    try:
        tried = pictures.clone().requires_grad_()
        torch.autograd.grad(batches(tried).sum(), tried)
    except RuntimeError:
        batches.order = torch.contiguous_format
    return batches


def cpu_batch_size(input_px: int) -> int:
    """How many pictures of that side a CPU takes at a time."""
    return max(1, CPU_BATCH_PIXELS // input_px**2)
