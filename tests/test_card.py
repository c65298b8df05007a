"""A bank card in its outline gives a photograph its scale, or a reason why it does not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import card_photo
from patchproof.channel import lens
from patchproof.color import linear_from_srgb
from patchproof.evidence.camera import _turned, view_of
from patchproof.evidence.surface import surface_of
from patchproof.geometry import apply_homography, intrinsics, look_at, normalized, plane_homography
from patchproof.photo.card import _sizes, card_scale
from patchproof.photo.card_lines import CARD_MM, LEAST_PX_PER_MM, NoCard
from patchproof.photo.complete import complete
from patchproof.photo.detect import find_markers
from patchproof.photo.quality import blur_px, frame_light
from patchproof.photo.ratio import x_over_y
from patchproof.photo.read import Photo
from patchproof.photo.rectify import fit_page
from patchproof.sheets.blank import blank_sheet
from patchproof.sheets.manifest import load_manifest
from patchproof.sheets.raster import page_pixels

SIZE_PX = (900, 700)


@pytest.fixture(scope="module")
def sheet(tmp_path_factory):
    """The manifest's surface and the printed page as linear light at 10 px per mm."""
    pdf = tmp_path_factory.mktemp("sheet") / "blank.pdf"
    blank_sheet("blank_a4", pdf)
    page = linear_from_srgb(page_pixels(pdf, 1, 254) / 255.0) * 0.93
    return surface_of(load_manifest(pdf.with_suffix(".json"))), page.astype(np.float32)


def taken(sheet, scale=(1.0, 1.0), tilt=15.0, toward=60.0, px_per_mm=3.4, focal=1000.0, card=(), **look):
    """(picture, matrix) of the page printed at `scale` with a card laid a little askew; card=None lays none."""
    surface, page = sheet
    scale = np.array(scale)
    x, y, w, h = surface.card_mm
    middle = np.array([x + w / 2, y + h / 2]) * scale
    laid = (
        None
        if card is None
        else card_photo.Card(**{"middle": tuple(middle + np.array([0.2, -0.15])), "turn_deg": 0.5, **dict(card)})
    )
    rotation, eye = card_photo.pose(tilt, toward, focal / px_per_mm, 3, middle + np.array([38, -25]))
    settings = {"fine": 2, "blur": 0.6, "noise": 0.004, "jpeg": 88, "gamma": 2.3, **look}
    picture = card_photo.photo(page, 10, scale, laid, rotation, eye, focal, SIZE_PX, **settings)
    return picture, np.array([[focal, 0, SIZE_PX[0] / 2], [0, focal, SIZE_PX[1] / 2], [0, 0, 1.0]])


def measured(sheet, picture, matrix, focal_error=0.005):
    surface = sheet[0]
    found = find_markers(picture, surface.piece_ids, frozenset(surface.corners_mm))
    found = complete(picture, found, surface.corners_mm)
    fit = fit_page({i: b.corners_px for i, b in found.markers.items() if b.fitted}, surface.corners_mm)
    borders = found.markers.values()
    return card_scale(
        picture,
        fit.px_from_mm,
        surface.card_mm,
        surface.printed_mm,
        matrix,
        focal_error,
        blur_px(borders),
        frame_light(picture, borders).paper,
        x_over_y(fit, matrix, focal_error),
    )


@pytest.mark.parametrize(
    ("scale", "tilt", "toward", "card"),
    [
        ((0.94, 1.05), 5, 0, {"seed": 3, "wall": None}),
        (
            (1.06, 0.97),
            20,
            130,
            {"seed": 8, "wall": 0.6},
        ),  # a frame is printed on this one, and all of the outline shows
        ((1.0, 1.0), 38, 80, {"seed": 7, "wall": 0.3}),  # a dark side wall of 0.6 mm shows, as wide as 1.1 %
    ],
)
def test_the_scale_is_right_to_half_a_percent_along_both_axes(sheet, scale, tilt, toward, card):
    told = measured(sheet, *taken(sheet, scale, tilt, toward, card=card))
    assert told.x == pytest.approx(scale[0], rel=0.005) and told.y == pytest.approx(scale[1], rel=0.005)
    assert max(abs(told.x / scale[0] - 1), abs(told.y / scale[1] - 1)) < told.uncertainty < 0.01


@pytest.mark.parametrize(
    ("card", "words"),
    [
        (None, "no bank card stands out|do not make an ID-1 card"),  # the outline alone would be read as exactly 1
        ({"size": (85.6, 51.0)}, "ID-1"),
    ],
)
def test_no_card_or_another_shape_gives_no_scale_but_a_reason(sheet, card, words):
    with pytest.raises(NoCard, match=words):
        measured(sheet, *taken(sheet, card=card, tilt=5))


def test_too_few_pixels_are_refused_with_their_figure(sheet):
    with pytest.raises(NoCard, match="px per mm at the card are too few"):
        measured(sheet, *taken(sheet, px_per_mm=LEAST_PX_PER_MM * 0.95))


def test_a_card_of_true_size_at_scale_1_and_smaller_paper_makes_it_larger():
    card = np.array([[0, 0], [CARD_MM[0], 0], CARD_MM, [0, CARD_MM[1]]])
    assert _sizes(card)[:2] == pytest.approx((1, 1))
    # on a page printed at 0.95 × 1.04 a card spans 85.60 / 0.95 of the page's own millimetres
    assert _sizes(card / [0.95, 1.04])[:2] == pytest.approx((0.95, 1.04))


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
    for px, py in lens.distort_points(dots, camera, size_px):
        picture[(x - px) ** 2 + (y - py) ** 2 < 64] = 10
    assert np.abs(lens.distort_points(dots, camera, size_px) - dots).max() > 3
    view = view_of(Photo(picture, None, Path("a")), camera)
    dark = 255.0 - view.photo.srgb[..., 0]
    dark[dark < 60] = 0
    for px, py in dots:
        near = dark * ((np.abs(x - px) < 15) & (np.abs(y - py) < 15))
        assert (near * x).sum() / near.sum() == pytest.approx(px, abs=0.25)
        assert (near * y).sum() / near.sum() == pytest.approx(py, abs=0.25)
    assert view.calibrated and view.matrix_px == pytest.approx(lens.matrix_px(camera, size_px))


def test_a_turned_camera_bends_turned_points():
    camera = PHONE.model_copy(update={"cx": 1980.0, "cy": 1530.0, "p1": 2e-3, "p2": -1e-3})
    points = np.array([[100.0, 200], [3900, 250], [2500, 2800]])
    turn = lambda p: np.column_stack([3000 - p[:, 1], p[:, 0]])  # noqa: E731
    bent = lens.distort_points(turn(points), _turned(camera), (3000, 4000))
    assert bent == pytest.approx(turn(lens.distort_points(points, camera, (4000, 3000))), abs=1e-6)


def test_a_picture_of_another_shape_is_another_camera_s():
    photo = Photo(np.zeros((500, 800, 3), np.uint8), 700.0, Path("a"))
    view = view_of(photo, PHONE)
    assert not view.calibrated and view.matrix_px[0, 0] == 700.0
    assert view_of(replace(photo, focal_px=None), None).matrix_px is None
    assert normalized(view.matrix_px)[0, 2] == 400
