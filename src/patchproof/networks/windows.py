"""Windows: where pictures may differ, and whether a network is large enough to compute there only (see `cuts`)."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from patchproof.networks.tensor_observer import TensorObserver

# Rectangles save about (GRADIENT_GAIN - their share of the picture) · (all numbers computed by the first steps) -
# CUT_COST: with windows of 0.2 to 0.6 of the side, MobileNetV2 saves nothing from a share of 0.53 on, SqueezeNet 1.1
# from 0.49, MobileNet v1 0.75 from 0.44; MobileNet v1 0.25 would lose a tenth with any. For answers alone nothing is
# computed twice: there 1 replaces GRADIENT_GAIN.
GRADIENT_GAIN, CUT_COST = 0.54, 270_000


@dataclass(frozen=True)
class Windows:
    """Where pictures of some views may differ, N×4 pixels (left, top, right, bottom). With `cache`, no gradient is
    needed: the network's intermediate values for the first pictures are stored in it and reused for all later ones.
    """

    px: np.ndarray
    cache: dict[Any, Any] | None = None

    def part(self, first: int, last: int) -> "Windows":
        """The windows of the views from `first` to before `last`."""
        return Windows(self.px[first:last], None if self.cache is None else self.cache.setdefault(first, {}))


def numbers_saved(numbers: float, share: float, answers_alone: bool = False) -> float:
    """How many of `numbers` per picture need not be computed, in rectangles of that share of the picture."""
    return numbers * ((1 if answers_alone else GRADIENT_GAIN) - share) - CUT_COST


def worth_cutting(network: Callable[[Tensor], Tensor], pictures: Tensor) -> bool:
    """True if windows could save anything, judged by all numbers computed for such pictures N×3×S×S."""
    numbers: list[int] = []
    with torch.no_grad(), TensorObserver(lambda tensor, *_: numbers.append(tensor.numel())):
        network(pictures)
    return numbers_saved(sum(numbers) / len(pictures), 0.0) > 0
