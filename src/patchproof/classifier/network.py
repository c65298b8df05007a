"""The classifier as the rest of the project sees it: photographs in, logits out, and a rule for "recognized".

In: N×3×H×W sRGB in [0, 1] of any size. Out: N×K logits. Normalization belongs to the network; cropping and resizing to
the centered square belong here, in one function for training, promise, reprint and verification, so that all of them
see the same. Recognized means that the top-1 label is among the target's indices; for detectors see detector.py.
Left out on purpose: labels' meaning (labels.py), loading (load.py), ensembles (a tuple of classifiers is one).
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from patchproof.base.errors import Refused
from patchproof.base.fingerprint import value_sha256
from patchproof.base.text import brief, short_repr
from patchproof.networks.batches import BatchedNetwork, Windows

INPUT_PX = range(8, 4097)  # sides of the squares that networks may take
NO_BOX_LOGIT = -20.0  # the logit where no candidate of a detector lies on the object: a score of 2e-9


class Odds(NamedTuple):
    """The logarithms of N confidences and of 1 minus each; float64, so that 1 - 1e-9 is not 1."""

    log_confidence: Tensor
    log_complement: Tensor


@dataclass(frozen=True)
class Classifier:
    """A frozen network with its labels; `network` takes N×3×S×S sRGB in [0, 1], S = `input_px`, gives N×K logits."""

    name: str  # as written in the scene file
    sha256: str | None  # of the weights or the file; None if there is nothing to hash
    input_px: int
    labels: tuple[str, ...]
    network: Callable[[Tensor], Tensor]
    least_score: float | None = None  # from which a detector's boxes count; a classifier needs none
    notes: tuple[str, ...] = ()  # what is odd about it

    KIND: ClassVar[str] = "classifier"
    LOOKS_AT_BOXES: ClassVar[bool] = False  # whether the object's box matters
    __repr__ = short_repr

    def __init_subclass__(cls):
        cls.__repr__ = short_repr  # a dataclass would list all layers

    @property
    def fingerprint(self) -> str:
        """SHA-256 of what its answers depend on: weights, input size, labels; code is not among it."""
        return value_sha256([self.KIND, self.sha256, self.input_px, self.labels])

    def with_least_score(self, least_score: float | None) -> "Classifier":
        """A copy with that `least_score`; the classifier itself if the score is None or it needs none."""
        return self if None in (least_score, self.least_score) else replace(self, least_score=least_score)

    def logits(
        self,
        photos_srgb: Tensor,
        boxes: np.ndarray | None = None,
        windows: np.ndarray | None = None,
        cache: dict[Any, Any] | None = None,
    ) -> Tensor:
        """N×K logits of the photographs' centered squares; refused if any is not finite.

        `boxes` N×4 are the object's boxes as shares of the square's side (left, top, right, bottom), for detectors.
        With `windows`, N×4 pixels in that order, the gradient at the photographs may be 0 outside of them. With `cache`
        as well there is no gradient, and outside of the windows photographs equal the first ones passed with this
        cache.
        """
        if not isinstance(photos_srgb, Tensor) or photos_srgb.dim() != 4 or photos_srgb.shape[1] != 3:
            raise Refused("photographs as a tensor N×3×H×W", brief(photos_srgb), "stack them, channels first")
        squares, square_windows = center_square(photos_srgb, self.input_px), None
        if windows is not None:
            square_windows = Windows(_windows_in_square(windows, photos_srgb.shape[-2:], self.input_px), cache)
        logits = self.square_logits(squares, boxes, square_windows)
        if not bool(torch.isfinite(logits).all()):
            do = "check its weights and its number format"
            raise Refused("finite logits", f"NaN or infinity from the network {self.name}", do)
        return logits

    def probabilities(self, logits: Tensor) -> Tensor:
        """N×K softmax, float64."""
        return torch.softmax(logits.double(), 1)

    def odds(self, logits: Tensor, indices: Sequence[int]) -> Odds:
        """Logarithms of the summed softmax of the labels in `indices` and of all others."""
        log_p = torch.log_softmax(logits.double(), 1)
        chosen, others = sorted(indices), [i for i in range(logits.shape[1]) if i not in indices]
        return Odds(*(torch.logsumexp(columns(log_p, which), 1) for which in (chosen, others)))

    def confidence(self, logits: Tensor, indices: Sequence[int]) -> Tensor:
        """N confidences in the labels of `indices`."""
        return columns(self.probabilities(logits), indices).sum(1)

    def recognized(self, logits: Tensor, indices: Sequence[int]) -> Tensor:
        """N bool: the largest logit is one of `indices`."""
        return torch.isin(logits.argmax(1), _on_device(tuple(indices), logits.device))

    def target_box(self, square: Tensor, indices: Sequence[int], boxes: np.ndarray | None) -> tuple[float, ...] | None:
        """The surest box of the labels in `indices` in one square, in shares of its side; None without boxes."""

    def square_logits(self, squares: Tensor, boxes: np.ndarray | None = None, windows: Windows | None = None) -> Tensor:
        """N×K logits of squares of the network's input size, not checked for NaN."""
        return self._call_network(squares, windows)

    def _call_network(self, squares: Tensor, windows: Windows | None) -> Tensor:
        """The network's own output for squares N×3×S×S."""
        if windows is not None and isinstance(self.network, BatchedNetwork):
            return self.network(squares, windows)
        return self.network(squares)


def columns(values: Tensor, indices: Sequence[int]) -> Tensor:
    """Columns of N×K values by number; a device gets the numbers once, not with every picture."""
    return values.index_select(1, _on_device(tuple(indices), values.device))


@lru_cache(maxsize=64)
def _on_device(indices: tuple[int, ...], device: torch.device) -> Tensor:
    with torch.inference_mode(False):  # whose tensors no gradient could pass later
        return torch.tensor(indices, dtype=torch.int64, device=device)


def center_square(photos_srgb: Tensor, size_px: int) -> Tensor:
    """N×3×H×W in any range → N×3×S×S, unchanged where it has that size; an odd pixel is lost on the right or below. It
    is resampled bilinearly with antialiasing, as in Pillow, and differentiably.
    """
    height, width = photos_srgb.shape[-2:]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    square = photos_srgb[..., top : top + side, left : left + side]
    if side == size_px:
        return square
    size = (size_px, size_px)
    return torch.nn.functional.interpolate(square, size, mode="bilinear", align_corners=False, antialias=True)


def _windows_in_square(windows: np.ndarray, photo_px: Sequence[int], size_px: int) -> np.ndarray:
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
    """SHA-256 over names, types, shapes and bytes of a module's state, in the order of the names; None without any, and
    for weights without bytes of their own (quantized, sparse, still lazy, not tensors).
    """
    if not isinstance(network, torch.nn.Module) or not network.state_dict():
        return None
    digest = hashlib.sha256()
    try:
        for name, tensor in sorted(network.state_dict().items()):
            digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
            digest.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    except (AttributeError, RuntimeError):  # such as of meta tensors
        return None
    return digest.hexdigest()
