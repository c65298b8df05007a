"""Poses and homographies: laws that hold for any camera, and signs checked by hand."""

import numpy as np
import pytest

from patchproof.base.geometry import (
    apply_homography,
    fit_homography,
    intrinsics,
    local_scale,
    look_at,
    normalize_homography,
    orbit,
    plane_homography,
    plane_pose,
    project,
    rect_corners,
    view_angles,
)

K = intrinsics(50, (1600, 1200))
# a page that faces world +z, its top-left at (-50, 50, 0): page x is world x, page y is world -y, page z into the paper
WORLD_FROM_PAGE = np.array([[1.0, 0, 0, -50], [0, -1, 0, 50], [0, 0, -1, 0], [0, 0, 0, 1]])
CENTER = (50.0, 50.0)


def camera(azimuth=20.0, elevation=15.0, distance=500.0, roll=0.0):
    eye = distance * orbit(np.array(azimuth), np.array(elevation), (0, 0, 1)).reshape(3)
    return look_at(eye, (0, 0, 0), roll)


def page_points(n=20, seed=0):
    return np.random.default_rng(seed).uniform(0, 100, (n, 2))


def in_world(points):
    return points @ WORLD_FROM_PAGE[:3, :2].T + WORLD_FROM_PAGE[:3, 3]


def test_positive_azimuth_is_the_viewers_right_and_positive_elevation_is_up():
    # facing the +z side one looks along -z, and world +x is on the right
    np.testing.assert_allclose(orbit(np.array(90.0), np.array(0.0), (0, 0, 1)).reshape(3), [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(orbit(np.array(0.0), np.array(90.0), (0, 0, 1)).reshape(3), [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(orbit(np.array(0.0), np.array(0.0), (0, 0, 2)).reshape(3), [0, 0, 1], atol=1e-12)
    # facing the +x side, world -z is on the right
    np.testing.assert_allclose(orbit(np.array(90.0), np.array(0.0), (1, 0, 0)).reshape(3), [0, 0, -1], atol=1e-12)


def test_orbit_takes_arrays_and_gives_unit_rows():
    directions = orbit(np.linspace(-180, 180, 9), np.linspace(-80, 80, 9), (1, 0, 0))
    assert directions.shape == (9, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)


def test_look_at_puts_the_target_in_the_middle_and_up_upwards():
    pose = camera()
    np.testing.assert_allclose(project(K, pose, [[0, 0, 0]]), [[800, 600]], atol=1e-9)
    assert project(K, pose, [[0, 10, 0]])[0, 1] < 600  # image y runs down
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)


def test_from_the_front_world_right_is_image_right():
    x, y = project(K, camera(0, 0), [[10, 0, 0]])[0]
    assert x > 800 and y == pytest.approx(600)


def test_roll_turns_the_picture_clockwise():
    x, y = project(K, camera(0, 0, roll=10), [[0, 10, 0]])[0]  # a point above the middle
    assert x > 800 and y < 600
    assert np.degrees(np.arctan2(x - 800, 600 - y)) == pytest.approx(10)


@pytest.mark.parametrize("eye", [(0, 300, 0), (0, -300, 0)])
def test_straight_down_and_up_have_a_pose(eye):
    pose = look_at(eye, (0, 0, 0))
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(project(K, pose, [[0, 0, 0]]), [[800, 600]], atol=1e-9)


@pytest.mark.parametrize("size", [(1600, 1200), (1200, 1600), (500, 500)])
def test_fov_spans_the_shorter_side(size):
    k = intrinsics(50, size)
    edge = np.tan(np.radians(25))
    short = np.argmin(size)
    ray = np.array([0.0, 0, 1])
    ray[short] = edge
    assert project(k, np.eye(4), [ray])[0, short] == pytest.approx(min(size))


def test_points_behind_the_camera_are_nan():
    pixels = project(K, np.eye(4), [[0, 0, 1], [0, 0, -1], [1, 1, 0]])
    assert np.isfinite(pixels[0]).all() and np.isnan(pixels[1:]).all()


def test_a_plane_through_projection_and_through_its_homography_agree():
    points, pose = page_points(), camera(35, -10, 400, 5)
    homography = plane_homography(K, pose, WORLD_FROM_PAGE)
    np.testing.assert_allclose(apply_homography(homography, points), project(K, pose, in_world(points)), atol=1e-8)
    assert homography[2, 2] == 1


@pytest.mark.parametrize("n", [4, 5, 40])
def test_fit_is_exact_on_exact_points(n):
    homography = plane_homography(K, camera(50, 25, 300, -20), WORLD_FROM_PAGE)
    source = rect_corners((5, 5, 80, 60)) if n == 4 else page_points(n)
    fitted = fit_homography(source, apply_homography(homography, source))
    np.testing.assert_allclose(
        apply_homography(fitted, page_points(seed=9)), apply_homography(homography, page_points(seed=9)), atol=1e-7
    )


def test_fit_averages_noise_down():
    homography = plane_homography(K, camera(), WORLD_FROM_PAGE)
    rng = np.random.default_rng(0)
    errors = []
    for n in (16, 256):
        source = page_points(n)
        noisy = apply_homography(homography, source) + rng.normal(0, 0.5, (n, 2))
        seen = apply_homography(fit_homography(source, noisy), page_points(seed=9))
        errors.append(np.sqrt(((seen - apply_homography(homography, page_points(seed=9))) ** 2).mean()))
    assert errors[1] < 0.15 and errors[1] < errors[0] / 2


def test_fit_of_an_inverse_is_the_inverse_of_the_fit():
    source = page_points(12)
    target = apply_homography(plane_homography(K, camera(), WORLD_FROM_PAGE), source)
    there, back = fit_homography(source, target), fit_homography(target, source)
    np.testing.assert_allclose(normalize_homography(there @ back), np.eye(3), atol=1e-8)


def test_normalized_where_the_last_entry_vanishes():
    homography = normalize_homography(np.array([[0, 0, 3.0], [0, 4, 0], [5, 0, 0]]))
    assert np.isfinite(homography).all() and np.linalg.norm(homography) == pytest.approx(1)


def test_local_scale_against_finite_differences():
    homography, h = plane_homography(K, camera(40, 20, 350, 12), WORLD_FROM_PAGE), 1e-4
    for point in ((50, 50), (0, 0), (90, 20)):
        steps = np.array(point) + h * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
        right, left, down, up = apply_homography(homography, steps)
        jacobian = np.column_stack([(right - left) / (2 * h), (down - up) / (2 * h)])
        large, small = np.linalg.svd(jacobian, compute_uv=False)
        scale, tilt = local_scale(homography, point)
        assert scale == pytest.approx(np.sqrt(abs(np.linalg.det(jacobian))), rel=1e-6)
        assert tilt == pytest.approx(np.degrees(np.arccos(small / large)), abs=1e-3)


@pytest.mark.parametrize("azimuth, elevation", [(0, 0), (30, 0), (0, 40), (-60, 0)])
def test_tilt_is_the_angle_off_axis_for_a_far_camera(azimuth, elevation):
    homography = plane_homography(intrinsics(2, (1000, 1000)), camera(azimuth, elevation, 50_000), WORLD_FROM_PAGE)
    assert local_scale(homography, CENTER)[1] == pytest.approx(max(abs(azimuth), abs(elevation)), abs=0.2)


def test_scale_of_a_frontal_view_is_focal_length_over_distance():
    scale, tilt = local_scale(plane_homography(K, camera(0, 0, 500), WORLD_FROM_PAGE), CENTER)
    assert scale == pytest.approx(K[0, 0] / 500) and tilt == pytest.approx(0, abs=1e-4)


@pytest.mark.parametrize(
    "azimuth, elevation, distance, roll", [(0, 0, 500, 0), (25, 10, 440, 3), (-60, 27, 800, -5), (80, -30, 300, 170)]
)
def test_view_angles_and_plane_pose_undo_orbit_and_look_at(azimuth, elevation, distance, roll):
    homography = plane_homography(K, camera(azimuth, elevation, distance, roll), WORLD_FROM_PAGE)
    for sign in (1, -1, 7):  # a homography has no scale
        seen = view_angles(plane_pose(sign * homography, K), CENTER)
        np.testing.assert_allclose(seen, (azimuth, elevation, distance), atol=1e-6)


def test_rect_corners_run_clockwise_from_the_top_left():
    assert rect_corners((1, 2, 10, 20)).tolist() == [[1, 2], [11, 2], [11, 22], [1, 22]]
