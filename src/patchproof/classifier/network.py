"""The classifier as the rest of the project sees it: photographs in, logits out, and what counts as recognized.

In: N×3×H×W sRGB in [0, 1] of any size. Out: N×K logits. Normalization belongs to the network, cropping and resizing to
the centered square belongs here: one function for training, promise, reprint and verification, so that none of them
sees anything else. Recognized means that the top-1 label is among the target's indices; of a detector, see detector.py.
Left out on purpose: labels' meaning (labels.py), loading (load.py), ensembles (a tuple of classifiers is one).
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from patchproof.base.errors import Refused
from patchproof.networks.batches import BatchedNetwork
from patchproof.networks.windows import Windows

NO_BOX_LOGIT = -20.0  # the logit where no candidate of a detector lies on the object: a score of 2e-9


class Odds(NamedTuple):
    """The logarithms of N confidences and of what they lack to 1; float64, so that 1 - 1e-9 is not 1."""

    log_confidence: Tensor
    log_complement: Tensor


@dataclass(frozen=True)
class Classifier:
    """A frozen network with its labels; `network` takes N×3×S×S sRGB in [0, 1], S = `input_px`, gives N×K logits."""

    name: str  # as written in the scene file
    sha256: str | None  # of the weights or the file; None where nothing can be hashed
    input_px: int
    labels: tuple[str, ...]
    network: Callable[[Tensor], Tensor]
    least_score: float | None = None  # from which on a detector's boxes count; a classifier needs none

    KIND: ClassVar[str] = "classifier"
    LOOKS_AT_BOXES: ClassVar[bool] = False  # whether it matters where the object lies

    def with_least_score(self, least_score: float | None) -> Classifier:
        """The network with that score in place of its own, if there is one and it needs any."""
        return self if None in (least_score, self.least_score) else replace(self, least_score=least_score)

    def logits(
        self,
        photos_srgb: Tensor,
        boxes: np.ndarray | None = None,
        windows: np.ndarray | None = None,
        kept: dict[Any, Any] | None = None,
    ) -> Tensor:
        """N×K logits of the photographs' centered squares; refused where they are no numbers, which would pass for an
        answer: the largest of a row with NaN is the NaN. `boxes` N×4 tell where the object lies, as shares of the
        square's side (left, top, right, bottom); only a detector looks at them. Outside of `windows`, N×4 pixels in
        the same order, the photographs' gradient is not asked for, and may be 0; or, with `kept`, they show what the
        first did that it went with, and no gradient is asked for.
        """
        squares, asked = center_square(photos_srgb, self.input_px), None
        if windows is not None:
            asked = Windows(_in_square(windows, photos_srgb.shape[-2:], self.input_px), kept)
        logits = self.answer(squares, boxes, asked)
        if not bool(torch.isfinite(logits).all()):
            do = "check its weights and its number format"
            raise Refused("finite logits", f"NaN or infinity from the network {self.name}", do)
        return logits

    def probabilities(self, logits: Tensor) -> Tensor:
        """N×K softmax, float64."""
        return torch.softmax(logits.double(), 1)

    def odds(self, logits: Tensor, indices: Sequence[int]) -> Odds:
        """Of the summed softmax of the labels in `indices`."""
        log_p = torch.log_softmax(logits.double(), 1)
        chosen = torch.zeros(logits.shape[1], dtype=torch.bool, device=logits.device)
        chosen[list(indices)] = True
        return Odds(torch.logsumexp(log_p[:, chosen], 1), torch.logsumexp(log_p[:, ~chosen], 1))

    def confidence(self, logits: Tensor, indices: Sequence[int]) -> Tensor:
        """N confidences in the labels of `indices`."""
        return self.probabilities(logits)[:, list(indices)].sum(1)

    def recognized(self, logits: Tensor, indices: Sequence[int]) -> Tensor:
        """N bool: the largest logit is one of `indices`."""
        return torch.isin(logits.argmax(1), torch.tensor(list(indices), device=logits.device))

    def answer(self, squares: Tensor, boxes: np.ndarray | None = None, windows: Windows | None = None) -> Tensor:
        """N×K logits of squares of the network's own size, unchecked."""
        return self._asked(squares, windows)

    def _asked(self, squares: Tensor, windows: Windows | None) -> Tensor:
        """What the network itself says."""
        if windows is not None and isinstance(self.network, BatchedNetwork):
            return self.network(squares, windows)
        return self.network(squares)


def center_square(photos_srgb: Tensor, size_px: int) -> Tensor:
    """N×3×H×W in any range → N×3×S×S, unchanged where it has that size; an odd pixel is lost on the right or below.

    Antialiased bilinear resampling, as Pillow does it: each output pixel averages its whole footprint, so a large
    photograph does not alias; differentiable, so that gradients reach the patch.
    """
    height, width = photos_srgb.shape[-2:]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    square = photos_srgb[..., top : top + side, left : left + side]
    if side == size_px:
        return square
    size = (size_px, size_px)
    return torch.nn.functional.interpolate(square, size, mode="bilinear", align_corners=False, antialias=True)


def _in_square(windows: np.ndarray, photo_px: Sequence[int], size_px: int) -> np.ndarray:
    """The pixels of centered squares that depend on those in windows of photographs, both N×4."""
    side = min(photo_px)
    corner, ratio = (np.array(photo_px[::-1]) - side) // 2, side / size_px
    reach = 0 if side == size_px else max(ratio, 1)
    first = np.floor((windows[:, :2] - corner - reach) / ratio)
    last = np.ceil((windows[:, 2:] - corner + reach) / ratio)
    return np.hstack([first, last]).clip(0, size_px).astype(int)


def freeze(network: torch.nn.Module) -> torch.nn.Module:
    """Ask for no gradients of the module's weights; scripted modules cannot do so as a whole."""
    for weights in network.parameters():
        weights.requires_grad_(False)
    return network


def weights_sha256(network: object) -> str | None:
    """SHA-256 over names, types, shapes and bytes of a module's state, in the order of the names; None without any."""
    if not isinstance(network, torch.nn.Module) or not network.state_dict():
        return None
    digest = hashlib.sha256()
    for name, tensor in sorted(network.state_dict().items()):
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()
