"""Every code of a photograph: the last figure that passes, the first that does not, and advice for a person."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from synthetic_photos import PIECE_IDS, make_manifest, view

from patchproof.base.geometry import apply_homography, intrinsics
from patchproof.evidence import measure
from patchproof.evidence.appearance import MOST_NOISE
from patchproof.evidence.locate import FOCAL_ERROR, PinholePhoto, camera_pose
from patchproof.evidence.results import Geometry, Scale
from patchproof.evidence.surface import surface_of
from patchproof.photo.detect import MarkersInView
from patchproof.photo.edges import Borders
from patchproof.photo.rectify import PageFit, fit_page
from patchproof.photo.unroll import flat_sheet
from test_photo_rectify import marker_corners, noisy_corners
from test_verify_run import measured, shot

SURFACE = surface_of(make_manifest())
GOOD = dict(tilt_deg=10.0, blur_px=1.0, contrast=0.5, px_per_mm=2.0, residual_mm=0.05, corner_uncertainty_mm=0.05)
FLAT = {"homography_px_from_mm": np.eye(3).tolist()}


def trouble(markers=8, module_px=4.0, **figures):
    """What `measure` says of these figures, of a 140 mm piece."""
    borders = Borders(np.zeros((4, 2)), 1.0, module_px, True)
    found = MarkersInView({i: borders for i in PIECE_IDS[:markers]}, (), ())
    fit = PageFit(np.eye(3), np.eye(8), 0.05, PIECE_IDS[:markers])
    return measure._trouble(Geometry(**(GOOD | figures)), fit, found, SURFACE)


@pytest.mark.parametrize(
    ("code", "good", "bad"),
    [
        ("tilted", {"tilt_deg": 77.9}, {"tilt_deg": 78.1}),
        ("blurred", {"blur_px": 1.99}, {"blur_px": 2.01}),  # half a module of 4 px
        ("too_small", {"px_per_mm": 0.172}, {"px_per_mm": 0.171}),  # 24 px across 140 mm
        ("too_small", {"corner_uncertainty_mm": 1.49}, {"corner_uncertainty_mm": 1.51}),
        ("curled", {"residual_mm": 1.39}, {"residual_mm": 1.41}),
        ("curled", {"bend_mm": 0.27} | FLAT, {"bend_mm": 0.29} | FLAT),
        ("curled", {"bend_mm": 0.055, "curl_radius_mm": 100}, {"bend_mm": 0.057, "curl_radius_mm": 100}),
        ("curled", {"design_shift_mm": 0.69}, {"design_shift_mm": 0.71}),
    ],
)
def test_figures_at_both_sides_of_their_thresholds(code, good, bad):
    assert trouble(**good) is None
    cannot = trouble(**bad)
    assert cannot.code == code and len(cannot.advice) > 15
    assert cannot.figure is not None and cannot.threshold is not None


@pytest.mark.parametrize(
    ("tilt_deg", "figures", "advice"),
    [
        (63.0, {"corner_uncertainty_mm": 3.2}, "more squarely"),  # 1.45 mm seen straight
        (63.0, {"corner_uncertainty_mm": 3.4}, "come closer"),
        (63.0, {"px_per_mm": 0.116}, "more squarely"),  # 24.1 px seen straight
        (63.0, {"px_per_mm": 0.115}, "come closer"),
        (10.0, {"corner_uncertainty_mm": 1.6}, "come closer"),
    ],
)
def test_what_is_too_small_for_its_tilt_alone_is_to_be_looked_at_more_squarely(tilt_deg, figures, advice):
    cannot = trouble(tilt_deg=tilt_deg, **figures)
    assert cannot.code == "too_small" and advice in cannot.advice


def test_a_piece_that_is_made_to_bend_is_not_to_be_pressed_flat(monkeypatch):
    assert "press the sheet flat" in trouble(residual_mm=2.0).advice
    bent = make_manifest()
    bent = surface_of(bent.changed(settings=bent.settings | {"patch": {"bend": True}}))
    assert bent.bent and not SURFACE.bent
    monkeypatch.setattr(f"{__name__}.SURFACE", bent)
    for figures in ({"residual_mm": 2.0}, {"bend_mm": 0.3} | FLAT, {"design_shift_mm": 0.8}):
        assert "flat" not in trouble(**figures).advice and trouble(**figures).code == "curled"


def test_a_marker_off_the_plane_and_a_corner_that_is_not_seen_are_said():
    borders = Borders(np.zeros((4, 2)), 1.0, 4.0, True)
    found = MarkersInView(dict.fromkeys(PIECE_IDS, borders), (), ())
    for outlier_mm, code in ((0.55, None), (0.57, "curled")):
        fit = PageFit(np.eye(3), np.eye(8), 0.05, PIECE_IDS[1:], outlier_mm=outlier_mm)
        trouble = measure._trouble(Geometry(**GOOD), fit, found, SURFACE)
        assert (trouble and trouble.code) == code
    fit = PageFit(np.eye(3), np.eye(8), 0.05, PIECE_IDS)
    assert measure._trouble(Geometry(**GOOD), fit, found, SURFACE, 4) is None
    assert measure._trouble(Geometry(**GOOD), fit, found, SURFACE, 3).code == "too_few_markers"


@pytest.mark.parametrize(
    ("scale", "code"), [(0.9905, None), (0.9895, "scale_off"), (1.0095, None), (1.0105, "scale_off")]
)
def test_a_print_more_than_one_percent_off_is_scale_off(scale, code):
    remark = measure._print_check(False, Scale(scale_x=scale, scale_y=1.0), 300)
    assert remark.code == code and ("100 %" if code else "not counted") in remark.advice


def test_an_azimuth_that_corners_cannot_tell_is_not_measured():
    """The same sheet from 10° to the right: at 1.5 m the corners know it to 1°, at 8 m neither it nor how far it is."""
    matrix = intrinsics(40, (1200, 900))
    seen = PinholePhoto(np.zeros((900, 1200, 3), np.uint8), matrix, True, FOCAL_ERROR / 1.96)
    for distance, tells in ((1500, True), (12000, False)):
        corners = noisy_corners(view(10, 3, distance), 0.045)
        pose, _ = camera_pose(
            seen, flat_sheet(seen.srgb, fit_page(corners, marker_corners()), SURFACE.rect_mm), SURFACE
        )
        assert (pose.azimuth_deg is not None) == tells == (pose.azimuth_uncertainty_deg < 10)
        if tells:
            assert pose.azimuth_deg == pytest.approx(10, abs=2) and pose.distance_mm == pytest.approx(1500, rel=0.01)


def test_one_foreign_marker_is_clutter_two_or_one_of_this_sheet_twice_are_another_print(monkeypatch):
    borders = Borders(np.zeros((4, 2)), 1.0, 4.0, True)
    for foreign, doubled, code in (
        ((7,), (), None),
        ((7, 8), (), "several"),
        ((), (100,), "several"),
        ((), (100, 101), "several"),
    ):
        found = MarkersInView({i: borders for i in PIECE_IDS}, foreign, doubled)
        monkeypatch.setattr(measure, "find_sheet", lambda *_, found=found: found)
        if code is None:
            assert measure.identify_sheet(np.zeros((9, 9, 3), np.uint8), SURFACE)[0] is found
        else:
            with pytest.raises(measure.PhotoRejected, match="several_sheets: more than one sheet"):
                measure.identify_sheet(np.zeros((9, 9, 3), np.uint8), SURFACE)


@pytest.mark.parametrize("flip", [np.fliplr, np.flipud])
def test_a_mirrored_photo_or_print_is_known_whichever_way_it_is_held(flip):
    entry = measured(np.ascontiguousarray(flip(shot()))).entry
    assert (entry.status, entry.code) == ("rejected", "mirrored") and "mirror" in entry.remark.advice


def test_half_of_the_design_may_be_clipped():
    # in light of 2 a third of the piece is at full white, in light of 3 two thirds are
    assert measured(shot(light=2.0)).entry.code is None
    entry = measured(shot(light=3.0)).entry
    assert entry.code == "clipped" and entry.remark.figure > entry.remark.threshold == measure.MOST_CLIPPED


@pytest.mark.parametrize(("light", "noise", "code"), [(0.5, 0.01, None), (0.5, 0.08, "noisy"), (0.01, 0.0005, "noisy")])
def test_colors_that_noise_or_darkness_made_are_not_stated(light, noise, code):
    """Of a right print: what is stated is small."""
    entry = measured(shot(light=light, noise=noise)).entry
    assert (entry.status, entry.code, entry.color.delta_e00_mean is None) == ("measured", code, code is not None)
    assert entry.color.noise_delta_e00 > MOST_NOISE if code else entry.color.delta_e00_mean < 2


@pytest.mark.parametrize("light", [2.2, np.array([3, 1, 0.5])])
def test_paper_at_full_white_does_not_turn_the_map_of_colors(light):
    """With it as the fit's reference for white these state 3.5 and 6.6."""
    entry = measured(shot(light=light)).entry
    assert entry.code is None and entry.color.delta_e00_mean < 1


@pytest.mark.parametrize(
    ("share", "code"),
    [(0.0, None), (0.06, None), (0.2, "too_few_markers"), (0.3, "too_few_markers"), (0.4, "other_design")],
)
@pytest.mark.parametrize("cover", [40, 160, 235])
def test_a_design_that_is_partly_covered_is_not_another_one_and_its_colors_are_not_stated(share, code, cover):
    """With something in its middle; all of its corners show. Two fifths are too much to tell it."""
    look = shot()
    x, y, width, height = SURFACE.rect_mm
    middle, half = np.array([x + width / 2, y + height / 2]), np.sqrt(share) * np.array([width, height]) / 2
    corners_px = apply_homography(
        view(10, 5, 550, size_px=(800, 600)), middle + half * [[-1, -1], [1, -1], [1, 1], [-1, 1]]
    )
    if share:
        cv2.fillPoly(look, [np.round(corners_px).astype(np.int32)], (cover, cover, 0.9 * cover))
    found = measured(look)
    assert (found.entry.code, found.counted) == (code, code != "other_design") and (found.entry.color is None) == (
        code is not None
    )
    assert code != "too_few_markers" or found.entry.remark.advice == "part of the design is covered: show all of it"
