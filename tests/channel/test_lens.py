"""The lens: OpenCV as the oracle, straight lines and rays, and files that are refused."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
import torch

from patchproof.base import geometry
from patchproof.base.errors import Refused
from patchproof.base.packaged import packaged_path
from patchproof.channel.lens import Camera, load_camera

ORIGIN = {"when": "2020-01-01", "instrument": "a board", "uncertainty": "1 px"}
BARREL = {"k1": -0.12, "k2": 0.02, "p1": 1e-3, "p2": -2e-3, "k3": -0.003}
CUSHION = {"k1": 0.08, "k2": -0.01, "p1": -1e-3, "p2": 5e-4, "k3": 0.001}


def camera(**terms) -> Camera:
    numbers = {"image_px": (800, 600), "fx": 640.0, "fy": 655.0, "cx": 410.0, "cy": 293.0} | terms
    return Camera(name="one", method="measured", **ORIGIN, **numbers)


def write(tmp_path, **changes):
    """A camera file with these keys changed (None removes one)."""
    data = camera().model_dump(mode="json") | changes
    path = tmp_path / "one.json"
    path.write_text(json.dumps({k: v for k, v in data.items() if v is not None}), "utf-8")
    return path


def refusal(path, **more) -> str:
    with pytest.raises(Refused) as refused:
        load_camera(str(path), **more)
    assert "\n" not in str(refused.value)
    return str(refused.value)


def points(size_px, n=200):
    return np.random.default_rng(0).uniform(0, 1, (n, 2)) * size_px


def by_opencv(terms):
    """Matrix and coefficients as OpenCV wants them, whose pixel centers are whole numbers."""
    matrix = np.array([[640, 0, 409.5], [0, 655, 292.5], [0, 0, 1.0]])
    return matrix, np.array([terms[k] for k in ("k1", "k2", "p1", "p2", "k3")])


@pytest.mark.parametrize("terms", [BARREL, CUSHION])
def test_points_are_where_opencv_puts_them(terms):
    matrix, coefficients = by_opencv(terms)
    straight = points((800, 600))
    rays = np.concatenate([(straight - 0.5 - matrix[:2, 2]) / [640, 655], np.ones((200, 1))], 1)
    theirs = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, coefficients)[0][:, 0] + 0.5
    ours = camera(**terms).distort_points(straight, (800, 600))
    np.testing.assert_allclose(ours, theirs, atol=1e-9)
    assert np.abs(ours - straight).max() > 5
    # OpenCV stops after 5 iterations, enough in the picture's middle
    near = np.abs(theirs - [400, 300]).max(1) < 200
    back = cv2.undistortPoints(theirs - 0.5, matrix, coefficients, P=matrix)[:, 0] + 0.5
    np.testing.assert_allclose(camera(**terms).undistort_points(ours, (800, 600))[near], back[near], atol=2e-3)


@pytest.mark.parametrize("size_px", [(800, 600), (1600, 1200), (224, 224), (600, 600)])
def test_undistorting_is_the_inverse_at_every_size(size_px):
    for terms in (BARREL, CUSHION, {}):
        seen = points(size_px)
        back = camera(**terms).distort_points(camera(**terms).undistort_points(seen, size_px), size_px)
        np.testing.assert_allclose(back, seen, atol=1e-7)


def test_matrices_of_smaller_pictures_and_of_the_centered_square_look_the_same_way():
    one, ray = camera(), np.array([0.2, -0.1, 1.0])
    x, y = (one.matrix_px((800, 600)) @ ray)[:2]
    np.testing.assert_allclose((one.matrix_px((1600, 1200)) @ ray)[:2], [2 * x, 2 * y])
    np.testing.assert_allclose((one.matrix_px((600, 600)) @ ray)[:2], [x - 100, y])
    np.testing.assert_allclose((one.matrix_px((300, 300)) @ ray)[:2], [(x - 100) / 2, y / 2])


def test_a_camera_with_the_field_of_view_of_a_scene_has_its_matrix():
    focal = geometry.intrinsics(50, (800, 600))[0, 0]
    one = camera(fx=focal, fy=focal, cx=400.0, cy=300.0)
    for size_px in ((800, 600), (400, 300), (224, 224)):
        np.testing.assert_allclose(one.matrix_px(size_px), geometry.intrinsics(50, size_px))


def test_points_of_the_square_are_those_of_the_whole_picture():
    one, square = camera(**BARREL), points((600, 600))
    whole = one.distort_points(square + np.array([100, 0]), (800, 600))
    np.testing.assert_allclose(one.distort_points(square, (600, 600)) + np.array([100, 0]), whole)


def test_no_distortion_changes_nothing():
    one, pictures = camera(), torch.rand(2, 3, 30, 40)
    frame = one.pinhole_frame((40, 30))
    assert frame.size_px == (40, 30) and not one.has_distortion
    np.testing.assert_array_equal(frame.matrix_px, one.matrix_px((40, 30)))
    assert one.distort_pictures(pictures, (40, 30)) is pictures


@pytest.mark.parametrize("terms", [BARREL, CUSHION])
@pytest.mark.parametrize("size_px", [(160, 120), (96, 96)])
def test_a_picture_is_bent_as_its_points_are(terms, size_px):
    """A smooth picture of direction: after the lens every pixel holds the direction that its own point comes from."""
    one = camera(**terms)
    frame = one.pinhole_frame(size_px)
    width, height = frame.size_px
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    ramp = torch.tensor(np.stack([x - frame.left, y - frame.top])[None])
    seen = one.distort_pictures(ramp, size_px)[0].permute(1, 2, 0).reshape(-1, 2).numpy()
    assert len(seen) == size_px[0] * size_px[1]
    x, y = np.meshgrid(np.arange(size_px[0]) + 0.5, np.arange(size_px[1]) + 0.5)
    came_from = one.undistort_points(np.stack([x.ravel(), y.ravel()], 1), size_px)
    # bilinear is exact on a ramp
    np.testing.assert_allclose(seen, came_from, atol=1e-9)


@pytest.mark.parametrize("terms", [BARREL, CUSHION])
@pytest.mark.parametrize("size_px", [(160, 120), (96, 96), (37, 37)])
def test_the_frame_holds_all_that_the_lens_reads(terms, size_px):
    """What a bilinear sample reads lies inside, so that the border's padding is never seen."""
    one = camera(**terms)
    frame = one.pinhole_frame(size_px)
    x, y = np.meshgrid(np.arange(size_px[0]) + 0.5, np.arange(size_px[1]) + 0.5)
    source = one.undistort_points(np.stack([x.ravel(), y.ravel()], 1), size_px) + np.array([frame.left, frame.top])
    assert source.min() >= 0.5 and (source <= np.array(frame.size_px) - 0.5).all()
    bare = one.matrix_px(size_px)
    np.testing.assert_allclose(frame.matrix_px[:2, 2] - bare[:2, 2], [frame.left, frame.top])
    assert frame.size_px == (size_px[0] + frame.left + frame.right, size_px[1] + frame.top + frame.bottom)


def test_gradients_reach_what_was_rendered():
    one = camera(**BARREL)
    width, height = one.pinhole_frame((8, 6)).size_px
    pictures = torch.rand(1, 2, height, width, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda p: one.distort_pictures(p, (8, 6)), pictures)


def test_batches_equal_single_pictures():
    one = camera(**BARREL)
    width, height = one.pinhole_frame((40, 30)).size_px
    pictures = torch.rand(3, 3, height, width)
    together = one.distort_pictures(pictures, (40, 30))
    for i in range(3):
        assert torch.equal(one.distort_pictures(pictures[i : i + 1], (40, 30))[0], together[i])


@pytest.mark.parametrize("path", sorted(packaged_path("calibration", "cameras").glob("*.json")), ids=lambda p: p.stem)
def test_shipped_cameras_load_by_name_and_say_where_they_come_from(path):
    one = load_camera(path.stem)
    assert one.name == path.stem and one.when and one.instrument and one.uncertainty
    assert load_camera(str(path)) == one


def test_the_assumed_phone_says_so_and_fits_the_default_photograph():
    assert load_camera("phone", photo_px=(1600, 1200)).method == "assumed"


def test_files_that_are_missing_or_broken_are_refused(tmp_path):
    assert 'did you mean "phone"' in refusal("phnoe")
    assert "no file at" in refusal(tmp_path / "none.json")
    broken = tmp_path / "broken.json"
    broken.write_text("{", "utf-8")
    assert "cannot be read" in refusal(broken)
    assert load_camera("one.json", write(tmp_path).parent) == camera()


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"fx": None}, 'the key "fx"'),
        ({"k4": 0.1}, '"k4"'),
        ({"fx": float("nan")}, '"fx"'),
        ({"k1": float("inf")}, '"k1"'),
        ({"fy": -3}, '"fy"'),
        ({"method": "guessed"}, '"method"'),
        ({"cx": 4000}, "principal point inside the picture of 800 × 600 px"),
        ({"k1": -0.9}, "can be undone in the whole picture"),  # turns round at radius 0.6, the corner is at 0.78
        ({"k1": 0.3, "k2": -1.5}, "can be undone in the whole picture"),
        ({"p1": 0.9}, "can be undone in the whole picture"),
        ({"k3": 1e300}, "can be undone in the whole picture"),
    ],
)
def test_numbers_that_no_lens_has_are_refused(tmp_path, changes, words):
    assert words in refusal(write(tmp_path, **changes))


def test_another_aspect_is_refused_but_rounding_is_not(tmp_path):
    path = write(tmp_path, image_px=[6000, 4000], cx=3000, cy=2000, fx=5000, fy=5000)
    assert "photo_px = [1600, 1200]" in refusal(path, photo_px=(1600, 1200))
    assert "photo_px = [1067, 1600]" in refusal(path, photo_px=(1067, 1600))
    assert load_camera(str(path), photo_px=(1600, 1067)).fx == 5000
