"""Average precision of a detector for one label, with at most one object in each picture.

In: candidates before suppression, and the true boxes. Out: `Detection`s, which remain after suppression, and their AP
at an IoU of 0.5. In descending order of score, a detection is a hit if it is the first on its object; AP is the mean
precision over the recalls reached, each precision the best at that recall or a higher one (as in PASCAL VOC 2010, at
every point).
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from patchproof.classifier.detector import MIN_IOU, iou

SUPPRESS_IOU = 0.5  # of two detections of one label that overlap more, only the surer one counts
MIN_LOGIT = -4.6  # a score of 0.01: candidates below it are no detections


class Detection(NamedTuple):
    """One box that remains: its label's logit, and whether it is the surest on the picture's object."""

    logit: float
    is_hit: bool


def find_detections(
    candidates: Tensor, indices: Sequence[int], boxes_px: Tensor, shows: Sequence[bool]
) -> list[Detection]:
    """The detections under the labels `indices` in N pictures with candidates N×A×(4+K); `boxes_px` N×4 are the
    objects' boxes, `shows` says which pictures show one.
    """
    detections = []
    for picture_candidates, box, shows_object in zip(candidates, boxes_px, shows, strict=True):
        boxes, logits = picture_candidates[:, :4], picture_candidates[:, 4:][:, list(indices)].amax(1)
        remaining = suppress_overlaps(boxes, logits)
        on_object = (iou(boxes[None, remaining], box[None])[0] >= MIN_IOU) & shows_object
        first = on_object & (on_object.cumsum(0) == 1)
        detections += map(Detection, logits[remaining].tolist(), first.tolist())
    return detections


def average_precision(detections: Iterable[Detection], objects: int) -> float:
    """AP50 of detections in pictures with `objects` objects, at least one."""
    hits = np.array([detection.is_hit for detection in sorted(detections, key=lambda each: -each.logit)], float)
    precision = hits.cumsum() / np.arange(1, len(hits) + 1)
    best = np.maximum.accumulate(precision[::-1])[::-1]
    return float((best * hits).sum() / objects)


def suppress_overlaps(boxes: Tensor, logits: Tensor) -> Tensor:
    """Indices of the candidates A×4 of one label that remain after suppression, the surest first."""
    candidates = torch.nonzero(logits > MIN_LOGIT)[:, 0]
    candidates = candidates[logits[candidates].argsort(descending=True, stable=True)]
    remaining = []
    while len(candidates):
        remaining.append(candidates[0])
        candidates = candidates[1:][iou(boxes[None, candidates[1:]], boxes[None, candidates[0]])[0] <= SUPPRESS_IOU]
    return torch.stack(remaining) if remaining else candidates
