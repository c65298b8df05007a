"""Reduced pictures keep their mean and proportions; maps between OpenCV's indices are those between pixels."""

from __future__ import annotations

import cv2
import numpy as np

from patchproof.base.resample import downscale, downscaled_size, halving_pyramid, index_homography, to_sixteenths

RAMP = np.tile(np.arange(512, dtype=np.float32), (640, 1))  # light at a pixel's center is its x - .5


def test_a_picture_is_halved_until_its_shorter_side_is_below_256():
    levels = halving_pyramid(RAMP)
    assert [level.shape for level in levels] == [(640, 512), (320, 256), (160, 128)]
    assert np.allclose([level.mean() for level in levels], RAMP.mean())


def test_a_reduced_picture_keeps_its_proportions_and_a_small_one_its_pixels():
    assert downscale(RAMP, 160).shape == (160, 128) and downscale(RAMP, 640) is RAMP
    assert downscaled_size((1000, 3), 100) == (100, 1)


def test_a_warp_by_indices_shows_at_each_pixel_what_the_map_between_pixels_says():
    enlarged = index_homography(np.diag([2.0, 3.0, 1.0]))
    shown = cv2.warpPerspective(RAMP, enlarged, (400, 400), flags=cv2.INTER_LINEAR)
    x_px = np.arange(10, 390) + 0.5
    assert np.allclose(shown[200, 10:390], x_px / 2 - 0.5, atol=1 / 32)


def test_polygons_are_drawn_in_sixteenths_from_pixel_centers():
    assert to_sixteenths(np.array([[0.5, 1.0], [1e9, 0.53]])).tolist() == [[0, 8], [1_000_000, 0]]
