"""Classify photographs one by one: each network gets the photograph's centered square, as in training.

In: a square of every network's input size, and `Judges`. Out: `Prediction`s. The target's labels are looked up in each
network's own list; the promise fixes them for its primary network. There are no batches: with them, a photograph's
figures depended by 2e-5 on the photographs beside it, and on a CPU they are no faster.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse import csr_array

from patchproof.base.errors import Refused
from patchproof.base.geometry import rect_corners
from patchproof.evidence.results import Prediction
from patchproof.sheets.manifest import Manifest, Promise

if TYPE_CHECKING:
    from patchproof.classifier import Classifier

_STRIP_ROWS = 32  # of a photograph as float at a time: caches hold them
BoxEdges = tuple[float, float, float, float]  # left, top, right, bottom as shares of the photograph's centered square


@dataclass(frozen=True)
class Judges:
    """Networks, the labels of each that count as recognized, and the one that the promise was made for."""

    models: "Sequence[Classifier]"
    indices: dict[str, tuple[int, ...]]
    primary: "Classifier"

    def predictions(self, squares: Mapping[int, np.ndarray], box: BoxEdges | None) -> dict[str, Prediction]:
        """Classify one photograph with the object in `box` by every network: predictions by network's name."""
        return {m.name: predict(m, self.indices[m.name], squares[m.input_px], box) for m in self.models}


def judges_of(models: "Sequence[Classifier]", manifest: Manifest) -> Judges | None:
    """Combine the networks with the sheet's target; None if the sheet has no promise. Refused are networks without the
    promise's own one, and another file, or other labels, under its name.
    """
    if manifest.promise is None:
        return None
    by_name, first = {model.name: model for model in models}, manifest.promise.models[0].name
    if first not in by_name:
        raise Refused(f"the promise's own network {first}", ", ".join(by_name) or "none", f"add {first}")
    for promised in manifest.promise.models:
        sha256 = by_name[promised.name].sha256 if promised.name in by_name else promised.sha256
        if promised.sha256 not in (None, sha256):
            expected = f"the network {promised.name} that the promise was made for (SHA-256 {promised.sha256[:12]}...)"
            got = "a network without a file" if sha256 is None else f"SHA-256 {sha256[:12]}..."
            raise Refused(expected, got, "use the same weights, or make the sheet again")
    indices = {model.name: target_indices(model, manifest.promise, manifest.settings) for model in models}
    return Judges(models, indices, by_name[first])


def boxes_of(box: BoxEdges | None, n: int = 1) -> np.ndarray | None:
    """Repeat the object's box for n pictures (n×4), as networks take it; None stays None."""
    return None if box is None else np.tile(np.array(box), (n, 1))


def box_in_square(box: BoxEdges, size_px: tuple[int, int]) -> BoxEdges:
    """Convert a box in shares of the sides of a photograph of `size_px` to shares of its centered square; to all zeros,
    which no detection overlaps, if it lies outside.
    """
    edges = (size * (value - 0.5) / min(size_px) + 0.5 for value, size in zip(box, 2 * size_px, strict=True))
    x0, y0, x1, y1 = (min(max(value, 0.0), 1.0) for value in edges)
    return (x0, y0, x1, y1) if x1 > x0 and y1 > y0 else (0.0, 0.0, 0.0, 0.0)


def box_corners_px(box: BoxEdges, size_px: tuple[int, int]) -> np.ndarray:
    """Convert a box of `box_in_square` back to its corners (4×2) in pixels."""
    (width, height), side = size_px, min(size_px)
    x0, y0, x1, y1 = box
    return side * rect_corners((x0, y0, x1 - x0, y1 - y0)) + ((width - side) / 2, (height - side) / 2)


def square_of(srgb: np.ndarray) -> tuple[np.ndarray, tuple[int, int]]:
    """Slice the centered square from a picture H×W×3, without a copy; also returns its left and top pixel."""
    height, width = srgb.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    return srgb[top : top + side, left : left + side], (left, top)


def squares_of(srgb: np.ndarray, sizes_px: Sequence[int]) -> dict[int, np.ndarray]:
    """Resample the centered square of an uint8 photograph to each size, float32 3×S×S in [0, 1].

    The pixels are those of `center_square`, in an eighth of its time, with the same bits for any number of threads.
    """
    square, _ = square_of(srgb)
    side = len(square)
    rows = {size: np.zeros((size, 3 * side), np.float32) for size in sizes_px}
    for number, top in enumerate(range(0, side, _STRIP_ROWS)):
        strip = square[top : top + _STRIP_ROWS].astype(np.float32).reshape(-1, 3 * side)
        for size, sums in rows.items():
            affected, part = _strip_weights(side, size)[number]
            sums[affected] += part @ strip
    squares = {size: np.empty((3, size, size), np.float32) for size in sizes_px}  # other strides change rounding
    for size, sums in rows.items():
        for channel, plane in enumerate(squares[size]):
            plane[:] = (_weights(side, size) @ np.ascontiguousarray(sums[:, channel::3].T)).T / 255
    return squares


@lru_cache(8)  # most photographs of a verification are of one size
def _weights(side: int, size: int) -> csr_array:
    """Weights (float32, size×side) of resampling a row of `side` pixels to `size`, as `center_square` does it: the
    kernel is a triangle two new pixels wide, or two old ones if these are larger.
    """
    scale = side / size
    off = np.abs((np.arange(size)[:, None] + 0.5) * scale - (np.arange(side) + 0.5))
    weights = np.maximum(1 - off / max(scale, 1.0), 0)
    return csr_array((weights / weights.sum(1, keepdims=True)).astype(np.float32))


@lru_cache(8)
def _strip_weights(side: int, size: int) -> list[tuple[slice, csr_array]]:
    """For each strip of rows, the rows of the result that it contributes to, and its weights in them."""
    weights, strips = _weights(side, size).toarray(), []
    for top in range(0, side, _STRIP_ROWS):
        part = weights[:, top : top + _STRIP_ROWS]
        first, last = np.flatnonzero(part.any(1))[[0, -1]]
        affected = slice(int(first), int(last) + 1)
        strips.append((affected, csr_array(part[affected])))
    return strips


def target_indices(model: "Classifier", promise: Promise, settings: Mapping[str, Any]) -> tuple[int, ...]:
    """Indices of the labels that count as recognized; refused where the primary network's are not those promised."""
    from patchproof.classifier import find_labels

    target, told = promise.target, settings.get("target") or {}
    label, accept = told.get("label", target.label), told.get("accept", ())
    label = label if str(label) == target.label else target.label  # an index is text there
    is_primary, indices = model.name == promise.models[0].name, ()
    try:
        indices = find_labels(model.labels, label, accept)
    except Refused:
        if not is_primary:
            raise
    if is_primary and indices != target.indices:
        names, places = (" or ".join(map(str, each)) for each in ((label, *accept), target.indices))
        expected = f"{names} as label {places} of {model.name}, as promised"
        got = " or ".join(f'"{model.labels[i]}"' if i < len(model.labels) else "none" for i in target.indices)
        raise Refused(expected, got, "give it back the labels it had, or make the sheet again")
    return indices


def predict(model: "Classifier", indices: tuple[int, ...], square: np.ndarray, box: BoxEdges | None) -> Prediction:
    """Classify one square of the network's input size, float32 3×S×S, with the object in `box`."""
    import torch

    with torch.inference_mode():
        squares = torch.from_numpy(square)[None]
        logits = model.logits(squares, boxes_of(box)).cpu()
        target_box = model.target_box(squares, indices, boxes_of(box))
    likely = model.probabilities(logits)[0]
    best, target_confidence = int(likely.argmax()), float(model.confidence(logits, indices)[0])
    figures = {"confidence": float(likely[best]), "target_confidence": target_confidence, "target_box": target_box}
    is_target = bool(model.recognized(logits, indices)[0])
    return Prediction(label=model.labels[best], recognized=is_target, least_score=model.least_score, **figures)
