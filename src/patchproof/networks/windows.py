"""Where pictures may differ, and whether a network is large enough to be asked there only (see `cuts`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from patchproof.networks.tensor_observer import TensorObserver

# What rectangles save, in numbers that are made, is about LARGEST less their share of the picture, times all those of
# the first steps, less FIXED: with windows of 0.2 to 0.6 of the side, MobileNetV2 saves nothing any more from a share
# of 0.53 on, SqueezeNet 1.1 from 0.49, MobileNet v1 0.75 from 0.44; MobileNet v1 0.25 would lose a tenth with any.
# Answers alone cost the rectangles and nothing twice: in place of LARGEST it is 1.
LARGEST, FIXED = 0.54, 270_000


@dataclass(frozen=True)
class Windows:
    """Where pictures of some views may differ: N×4 pixels (left, top, right, bottom). With `kept`, no gradient is asked
    for: what a network makes of the first pictures that it goes with is left there for all others.
    """

    px: np.ndarray
    kept: dict[Any, Any] | None = None

    def part(self, first: int, last: int) -> Windows:
        """Those of some views."""
        return Windows(self.px[first:last], None if self.kept is None else self.kept.setdefault(first, {}))


def numbers_saved(made: float, share: float, answers_alone: bool = False) -> float:
    """How many of the numbers `made` for each picture need not be, in rectangles of that share of it."""
    return made * ((1 if answers_alone else LARGEST) - share) - FIXED


def worth_cutting(network: Callable[[Tensor], Tensor], pictures: Tensor) -> bool:
    """Whether windows could save anything of a network, by all that it makes of such pictures N×3×S×S."""
    numbers: list[int] = []
    with torch.no_grad(), TensorObserver(lambda tensor: numbers.append(tensor.numel())):
        network(pictures)
    return numbers_saved(sum(numbers) / len(pictures), 0.0) > 0
