"""A known camera gives the print's proportions from one photograph, and takes its lens out of the picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from patchproof.base.geometry import apply_homography, intrinsics, look_at, normalize_homography, plane_homography
from patchproof.channel import lens
from patchproof.evidence.camera import _turn_clockwise, pinhole_photo
from patchproof.photo.print_ratio import x_over_y
from patchproof.photo.read import Photo
from patchproof.photo.rectify import fit_page

CORNERS = np.array([[x, y] for x in (10, 100, 190) for y in (10, 140, 280)], float)


def page_fit(scale, tilt_deg, azimuth_deg=90.0):
    """A fit to exact corners, with the noise that corners always have, and the matrix."""
    matrix = intrinsics(50, (1600, 1200))
    tilt, azimuth = np.radians([tilt_deg, azimuth_deg])
    away = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)])
    middle = np.array([100.0, 145.0, 0.0])
    pose = look_at(middle + 500 * away, middle, 10, up=(0.3, -1.0, 0.0))
    homography = plane_homography(matrix, pose, np.eye(4)) @ np.diag([*scale, 1.0])
    quads = {i: CORNERS[i] + np.array([[0, 0], [14, 0], [14, 14], [0, 14]]) for i in range(len(CORNERS))}
    return fit_page({i: apply_homography(homography, q) for i, q in quads.items()}, quads), matrix


@pytest.mark.parametrize("tilt", [0.0, 20.0, 40.0])
def test_the_proportions_follow_from_one_photograph(tilt):
    fit, matrix = page_fit((0.95, 1.04), tilt)
    ratio, uncertainty = x_over_y(fit, matrix, 0.005)
    assert ratio == pytest.approx(0.95 / 1.04, rel=1e-4) and uncertainty < 0.005


def test_a_wrong_focal_length_bends_the_proportions_by_sin_squared_of_the_tilt_and_is_in_the_uncertainty():
    fit, matrix = page_fit((1.0, 1.0), 40)  # tilted about the page's x axis: y is the foreshortened one
    wrong = matrix.copy()
    wrong[[0, 1], [0, 1]] *= 1.03
    ratio, uncertainty = x_over_y(fit, wrong, 0.04)
    assert abs(ratio - 1) == pytest.approx(0.03 * np.sin(np.radians(40)) ** 2, rel=0.1)
    assert abs(ratio - 1) < uncertainty


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
