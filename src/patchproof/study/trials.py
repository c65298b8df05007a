"""What studies of patches share: a loop run to its end, and things shown under the same conditions.

In: problems. Out: the best design's pixels; logits by what is shown; and, for tables, groups of results and differences
over clusters. Nothing is drawn, chosen or kept here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from patchproof.claims import LEAST_CLUSTERS, Estimate, clustered_mean
from patchproof.optimizer import loop
from patchproof.optimizer.problem import Problem
from patchproof.output import image_bytes
from patchproof.render.photograph import Shown, expose
from patchproof.scene.conditions import Conditions
from patchproof.study.study import Result

_CHUNK = 16


def passes(problem: Problem) -> int:
    """Views that each network sees in training and selection."""
    settings = problem.scene.settings.optimize
    return settings.steps * settings.views + loop.selections(settings) * loop.SELECT_VIEWS


def logits_of(problem: Problem, shown: dict[str, Shown], conditions: Conditions) -> dict[str, Tensor]:
    """N×K logits of the first network by what is shown, in the same views, at the size of figures people read."""
    piece = next(one for one in shown.values() if one is not None)
    parts: dict[str, list[Tensor]] = {kind: [] for kind in shown}
    with torch.no_grad():
        for first in range(0, len(conditions), _CHUNK):
            seen = problem.see(piece, conditions[first : first + _CHUNK], problem.figure_px)
            for kind, one in shown.items():
                parts[kind].append(problem.classifiers[0].logits(expose(seen, one)))
    return {kind: torch.cat(part) for kind, part in parts.items()}


def png_of(pixels: np.ndarray) -> bytes:
    """uint8 H×W×3 as a PNG file's bytes."""
    return image_bytes(pixels, "PNG")


def enlarged(pixels: np.ndarray, side_px: int) -> np.ndarray:
    """A design in the middle of a white square tile, as large as fits, so that its pixels can be seen."""
    from PIL import Image

    height, width = pixels.shape[:2]
    scale = side_px / max(height, width)
    size = (round(width * scale), round(height * scale))
    tile = Image.new("RGB", (side_px, side_px), "white")
    tile.paste(
        Image.fromarray(pixels).resize(size, Image.Resampling.NEAREST),
        ((side_px - size[0]) // 2, (side_px - size[1]) // 2),
    )
    return np.array(tile)


def short(model: str) -> str:
    """A network's name for people and files: `file:${DIR}/models/net.pt2` is net."""
    return Path(model.partition(":")[2] or model).name.removesuffix(".pt2")


def grouped(results: Sequence[Result], key: Callable[[Result], Any]) -> dict[Any, list[Result]]:
    """Results by key, keys in the order they come."""
    groups: dict[Any, list[Result]] = {}
    for one in results:
        groups.setdefault(key(one), []).append(one)
    return groups


def clustered(values: Sequence[float]) -> Estimate | float | None:
    """Mean of one figure per cluster with its bootstrap interval, n the number of clusters; without an interval where
    they are too few for one; None of nothing.
    """
    if len(values) < LEAST_CLUSTERS:
        return float(np.mean(values)) if values else None
    mean, (low, high) = clustered_mean(values)
    return Estimate(mean, low, high, len(values))
