"""Proposed places of a design: matches and correlations are OpenCV's own, in less time."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from patchproof.photo import design_places


def test_the_nearest_features_are_opencv_s():
    own, seen = (np.random.default_rng(n).random((n, 128), np.float32) for n in (40, 300))
    own, seen = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in (own, seen))
    index, distance = design_places._nearest(own, seen)
    for row, matches in enumerate(cv2.BFMatcher(cv2.NORM_L2).knnMatch(own, seen, 3)):
        assert index[row].tolist() == [match.trainIdx for match in matches]
        assert distance[row] == pytest.approx([match.distance for match in matches], abs=1e-3)


@pytest.mark.parametrize("size", [(120, 90), (37, 61)])  # 37 and 61 are no sizes that transforms like
def test_correlations_are_opencv_s(size):
    rng = np.random.default_rng(1)
    picture = cv2.GaussianBlur(rng.integers(0, 256, (size[1], size[0], 3), np.uint8), (0, 0), 1.5)
    drawn = cv2.resize(picture[5:29, 8:32], (48, 48), interpolation=cv2.INTER_CUBIC)
    templates = list(design_places._templates(drawn, picture.shape[:2]))
    assert [shape for shape, _ in templates] == [(12, 12), (9, 12), (7, 12)]
    for (shape, _), (peak, rect) in zip(templates, design_places._correlation_peaks(picture, templates), strict=True):
        template = cv2.resize(drawn, shape, interpolation=cv2.INTER_AREA)
        _, expected, _, place = cv2.minMaxLoc(cv2.matchTemplate(picture, template, cv2.TM_CCOEFF_NORMED))
        assert rect == (*place, *shape) and peak == pytest.approx(expected, abs=0.01)


def test_plain_parts_of_a_picture_are_like_nothing():
    """A window without a deviation of its own has that of a code value: rounding is no likeness."""
    plain = np.full((60, 80, 3), 200, np.uint8)
    drawn = np.random.default_rng(2).integers(0, 256, (48, 48, 3), np.uint8)
    peaks = design_places._correlation_peaks(plain, design_places._templates(drawn, plain.shape[:2]))
    assert [peak for peak, _ in peaks] == pytest.approx([0, 0, 0], abs=0.01)
