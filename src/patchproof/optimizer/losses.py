"""The losses that the optimizer descends on.

In: logits and label indices, or a design. Out: scalars, which add. The target term is the cross-entropy of the *summed*
probability of all accepted labels, the quantity that is reported as confidence; for `deceive`, of its complement.

The paper's printed update Θ + α∇L raises the loss (Pestana et al., Algorithm 1); recognition needs the descent done
here. TV: Mahendran and Vedaldi, CVPR 2015.
"""

from collections.abc import Callable, Sequence

from torch import Tensor

from patchproof.base.goal import Goal
from patchproof.classifier.network import Odds

Loss = Callable[[Tensor, Sequence[int]], Tensor]  # (logits N×K, label indices) -> N losses to descend on


def target_loss(odds: Odds, goal: Goal) -> Tensor:
    """N losses: -log of the confidence (`assist`) or of 1 minus it (`deceive`), in float64 so that none saturates."""
    return -(odds.log_confidence if goal.sign > 0 else odds.log_complement)


def total_variation(design_srgb: Tensor) -> Tensor:
    """Mean absolute difference of neighboring pixels of a 3×h×w design."""
    across = (design_srgb[:, :, 1:] - design_srgb[:, :, :-1]).abs().mean()
    return across + (design_srgb[:, 1:] - design_srgb[:, :-1]).abs().mean()
