"""Rolled paper is recognized and made flat; flat paper is left alone; what neither explains is refused."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import synthetic_photos
from synthetic_photos import (
    CUT_MM,
    DESIGN_MM,
    PIECE_IDS,
    curled_photograph,
    make_manifest,
    page_raster,
    photograph,
    view,
)

from patchproof.base.geometry import apply_homography, intrinsics, look_at, rect_corners
from patchproof.evidence.surface import surface_of, with_markers
from patchproof.photo.pose import bent_sheet_position
from patchproof.photo.registration import register
from patchproof.photo.unroll import fit_shape, unroll
from test_verify_run import measured

SIZE = (1200, 900)
MATRIX = intrinsics(40.0, SIZE)
CENTER = np.array(DESIGN_MM[:2]) + np.array(DESIGN_MM[2:]) / 2


def pose(azimuth_deg=25.0, elevation_deg=15.0, distance_mm=450.0):
    """`camera_from_page` with the page's origin at the design's center."""
    az, el = np.radians([azimuth_deg, elevation_deg])
    eye = distance_mm * np.array([np.cos(el) * np.sin(az), np.sin(el), np.cos(el) * np.cos(az)])
    return look_at(eye, [0, 0, 0]) @ np.diag([1.0, -1.0, -1.0, 1.0])


def rolled_px(mm, curvature, camera_from_page):
    """Where page points lie in the picture when the paper is rolled about the upright axis."""
    x, y = (np.asarray(mm, float) - CENTER).T
    world = np.column_stack([np.sin(curvature * x) / curvature, y, (1 - np.cos(curvature * x)) / curvature])
    seen = (world @ camera_from_page[:3, :3].T + camera_from_page[:3, 3]) @ MATRIX.T
    return seen[:, :2] / seen[:, 2:]


def markers_mm():
    return {m.id: np.array(m.corners_mm) for m in make_manifest().markers if m.id in PIECE_IDS}


@functools.cache
def piece():
    """The piece's printed page."""
    return page_raster(make_manifest(), only_piece=True) * np.float32(0.97) + np.float32(0.02)


@functools.cache
def rolled_photograph():
    """Of the piece at a radius of 150 mm."""
    return curled_photograph(piece(), pose(), MATRIX, 1 / 150)


def unrolled(corners_px, focal_px=None):
    blank = np.zeros((*SIZE[::-1], 3), np.uint8)
    return unroll(blank, corners_px, markers_mm(), CUT_MM, focal_px)


@pytest.mark.parametrize("radius_mm", [-80.0, 100.0, 400.0, 2000.0])
def test_the_radius_of_rolled_paper_is_found_without_a_focal_length(radius_mm):
    corners = {i: rolled_px(mm, 1 / radius_mm, pose()) for i, mm in markers_mm().items()}
    # exact corners, not where straight borders would meet: what that correction does to them is what remains
    assert unrolled(corners).shape.radius_mm == pytest.approx(radius_mm, rel=0.03)


def test_flat_paper_is_left_alone_also_with_noise():
    for seed in range(5):
        rng = np.random.default_rng(seed)
        true = view(rng.uniform(-60, 60), 10, 500)
        corners = {i: apply_homography(true, mm) + rng.normal(0, 0.3, (4, 2)) for i, mm in markers_mm().items()}
        assert unrolled(corners) is None


def test_a_crumpled_sheet_is_no_cylinder():
    rng, true = np.random.default_rng(0), view(20, 10, 500)
    corners = {i: apply_homography(true, mm) + rng.normal(0, 6, 2) for i, mm in markers_mm().items()}
    assert unrolled(corners) is None


def test_three_markers_are_too_few_to_tell():
    corners = {i: rolled_px(mm, 1 / 100, pose()) for i, mm in list(markers_mm().items())[:3]}
    assert unrolled(corners) is None


def test_a_photograph_of_rolled_paper_is_measured_as_if_it_were_flat():
    seen = measured(rolled_photograph())
    entry = seen.entry
    assert entry.status == "measured" and seen.counted and entry.geometry.homography_px_from_mm is None
    assert entry.geometry.curl_radius_mm == pytest.approx(150, rel=0.05)
    # measured 0.03 to 0.1 mm
    assert entry.geometry.residual_mm < 0.15 and entry.geometry.corner_uncertainty_mm < 0.5


def test_the_unrolled_picture_shows_the_design_where_its_homography_says():
    page, photo = piece(), rolled_photograph()
    corners = {i: rolled_px(mm, 1 / 150, pose()) for i, mm in markers_mm().items()}
    flat = unroll(photo, corners, markers_mm(), CUT_MM, MATRIX[0, 0])
    expected = photograph(page, flat.fit.px_from_mm, SIZE, blur_px=0.9)
    quad = apply_homography(flat.fit.px_from_mm, rect_corners(DESIGN_MM))
    (x0, y0), (x1, y1) = quad.min(0).astype(int) + 20, quad.max(0).astype(int) - 20
    off = np.abs(flat.srgb[y0:y1, x0:x1].astype(float) - expected[y0:y1, x0:x1]).mean()
    bent = np.abs(photo[y0:y1, x0:x1].astype(float) - expected[y0:y1, x0:x1]).mean()
    assert off < 6 and off < bent / 2


@pytest.mark.parametrize("azimuth", [0.0, 10.0, 25.0, 40.0])
@pytest.mark.parametrize("radius_mm", [-100.0, 100.0, 600.0])
def test_rolled_paper_says_where_the_camera_stood_by_its_own_middle(azimuth, radius_mm):
    """By the homography of the unrolled sheet, 10°, 25° and 40° at a radius of 100 mm were 18°, 41° and 57°."""
    corners = {i: rolled_px(mm, 1 / radius_mm, pose(azimuth)) for i, mm in markers_mm().items()}
    shape = fit_shape(corners, markers_mm(), SIZE, MATRIX[0, 0], 0.03)[0]
    position = bent_sheet_position(shape, MATRIX, 0.03, CENTER)
    # exact corners, not where straight borders would meet: the correction for that is what remains
    assert position.azimuth_deg == pytest.approx(azimuth, abs=0.6) and position.azimuth_uncertainty_deg > 0.3
    assert position.distance_mm == pytest.approx(450, rel=0.02) and position.focal_agrees is not False


def test_the_designs_own_pixels_say_where_it_lies():
    """Shifted by 2 mm it is found there, to a tenth of that; what is covered is left out."""
    manifest, true = make_manifest(), view(20, 10, 450)
    page, surface = page_raster(manifest, only_piece=True), surface_of(manifest)
    design = with_markers(page_raster(manifest, True)[600:2000:4, 350:1750:4], surface, np.zeros(3))
    photo = photograph(page, true, SIZE, blur_px=0.6)
    moved = true @ np.array([[1, 0, 2.0], [0, 1, 0], [0, 0, 1]])
    for homography, shift in ((true, 0.0), (moved, -2.0)):
        cells = register(photo, homography, DESIGN_MM, design, 2.5, 0.7)
        sure = cells.sigma_mm < 0.3
        assert sure.sum() > 8 and np.median(cells.shift_mm[sure], 0) == pytest.approx([shift, 0], abs=0.2)
    photo[:, :600] = 90
    shown = np.isfinite(register(photo, true, DESIGN_MM, design, 2.5, 0.7).shift_mm[:, 0])
    left = register(photo, true, DESIGN_MM, design, 2.5, 0.7).middle_mm[:, 0] < CENTER[0] - 15
    assert not shown[left].any() and shown[~left].sum() > 8


def test_an_uncut_page_is_not_counted_when_it_curls_either(monkeypatch):
    """Of flat paper its markers fit the piece's plane; rolled as the piece above is, which counts, they only lie near
    where it has them.
    """
    whole = page_raster(make_manifest(), only_piece=False)
    monkeypatch.setattr(synthetic_photos, "CUT_MM", (0.0, 0.0, *synthetic_photos.PAGE_MM))
    photo = curled_photograph(whole, pose(), MATRIX, 1 / 150)
    monkeypatch.undo()
    assert not measured(photo).counted
