"""The piece: ids, layout, the frame's raster, and controls."""

import subprocess
import sys

import cv2
import numpy as np
import pytest

from patchproof.color import linear_from_srgb, srgb_from_linear
from patchproof.sheets.piece import (
    KINDS,
    black_runs,
    control_design,
    frame_image,
    frame_mm,
    hash_order,
    lay_out_piece,
    marker_ids,
    marker_rects_mm,
    marker_size_mm,
    sheet_id,
)
from patchproof.strict import Refused

ID = "A1B2C3D4E5"


def rects_of(piece):
    """Design, markers and swatches as x0, y0, x1, y1."""
    x, y, w, h = piece.design_rect_mm
    rects = [(x, y, x + w, y + h)]
    rects += [(*m.corners_mm[0], *m.corners_mm[2]) for m in piece.markers]
    return rects + [(x, y, x + w, y + h) for (x, y, w, h), _ in piece.swatches]


def white_between(a, b):
    """The larger of the gaps along x and y: negative where two rectangles overlap."""
    return max(max(a[i] - b[i + 2], b[i] - a[i + 2]) for i in (0, 1))


def test_sheet_id_is_ten_characters_that_never_change():
    # written down once; another value would orphan every sheet ever printed
    assert sheet_id({"b": 1.0, "a": [1, "x"]}, 3) == sheet_id({"a": [1, "x"], "b": 1.0}, 3) == "QN1RBZLCDM"
    assert sheet_id({"a": 1}, 0) != sheet_id({"a": 1}, 1) != sheet_id({"a": 2}, 1)


def test_marker_ids_never_change_and_grow_by_appending():
    assert marker_ids(ID, "design", 4) == [295, 626, 539, 749]
    assert marker_ids(ID, "design", 12)[:4] == marker_ids(ID, "design", 4)


def test_kinds_of_one_sheet_share_no_id():
    ids = [i for kind in KINDS for i in marker_ids(ID, kind, 166)]
    assert len(ids) == len(set(ids)) == 6 * 166
    assert 0 <= min(ids) and max(ids) < 1000


def test_marker_ids_refuse_too_many_and_unknown_kinds():
    with pytest.raises(Refused, match="at most 166 markers"):
        marker_ids(ID, "design", 167)
    with pytest.raises(Refused, match='did you mean "gray"'):
        marker_ids(ID, "grayy", 4)


def test_ids_do_not_depend_on_the_hash_seed():
    code = (
        "from patchproof.sheets.piece import marker_ids, sheet_id; "
        "print(sheet_id({'a': 1, 'b': 2}, 0), marker_ids('A1B2C3D4E5', 'noise', 5))"
    )
    runs = {
        subprocess.run(
            [sys.executable, "-c", code], env={"PYTHONHASHSEED": seed, "PYTHONPATH": ":".join(sys.path)},
            capture_output=True, text=True, check=True,
        ).stdout
        for seed in ("0", "1")
    }  # fmt: skip
    assert len(runs) == 1


def test_hash_order_is_a_permutation():
    assert sorted(hash_order("x", 50)) == list(range(50)) != list(hash_order("x", 50))


@pytest.mark.parametrize("design_mm", [(110, 110), (40, 40), (60, 140), (140, 20), (9, 9)])
@pytest.mark.parametrize("marker_mm", [8.0, 13.7, 20.0])
def test_everything_in_the_frame_is_a_module_apart_and_within_the_scissors_margin(design_mm, marker_mm):
    piece = lay_out_piece(design_mm, marker_mm, ID, "design")
    module = marker_mm / 7
    rects = rects_of(piece)
    for i, a in enumerate(rects):
        for b in rects[:i]:
            assert white_between(a, b) >= module - 1e-9
        inset = min(a[0], a[1], piece.size_mm[0] - a[2], piece.size_mm[1] - a[3])
        assert inset >= 2 + module - 1e-9
    assert len({m.id for m in piece.markers}) == len(piece.markers)


def test_hand_numbers_of_a_piece():
    # 110 mm design, 19 mm markers: frame 19 × 9/7 + 2 = 26.4286, piece 162.857
    piece = lay_out_piece((110, 110), 19, ID, "design")
    assert piece.size_mm == pytest.approx((162.857143, 162.857143))
    assert piece.design_rect_mm == pytest.approx((26.428571, 26.428571, 110, 110))
    assert np.array(piece.markers[0].corners_mm) == pytest.approx(
        np.array([[0, 0], [19, 0], [19, 19], [0, 19]]) + 2 + 19 / 7
    )
    assert (len(piece.markers), len(piece.swatches)) == (8, 12)
    assert len({srgb for _, srgb in piece.swatches}) == 12


@pytest.mark.parametrize(("design_mm", "markers"), [((20, 20), 8), ((20, 19.9), 6), ((19.9, 20), 6), ((19, 19), 4)])
def test_mid_edge_markers_come_where_a_side_is_as_long_as_a_marker(design_mm, markers):
    assert len(lay_out_piece(design_mm, 20, ID, "design").markers) == markers


def test_swatches_are_as_large_as_fit_and_fewer_where_four_millimeters_do_not():
    # 40 mm design, 20 mm markers: runs (40 + 2q - 20 - 2q) / 2 - q with q = 20/7, so 10 - 20/7 = 7.142857; one in each
    small = lay_out_piece((40, 40), 20, ID, "design").swatches
    assert len(small) == 8 and {round(rect[2], 6) for rect, _ in small} == {7.142857}
    assert lay_out_piece((21, 21), 20, ID, "design").swatches == ()
    # 110 mm: runs of 45 - q = 42.1429 hold two of (42.1429 - q) / 2 = 19.6429
    assert lay_out_piece((110, 110), 20, ID, "design").swatches[0][0][2] == pytest.approx(19.642857)


def test_each_side_has_three_swatches_one_of_them_gray():
    piece = lay_out_piece((110, 110), 19, ID, "design")
    x, y, _, h = piece.design_rect_mm
    sides = {"top": [], "bottom": [], "left": [], "right": []}
    for (sx, sy, sw, sh), srgb in piece.swatches:
        name = "top" if sy + sh < y else "bottom" if sy > y + h else "left" if sx + sw < x else "right"
        sides[name].append(srgb)
    for colors in sides.values():
        assert len(colors) == 3
        assert sum(len(set(c)) == 1 and 0 < c[0] < 1 for c in colors) == 1


def test_marker_size_is_what_is_needed_else_what_fits_else_refused():
    assert marker_size_mm(12.3, (110, 110), (166, 170)) == 12.3
    assert marker_size_mm(2, (110, 110), (166, 170)) == 8
    # (166 - 110) / 2 = 28 mm of frame; (28 - 2) × 7/9 = 20.22
    assert marker_size_mm(40, (110, 110), (166, 170)) == 20.2
    assert 110 + 2 * frame_mm(20.2) <= 166 < 110 + 2 * frame_mm(20.3)
    with pytest.raises(Refused, match="at most 141 × 145 mm, beside 8 mm markers, got 150 × 20 mm"):
        marker_size_mm(19, (150, 20), (166, 170))


def test_marker_rects_cover_opencv_s_own_picture():
    piece = lay_out_piece((50, 50), 14, ID, "design")
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_1000)
    for marker in piece.markers:
        drawn = np.full((70, 70), 255)
        for x, y, w, h in marker_rects_mm(marker):
            x, y = (x - marker.corners_mm[0][0]) * 5, (y - marker.corners_mm[0][1]) * 5
            drawn[round(y) : round(y + h * 5), round(x) : round(x + w * 5)] = 0
        assert np.array_equal(drawn, cv2.aruco.generateImageMarker(dictionary, marker.id, 70))


def test_black_runs():
    dark = np.array([[0, 1, 1, 0, 1], [0, 0, 0, 0, 0], [1, 1, 1, 1, 1]], bool)
    assert black_runs(dark, (10, 20), 2) == [(12, 20, 4, 2), (18, 20, 2, 2), (10, 24, 10, 2)]


@pytest.mark.parametrize("design_px", [(64, 64), (113, 71), (300, 300)])
def test_frame_image_is_the_mean_light_of_a_supersampled_frame(design_px):
    """Slow twin: point samples, 24 × 24 in each pixel."""
    piece = lay_out_piece((60, 41), 11, ID, "design")
    frame = frame_image(piece, design_px)
    n = 24 if max(design_px) < 200 else 8
    height, width = frame.srgb.shape[:2]
    scale = np.array(design_px) / piece.design_rect_mm[2:]
    x = ((np.arange(width * n) + 0.5) / n - frame.piece_box_px[0]) / scale[0]
    y = ((np.arange(height * n) + 0.5) / n - frame.piece_box_px[1]) / scale[1]
    linear = np.ones((height * n, width * n, 3), np.float32)
    rects = [(rect, (0, 0, 0)) for marker in piece.markers for rect in marker_rects_mm(marker)]
    for (rx, ry, rw, rh), srgb in [*rects, *piece.swatches]:
        inside = np.ix_((y >= ry) & (y < ry + rh), (x >= rx) & (x < rx + rw))
        linear[inside] = linear_from_srgb(np.array(srgb))
    mean = linear.reshape(height, n, width, n, 3).mean((1, 3))
    dx, dy, dw, dh = frame.design_box_px
    mean[dy : dy + dh, dx : dx + dw] = linear_from_srgb(np.array(0.5))
    # a straight edge through n × n samples is off by at most half a sample in each direction
    assert np.abs(linear_from_srgb(frame.srgb.astype(float)) - mean).max() < 1.01 / n
    assert np.abs(linear_from_srgb(frame.srgb.astype(float)).mean() - mean.mean()) < 1e-3


def test_frame_image_conserves_ink():
    """Sum of darkness in px² = black area in mm² × px²/mm², whatever the grid."""
    piece = lay_out_piece((60, 41), 11, ID, "design")
    frame = frame_image(piece, (97, 53))
    x, y, w, h = frame.design_box_px
    dark = 1 - linear_from_srgb(frame.srgb.astype(float))
    dark[y : y + h, x : x + w] = 0
    area = sum(w * h for m in piece.markers for _, _, w, h in marker_rects_mm(m)) * np.ones(3)
    area += sum(w * h * (1 - linear_from_srgb(np.array(srgb))) for (_, _, w, h), srgb in piece.swatches)
    # 2e-5: the image is float32 sRGB
    assert dark.sum((0, 1)) == pytest.approx(area * 97 / 60 * 53 / 41, rel=2e-5)


def test_frame_image_puts_the_design_on_its_own_pixel_grid():
    piece = lay_out_piece((110, 55), 19, ID, "design")
    frame = frame_image(piece, (220, 110))  # 2 px/mm: frame of 26.4286 mm is 52.857 px, so 53 whole pixels
    assert frame.design_box_px == (53, 53, 220, 110)
    assert frame.piece_box_px == pytest.approx((1 / 7, 1 / 7, 325 + 6 / 7, 215 + 6 / 7))
    assert frame.srgb.dtype == np.float32 and frame.srgb.shape == (216, 326, 3)
    assert (frame.srgb[53:163, 53:273] == 0.5).all() and (frame.srgb[50:53] != 0.5).all()


def photo_like_design():
    y, x = np.mgrid[:100, :70]
    return np.stack([x * 3, y * 2, (x * y) % 256], -1).astype(np.uint8)


def test_mean_control_is_averaged_in_light():
    design = np.zeros((10, 10, 3), np.uint8)
    design[:5] = 255
    # half the light is sRGB 0.7354, code 188, not 128
    assert (control_design("mean", design, ID) == 188).all()
    assert srgb_from_linear(np.array(0.5)) * 255 == pytest.approx(187.5, abs=0.1)


def test_shuffled_control_has_the_same_pixels_in_other_places():
    design = photo_like_design()
    shuffled = control_design("shuffled", design, ID)
    assert not np.array_equal(shuffled, design)
    for a, b in zip(shuffled.reshape(-1, 3).T, design.reshape(-1, 3).T, strict=True):
        assert np.array_equal(np.sort(a), np.sort(b))
    # 100 × 70 px: cells of 6 × 4, and each cell is one of the design's own
    cells = {design[r * 6 : r * 6 + 6, c * 4 : c * 4 + 4].tobytes() for r in range(16) for c in range(16)}
    assert {shuffled[r * 6 : r * 6 + 6, c * 4 : c * 4 + 4].tobytes() for r in range(16) for c in range(16)} == cells


def test_noise_control_is_uniform_and_follows_the_sheet_id():
    design = np.zeros((256, 512, 3), np.uint8)
    noise = control_design("noise", design, ID)
    cells = noise[8::16, 8::16]
    assert cells.shape == (16, 32, 3)
    assert np.array_equal(np.kron(cells, np.ones((16, 16, 1), np.uint8)), noise)
    # 1536 uniform bytes: mean 127.5 ± 4 × 73.9 / √1536
    assert abs(cells.mean() - 127.5) < 7.6
    assert np.array_equal(noise, control_design("noise", design, ID))
    assert not np.array_equal(noise, control_design("noise", design, "A1B2C3D4E6"))


@pytest.mark.parametrize("size", [(1, 1), (5, 3), (17, 100)])
@pytest.mark.parametrize("kind", KINDS)
def test_controls_have_the_design_s_size_however_small(size, kind):
    design = np.arange(size[0] * size[1] * 3, dtype=np.uint8).reshape(*size, 3)
    control = control_design(kind, design, ID)
    assert control.shape == design.shape and control.dtype == np.uint8


def test_plain_controls():
    design = photo_like_design()
    assert (control_design("gray", design, ID) == 128).all()
    assert (control_design("blank", design, ID) == 255).all()
    assert np.array_equal(control_design("design", design, ID), design)
    with pytest.raises(Refused, match='did you mean "noise"'):
        control_design("noisy", design, ID)
