"""A detector with the interface of a classifier: photographs and the object's box in, logits out.

In: what a network finds in the photographs' centered squares: candidate boxes with a score for each label, before
overlapping ones are suppressed. Out: per photograph and label the logit of the best candidate on the object
(intersection over union of at least `MIN_IOU` with its box), so that rates, losses, controls and promises are defined
as for classifiers: the object is recognized where that score reaches `least_score`, and confidence is the score. Where
the object's box is not known, any candidate counts. Left out on purpose: suppression, which keeps the best candidate of
an object, the only one that counts here.
"""

from collections.abc import Callable, Sequence  # noqa: F401 (Callable: of the annotations of the inherited __init__)
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from patchproof.classifier.network import NO_BOX_LOGIT, Classifier, Odds, columns
from patchproof.networks.batches import Windows

MIN_IOU = 0.5  # as in PASCAL VOC's and COCO's AP50


@dataclass(frozen=True)
class Detector(Classifier):
    """A frozen detector; `network` takes N×3×S×S sRGB in [0, 1], S = `input_px`, and gives candidates N×A×(4+K): a box
    (left, top, right, bottom) in the square's pixels, then the logits of its labels.
    """

    least_score: float = 0.5

    KIND = "detector"
    LOOKS_AT_BOXES = True

    def probabilities(self, logits: Tensor) -> Tensor:
        """N×K scores, each label's own."""
        return torch.sigmoid(logits.double())

    def odds(self, logits: Tensor, indices: Sequence[int]) -> Odds:
        """The logarithms of the best score among the labels in `indices`, and of 1 minus that score."""
        best = columns(logits, indices).amax(1).double()
        return Odds(torch.nn.functional.logsigmoid(best), torch.nn.functional.logsigmoid(-best))

    def confidence(self, logits: Tensor, indices: Sequence[int]) -> Tensor:
        """N best scores of the labels in `indices`."""
        return columns(self.probabilities(logits), indices).amax(1)

    def recognized(self, logits: Tensor, indices: Sequence[int]) -> Tensor:
        """N bool: the object was found under one of these labels with a sufficient score."""
        return self.confidence(logits, indices) >= self.least_score

    def square_logits(self, squares: Tensor, boxes: np.ndarray | None = None, windows: Windows | None = None) -> Tensor:
        """N×K logits of the best candidates on the object; `boxes` N×4 are shares of the square."""
        return self._on_object(self._call_network(squares, windows), boxes).amax(1)

    def target_box(self, square: Tensor, indices: Sequence[int], boxes: np.ndarray | None) -> tuple[float, ...] | None:
        """The surest box of the labels in `indices` on the object, in shares of the square; None if there is none."""
        candidates = self._call_network(square, None)
        score, best = self._on_object(candidates, boxes)[0, :, list(indices)].amax(1).max(0)
        return tuple((candidates[0, best, :4] / self.input_px).tolist()) if float(score) > NO_BOX_LOGIT else None

    def _on_object(self, candidates: Tensor, boxes: np.ndarray | None) -> Tensor:
        """N×A×K logits of the candidates, those that do not lie on the object masked."""
        logits = candidates[..., 4:]
        if boxes is not None:
            overlap = iou(candidates[..., :4].detach(), torch.as_tensor(boxes).to(candidates) * self.input_px)
            logits = logits.masked_fill((overlap < MIN_IOU)[..., None], NO_BOX_LOGIT)
        return logits


def iou(boxes: Tensor, truth: Tensor) -> Tensor:
    """N×A intersections over unions of boxes N×A×4 with one true box each, N×4."""
    truth = truth[:, None]
    low, high = torch.maximum(boxes[..., :2], truth[..., :2]), torch.minimum(boxes[..., 2:], truth[..., 2:])
    shared = (high - low).clamp_min(0).prod(-1)
    areas = [(each[..., 2:] - each[..., :2]).clamp_min(0).prod(-1) for each in (boxes, truth)]
    return shared / (areas[0] + areas[1] - shared).clamp_min(1e-9)
