"""How well a detector finds objects of one label: average precision, with one object or none in each picture.

In: candidates before suppression, and the true boxes. Out: AP at an IoU of 0.5: all findings of the label, the surest
first, are right where they are the first on their object; AP is the mean precision over the recall that they reach,
each precision the best at that recall or a higher one (as COCO and PASCAL VOC 2010 have it, at every point).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from patchproof.classifier.detector import LEAST_IOU, iou

SUPPRESS_IOU = 0.5  # of two findings of one label that overlap more, only the surer one counts
LEAST_LOGIT = -4.6  # a score of 0.01: less is no finding


def average_precision(candidates: Tensor, label: int, boxes_px: Tensor, shows: Tensor) -> float:
    """AP50 of `label` over N pictures with candidates N×A×(4+K); `boxes_px` N×4 of the objects in those that show one
    (N bool). NaN where none does.
    """
    scores, right = [], []
    for found, box, is_there in zip(candidates, boxes_px, shows.tolist(), strict=True):
        kept = unsuppressed(found[:, :4], found[:, 4 + label])
        on_object = (iou(found[None, kept, :4], box[None])[0] >= LEAST_IOU) & is_there
        first = on_object & (on_object.cumsum(0) == 1)  # kept ones come surest first
        scores.append(found[kept, 4 + label])
        right.append(first)
    order = torch.cat(scores).argsort(descending=True, stable=True)
    hits = torch.cat(right)[order].cpu().numpy().astype(float)
    total = int(shows.sum())
    if not total:
        return float("nan")
    precision = hits.cumsum() / np.arange(1, len(hits) + 1)
    best = np.maximum.accumulate(precision[::-1])[::-1]
    return float((best * hits).sum() / total)


def unsuppressed(boxes: Tensor, logits: Tensor) -> Tensor:
    """Indices of the candidates A×4 of one label that remain, the surest first."""
    left = torch.nonzero(logits > LEAST_LOGIT)[:, 0]
    left = left[logits[left].argsort(descending=True, stable=True)]
    kept = []
    while len(left):
        kept.append(left[0])
        left = left[1:][iou(boxes[None, left[1:]], boxes[None, left[0]])[0] <= SUPPRESS_IOU]
    return torch.stack(kept) if kept else left
