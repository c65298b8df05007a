"""A known camera takes its lens out of the picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from patchproof.base.geometry import normalize_homography
from patchproof.channel import lens
from patchproof.evidence.locate import _turn_clockwise, pinhole_photo
from patchproof.photo.read import Photo

PHONE = lens.load_camera("phone")


def test_a_lens_is_taken_out_and_the_homography_is_the_pinhole_s():
    # lines of dots through a lens of 1.5 % barrel come back straight: the middle of each dot is where a pinhole has it
    camera = PHONE.model_copy(update={"k1": -0.06})
    size_px, dots = (800, 600), np.array([[60.0, 60], [400, 60], [740, 60], [60, 540], [740, 540]])
    picture = np.full((600, 800, 3), 230, np.uint8)
    y, x = np.mgrid[0:600, 0:800] + 0.5
    for px, py in camera.distort_points(dots, size_px):
        picture[(x - px) ** 2 + (y - py) ** 2 < 64] = 10
    assert np.abs(camera.distort_points(dots, size_px) - dots).max() > 3
    view = pinhole_photo(Photo(picture, None), camera)
    dark = 255.0 - view.srgb[..., 0]
    dark[dark < 60] = 0
    for px, py in dots:
        near = dark * ((np.abs(x - px) < 15) & (np.abs(y - py) < 15))
        assert (near * x).sum() / near.sum() == pytest.approx(px, abs=0.25)
        assert (near * y).sum() / near.sum() == pytest.approx(py, abs=0.25)
    assert view.calibrated and view.matrix_px == pytest.approx(camera.matrix_px(size_px))


def test_a_turned_camera_bends_turned_points():
    camera = PHONE.model_copy(update={"cx": 1980.0, "cy": 1530.0, "p1": 2e-3, "p2": -1e-3})
    points = np.array([[100.0, 200], [3900, 250], [2500, 2800]])
    turn = lambda p: np.column_stack([3000 - p[:, 1], p[:, 0]])  # noqa: E731
    bent = _turn_clockwise(camera).distort_points(turn(points), (3000, 4000))
    assert bent == pytest.approx(turn(camera.distort_points(points, (4000, 3000))), abs=1e-6)


def test_a_picture_of_another_shape_is_another_camera_s():
    photo = Photo(np.zeros((500, 800, 3), np.uint8), 700.0)
    view = pinhole_photo(photo, PHONE)
    assert not view.calibrated and view.matrix_px[0, 0] == 700.0
    assert pinhole_photo(replace(photo, focal_px=None), None).matrix_px is None
    assert normalize_homography(view.matrix_px)[0, 2] == 400
