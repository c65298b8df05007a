"""What the optimizer wants, as losses to descend on.

In: logits and label indices, or a design. Out: scalars. Goals add. The target term is the cross-entropy of the *summed*
probability of all accepted labels, the quantity that is reported as confidence; for `deceive`, of its complement.

The paper's printed update Θ + α∇L raises the loss (Pestana et al., Algorithm 1); recognition needs the descent done
here. TV: Mahendran and Vedaldi, CVPR 2015. The non-printability score of Sharif et al. (Accessorize to a Crime, CCS
2016) is there to compare with: it knows a printer by thirty of its colors, the gamut term by its whole table.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from patchproof.channel.printer import Printer

PRINTABLE_COLORS = 30  # as many as Sharif et al. kept
_CUBE = 12  # levels of each channel that stand for all colors


def target_loss(logits: Tensor, indices: Sequence[int], goal: str) -> Tensor:
    """N losses: -log p of the accepted labels (`assist`) or of all others (`deceive`), in float64 so that none
    saturates.
    """
    log_p = torch.log_softmax(logits.double(), 1)
    wanted = torch.zeros(logits.shape[1], dtype=torch.bool, device=logits.device)
    wanted[list(indices)] = True
    return -torch.logsumexp(log_p[:, wanted if goal == "assist" else ~wanted], 1)


def total_variation(design_srgb: Tensor) -> Tensor:
    """Mean absolute difference of neighboring pixels of a 3×h×w design."""
    across = (design_srgb[:, :, 1:] - design_srgb[:, :, :-1]).abs().mean()
    return across + (design_srgb[:, 1:] - design_srgb[:, :-1]).abs().mean()


def printable_colors(printer: Printer, count: int = PRINTABLE_COLORS) -> Tensor:
    """count×3: colors on paper that stand for all that a printer shows of a 9×9×9 grid, those nearest to the centers of
    k-means. (Sharif et al. photographed such a print and kept the triplets that stand for it best.)
    """
    from scipy.cluster.vq import kmeans2

    shown = printer.lut[::4, ::4, ::4].reshape(-1, 3).double().numpy()
    centers, _ = kmeans2(shown, count, minit="++", seed=0)
    nearest = np.linalg.norm(shown[:, None] - centers, axis=-1).argmin(0)
    return torch.tensor(shown[nearest], dtype=torch.float32)


def non_printability(design_srgb: Tensor, printable: Tensor) -> Tensor:
    """NPS of Sharif et al. 2016, NPS(p̂) = Π_{p in P} |p̂ - p|, mean over the pixels of a 3×h×w design, over its mean on
    the sRGB cube: 1 is what random colors score, whatever the number of printable ones P×3.
    """
    levels = (torch.arange(_CUBE).to(printable) + 0.5) / _CUBE
    grid = torch.cartesian_prod(levels, levels, levels)
    return _distance_product(design_srgb.flatten(1).T, printable).mean() / _distance_product(grid, printable).mean()


def _distance_product(colors: Tensor, printable: Tensor) -> Tensor:
    exact = "donot_use_mm_for_euclid_dist"  # the faster way rounds small distances to nothing
    return torch.cdist(colors, printable.to(colors), compute_mode=exact).prod(1)
