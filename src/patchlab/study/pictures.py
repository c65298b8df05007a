"""Pictures that a study's cells store: photographs side by side, enlarged designs.

In: a problem and an appearance, or pixels. Out: tensors N×3×S×S in [0, 1], and PNG bytes.
"""

from collections.abc import Sequence

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from patchproof.optimizer.pixels import as_pixels, from_pixels
from patchproof.optimizer.problem import Problem
from patchproof.render.photograph import Appearance, expose
from patchproof.report.images import png
from patchproof.scene.conditions import Conditions


def photographs(problem: Problem, shown: Appearance, conditions: Conditions, side_px: int) -> Tensor:
    """N×3×S×S square photographs of one appearance; None is the bare object."""
    with torch.no_grad():
        return expose(problem.see(shown, conditions, side_px), shown)


def contact_sheet(rows: Sequence[Sequence[Tensor] | Tensor]) -> bytes:
    """One PNG of rows of pictures 3×S×S."""
    return png(as_pixels(torch.cat([torch.cat(list(row), 2) for row in rows], 1)))


def enlarge_design(pixels: np.ndarray, side_px: int) -> Tensor:
    """A design H×W×3 enlarged, without smoothing, in the middle of a white square 3×S×S."""
    height, width = pixels.shape[:2]
    scale = side_px / max(height, width)
    size = (round(width * scale), round(height * scale))
    tile = Image.new("RGB", (side_px, side_px), "white")
    large = Image.fromarray(pixels).resize(size, Image.Resampling.NEAREST)
    tile.paste(large, ((side_px - size[0]) // 2, (side_px - size[1]) // 2))
    return from_pixels(np.asarray(tile))
