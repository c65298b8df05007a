"""Average precision of a detector, by hand and beside OpenCV's suppression."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
import torch

from patchlab.training.average_precision import average_precision, find_detections, suppress_overlaps


def test_average_precision_by_hand():
    """Three pictures, two of which show the object: hits of 0.9 and 0.6, a duplicate of 0.8, a false one of 0.7."""

    def logit(score):
        return math.log(score / (1 - score))

    here, away = [0.0, 0, 10, 10], [50.0, 50, 60, 60]
    rows = torch.tensor(
        [
            [[*here, logit(0.9)], [1.0, 0, 10, 10, logit(0.8)]],
            [[*away, logit(0.7)], [*here, logit(0.6)]],
            [[*here, -9.0], [*away, -9.0]],
        ]
    )
    assert suppress_overlaps(rows[0, :, :4], rows[0, :, 4]).tolist() == [0]
    found = find_detections(rows, [0], torch.tensor([here] * 3), [True, True, False])
    assert [right for _, right in found] == [True, False, True]
    assert average_precision(found, 2) == pytest.approx((1 + 2 / 3) / 2)
    assert average_precision(found, 3) == pytest.approx((1 + 2 / 3) / 3)
    assert average_precision([], 3) == 0
    assert not any(right for _, right in find_detections(rows, [0], torch.tensor([here] * 3), [False] * 3))


def test_suppression_agrees_with_opencv_s():
    rng = np.random.default_rng(1)
    corners = rng.uniform(0, 60, (80, 2))
    boxes = np.concatenate([corners, corners + rng.uniform(5, 30, (80, 2))], 1)
    logits = rng.normal(0, 2, 80)
    scores = 1 / (1 + np.exp(-logits))
    as_opencv = np.concatenate([corners, boxes[:, 2:] - corners], 1)
    theirs = cv2.dnn.NMSBoxes(as_opencv.tolist(), scores.tolist(), 1 / (1 + math.exp(4.6)), 0.5)
    assert suppress_overlaps(torch.tensor(boxes), torch.tensor(logits)).tolist() == list(np.ravel(theirs))
