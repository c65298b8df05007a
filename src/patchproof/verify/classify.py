"""What the networks make of the photographs: the whole photo's centered square, as in training, in batches.

In: squares of every network's input size. Out: `Prediction`s. The target's labels are looked up in each network's own
list; the promise fixes them for its primary network. Squares, not photographs, wait for their batch, so memory does
not grow with megapixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from patchproof.settings import Refused
from patchproof.sheet.manifest import Manifest, Promise
from patchproof.verify.results import Prediction

if TYPE_CHECKING:
    from patchproof.classifier import Classifier

BATCH = 16


def squares_of(srgb: np.ndarray, sizes_px: Sequence[int]) -> dict[int, np.ndarray]:
    """The centered square of an uint8 photograph at each size, float32 3×S×S in [0, 1]."""
    import torch

    from patchproof.classifier import center_square

    height, width = srgb.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    square = srgb[top : top + side, left : left + side]  # before it becomes float, which takes 4 times the memory
    photo = torch.from_numpy(np.ascontiguousarray(square.transpose(2, 0, 1))).float().div_(255)[None]
    with torch.inference_mode():
        return {size: center_square(photo, size)[0].numpy() for size in sizes_px}


def target_indices(model: Classifier, manifest: Manifest) -> tuple[int, ...]:
    """The labels of `model` that count as recognized; for the promise's primary network those of the promise itself."""
    from patchproof.classifier import find_labels

    target = manifest.promise.target
    if model.name == manifest.promise.models[0].name and max(target.indices) < len(model.labels):
        return target.indices
    wanted = manifest.settings.get("target", {})
    return find_labels(model.labels, wanted.get("label", target.label), wanted.get("accept", ()))


def check_primary(models: Sequence[Classifier], promise: Promise) -> None:
    """Refuse a judge other than the one that the promise was made for."""
    primary = promise.models[0]
    named = {model.name: model for model in models}
    if primary.name not in named:
        raise Refused(f"the promise's own network {primary.name}", ", ".join(named) or "none", f"add {primary.name}")
    if primary.sha256 is not None and named[primary.name].sha256 != primary.sha256:
        raise Refused(
            f"the network {primary.name} that the promise was made for (SHA-256 {primary.sha256[:12]}...)",
            "another file under that name",
            "use the same weights, or make the sheet again",
        )


def predict(model: Classifier, indices: tuple[int, ...], squares: Sequence[np.ndarray]) -> list[Prediction]:
    """One prediction for each square of the network's size."""
    import torch

    out = []
    for start in range(0, len(squares), BATCH):
        with torch.inference_mode():
            logits = model.logits(torch.from_numpy(np.stack(squares[start : start + BATCH]))).cpu()
        likely = torch.softmax(logits.double(), 1)
        top = likely.argmax(1)
        for row, best in enumerate(top.tolist()):
            out.append(
                Prediction(
                    label=model.labels[best],
                    confidence=float(likely[row, best]),
                    target_confidence=float(model.confidence(logits[row : row + 1], indices)[0]),
                    recognized=bool(model.recognized(logits[row : row + 1], indices)[0]),
                )
            )
    return out
