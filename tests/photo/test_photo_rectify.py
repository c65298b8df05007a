"""The homography, its uncertainty, the flattened patch, and the colors fitted on it."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic_photos import DESIGN_MM, PIECE_IDS, make_manifest, page_raster, photograph, view

from patchproof.base.geometry import apply_homography, intrinsics, plane_pose, rect_corners, view_angles
from patchproof.channel.print_colors import affine12, white_black
from patchproof.photo.detect import find_markers
from patchproof.photo.known_page import complete_markers
from patchproof.photo.pose import flat_sheet_position
from patchproof.photo.quality import frame_light
from patchproof.photo.rectify import corner_uncertainty_mm, fit_page, noise_and_bend, rectify
from patchproof.photo.rejection import PhotoRejected


def marker_corners():
    return {m.id: np.array(m.corners_mm) for m in make_manifest().markers if m.id in PIECE_IDS}


def noisy_corners(homography, sigma_px, seed=0):
    rng = np.random.default_rng(seed)
    return {i: apply_homography(homography, c) + rng.normal(0, sigma_px, (4, 2)) for i, c in marker_corners().items()}


def worst_error_mm(found, true):
    corners = rect_corners(DESIGN_MM)
    back = apply_homography(np.linalg.inv(found), apply_homography(true, corners))
    return float(np.linalg.norm(back - corners, axis=1).max())


def test_exact_corners_give_the_homography_back():
    true = view(40, 15, 600, 20)
    fit = fit_page(noisy_corners(true, 0), marker_corners())
    assert worst_error_mm(fit.px_from_mm, true) < 1e-6 and fit.residual_mm < 1e-6
    assert fit.inlier_ids == PIECE_IDS


@pytest.mark.parametrize("wrong", [1, 2, 3])
def test_markers_that_lie_are_left_out(wrong):
    true = view(30, 5, 500)
    corners = noisy_corners(true, 0.05)
    for i in PIECE_IDS[:wrong]:
        corners[i] = corners[i] + [25.0, -12.0]
    fit = fit_page(corners, marker_corners())
    assert worst_error_mm(fit.px_from_mm, true) < 0.1
    assert fit.inlier_ids == PIECE_IDS[wrong:]


def test_three_markers_whose_corners_agree_but_for_noise_all_count_and_a_moved_one_does_not():
    true, ids = view(45, 5, 900), [PIECE_IDS[0], PIECE_IDS[2], PIECE_IDS[5]]
    inliers, moved = [], []
    for seed in range(100):
        corners = {i: c for i, c in noisy_corners(true, 0.12, seed).items() if i in ids}
        inliers.append(len(fit_page(corners, marker_corners()).inlier_ids))
        corners[ids[0]] = corners[ids[0]] + [8.0, -5.0]
        moved.append(len(fit_page(corners, marker_corners()).inlier_ids))
    assert inliers.count(3) == 100 and moved.count(3) == 0


def test_when_most_markers_lie_the_residual_or_the_ids_show_it():
    # the breaking point of least median of squares: beyond half nothing can be told apart, but it is not silent
    true = view(30, 5, 500)
    corners = noisy_corners(true, 0.05)
    rng = np.random.default_rng(1)
    for i in PIECE_IDS[:6]:
        corners[i] = corners[i] + rng.normal(0, 20, 2)
    fit = fit_page(corners, marker_corners())
    assert len(fit.inlier_ids) < 4 or fit.residual_mm > 1.0  # either is what measure() stops at


def test_no_known_marker_cannot_be_judged():
    with pytest.raises(PhotoRejected) as caught:
        fit_page({7: np.zeros((4, 2))}, marker_corners())
    assert caught.value.code == "too_few_markers"


def test_one_marker_is_far_less_certain_than_eight():
    corners = noisy_corners(view(0, 0, 500), 0.05)
    all_eight = corner_uncertainty_mm(fit_page(corners, marker_corners()), DESIGN_MM)
    one = corner_uncertainty_mm(fit_page({100: corners[100]}, marker_corners()), DESIGN_MM)
    assert one > 20 * all_eight


def test_the_stated_uncertainty_covers_the_truth_in_drawn_corners():
    # corners drawn with known noise above the floor: the 95 % figure must hold in 90 to 99 % of 60 draws
    hits = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        true = view(rng.uniform(-60, 60), rng.uniform(-20, 20), rng.uniform(350, 900), rng.uniform(-20, 20))
        fit = fit_page(noisy_corners(true, 0.15, seed), marker_corners())
        hits += worst_error_mm(fit.px_from_mm, true) <= corner_uncertainty_mm(fit, DESIGN_MM)
    assert 54 <= hits <= 60


@pytest.mark.parametrize(
    ("ids", "typical_mm"),
    [((100,), 72), ((100, 101), 7), ((100, 102, 105, 107), 0.14), (PIECE_IDS, 0.115)],
    ids=["one", "two", "four", "eight"],
)
def test_few_markers_state_as_wide_an_uncertainty_as_they_have(ids, typical_mm):
    """Noise three times the floor; of 100 draws 96, 96, 92 and 92 % are covered. One marker's residual tells nothing
    of its noise: taken for the floor, its 95 % figure held in 29 %.
    """
    hits, stated = 0, []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        true = view(rng.uniform(-60, 60), rng.uniform(-20, 20), rng.uniform(350, 900), rng.uniform(-20, 20))
        noisy = noisy_corners(true, 0.15, seed)
        fit = fit_page({i: noisy[i] for i in ids}, marker_corners())
        stated.append(corner_uncertainty_mm(fit, DESIGN_MM))
        hits += worst_error_mm(fit.px_from_mm, true) <= stated[-1]
    assert hits >= 10 and np.median(stated) == pytest.approx(typical_mm, rel=0.25)


@pytest.mark.parametrize(
    ("ids", "good_mm", "bad_mm"), [((100,), 150, 1000), ((100, 101), 1000, 4000), ((100, 102, 105, 107), 3000, 8000)]
)
def test_a_sheet_too_small_to_tell_left_from_right_says_so(ids, good_mm, bad_mm):
    """Seen from 10° to the right. Where views flip to the left, the stated uncertainty is larger than 10°."""
    matrix, center = intrinsics(40, (1200, 900)), np.array([105.0, 130.0])
    for distance, tells in ((good_mm, True), (bad_mm, False)):
        azimuths, stated = [], []
        for seed in range(8):
            noisy = noisy_corners(view(10, 3, distance), 0.045, seed)
            fit = fit_page({i: noisy[i] for i in ids}, marker_corners())
            azimuths.append(view_angles(plane_pose(fit.px_from_mm, matrix), center)[0])
            stated.append(flat_sheet_position(fit, matrix, 0.0, center, matrix_is_known=True).azimuth_uncertainty_deg)
        azimuths, stated = np.array(azimuths), np.array(stated)
        assert np.mean(np.abs(azimuths - 10) <= stated) >= 0.75
        assert (azimuths > 0).all() == tells
        assert bool(np.median(stated) < 10) == tells and (stated[azimuths < 0] > 10).all()


def test_the_stated_uncertainty_covers_the_truth_in_photographs():
    piece = page_raster(make_manifest(), only_piece=True) * np.float32(0.97) + np.float32(0.02)
    rng, ratios = np.random.default_rng(5), []
    for seed in range(6):
        true = view(rng.uniform(-60, 60), rng.uniform(-25, 25), rng.uniform(350, 750), rng.uniform(-20, 20), (900, 700))
        look = dict(blur_px=rng.uniform(0, 1), noise=rng.uniform(0, 0.01), jpeg=int(rng.integers(65, 96)), seed=seed)
        photo = photograph(piece, true, (900, 700), light=rng.uniform(0.4, 0.95), **look)
        found = complete_markers(photo, find_markers(photo, frozenset(PIECE_IDS)), marker_corners())
        fit = fit_page({i: b.corners_px for i, b in found.markers.items()}, marker_corners())
        ratios.append(worst_error_mm(fit.px_from_mm, true) / corner_uncertainty_mm(fit, DESIGN_MM))
    # over 200 views of two kinds of pieces 95 to 97 %; six views allow for a miss, but never a wild one
    assert np.mean(np.array(ratios) <= 1) >= 0.8
    assert max(ratios) < 2.5 and np.median(ratios) > 0.2


def test_the_same_corners_give_the_same_bytes():
    corners = noisy_corners(view(20, 0, 500), 0.1)
    a, b = (fit_page(corners, marker_corners()) for _ in range(2))
    assert a.px_from_mm.tobytes() == b.px_from_mm.tobytes()
    assert corner_uncertainty_mm(a, DESIGN_MM) == corner_uncertainty_mm(b, DESIGN_MM)


def test_rectifying_at_the_photos_own_grid_is_the_photo():
    photo = np.random.default_rng(0).integers(0, 256, (50, 80, 3), np.uint8)
    flat = rectify(photo, np.diag([2.0, 2.0, 1.0]), (5.0, 10.0, 20.0, 10.0), 2.0)
    assert (flat == photo[20:40, 10:50]).all()


def test_fine_stripes_become_gray_instead_of_moire():
    stripes = np.zeros((400, 400, 1), np.float32)
    stripes[:, ::2] = 1
    flat = rectify(stripes, np.diag([10.0, 10.0, 1.0]), (2.0, 2.0, 30.0, 30.0), 1.7)
    assert flat == pytest.approx(0.5, abs=0.06)


def test_paper_and_ink_are_read_in_linear_light_through_blur():
    # page: paper 1, ink 0, then a veil of 2 %, times 0.6 of light
    piece = page_raster(make_manifest(), only_piece=True) * np.float32(0.98) + np.float32(0.02)
    photo = photograph(piece, view(20, 0, 400), blur_px=1.2, light=np.array([0.6, 0.5, 0.4]))
    light = frame_light(photo, find_markers(photo, frozenset(PIECE_IDS)).markers.values())
    assert light.paper == pytest.approx([0.6, 0.5, 0.4], rel=0.04)
    assert light.ink == pytest.approx(0.02 * np.array([0.6, 0.5, 0.4]), abs=0.012)
    assert light.clipped == 0
    bright = photograph(piece, view(20, 0, 400), blur_px=1.2, light=1.5)
    assert frame_light(bright, find_markers(bright, frozenset(PIECE_IDS)).markers.values()).clipped > 0.5


def test_an_affine_map_of_light_is_found_despite_one_bad_swatch():
    rng = np.random.default_rng(2)
    promised = rng.uniform(0, 1, (12, 3))
    matrix = np.array([[0.6, 0.05, 0.0], [0.02, 0.5, 0.03], [0.0, 0.1, 0.4]])
    seen = promised @ matrix.T + [0.02, 0.01, 0.03]
    assert affine12(seen, promised).undo(seen) == pytest.approx(promised, abs=1e-9)
    seen[4] = 0.9  # glare
    fitted = affine12(seen, promised).undo(seen)
    assert np.delete(fitted, 4, 0) == pytest.approx(np.delete(promised, 4, 0), abs=0.02)


def test_few_or_gray_swatches_hold_no_affine_map():
    gray = np.repeat(np.linspace(0, 1, 12)[:, None], 3, 1)
    assert affine12(gray, gray) is None
    assert affine12(np.random.default_rng(0).random((7, 3)), np.zeros((7, 3))) is None


def test_paper_and_ink_go_where_they_were_promised():
    fit = white_black(np.array([0.6, 0.5, 0.4]), np.array([0.05, 0.04, 0.06]), np.array([0.02, 0.02, 0.02]))
    assert fit.undo(np.array([0.6, 0.5, 0.4])) == pytest.approx(1.0)
    assert fit.undo(np.array([0.05, 0.04, 0.06])) == pytest.approx(0.02)
    white = white_black(np.full(3, 0.6), np.full(3, 0.05), np.array([1.0, 0.02, 0.02]))  # as a printer's file may say
    assert white.undo(np.full(3, 0.05)) == pytest.approx([1, 0.02, 0.02])


def test_markers_that_blur_made_larger_are_neither_noise_nor_an_error():
    """Three markers of a tilted sheet whose borders all lie 0.3 px too far out: the hidden corner stays put."""
    truth = np.array([[4.0, 0.6, 300], [-0.4, 3.5, 200], [1e-3, 4e-4, 1]])
    places = {1: (3, 3), 2: (127, 3), 3: (127, 127)}
    mm = {i: np.array([[0, 0], [20, 0], [20, 20], [0, 20.0]]) + at for i, at in places.items()}
    swollen = {}
    for i, corners in mm.items():
        px = apply_homography(truth, corners)
        along = np.roll(px, -1, 0) - px
        normal = np.stack([along[:, 1], -along[:, 0]], 1) / np.linalg.norm(along, axis=1, keepdims=True)
        out = normal + np.roll(normal, 1, 0)
        swollen[i] = px + 0.3 * out / (1 + (normal * np.roll(normal, 1, 0)).sum(1, keepdims=True))
    fit, hidden = fit_page(swollen, mm), np.array([[0.0, 150.0]])
    off_px = np.linalg.norm(apply_homography(fit.px_from_mm, hidden) - apply_homography(truth, hidden))
    assert off_px < 0.05  # measured 0.034; 0.72 where the swelling is left in


def test_markers_that_are_stretched_are_no_noise_and_twisted_ones_are():
    """Of 40 draws of noise 4 have a bend by chance; a smooth stretch of 1 px over a marker is one each time."""
    rng, bends = np.random.default_rng(1), []
    for _ in range(40):
        noise = rng.normal(0, 0.2, (4, 4, 2))
        bends.append(noise_and_bend(noise.reshape(-1, 2), noise, 23)[1] > 0)
        stretched = 0.5 * noise + STRETCH
        stated, bend = noise_and_bend(stretched.reshape(-1, 2), stretched, 23)
        assert bend > 0.2 and stated > 3 * bend
    assert sum(bends) <= 8


STRETCH = np.array([[-0.5, 0], [0.5, 0], [0.5, 0], [-0.5, 0]])[None] * np.array([1, -1, -1, 1])[:, None, None]
