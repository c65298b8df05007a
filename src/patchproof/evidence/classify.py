"""What the networks make of the photographs: the whole photo's centered square, as in training, one by one.

In: a square of every network's input size, and `Judges`. Out: `Prediction`s. The target's labels are looked up in each
network's own list; the promise fixes them for its primary network. No batches: a photograph's figures must not depend
on which others lie beside it (they did, by 2e-5), and on a processor batches are no faster.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse import csr_array

from patchproof.base.errors import Refused
from patchproof.evidence.results import Prediction
from patchproof.sheets.manifest import Manifest, Promise

if TYPE_CHECKING:
    from patchproof.classifier import Classifier

_STRIP_ROWS = 32  # of a photograph as float: of these few pixels of a square are made, and caches hold them
BoxEdges = tuple[float, float, float, float]  # left, top, right, bottom as shares of the photograph's centered square


@dataclass(frozen=True)
class Judges:
    """Networks, the labels of each that count as recognized, and the one that the promise was made for."""

    models: Sequence[Classifier]
    indices: dict[str, tuple[int, ...]]
    primary: Classifier

    def predictions(self, squares: Mapping[int, np.ndarray], box: BoxEdges | None) -> dict[str, Prediction]:
        """What every network says of one photograph with the object in `box`, by name."""
        models = {model.name: model for model in self.models}
        return {n: predict(m, self.indices[n], squares[m.input_px], box) for n, m in models.items()}


def judges_of(models: Sequence[Classifier], manifest: Manifest) -> Judges | None:
    """The networks as the sheet's judges; None where it promises nothing. Refused without the promise's own network, or
    with another under its name.
    """
    if manifest.promise is None:
        return None
    promised, named = manifest.promise.models[0], {model.name: model for model in models}
    if promised.name not in named:
        raise Refused(f"the promise's own network {promised.name}", ", ".join(named) or "none", f"add {promised.name}")
    primary = named[promised.name]
    if promised.sha256 not in (None, primary.sha256):
        expected = f"the network {promised.name} that the promise was made for (SHA-256 {promised.sha256[:12]}...)"
        raise Refused(expected, "another file under that name", "use the same weights, or make the sheet again")
    indices = {model.name: target_indices(model, manifest.promise, manifest.settings) for model in models}
    return Judges(models, indices, primary)


def boxes_of(box: BoxEdges | None, n: int = 1) -> np.ndarray | None:
    """The object's box in n pictures that all show it there, as networks take it."""
    return None if box is None else np.tile(np.array(box), (n, 1))


def square_of(srgb: np.ndarray) -> tuple[np.ndarray, tuple[int, int]]:
    """The centered square of a picture H×W×3 (a view of it), and its left and top pixel."""
    height, width = srgb.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    return srgb[top : top + side, left : left + side], (left, top)


def squares_of(srgb: np.ndarray, sizes_px: Sequence[int]) -> dict[int, np.ndarray]:
    """The centered square of an uint8 photograph at each size, float32 3×S×S in [0, 1]: `center_square`'s pixels, in an
    eighth of its time, since a strip of rows counts in few rows of the result. The same bits on any number of threads.
    """
    square, _ = square_of(srgb)
    side = len(square)
    rows = {size: np.zeros((size, 3 * side), np.float32) for size in sizes_px}
    for number, top in enumerate(range(0, side, _STRIP_ROWS)):
        strip = square[top : top + _STRIP_ROWS].astype(np.float32).reshape(-1, 3 * side)
        for size, own in rows.items():
            reached, part = _strips(side, size)[number]
            own[reached] += part @ strip
    squares = {size: np.empty((3, size, size), np.float32) for size in sizes_px}  # other strides: other sums
    for size, own in rows.items():
        for channel, plane in enumerate(squares[size]):
            plane[:] = (_weights(side, size) @ np.ascontiguousarray(own[:, channel::3].T)).T / 255
    return squares


@lru_cache(8)  # most photographs of a verification are of one size
def _weights(side: int, size: int) -> csr_array:
    """What each of `side` pixels in a row counts in each of `size`, float32 size×side: `center_square`'s resampling,
    whose kernel is a triangle as wide as two of the new pixels, or two of the old ones where these are larger.
    """
    scale = side / size
    off = np.abs((np.arange(size)[:, None] + 0.5) * scale - (np.arange(side) + 0.5))
    weights = np.maximum(1 - off / max(scale, 1.0), 0)
    return csr_array((weights / weights.sum(1, keepdims=True)).astype(np.float32))


@lru_cache(8)
def _strips(side: int, size: int) -> list[tuple[slice, csr_array]]:
    """Of each strip of rows the rows of the result that it counts in, and its weights there."""
    weights, strips = _weights(side, size).toarray(), []
    for top in range(0, side, _STRIP_ROWS):
        part = weights[:, top : top + _STRIP_ROWS]
        first, last = np.flatnonzero(part.any(1))[[0, -1]]
        reached = slice(int(first), int(last) + 1)
        strips.append((reached, csr_array(part[reached])))
    return strips


def target_indices(model: Classifier, promise: Promise, settings: Mapping[str, Any]) -> tuple[int, ...]:
    """The labels of `model` that count as recognized; for the promise's primary network those of the promise itself."""
    from patchproof.classifier import find_labels

    target = promise.target
    if model.name == promise.models[0].name and max(target.indices) < len(model.labels):
        return target.indices
    wanted = settings.get("target", {})
    return find_labels(model.labels, wanted.get("label", target.label), wanted.get("accept", ()))


def predict(model: Classifier, indices: tuple[int, ...], square: np.ndarray, box: BoxEdges | None) -> Prediction:
    """What the network makes of one square of its size, float32 3×S×S, with the object in `box`."""
    import torch

    with torch.inference_mode():
        logits = model.logits(torch.from_numpy(square)[None], boxes_of(box)).cpu()
    likely = model.probabilities(logits)[0]
    best = int(likely.argmax())
    return Prediction(
        label=model.labels[best],
        confidence=float(likely[best]),
        target_confidence=float(model.confidence(logits, indices)[0]),
        recognized=bool(model.recognized(logits, indices)[0]),
    )
