"""How well a detector finds objects of one label: average precision, with one object or none in each picture.

In: candidates before suppression, and the true boxes. Out: `Detection`s, what is left after suppression, and their AP at
an IoU of 0.5: the surest first, they are right where they are the first on their object; AP is the mean precision over
the recall that they reach, each precision the best at that recall or a higher one (as PASCAL VOC 2010 has it, at every
point).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from patchproof.classifier.detector import MIN_IOU, iou

SUPPRESS_IOU = 0.5  # of two findings of one label that overlap more, only the surer one counts
LEAST_LOGIT = -4.6  # a score of 0.01: less is no finding


class Detection(NamedTuple):
    """One box that is left: its label's logit, and whether it is the surest on the picture's object."""

    logit: float
    right: bool


def find_detections(
    candidates: Tensor, indices: Sequence[int], boxes_px: Tensor, shows: Sequence[bool]
) -> list[Detection]:
    """What is found under one of the labels in N pictures with candidates N×A×(4+K); `boxes_px` N×4 of the objects in
    those that show one.
    """
    all_found = []
    for found, box, is_there in zip(candidates, boxes_px, shows, strict=True):
        boxes, logits = found[:, :4], found[:, 4:][:, list(indices)].amax(1)
        kept = suppress_overlaps(boxes, logits)
        on_object = (iou(boxes[None, kept], box[None])[0] >= MIN_IOU) & is_there
        first = on_object & (on_object.cumsum(0) == 1)
        all_found += map(Detection, logits[kept].tolist(), first.tolist())
    return all_found


def average_precision(found: Iterable[Detection], objects: int) -> float:
    """AP50 of what was found where there were so many objects, at least one."""
    hits = np.array([finding.right for finding in sorted(found, key=lambda each: -each.logit)], float)
    precision = hits.cumsum() / np.arange(1, len(hits) + 1)
    best = np.maximum.accumulate(precision[::-1])[::-1]
    return float((best * hits).sum() / objects)


def suppress_overlaps(boxes: Tensor, logits: Tensor) -> Tensor:
    """Indices of the candidates A×4 of one label that remain, the surest first."""
    left = torch.nonzero(logits > LEAST_LOGIT)[:, 0]
    left = left[logits[left].argsort(descending=True, stable=True)]
    kept = []
    while len(left):
        kept.append(left[0])
        left = left[1:][iou(boxes[None, left[1:]], boxes[None, left[0]])[0] <= SUPPRESS_IOU]
    return torch.stack(kept) if kept else left
