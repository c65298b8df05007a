"""A print without markers is found by its design: the smallest that is, and what is rejected by name."""

from __future__ import annotations

from functools import cache

import cv2
import find_trials
import numpy as np
import pytest
import synthetic_photos as paper

from patchproof.base.geometry import apply_homography, rect_corners
from patchproof.channel.printer import load_printer
from patchproof.evidence.locate import pinhole_photo
from patchproof.evidence.measure import measure
from patchproof.evidence.surface import printed_colors, surface_of
from patchproof.evidence.task import promised_ranges
from patchproof.photo import detect
from patchproof.photo.design_places import SMALLEST_PRINT_PX
from patchproof.photo.find_design import _refiners, find_design, refuse_other_order
from patchproof.photo.read import Photo
from patchproof.photo.rejection import PhotoRejected
from patchproof.sheets.markers import aruco_dictionary

SIZE_PX, FINE = (480, 360), 3


def blocks(seed: int) -> np.ndarray:
    """Blocks of few colors, which look alike."""
    rng = np.random.default_rng(seed)
    return rng.integers(0, 256, (6, 3), np.uint8)[rng.integers(0, 6, (12, 12))]


def smooth(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return cv2.resize(rng.integers(0, 256, (8, 8, 3), np.uint8), (64, 64), interpolation=cv2.INTER_CUBIC)


def sign(lettered: bool = True) -> np.ndarray:
    """A red disc on white; its letters look nearly alike when turned and mirrored."""
    design = cv2.circle(np.full((200, 200, 3), 255, np.uint8), (199, 199), 120, (220, 30, 40), -1, shift=1)
    if lettered:
        cv2.putText(design, "GO", (63, 116), cv2.FONT_HERSHEY_SIMPLEX, 1.5, (255, 255, 255), 8)
    return design


@cache
def wall() -> tuple[np.ndarray, np.ndarray]:
    """A rough wall, `FINE` times as large as photographs are, and their noise."""
    rng = np.random.default_rng(0)
    walls = [cv2.resize(rng.uniform(60, 190, (n, n, 3)), SIZE_PX, interpolation=cv2.INTER_CUBIC) for n in (6, 30, 120)]
    return cv2.resize(np.mean(walls, 0, np.float32), None, fx=FINE, fy=FINE), rng.normal(0, 2, (*SIZE_PX[::-1], 3))


def photograph(*prints: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Designs at corners 4×2 px on a rough wall: paler, in another tone, with less chroma, blurred and noisy."""
    picture, noise = wall()
    for design, corners_px in prints:
        codes = cv2.resize(design, (240, 240), interpolation=cv2.INTER_NEAREST) / 255.0
        codes = (255 * (0.12 + 0.7 * (0.6 * codes + 0.4 * codes.mean(2, keepdims=True)) ** 1.4)).astype(np.float32)
        outline = np.array([[0, 0], [240, 0], [240, 240], [0, 240]], np.float32)
        to_px = cv2.getPerspectiveTransform(outline - 0.5, (FINE * corners_px - 0.5).astype(np.float32))
        size = picture.shape[1::-1]
        inside = cv2.warpPerspective(np.ones((240, 240), np.float32), to_px, size)[..., None]
        picture = picture * (1 - inside) + inside * cv2.warpPerspective(
            codes.astype(np.float32), to_px, size, borderMode=1
        )
    picture = cv2.GaussianBlur(cv2.resize(picture, SIZE_PX, interpolation=cv2.INTER_AREA), (0, 0), 0.7)
    return np.clip(picture + noise, 0, 255).round().astype(np.uint8)


def corners(side_px: float, middle=(230, 180), turn_deg: float = 12.0) -> np.ndarray:
    """A square of about this side, turned and seen from aside."""
    quad = side_px * np.array([[-0.5, -0.47], [0.5, -0.53], [0.5, 0.53], [-0.5, 0.47]])
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    return quad @ np.array([[c, s], [-s, c]]) + middle


def rejection_of(srgb: np.ndarray, design: np.ndarray) -> PhotoRejected:
    with pytest.raises(PhotoRejected) as caught:
        find_design(srgb, design, (100.0, 100.0))
    return caught.value


@pytest.mark.parametrize(("design", "side_px"), [(blocks(1), 64), (blocks(2), 170), (smooth(1), 110)])
def test_a_design_is_found_to_a_pixel(design, side_px):
    expected = corners(side_px)
    found = find_design(photograph((design, expected)), design, (100.0, 100.0))
    assert found.located == "found"
    off_px = np.abs(found.px - expected)
    assert off_px.max() < 1 and off_px.max() < 4 * found.sigma_px


def test_a_proposal_an_eighth_of_the_side_off_is_refined_and_not_given_up():
    expected, around = corners(150), np.arange(8) * np.pi / 4
    refiner, _ = _refiners(photograph((blocks(2), expected)), blocks(2), (100.0, 100.0))
    for proposed in expected + 150 / 8 * np.column_stack([np.cos(around), np.sin(around)])[:, None]:
        place = refiner.refine(proposed)
        assert place is not None and place.accepted and np.abs(place.corners_px - expected).max() < 1


@pytest.mark.parametrize("number", [439, 448])
def test_corners_are_not_drawn_off_by_what_changes_slowly_over_a_print(number, data):
    """Parts of photographs, off by 11 and 2.4 px where corners took in all that changes over a third of the print."""
    assert data.is_dir() and find_trials.trial(number, True, [], [])["off_px"] < 0.8


def test_a_print_of_few_colors_is_found_where_inks_mix_its_channels(data):
    """Blocks of four colors: in each channel alone, the photograph is like them by 0.4."""
    assert data.is_dir() and find_trials.trial(318, True, [], [])["off_px"] < 1.5


def test_the_first_bad_size_says_so():
    trouble = rejection_of(photograph((blocks(1), corners(55))), blocks(1))
    assert trouble.code == "too_small" and trouble.figure == pytest.approx(55, abs=2)
    assert trouble.threshold == SMALLEST_PRINT_PX


def test_a_print_upside_down_is_found():
    expected = corners(120, turn_deg=170)
    assert np.abs(find_design(photograph((blocks(3), expected)), blocks(3), (100.0, 100.0)).px - expected).max() < 1


def test_other_designs_mirrored_ones_and_two_prints_are_rejected_by_name():
    assert rejection_of(photograph((blocks(4), corners(140))), blocks(5)).code == "no_corners"
    assert rejection_of(photograph((blocks(4)[:, ::-1], corners(140))), blocks(4)).code == "mirrored"
    two = photograph((blocks(4), corners(110, (110, 170))), (blocks(4), corners(110, (330, 180))))
    assert rejection_of(two, blocks(4)).code == "several_sheets"


def test_a_mirrored_sign_is_none_that_lies_upside_down():
    expected = corners(110)
    found = find_design(photograph((sign(), expected)), sign(), (100.0, 100.0))
    assert np.abs(found.px - expected).max() < 1
    mirrored = photograph((sign()[:, ::-1], expected))
    assert rejection_of(mirrored, sign()).code == "mirrored"


def test_a_part_of_a_sign_or_its_negative_is_not_taken_for_the_whole():
    assert rejection_of(photograph((sign(), corners(620))), sign()).code == "no_corners"  # in a picture of 460 × 360 px
    assert rejection_of(photograph((255 - sign(), corners(160))), sign()).code in ("no_corners", "several_sheets")


@pytest.mark.parametrize(("design", "turn"), [(sign(), 1), (blocks(6), 2), (smooth(2), 3)])
def test_corners_named_in_another_order_are_refused_unless_the_design_looks_alike_when_turned(design, turn):
    srgb, named = photograph((design, corners(150))), corners(150) + 2.0
    refuse_other_order(srgb, design, (100.0, 100.0), named)
    with pytest.raises(PhotoRejected, match="named in another order"):
        refuse_other_order(srgb, design, (100.0, 100.0), np.roll(named, turn, 0))


def test_corners_of_a_disc_may_be_named_in_any_order():
    disc = sign(lettered=False)
    refuse_other_order(photograph((disc, corners(150))), disc, (100.0, 100.0), np.roll(corners(150), 1, 0))


def test_a_print_that_was_found_is_measured_like_one_whose_corners_were_named():
    design = (255 * paper.noisy_design(0)).astype(np.uint8)
    surface = surface_of(paper.make_manifest(design=design)).without_markers
    promised = printed_colors(design, surface, load_printer("coated"))
    page = np.full((2000, 1750, 3), 0.2, np.float32)
    page[600:, 350:] = promised.design.repeat(10, 0).repeat(10, 1)
    px_from_mm = paper.view(25, 15, 480, size_px=SIZE_PX)
    view = pinhole_photo(
        Photo(paper.photograph(page, px_from_mm, SIZE_PX, blur_px=0.8, noise=0.004, fine=2), None), None
    )
    parts = "a.jpg", surface, promised, promised_ranges(())
    entry = measure(view, *parts, with_pictures=False, find=design).entry
    assert (entry.status, entry.located) == ("measured", "found")
    found = apply_homography(np.array(entry.geometry.homography_px_from_mm), rect_corners(paper.DESIGN_MM))
    assert np.abs(found - apply_homography(px_from_mm, rect_corners(paper.DESIGN_MM))).max() < 0.7


def test_among_many_squares_a_marker_is_read_as_opencv_reads_it():
    """In a block design of 40 × 30, whose squares are compared only with codes that some of them resemble."""
    cells = np.random.default_rng(0).integers(0, 256, (30, 40), np.uint8)
    picture, aruco = cells.repeat(24, 0).repeat(24, 1), aruco_dictionary(detect.DICTIONARY)
    assert detect.detect_markers(picture, aruco, detect.detector_settings())[1] is None
    picture[200:400, 200:400] = 255
    picture[230:370, 230:370] = cv2.aruco.generateImageMarker(aruco, 7, 140)
    quads, ids, *_ = detect.detect_markers(picture, aruco, detect.detector_settings())
    around = picture[160:440, 160:440]  # of all squares OpenCV's reading would take its time
    theirs, _, _ = cv2.aruco.ArucoDetector(aruco, detect.detector_settings()).detectMarkers(around)
    assert ids.ravel().tolist() == [7] and np.allclose(quads[0], theirs[0] + 160, atol=1e-3)
