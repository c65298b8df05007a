"""Where the camera stood is stated no surer than one picture can know: crops without a trace, folds between markers."""

from __future__ import annotations

import numpy as np
import pytest
from bent_paper import CENTER, MARKER_MM, SIDE_MM, Place, camera, flat, folded, rolled

from patchproof.base.geometry import look_at, view_angles
from patchproof.photo.pose import bent_sheet_position, flat_sheet_position, turn_rad
from patchproof.photo.rectify import fit_page
from patchproof.photo.unroll import fit_shape
from patchproof.sheets.piece import lay_out_piece

SIZE = np.array([1200, 900])
FOCAL = 1250.0
MIDDLE_MM = (SIDE_MM / 2, SIDE_MM / 2)
MATRIX = np.array([[FOCAL, 0, 600], [0, FOCAL, 450], [0, 0, 1.0]])


def markers_mm(bends: bool = False) -> dict[int, np.ndarray]:
    piece = lay_out_piece((SIDE_MM, SIDE_MM), MARKER_MM, "TESTSHEET0", "design", bends)
    return {marker.id: np.array(marker.corners_mm) for marker in piece.markers}


def corners_px(place: Place, camera_from_page: np.ndarray, middle_px=SIZE / 2, noise_px=0.0, bends=False, seed=0):
    """Of paper in that place, with the principal point there."""
    rng = np.random.default_rng(seed)

    def px(mm: np.ndarray) -> np.ndarray:
        points = place(mm - CENTER) @ camera_from_page[:3, :3].T + camera_from_page[:3, 3]
        return FOCAL * points[:, :2] / points[:, 2:] + middle_px + rng.normal(0, noise_px, mm.shape)

    return {i: px(mm) for i, mm in markers_mm(bends).items()}


@pytest.mark.parametrize(
    ("azimuth", "longer", "agrees"), [(35.0, 1.0, True), (35.0, 0.6, False), (2.0, 0.6, None), (35.0, 1.06, True)]
)
def test_perspective_confirms_a_focal_length_contradicts_it_or_cannot_tell(azimuth, longer, agrees):
    fit = fit_page(corners_px(flat, camera(azimuth, 3, 450)), markers_mm())
    position = flat_sheet_position(fit, MATRIX @ np.diag([longer, longer, 1.0]), 0.03, MIDDLE_MM)
    assert position.focal_agrees is agrees


@pytest.mark.parametrize("radius_mm", [-100.0, 100.0])
@pytest.mark.parametrize(("longer", "agrees"), [(1.0, True), (0.5, False)])
def test_so_does_the_bend_of_paper(radius_mm, longer, agrees):
    corners, matrix = corners_px(rolled(radius_mm, 0.0), camera(25, 5, 450)), MATRIX @ np.diag([longer, longer, 1.0])
    shape = fit_shape(corners, markers_mm(), tuple(SIZE), matrix[0, 0], 0.03)[0]
    assert bent_sheet_position(shape, matrix, 0.03, MIDDLE_MM).focal_agrees is agrees


def test_crops_without_a_trace_are_contradicted_or_within_what_is_stated():
    """Azimuths of two in three whose perspective cannot tell would be beyond three times it, would they be whole."""
    rng, ratios, blind = np.random.default_rng(3), [], []
    for seed in range(150):
        share = rng.uniform(0.35, 0.95)
        size = SIZE * share
        start = rng.uniform(0, 1, 2) * (SIZE - size)
        toward = (start + size / 2 + rng.uniform(-0.1, 0.1, 2) * size - SIZE / 2) / FOCAL
        where = camera(rng.uniform(-30, 30), rng.uniform(-20, 20), rng.uniform(380, 620))
        where = look_at([0, 0, 0], [*toward, 1.0], 0, (0, -1, 0)).T @ where
        fit = fit_page(corners_px(flat, where, SIZE / 2 - start, 0.045, seed=seed), markers_mm())
        matrix = np.array([[FOCAL * share, 0, size[0] / 2], [0, FOCAL * share, size[1] / 2], [0, 0, 1.0]])
        position, true = flat_sheet_position(fit, matrix, 0.03, MIDDLE_MM), view_angles(where, (0, 0))
        if position.focal_agrees is not False:
            off = abs(position.azimuth_deg - true[0]), abs(position.distance_mm - true[2])
            ratios.append(np.divide(off, [position.azimuth_uncertainty_deg, position.distance_uncertainty_mm]))
            whole = flat_sheet_position(fit, matrix, 0.03, MIDDLE_MM, matrix_is_known=True)
            blind.append(off[0] / whole.azimuth_uncertainty_deg)
    ratios = np.array(ratios)
    assert len(ratios) > 40 and ratios.max() <= 3
    assert np.mean(np.array(blind) > 3) > 0.4


def test_straightened_views_are_contradicted_or_within_what_is_stated():
    """Software took away 40 to 100 % of their perspective, and some of the foreshortening. Those that look like a view
    of their own, nearly frontal, are not known to be any.
    """
    rng, ratios = np.random.default_rng(0), []
    for seed in range(150):
        where = camera(rng.choice([-1, 1]) * rng.uniform(15, 45), rng.uniform(-20, 25), rng.uniform(380, 620))
        slope = rng.uniform(0.4, 1) * where[:2, 2] / where[2, 2] / FOCAL
        way, lengths, _ = np.linalg.svd(where[:2, :2])
        widen = way @ np.diag([1, (lengths[0] / lengths[1]) ** rng.uniform(0, 1)]) @ way.T
        seen = corners_px(flat, where, (0, 0), 0.045, seed=seed)
        fit = fit_page({i: px @ widen / (1 + px @ slope)[:, None] + SIZE / 2 for i, px in seen.items()}, markers_mm())
        position = flat_sheet_position(fit, MATRIX, 0.03, MIDDLE_MM)
        if position.focal_agrees is not False:
            ratios.append(abs(position.azimuth_deg - view_angles(where, (0, 0))[0]) / position.azimuth_uncertainty_deg)
    assert len(ratios) > 20 and 2 < max(ratios) <= 3


def test_where_perspective_cannot_tell_only_a_known_camera_gives_a_distance():
    fit = fit_page(corners_px(flat, camera(2, 3, 450), noise_px=0.045), markers_mm())
    position = flat_sheet_position(fit, MATRIX, 0.03, MIDDLE_MM)
    assert (
        position.focal_agrees is None
        and np.isinf(position.distance_uncertainty_mm)
        and position.azimuth_uncertainty_deg > 7
    )
    known = flat_sheet_position(fit, MATRIX, 0.0025, MIDDLE_MM, matrix_is_known=True)
    assert known.distance_uncertainty_mm < 5 and known.azimuth_uncertainty_deg < 7


@pytest.mark.parametrize("at_mm", [3.0, 10.0, 25.0])
@pytest.mark.parametrize("along", [0.0, np.pi / 2])
def test_a_fold_between_markers_that_looks_like_a_roll_turns_the_middle_within_what_is_stated(at_mm, along):
    """By 10°: a cylinder explains it, and its middle is turned by 3 to 5°, which the corners claim to know to 0.4°."""
    where = camera(23, 8, 590)
    shape = fit_shape(corners_px(folded(10, at_mm, along), where), markers_mm(), tuple(SIZE), FOCAL, 0.03)[0]
    position, blind = (
        bent_sheet_position(shape, MATRIX, 0.03, MIDDLE_MM, turn, matrix_is_known=True)
        for turn in (turn_rad(0.0, shape), 0.0)
    )
    assert shape.radius_mm is not None and 0.03 < shape.hidden_turn_rad < 0.12
    off = abs(position.azimuth_deg - view_angles(where, (0, 0))[0])
    assert off <= 3 * position.azimuth_uncertainty_deg
    if along == 0:
        assert off > 3 * blind.azimuth_uncertainty_deg


def test_markers_over_the_middle_leave_no_turn_hidden_and_what_they_miss_adds_one():
    corners = corners_px(rolled(150, 0.0), camera(25, 5, 450), bends=True)
    assert fit_shape(corners, markers_mm(True), tuple(SIZE), FOCAL, 0.03)[0].hidden_turn_rad < 0.01
    assert turn_rad(0.0, None) == 0 and np.degrees(turn_rad(0.002, None)) == pytest.approx(5.7, abs=0.1)
